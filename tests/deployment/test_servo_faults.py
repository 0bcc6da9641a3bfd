"""Faults of messages and senders, and the fault bit with which the servo stops."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from loop_lab import PROFILE
from servo_rows import HOME, LIMITS
from wire_lab import Stage, taken

from pixel2catch.ros2 import messages
from pixel2catch.servo.limits import STOP_TIME
from pixel2catch.servo.link import Mode

STOP_TICKS = round(STOP_TIME / LIMITS.dt)


def silence(*names: str) -> Callable[[Stage], None]:
    return lambda stage: stage.lab.silent.update(names)


def sets(name: str, value: Any) -> Callable[[Stage], None]:
    return lambda stage: setattr(stage.lab, name, value)


def joints(change: Callable[[messages.JointReading], messages.JointReading]) -> Callable[[Stage], None]:
    return sets("change", change)


def sends(name: str, data: bytes) -> Callable[[Stage], None]:
    def say(stage: Stage) -> None:
        profile = stage.lab.profile
        owner = profile.operator if hasattr(profile.operator, name) else profile.status
        stage.lab.send(getattr(owner, name), data)

    return say


def add_publisher(stage: Stage) -> None:
    stage.broker.node(stage.clock).publisher(stage.lab.profile.robots[0].command_topic)


def remove_subscriber(stage: Stage) -> None:
    node = stage.laboratory
    node.queues[:] = [each for each in node.queues if not each.topic.name.endswith("commands")]


def add_subscriber(stage: Stage) -> None:
    stage.broker.node(stage.clock).subscription(stage.lab.profile.robots[1].command_topic)


def add_status_publisher(stage: Stage) -> None:
    """A second publisher of the safety mode, such as a recording that is played."""
    topic = stage.lab.profile.status.safety_mode
    assert topic is not None
    stage.broker.node(stage.clock).publisher(topic).publish(messages.safety_mode(1))


def without_elbow(reading: messages.JointReading) -> messages.JointReading:
    return taken(reading, [place for place, name in enumerate(reading.names) if name != "elbow_joint"])


def with_1000_joints(reading: messages.JointReading) -> messages.JointReading:
    others = tuple(f"joint_{i}" for i in range(1000))
    position = np.concatenate((reading.position, np.zeros(len(others))))
    return replace(reading, names=(*reading.names, *others), position=position)


def remove_status_sender(stage: Stage) -> None:
    node = stage.laboratory
    node.publishers = [each for each in node.publishers if not each.topic.is_latched]


def switches_controllers(part: int) -> Callable[[Stage], None]:
    controller = PROFILE.robots[part].controller
    assert controller is not None
    states = messages.activity(
        {controller.name: 2, "scaled_joint_trajectory_controller": messages.ACTIVE}, 0.0
    )
    return lambda stage: stage.lab.send(controller.activity, states)


def send_garbage(stage: Stage) -> None:
    """Bytes that are not a joint state, and one with fewer positions than names."""
    topic, lab = stage.lab.profile.robots[0].state_topic, stage.lab
    lab.send(topic, b"\x00\x01\x00\x00garbage")
    lab.send(topic, messages.joint_state(["elbow_joint", "wrist_1_joint"], [1.0], 1.0))
    lab.silent.add("arm")


def add_operator(stage: Stage) -> None:
    """A pedal was killed, and another node still sends that the switch is held."""
    topic = stage.lab.profile.operator.dead_man
    stage.lab.silent.add(topic.name)
    publisher = stage.broker.node(stage.clock).publisher(topic)
    stage.each_tick = lambda: publisher.publish(messages.boolean(True))


def age_switch(stage: Stage) -> None:
    """Messages of the switch that were sent 0.3 s ago."""
    topic = stage.lab.profile.operator.dead_man
    stage.lab.silent.add(topic.name)
    (switch,) = [each for each in stage.node.queues if each.topic == topic]
    stage.each_tick = lambda: switch.put(messages.boolean(True), age=0.3)


FAULTS = {
    "hand gone": (silence("hand"), "joints stale"),
    "controller of the hand": (switches_controllers(1), "controller"),
    "not a number": (
        joints(lambda each: replace(each, position=np.nan * HOME[: len(each.names)])),
        "joints not finite",
    ),
    "control loop gone": (silence("control loop"), "policy late"),
    "images old": (sets("image_age", 0.2), "image stale"),
    "arm gone": (silence("arm"), "joints stale"),
    "joint missing": (joints(without_elbow), "joints stale"),
    "joint states frozen": (joints(lambda reading: replace(reading, stamp=5.0)), "joints stale"),
    "joint states send_garbage": (send_garbage, "joints stale"),
    "joint twice": (joints(lambda reading: taken(reading, [*range(len(reading.names)), 0])), "joints stale"),
    "joints without end": (joints(with_1000_joints), "joints stale"),
    "protective stop": (sends("safety_mode", messages.safety_mode(3)), "safety mode"),
    "robot idle": (sends("robot_mode", messages.robot_mode(5)), "safety mode"),
    "program stopped": (sends("program_running", messages.boolean(False)), "safety mode"),
    "speed slider": (sets("speed", 50.0), "speed scaling"),
    "speed not sent": (silence("/speed_scaling_state_broadcaster/speed_scaling"), "status unknown"),
    "status sender gone": (remove_status_sender, "status unknown"),
    "status of two": (add_status_publisher, "status unknown"),
    "other controller": (switches_controllers(0), "controller"),
    "no subscriber": (remove_subscriber, "no subscriber"),
    "two subscribers": (add_subscriber, "other subscriber"),
    "other publisher": (add_publisher, "other publisher"),
    "dead man let go": (sets("is_held", False), "dead man"),
    "dead man silent": (silence("/pixel2catch/dead_man"), "dead man"),
    "dead man old": (age_switch, "dead man"),
    "two operators": (add_operator, "other operator"),
    "operator stops": (sends("stop", messages.boolean(True)), "stop request"),
}
"""Each fault, and the only bit that is set; those of measured positions are in `test_servo_core.py`."""


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_stops_the_robot_with_its_own_bit(fault: str, stage: Stage):
    """When it is mended and the switch is pressed anew, the robot can be armed again."""
    (happens, reason), lab, node = FAULTS[fault], stage.lab, stage.laboratory
    queues, publishers = [*node.queues], [*node.publishers]
    stage.arm(60)
    happens(stage)
    stage.wait_until_stopped(130)
    assert stage.stopped_by == (reason,)
    for other in {*stage.broker.nodes} - {stage.node, node}:
        other.close()
    node.queues[:], node.publishers, stage.each_tick = queues, publishers, lambda: None
    lab.silent, lab.speed, lab.image_age = set(), 100.0, 0.03
    lab.change, lab.target = lambda reading: reading, lab.joint_pos.copy()
    lab.send_status()
    for lab.is_held, num_ticks in ((False, STOP_TICKS), (True, 52)):
        stage.wait(num_ticks)  # a request within 0.5 s of the first would count as its repetition
    lab.target = lab.joint_pos.copy()
    lab.request_arm()
    assert stage.wait(80) == Mode.RUN


def test_repeated_and_older_joint_states_are_ignored(stage: Stage):
    lab, said = stage.lab, deque[messages.JointReading](maxlen=200)
    lab.change = lambda reading: said.append(reading) or reading
    stage.arm(60)
    lab.target = HOME + 0.2
    for tick in range(60):
        for reading in (said[0], said[-1], said[-2], said[-30]) if tick % 2 else ():
            state = messages.joint_state(reading.names, reading.position, reading.stamp)
            lab.send(lab.profile.robots[0].state_topic, state)
        assert stage.wait(1) == Mode.RUN
    steps = np.diff([each.joint_pos[0] for each in lab.ticks[-60:]])
    assert steps.min() >= 0.0
    assert steps.sum() > 0.005


def test_a_driver_is_read_after_its_clock_was_set(stage: Stage):
    """Set ahead, nothing changes. Set back, its positions count as old for 0.1 s: the servo stops."""
    lab = stage.lab
    stage.arm(60)
    for seconds, mode in ((1.0, Mode.RUN), (0.0, Mode.IDLE)):
        lab.change = lambda reading, ahead=seconds: replace(reading, stamp=reading.stamp + ahead)
        assert stage.wait(2 * STOP_TICKS) == mode
    for lab.is_held in (False, True):
        stage.wait(26)
    stage.arm()
    assert stage.stopped_by == ("joints stale",)


@pytest.mark.parametrize(
    "fault",
    ["protective stop", "robot idle", "program stopped", "speed slider", "other controller", "arm gone"],
)
def test_a_robot_that_was_off_is_not_moved_when_it_is_on_again(fault: str, stage: Stage):
    """Nothing is sent to it from the end of the stop until it is armed, from wherever it is then."""
    lab = stage.lab
    stage.arm(60)
    FAULTS[fault][0](stage)
    assert stage.wait(65 + STOP_TICKS) == Mode.IDLE
    sent = len(lab.commands["arm"])
    lab.speed, lab.silent = 100.0, set()
    lab.send_status()
    lab.joint_pos[:6] += 0.03  # by hand
    assert stage.wait(2 * STOP_TICKS) == Mode.IDLE
    assert len(lab.commands["arm"]) == sent
