"""Nodes for tests, on networks that no other test is on."""

from collections.abc import Callable
from contextlib import ExitStack
from importlib.util import find_spec

import pytest
import rclpy_stand_in

from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.transport import LOOPBACK, ROS, RealClock, Transport, make_transport

MakeNode = Callable[[str], Transport]
"""Makes a node with a name."""


def memory_nodes(stack: ExitStack) -> MakeNode:
    broker = Broker()
    return lambda name: stack.enter_context(broker.node(RealClock()))


def dds_nodes(stack: ExitStack) -> MakeNode:
    return lambda name: stack.enter_context(make_transport(name, LOOPBACK, RealClock()))


def ros_nodes(stack: ExitStack) -> MakeNode:
    """Nodes of the rclpy that is installed, or else of its stand-in."""
    patch = stack.enter_context(pytest.MonkeyPatch.context())
    if not find_spec("rclpy"):
        rclpy_stand_in.install(patch)
    return lambda name: stack.enter_context(make_transport(name, ROS, RealClock()))
