"""What training writes and every other command reads: networks, input statistics and their contract."""

from pixel2catch.policy.contract import AgentContract as AgentContract
from pixel2catch.policy.contract import PolicyContract as PolicyContract
from pixel2catch.policy.contract import contract_of as contract_of
from pixel2catch.policy.contract import leaves as leaves
from pixel2catch.policy.contract import method_of as method_of
from pixel2catch.policy.policy import HIDDEN as HIDDEN
from pixel2catch.policy.policy import Policy as Policy
from pixel2catch.policy.policy import build_mlp as build_mlp
