"""What goes wrong in a laboratory on the wire, and the one reason that the servo gives for its stop."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from servo_rows import HOME, LIMITS
from servo_stage import Cut, Stage, wait
from wire_lab import frozen, twice, with_nan, without_elbow

from pixel2catch.ros2 import messages
from pixel2catch.servo.limits import STOP_TIME
from pixel2catch.servo.link import Mode

STOP_TICKS = round(STOP_TIME / LIMITS.dt)


def silence(*names: str) -> Callable[[Stage], None]:
    """Somebody says nothing more."""
    return lambda stage: stage.lab.silent.update(names)


def joints(change: Callable[[messages.JointReading], messages.JointReading]) -> Callable[[Stage], None]:
    """Joint states are otherwise from now on."""
    return lambda stage: setattr(stage.lab, "change", change)


def says(name: str, data: bytes) -> Callable[[Stage], None]:
    """The driver or the operator says something."""

    def say(stage: Stage) -> None:
        profile = stage.lab.profile
        owner = profile.operator if hasattr(profile.operator, name) else profile.status
        stage.lab.say(getattr(owner, name), data)

    return say


def slowed(stage: Stage) -> None:
    stage.lab.speed = 50.0


def scaled(percent: float) -> Callable[[Stage], None]:
    """The driver says another speed scaling."""
    return lambda stage: setattr(stage.lab, "speed", percent)


def released(stage: Stage) -> None:
    stage.lab.is_held = False


def rivalled(stage: Stage) -> None:
    stage.broker.node(stage.clock).publisher(stage.lab.profile.robots[0].command_topic)


def unheard(stage: Stage) -> None:
    """The driver listens to no commands any more, though it goes on speaking."""
    node = stage.laboratory
    node.listeners = [each for each in node.listeners if not each.topic.name.endswith("commands")]


def overheard(stage: Stage) -> None:
    """Somebody else takes the commands, too."""
    stage.broker.node(stage.clock).subscription(stage.lab.profile.robots[1].command_topic)


def contradicted(stage: Stage) -> None:
    """Somebody else says how the robot is, too, such as a recording that is played."""
    topic = stage.lab.profile.status.safety_mode
    assert topic is not None
    stage.broker.node(stage.clock).publisher(topic).publish(messages.safety_mode(1))


def endless(reading: messages.JointReading) -> messages.JointReading:
    """The same with more joints than it takes time to read."""
    others = tuple(f"joint_{i}" for i in range(2000))
    position = np.concatenate((reading.position, np.zeros(len(others))))
    return replace(reading, names=(*reading.names, *others), position=position)


def left(stage: Stage) -> None:
    """Who latched the status is gone; everything else goes on."""
    node = stage.laboratory
    node.publishers = [each for each in node.publishers if not each.topic.is_latched]


def switched(stage: Stage) -> None:
    """Somebody has switched controllers."""
    states = {"forward_position_controller": 2, "scaled_joint_trajectory_controller": messages.ACTIVE}
    (controller,) = [part.controller for part in stage.lab.profile.robots if part.controller]
    stage.lab.say(controller.activity, messages.activity(states, 0.0))


def garbled(stage: Stage) -> None:
    """Bytes that are no joint state, and one with fewer positions than names."""
    topic, lab = stage.lab.profile.robots[0].state_topic, stage.lab
    lab.say(topic, b"\x00\x01\x00\x00garbage")
    lab.say(topic, messages.joint_state(["elbow_joint", "wrist_1_joint"], [1.0], 1.0))
    lab.silent.add("arm")


FAULTS = {
    "arm gone": (silence("arm"), "joints stale"),
    "hand gone": (silence("hand"), "joints stale"),
    "joint missing": (joints(without_elbow), "joints stale"),
    "joint states frozen": (joints(frozen), "joints stale"),
    "joint states garbled": (garbled, "joints stale"),
    "joint twice": (joints(twice), "joints stale"),
    "joints without end": (joints(endless), "joints stale"),
    "joint not a number": (joints(with_nan), "joints not finite"),
    "protective stop": (says("safety_mode", messages.safety_mode(3)), "safety mode"),
    "robot idle": (says("robot_mode", messages.robot_mode(5)), "safety mode"),
    "program stopped": (says("program_running", messages.boolean(False)), "safety mode"),
    "speed slider": (slowed, "speed scaling"),
    "speed not a number": (scaled(np.nan), "speed scaling"),
    "speed not told": (silence("/speed_scaling_state_broadcaster/speed_scaling"), "status unknown"),
    "status left": (left, "status unknown"),
    "status of two": (contradicted, "status unknown"),
    "other controller": (switched, "controller"),
    "nobody listens": (unheard, "no subscriber"),
    "two listen": (overheard, "other subscriber"),
    "rival": (rivalled, "other publisher"),
    "dead man let go": (released, "dead man"),
    "dead man silent": (silence("/pixel2catch/dead_man"), "dead man"),
    "operator stops": (says("stop", messages.boolean(True)), "stop request"),
}
"""What goes wrong, and the one reason that is given."""


def stopped_by(stage: Stage, happens: Callable[[Stage], None], num_ticks: int) -> tuple[str, ...]:
    """Why it stops, if something happens so long after it was armed."""

    def script() -> Iterator[None]:
        yield from stage.armed(num_ticks)
        happens(stage)
        for _ in range(130):
            yield
            if stage.mode == Mode.STOPPED:
                raise Cut

    stage.play(script())
    return stage.stopped_by


@pytest.mark.parametrize("fault", FAULTS)
def test_what_goes_wrong_on_the_wire_stops_the_robot_by_name(fault: str, stage: Stage):
    happens, reason = FAULTS[fault]
    assert stopped_by(stage, happens, 5) == (reason,)


AUTHORITY = ("rival", "nobody listens", "other controller", "status left")


@pytest.mark.parametrize("fault", AUTHORITY)
def test_a_robot_that_is_not_ours_alone_is_not_armed(fault: str, stage: Stage):
    happens, reason = FAULTS[fault]

    def script() -> Iterator[None]:
        yield from wait(11)
        happens(stage)
        yield from wait(110)  # the next count of who is there
        stage.lab.ask_to_arm()
        yield from wait(5)

    stage.play(script())
    assert stage.modes == [Mode.IDLE]
    assert stage.refused == (reason,)


def test_nothing_is_sent_against_somebody_else_who_commands(stage: Stage):
    lab = stage.lab

    def script() -> Iterator[None]:
        yield from stage.armed(80)
        lab.target = HOME + 0.1
        yield from wait(20)
        rivalled(stage)
        yield from wait(110)
        assert stage.mode == Mode.STOPPED
        num_commands = len(lab.commands["arm"])
        yield from wait(STOP_TICKS)
        assert len(lab.commands["arm"]) == num_commands
        raise Cut

    stage.play(script())
    assert stage.stopped_by == ("other publisher",)


def test_joint_states_that_come_twice_or_too_late_change_nothing(stage: Stage):
    """As from a second network, or of a recording that is played beside the robot, while joints move."""
    lab, said = stage.lab, deque[messages.JointReading](maxlen=200)
    lab.change = lambda reading: said.append(reading) or reading

    def script() -> Iterator[None]:
        yield from stage.armed(60)
        lab.target = HOME + 0.2
        for tick in range(60):
            for reading in (said[0], said[-1], said[-2], said[-30]) if tick % 2 else ():
                state = messages.joint_state(reading.names, reading.position, reading.stamp)
                lab.say(lab.profile.robots[0].state_topic, state)
            yield
        assert stage.mode == Mode.RUN
        raise Cut

    stage.play(script())
    steps = np.diff([each.joint_pos[0] for each in lab.ticks[-60:]])
    assert steps.min() >= 0.0
    assert steps.sum() > 0.005


def test_a_driver_whose_clock_is_set_is_heard_again(stage: Stage):
    """Set ahead, nothing happens. Set back, its positions count as old for 0.1 s: it stops."""
    lab = stage.lab

    def script() -> Iterator[None]:
        yield from stage.armed(60)
        for seconds, mode in ((1.0, Mode.RUN), (0.0, Mode.STOPPED)):
            lab.change = lambda reading, ahead=seconds: replace(reading, stamp=reading.stamp + ahead)
            yield from wait(2 * STOP_TICKS)
            assert stage.mode == mode
        yield from stage.pressed_anew()
        yield from stage.armed()

    stage.play(script())
    assert stage.stopped_by == ("joints stale",)
