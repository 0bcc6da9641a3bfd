"""The controller gives what the environment gives: the same joint targets from the same measurements."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from paper_robot import JOINTS
from pixel2catch.deployment.policy_pipeline import PolicyController
from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg, Step
from pixel2catch.errors import PolicyMismatchError
from pixel2catch.mdp.control_step import BoxHistory, Measurement
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.tensors import clone
from pixel2catch.methods import find_method
from pixel2catch.policy import Policy, contract_of
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.shipped import shipped_policies
from pixel2catch.workcells import find_workcell
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

STEADY_ACTIONS = RandomizationCfg(action_noise=0.0, action_bias=0.0)
"""The environment adds this noise after the policy, so that no controller can reproduce it."""

HEIGHT = len(JOINTS) + 2
WITHOUT_AGES = ("proposed", "only_wh", "single_agent", "journal")
WITH_AGES = ("shared_reward+boxes", "shared_reward+fit", "catch_alone+anycamera")
LATE_AND_MISSING = SensingCfg(
    latency_steps=(0.6, 4.3),
    latency_grid=0.0,
    drop_rate=0.3,
    blackout_steps=4,
    clock_error=0.01,
    stamp_jitter=0.004,
    unstamped=0.3,
)
HOME = torch.tensor([[joint.home for joint in JOINTS]])
BOX = BoxHistory.begun(torch.tensor([[310.0, 200.0, 330.0, 225.0]]), torch.tensor([1.5]), 1)


def policy_of(method: str) -> Policy:
    """The shipped policy of a method, or one with random networks, whose actions fill their range."""
    folder = shipped_policies().get(method)
    if folder is not None:
        return Policy.load(folder)
    torch.manual_seed(0)
    policy = Policy(contract_of(find_method(method))).eval()
    with torch.no_grad():
        for network in (policy.network(name) for name in policy.contract.agents):
            network.get_parameter("network.6.weight").mul_(20.0)
    return policy


def steps(env: CatchEnv, policy: Policy) -> Iterator[Step]:
    """The environment's steps under its own observations; in the first one the object is lost."""
    observation = env.reset()
    env.world.simulation.bind("qpos")[:, HEIGHT] = 0.1
    while True:
        step = env.step(policy.act(observation.policy))
        observation = step.observation
        yield step


def require_parity(method: str, sensing: SensingCfg, most: float) -> list[BoxHistory]:
    """Compare whole episodes of one robot, with all sensor noise and a reset; return the boxes of all steps.

    Targets may differ by `most` [rad].
    """
    policy = policy_of(method)
    controller = PolicyController(policy_of(method), UR5E_ALLEGRO)
    cfg = CatchEnvCfg(randomization=STEADY_ACTIONS, sensing=sensing)
    env = CatchEnv(cfg, find_method(method), num_envs=1, seed=3)
    given, boxes, num_ended = None, list[BoxHistory](), 0
    for step in steps(env, policy):
        if given is not None:
            assert (given - step.joint_pos_target).abs().max() <= most, f"at step {len(boxes)}"
        if step.terminated.all():
            num_ended += 1
            controller.reset(step.measurement.joint_pos_target.clone())
        if num_ended > 1:
            break
        sensed = clone(step.measurement)
        given = controller.step(sensed.joint_pos, sensed.boxes)
        boxes.append(sensed.boxes)
    env.close()
    assert len(boxes) > 20
    return boxes


@pytest.mark.parametrize("method", WITHOUT_AGES)
def test_targets_are_those_of_the_environment_bit_for_bit(method: str):
    require_parity(method, SensingCfg(), most=0.0)


@pytest.mark.parametrize("method", WITH_AGES)
def test_targets_of_policies_with_ages_are_those_of_the_environment(method: str):
    """With latencies that are not whole steps, missing images, wrong stamps and none."""
    boxes = require_parity(method, LATE_AND_MISSING, most=1e-6)
    ages = torch.cat([each.age for each in boxes])
    assert ages.shape[1] == find_method(method).num_boxes
    assert (ages[:, 0] % 1.0).unique().numel() > 10
    assert ages[:, 0].max() > 4.0


def measured(controller: PolicyController) -> Measurement:
    assert controller.history is not None
    return controller.history.now


def test_a_throw_begins_as_an_episode():
    """The history is the first reading, the last action none; nothing of the throw before is left."""
    controller = PolicyController(policy_of("journal"), UR5E_ALLEGRO)
    first = controller.step(HOME, BOX)
    assert torch.equal(measured(controller).joint_pos_target, HOME)
    assert not measured(controller).action.any()
    controller.step(HOME, BOX)
    assert measured(controller).action.any()
    assert torch.equal(measured(controller).joint_pos_target, first)
    controller.reset()
    assert controller.history is None
    assert torch.equal(controller.step(HOME, BOX), first)


@pytest.mark.parametrize(
    ("method", "term"),
    [("without_pf", "initial_object_position"), ("object_position+fit", "object_position")],
)
def test_a_policy_that_needs_a_tracker_is_refused(method: str, term: str):
    with pytest.raises(PolicyMismatchError, match=term):
        PolicyController(policy_of(method), UR5E_ALLEGRO)


def test_the_robot_and_the_camera_of_the_policy_are_those_of_the_laboratory():
    """A policy trained for a calibrated camera runs with that one, and with no other."""
    calibrated = replace(RGB_CAMERA, pos=(0.02, -0.01, 2.19))
    policy = Policy(contract_of(find_method("proposed"), camera=calibrated)).eval()
    given = PolicyController(policy, UR5E_ALLEGRO, calibrated).step(HOME, BOX)
    assert given.isfinite().all()
    for workcell, camera, wrong in (
        (UR5E_ALLEGRO, RGB_CAMERA, r"camera\.pos"),
        (find_workcell("ur5e_allegro_right"), calibrated, "workcell"),
    ):
        with pytest.raises(PolicyMismatchError, match=wrong):
            PolicyController(policy, workcell, camera)
