"""Each shipped profile is armed against the doubles of its drivers, and moves all joints."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from driver_doubles import AllegroClassic, AllegroV4, AllegroV5, Double, Fr3, Leap, UrArms

from pixel2catch.deployment.control_loop import StepClock, SteppedServo
from pixel2catch.deployment.laboratory import Survey, commands, joint_states
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.servo.limits import JointLimits, ServoLimits
from pixel2catch.servo.link import Command, Fault, JointTargets, Mode
from pixel2catch.servo.process import ServoSetup
from pixel2catch.workcells import find_workcell

MakeDoubles = Callable[[Broker, StepClock], list[Double]]
CELLS: dict[str, tuple[str, MakeDoubles]] = {
    "humble": (
        "ur5e_allegro_v4",
        lambda net, clock: [UrArms(net, clock, "humble"), AllegroV4(net, clock, "humble")],
    ),
    "jazzy": (
        "ur5e_allegro_v4",
        lambda net, clock: [UrArms(net, clock, "jazzy"), AllegroV4(net, clock, "jazzy")],
    ),
    "lyrical": (
        "ur5e_allegro_v4",
        lambda net, clock: [UrArms(net, clock, "lyrical"), AllegroV4(net, clock, "lyrical")],
    ),
    "v5": ("ur5e_allegro_v5", lambda net, clock: [UrArms(net, clock, "jazzy"), AllegroV5(net, clock)]),
    "classic": (
        "ur5e_allegro_classic",
        lambda net, clock: [UrArms(net, clock, "jazzy"), AllegroClassic(net, clock)],
    ),
    "leap": ("ur5e_leap", lambda net, clock: [UrArms(net, clock, "jazzy"), Leap(net, clock)]),
    "fr3": ("fr3_allegro", lambda net, clock: [Fr3(net, clock), AllegroV4(net, clock, "jazzy")]),
    "two": (
        "two_ur5e_allegro",
        lambda net, clock: [
            UrArms(net, clock, "jazzy", ("left_", "right_")),
            AllegroV4(net, clock, "jazzy", ("l", "r")),
        ],
    ),
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
        profile, make = CELLS[name]
        self.broker, self.clock = Broker(), StepClock(lambda _: None)
        self.clock.time, self.profile = 1000.0, Profile.load(profile)
        if name == "humble":  # it does not publish the activity of controllers
            parts = tuple(replace(part, controller=None) for part in self.profile.robots)
            self.profile = replace(self.profile, robots=parts)
        workcell, parts = find_workcell(self.profile.workcell), self.profile.robots
        self.limits = ServoLimits.of(workcell, JointLimits.of(workcell, parts=parts), parts)
        self.home, self.names = np.array([joint.home for joint in workcell.joints]), workcell.joint_names
        self.doubles = make(self.broker, self.clock)
        home = {driver_name(joint, name): pos for joint, pos in zip(self.names, self.home, strict=True)}
        for double in self.doubles:
            double.pos[:] = [home.get(each, 0.0) for each in double.names]
            if isinstance(double, AllegroV4):  # the start pose of the guide, after it moved to its own
                double.goal[:] = double.pos
        self.of_joint = [
            next((double, double.names.index(each)) for double in self.doubles if each in double.names)
            for each in (driver_name(joint, name) for joint in self.names)
        ]
        node = self.broker.node(self.clock)
        self.servo = SteppedServo(
            ServoSetup(profile=self.profile, limits=self.limits), (node, node), self.clock, None
        )
        self.operator = self.broker.node(self.clock)
        operator = self.profile.operator
        self._switch, self._arm = (
            self.operator.publisher(operator.dead_man),
            self.operator.publisher(operator.arm),
        )
        self.last, self._ticks = list[Command](), 0

    @property
    def joint_pos(self) -> np.ndarray:
        return np.array([double.pos[place] for double, place in self.of_joint])

    def run(self, seconds: float, target: Callable[[float], np.ndarray] | None = None) -> Command:
        begin, ticks = self.clock.time, round(1000 * self.limits.dt)
        for _ in range(round(seconds * 1000)):
            self._ticks += 1
            self.clock.time += 0.001
            for double in self.doubles:
                double.step()
            if self._ticks % 50 == 0:
                self._switch.publish(messages.boolean(True))
            if self._ticks % 33 == 0:
                now = self.clock.time
                goal = target(now - begin) if target else self.home
                targets = JointTargets(
                    joint_pos_target=goal, target_stamp=now, image_stamp=now, box_stamp=now
                )
                self.servo.connection.servo.send(targets)
            if self._ticks % ticks == 0:
                self.servo.tick()
                self.last += self.servo.connection.servo.receive()
        return self.last[-1]

    def close(self) -> None:
        self.servo.close()

    def arm(self) -> None:
        assert self.run(0.5).mode == Mode.IDLE
        self._arm.publish(messages.boolean(True))
        command = self.run(1.3)
        assert (command.mode, Fault(command.refused), Fault(command.stopped_by)) == (
            Mode.RUN,
            Fault(0),
            Fault(0),
        )


@pytest.fixture
def cell(request: pytest.FixtureRequest) -> Iterator[Cell]:
    with closing(Cell(request.param)) as cell:
        yield cell


def of(*names: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("cell", names, indirect=True)


@of(*CELLS)
def test_a_profile_is_armed_moves_all_joints_and_stops_for_a_second_program(cell: Cell):
    cell.arm()
    way = np.where(cell.home + 0.25 < cell.limits.joints.upper, 0.2, -0.2)
    for begin, end in ((cell.home, cell.home + way), (cell.home + way, cell.home)):

        def wave(time: float, begin: np.ndarray = begin, end: np.ndarray = end) -> np.ndarray:
            return begin + 0.5 * (1.0 - np.cos(np.pi * min(time / 0.75, 1.0))) * (end - begin)

        command = cell.run(1.4, wave)
        assert (command.mode, Fault(command.stopped_by)) == (Mode.RUN, Fault(0))
        assert cell.joint_pos == pytest.approx(end, abs=0.02)
    assert [double.num_refused for double in cell.doubles] == [0] * len(cell.doubles)
    cell.broker.node(cell.clock).subscription(cell.profile.robots[-1].command_topic)
    assert Fault(cell.run(0.3).stopped_by) & Fault.OTHER_SUBSCRIBER


@of(*CELLS)
def test_the_survey_finds_the_drivers_as_the_profile_says(cell: Cell):
    """Rate, names, stamps, and one program that receives the commands of each part."""
    survey = Survey(cell.broker.node(cell.clock), cell.profile, cell.clock)
    for _ in range(40):
        cell.run(0.025)
        survey.listen()
    commanded = {part.command_topic.name for part in cell.profile.robots}
    survey.endpoints = [
        each for each in survey.endpoints if not (each.is_publisher and each.topic in commanded)
    ]
    for part in cell.profile.robots:
        age = float(cell.limits.joints.position_age[part.ids].min())
        assert "Hz" in joint_states(survey, part, age)
        assert "one driver" in commands(survey, part)


@of("jazzy", "two")
def test_an_inactive_controller_of_a_hand_stops_the_robot(cell: Cell):
    cell.arm()
    cell.doubles[1].set_activity([])
    assert Fault(cell.run(0.3).stopped_by) == Fault.CONTROLLER


@of("fr3")
def test_an_fr3_is_stopped_within_the_limits_of_its_interface(cell: Cell):
    """In the middle of motions to targets that jump."""
    rng = np.random.default_rng(0)
    cell.arm()
    (fr3,) = (double for double in cell.doubles if isinstance(double, Fr3))
    for _ in range(6):
        goal = cell.home + np.where(
            np.arange(len(cell.home)) < 7, rng.uniform(-0.4, 0.4, len(cell.home)), 0.0
        )
        cell.run(0.25, lambda _, goal=goal: goal)
    cell.operator.publisher(cell.profile.operator.stop).publish(messages.boolean(True))
    command = cell.run(0.305)
    assert command.mode == Mode.STOPPED
    assert np.array_equal(cell.run(0.1).joint_pos_command, command.joint_pos_command)
    assert fr3.num_refused == 0
    assert (fr3.reached[1:] > 0.95).all()
