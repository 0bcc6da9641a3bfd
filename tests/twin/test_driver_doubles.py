"""Each shipped profile is armed against the doubles of its drivers, and moves all joints."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import driver_doubles as doubles
import numpy as np
import pytest
from driver_doubles import AllegroV4, Double, Fr3, RealSense, UrArms

from pixel2catch.deployment.control_loop import StepClock, SteppedServo
from pixel2catch.deployment.laboratory import Survey, commands, images, joint_states
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.servo.limits import JointLimits, ServoLimits
from pixel2catch.servo.link import Command, Fault, JointTargets, Mode
from pixel2catch.servo.process import ServoSetup
from pixel2catch.workcells import find_workcell

CELLS: dict[str, tuple[str, type[Double], type[Double]]] = {
    **dict.fromkeys(("humble", "jazzy"), ("ur5e_allegro_v4", UrArms, AllegroV4)),
    "v5": ("ur5e_allegro_v5", UrArms, doubles.AllegroV5),
    "classic": ("ur5e_allegro_classic", UrArms, doubles.AllegroClassic),
    "leap": ("ur5e_leap", UrArms, doubles.Leap),
    "fr3": ("fr3_allegro", Fr3, AllegroV4),
    "two": ("two_ur5e_allegro", UrArms, AllegroV4),
}
THUMB_FIRST, INDEX_FIRST = ("thumb", "index", "middle", "ring"), ("index", "middle", "ring", "thumb")
LEAP_JOINTS = (("rot", "mcp", "pip", "dip"), ("cmc", "axl", "mcp", "ipl"))


def driver_name(joint: str, cell: str) -> str:
    """The driver's name of a joint of the work cell, by the drivers' sources."""
    side, _, own = joint.partition("_") if joint.startswith(("left_", "right_")) else ("", "", joint)
    finger, _, rest = own.removeprefix("leap_").partition("_")
    if finger not in THUMB_FIRST:
        return joint
    if cell == "leap":
        return str(4 * INDEX_FIRST.index(finger) + LEAP_JOINTS[finger == "thumb"].index(rest))
    number = rest.removeprefix("joint_")
    if cell in ("v5", "classic"):
        return f"joint_{4 * INDEX_FIRST.index(finger) + int(number)}{'_' if cell == 'v5' else '.'}0"
    return f"ah{side[:1]}_joint{THUMB_FIRST.index(finger)}{number}"


class Cell:
    """A servo with the limits of a profile, its drivers, an operator, and a policy that waves all joints."""

    def __init__(self, name: str) -> None:
        profile, *kinds = CELLS[name]
        self.broker, self.clock = Broker(), StepClock(lambda _: None)
        self.clock.time, self.profile = 1000.0, Profile.load(profile)
        if name == "humble":  # it does not publish the activity of controllers
            parts = tuple(replace(part, controller=None) for part in self.profile.robots)
            self.profile = replace(self.profile, robots=parts)
        workcell, parts = find_workcell(self.profile.workcell), self.profile.robots
        self.limits = ServoLimits.of(workcell, JointLimits.of(workcell, parts=parts), parts)
        self.home = np.array([joint.home for joint in workcell.joints])
        sides = ("left_", "right_") if name == "two" else ("",)
        self.arm_driver, self.hand = (kind(self.broker, self.clock, name, sides) for kind in kinds)
        self.camera = RealSense(self.broker, self.clock)
        names = [driver_name(joint, name) for joint in workcell.joint_names]
        home = dict(zip(names, self.home, strict=True))
        for double in (self.arm_driver, self.hand):
            double.pos[:] = [home.get(each, 0.0) for each in double.names]
            if isinstance(double, AllegroV4):  # the start pose of the guide, after it moved to its own
                double.goal[:] = double.pos
        self._places = [[*self.arm_driver.names, *self.hand.names].index(each) for each in names]
        node, self.operator = self.broker.node(self.clock), self.broker.node(self.clock)
        setup = ServoSetup(profile=self.profile, limits=self.limits)
        self.servo = SteppedServo(setup, (node, node), self.clock, None)
        topics = self.profile.operator
        self._switch, self._arm = map(self.operator.publisher, (topics.dead_man, topics.arm))
        self.last, self._ticks = list[Command](), 0

    @property
    def joint_pos(self) -> np.ndarray:
        return np.concatenate((self.arm_driver.pos, self.hand.pos))[self._places]

    def run(self, seconds: float, target: Callable[[float], np.ndarray] | None = None) -> Command:
        begin, ticks = self.clock.time, round(1000 * self.limits.dt)
        for _ in range(round(seconds * 1000)):
            self._ticks += 1
            self.clock.time += 0.001
            for driver in (self.arm_driver, self.hand, self.camera):
                driver.step()
            if self._ticks % 50 == 0:
                self._switch.publish(messages.boolean(True))
            if self._ticks % 33 == 0:
                now = self.clock.time
                goal = target(now - begin) if target else self.home
                stamps: Any = dict.fromkeys(("target_stamp", "image_stamp", "box_stamp"), now)
                targets = JointTargets(joint_pos_target=goal, **stamps)
                self.servo.connection.servo.send(targets)
            if self._ticks % ticks == 0:
                self.servo.tick()
                self.last += self.servo.connection.servo.receive()
        return self.last[-1]

    def arm(self) -> None:
        assert self.run(0.5).mode == Mode.IDLE
        self._arm.publish(messages.boolean(True))
        command = self.run(1.3)
        assert (command.mode, command.refused, command.stopped_by) == (Mode.RUN, 0, 0), Fault(command.refused)


@pytest.fixture
def cell(request: pytest.FixtureRequest) -> Iterator[Cell]:
    cell = Cell(request.param)
    with closing(cell.servo):
        yield cell


def of(*names: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("cell", names, indirect=True)


@of(*CELLS)
def test_a_profile_is_armed_moves_all_joints_and_stops_for_a_second_program(cell: Cell):
    cell.arm()
    way = np.where(cell.home + 0.25 < cell.limits.joints.upper, 0.2, -0.2)

    def wave(time: float) -> np.ndarray:
        return cell.home + 0.5 * (1.0 - np.cos(np.pi * min(time / 0.75, 1.0))) * way

    command = cell.run(1.1, wave)
    assert (command.mode, Fault(command.stopped_by)) == (Mode.RUN, Fault(0))
    assert cell.joint_pos == pytest.approx(cell.home + way, abs=0.02)
    assert (cell.arm_driver.num_refused, cell.hand.num_refused) == (0, 0)
    cell.broker.node(cell.clock).subscription(cell.profile.robots[-1].command_topic)
    assert Fault(cell.run(0.3).stopped_by) & Fault.OTHER_SUBSCRIBER


@of(*(name for name in CELLS if name != "humble"))  # its drivers send what those of jazzy send
def test_the_survey_finds_the_drivers_as_the_profile_says(cell: Cell):
    """Rate, names, stamps, images, and one program that receives the commands of each part."""
    survey = Survey(cell.broker.node(cell.clock), cell.profile, cell.clock)
    for _ in range(40):
        cell.run(0.025)
        survey.listen()
    commanded = {part.command_topic.name for part in cell.profile.robots}
    found = survey.endpoints
    survey.endpoints = [each for each in found if not (each.is_publisher and each.topic in commanded)]
    for part in cell.profile.robots:
        age = float(cell.limits.joints.position_age[part.ids].min())
        assert "Hz" in joint_states(survey, part, age)
        assert "one driver" in commands(survey, part)
    assert images(survey, cell.profile, cell.limits.image_age).startswith("640 x 480 rgb8, 30.0 Hz")


@of("fr3")
def test_an_fr3_is_stopped_within_the_limits_of_its_interface(cell: Cell):
    """In the middle of motions to targets that jump, one joint to the end of its travel and back."""
    rng, fr3 = np.random.default_rng(0), cell.arm_driver
    cell.arm()
    assert isinstance(fr3, Fr3)
    for number in range(6):
        way = np.where(np.arange(len(cell.home)) < 7, rng.uniform(-0.4, 0.4, len(cell.home)), 0.0)
        way[5] = -0.4 if number == 3 else 0.8
        cell.run(0.3, lambda _, goal=cell.home + way: goal)
    cell.operator.publisher(cell.profile.operator.stop).publish(messages.boolean(True))
    command = cell.run(0.305)
    assert command.mode == Mode.STOPPED
    assert np.array_equal(cell.run(0.1).joint_pos_command, command.joint_pos_command)
    assert fr3.num_refused == 0
    assert (fr3.reached > 0.95).all()
