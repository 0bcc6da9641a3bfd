"""Slow motions in the stepped twin: home, release, joint check, and throws without touching the robot."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from pixel2catch.camera.pinhole import project
from pixel2catch.cli.home import EVEN, QUARTER
from pixel2catch.cli.link import Link
from pixel2catch.cli.main import main
from pixel2catch.deployment import throw_cycle
from pixel2catch.deployment.follower import JointCheck, follow, record_of_today
from pixel2catch.deployment.operator import OperatorConsole
from pixel2catch.deployment.paths import PEAK, Motion, PathFinder
from pixel2catch.deployment.throw_cycle import HELD_TIME, MISSED_TIME, ThrowCycle
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import DeploymentError, UnknownNameError
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.robots.geometry import WorkcellGeometry
from pixel2catch.ros2.profile import Place, Profile
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.servo.laws import USER_CACHE
from pixel2catch.servo.limits import JointLimits, ServoLimits
from pixel2catch.servo.link import Command, JointTargets
from pixel2catch.twin import RehearsalCfg, stepped
from pixel2catch.twin.drivers import CYCLE
from pixel2catch.twin.lab_node import twin_profile
from pixel2catch.twin.rehearsal import run_throws
from pixel2catch.twin.simulated_lab import SimulatedLab
from pixel2catch.twin.stepped import SteppedTwin, in_step, plain_image
from pixel2catch.workcells import find_workcell

WORKCELL = find_workcell("ur5e_allegro")
HOME = np.array([joint.home for joint in WORKCELL.joints])
TWIN = twin_profile(WORKCELL)
PROFILE = replace(TWIN, places={"near": Place(joints={"shoulder_pan_joint": 2.8}), **TWIN.places})
LIMITS = ServoLimits.of(WORKCELL)
SLOW = ServoLimits.of(WORKCELL, JointLimits.of(WORKCELL, QUARTER))
FINDER = PathFinder(PROFILE, SLOW, EVEN)
ARMED = 0.3  #: Time at which the operator arms [s].


class MotionLab:
    """A stepped twin whose robot starts in any pose, with an operator who holds the switch and arms."""

    def __init__(self, twin: SteppedTwin) -> None:
        self.twin, self.connection = twin, twin.servo.connection
        self.poses, self.fastest = list[np.ndarray](), np.zeros(len(HOME))  #: Of all cycles [rad], [rad/s].
        self._operator = OperatorConsole(twin.broker.node(twin.clock), twin.profile.operator, twin.clock)
        twin.followers = (twin.servo.tick, self._operate)

    def follow(
        self, plan: Callable[[np.ndarray], Motion], on_command: Callable[[Command], None] = lambda _: None
    ) -> bool:
        """Let the robot follow a motion; return whether it did to the end."""
        topic, clock = self.twin.profile.operator.status, self.twin.clock
        return follow(
            plan, "motion", self.connection, topic, lambda: clock.time > 60.0, lambda _: None, on_command
        )

    def place(self, joint_pos: np.ndarray) -> None:
        lab = self.twin.lab
        lab._qpos[: len(joint_pos)], lab._qvel[:] = joint_pos - lab._encoder_offset, 0.0
        start = torch.from_numpy(lab._qpos[None, : len(joint_pos)].copy())
        lab._world._actuators.reset(torch.ones(1, dtype=torch.bool), start, lab.episode.parameters)
        self.twin._node._hold_still()

    def _operate(self) -> None:
        now, joints = self.twin.clock.time, self.twin.lab.joints
        self._operator.holds = now > ARMED / 2
        self._operator.watch()
        if ARMED <= now < ARMED + CYCLE:
            self._operator.arm()
        self.poses.append(joints.position.copy())
        self.fastest = np.maximum(self.fastest, np.abs(joints.velocity))


@contextmanager
def motion_lab(start: np.ndarray, limits: ServoLimits = SLOW) -> Iterator[MotionLab]:
    task = CatchEnvCfg(scene=SceneCfg(physics_hz=120.0))
    with SteppedTwin(RehearsalCfg(), task, plain_image, limits) as twin:
        lab = MotionLab(twin)
        lab.place(start)
        yield lab


def allowed_poses(number: int, finder: PathFinder, limits: ServoLimits) -> list[np.ndarray]:
    """Return random poses in which a robot may be, less than half a turn from the start pose [rad]."""
    rng, found = np.random.default_rng(5), list[np.ndarray]()
    lower = np.maximum(limits.joints.lower, finder.home - 3.0)
    upper = np.minimum(limits.joints.upper, finder.home + 3.0)
    while len(found) < number:
        pose = rng.uniform(lower, upper)
        if not finder.refusal(pose):
            found.append(pose)
    return found


def test_a_motion_is_at_rest_in_its_poses_and_as_fast_as_permitted():
    """A joint moves 1.875 rad at up to 1 rad/s in 3.515625 s; in the middle of the time it is half way."""
    motion = Motion.along(np.array([[0.0, 0.0], [PEAK, 0.1], [PEAK, 0.0]]), np.array([1.0, 0.5]))
    assert motion.duration == pytest.approx(PEAK**2 + 0.375)
    poses = [motion.at(time) for time in (-1.0, PEAK**2 / 2.0, PEAK**2, 99.0)]
    assert np.array(poses) == pytest.approx(
        np.array([[0.0, 0.0], [PEAK / 2.0, 0.05], [PEAK, 0.1], [PEAK, 0.0]]), abs=1e-9
    )
    times = np.linspace(0.0, motion.duration, 4001)
    speeds = np.abs(np.diff([motion.at(time) for time in times], axis=0)) / times[1]
    assert speeds.max(axis=0) == pytest.approx([1.0, 0.5], rel=1e-3)
    assert speeds[np.searchsorted(times, PEAK**2)] == pytest.approx([0.0, 0.0], abs=1e-2)


@pytest.mark.parametrize(("workcell", "number"), [("ur5e_allegro", 20), ("two_ur5e_allegro", 10)])
def test_the_way_home_keeps_its_distances_or_is_refused(workcell: str, number: int):
    """Near its ends their own distances count; none is a contact. Some ways of two arms lead around."""
    profile = Profile.load("ur5e_allegro_v4" if workcell == WORKCELL.name else workcell)
    limits = ServoLimits.of(find_workcell(workcell))
    finder, num_home = PathFinder(profile, limits, 1.0), 0
    for start in allowed_poses(number, finder, limits):
        with suppress(DeploymentError):
            motion = finder.motion(start, finder.home)
            ends = np.minimum(finder.nearest(start), finder.nearest(finder.home))
            way = [finder.nearest(motion.at(time)) for time in np.linspace(0.0, motion.duration, 100)]
            assert (np.min(way, axis=0) > np.minimum((0.05, 0.02), ends) - 0.004).all()
            assert np.min(way) > 0.0
            num_home += 1
    assert num_home >= 0.9 * number


def test_no_path_leads_from_a_pose_outside_the_limits_or_over_an_unknown_place():
    beyond, low = HOME.copy(), HOME.copy()
    beyond[0], low[1] = 4.5, -0.2
    for pose, reason in ((beyond, "shoulder_pan_joint is at 4.50 rad, beyond"), (low, "workspace")):
        with pytest.raises(DeploymentError, match=reason):
            FINDER.path(pose, HOME)
    with pytest.raises(UnknownNameError, match="near, side"):
        FINDER.pose_over("shelf")


@pytest.mark.parametrize(("command", "arm"), [("home", HOME[0]), ("release", 3.3), ("release near", 2.8)])
def test_the_commands_move_the_robot_to_the_end(command: str, arm: float, monkeypatch, capsys):
    monkeypatch.setattr("pixel2catch.cli.link.Robot.load", lambda _: PROFILE)
    start = HOME.copy()
    start[0] = 3.3
    start[6:] += 0.3
    with motion_lab(start) as lab:
        monkeypatch.setattr(Link, "connect", lambda *_, **__: lab.connection)
        assert main(command.split()) == 0
    assert lab.poses[-1][0] == pytest.approx(arm, abs=0.02)
    assert lab.poses[-1][6:] == pytest.approx(HOME[6:], abs=0.15)
    assert lab.fastest[6:].max() < 2.0
    assert (lab.fastest[:6] <= [0.25 * joint.velocity_limit for joint in WORKCELL.joints[:6]]).all()
    assert "done" in capsys.readouterr().out


FAULTS = {
    "sound": (1.0, 1.0, ""),
    "dead": (0.0, 1.0, "does not follow"),
    "inverted": (-1.0, 1.0, "is inverted"),
    "scaled": (2.0, 1.0, "has another scale"),
    "exchanged": (0.0, 0.0, "is exchanged"),
}
"""Motion of an encoder over that of its joint; that of the next encoder over that of its own; the finding."""


@pytest.mark.parametrize(("fault", "number"), [*((fault, 8) for fault in FAULTS), ("dead", 3)])
def test_the_joint_check_names_the_wrong_joint(fault: str, number: int):
    """A finger's and an arm's, of joints that follow their commands with the lag of the limits."""
    own, other, finding = FAULTS[fault]
    factors, check = np.eye(len(HOME)), JointCheck(LIMITS)
    factors[number, number], factors[number + 1, number + 1] = own, other
    factors[number, number + 1] = factors[number + 1, number] = 1.0 - other
    motion, joint_pos, dt = check.plan(HOME), HOME.copy(), 0.01
    for time in np.arange(0.0, motion.duration, dt):
        joint_pos += np.minimum(dt / LIMITS.joints.lag, 1.0) * (motion.at(time) - joint_pos)
        measured: Any = SimpleNamespace(
            time=time, joint_pos_command=motion.at(time), joint_pos=HOME + factors @ (joint_pos - HOME)
        )
        check.note(measured)
    names = WORKCELL.joint_names[number : number + (2 if fault == "exchanged" else 1)]
    found = zip(names if finding else (), check.findings(), strict=True)
    assert all(text.startswith(f"{name} {finding}") for name, text in found)


def test_a_stop_by_the_servo_does_not_hide_the_joint_that_is_wrong(monkeypatch: pytest.MonkeyPatch):
    """The pan's encoder stands still in the twin."""
    check, encoders = JointCheck(LIMITS), SimulatedLab.encoders

    def wrong(lab: SimulatedLab, time: float):
        found = encoders(lab, time)
        return replace(found, position=np.where(np.arange(len(HOME)) == 0, HOME, found.position))

    with motion_lab(HOME, LIMITS) as lab, ExitStack() as stack:
        monkeypatch.setattr(SimulatedLab, "encoders", wrong)
        stack.callback(monkeypatch.undo)
        with pytest.raises(DeploymentError):
            lab.follow(check.plan, check.note)
    assert check.findings()[0].startswith("shoulder_pan_joint does not follow")


class StubPipeline:
    """A pipeline whose policy holds the start pose, and whose object is where the test puts it."""

    def __init__(self) -> None:
        self.sight = SimpleNamespace(center=np.array([600.0, 100.0]), box_stamp=10.0)
        self.is_seen = False

    def decide(self, joint_pos: np.ndarray, now: float) -> JointTargets | None:
        stamps = dict.fromkeys(("target_stamp", "image_stamp", "box_stamp"), now)
        return JointTargets(joint_pos_target=joint_pos, **stamps) if self.is_seen else None

    def rest(self, joint_pos: np.ndarray) -> np.ndarray:
        return joint_pos


class Session:
    """A cycle whose robot follows at once."""

    def __init__(self) -> None:
        self.pipeline, self.waits, self.says, self.now = StubPipeline(), 0, list[str](), 10.0
        pipeline: Any = self.pipeline
        self.cycle = ThrowCycle(pipeline, PROFILE, LIMITS, RGB_CAMERA, "near", is_stepped=True)
        self.cycle.begin_waiting = self.count
        self.joint_pos = HOME.copy()
        self.cycle.arm(self.joint_pos, self.now + 1.0)

    def count(self) -> None:
        self.waits, self.pipeline.is_seen = self.waits + 1, False

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / CONTROL_DT)):
            self.now += CONTROL_DT
            targets = self.cycle.decide(self.joint_pos, self.now)
            assert targets is not None
            assert np.abs(targets.joint_pos_target - self.joint_pos).max() < 0.12  # a closing finger
            self.joint_pos = targets.joint_pos_target
            self.says += [self.cycle.message.split(":")[0]] if self.cycle.message else []

    def throw(self, center: Sequence[float]) -> None:
        self.pipeline.is_seen = True
        self.run(0.1)
        assert self.cycle.phase == "throw"
        self.pipeline.sight.center, self.pipeline.sight.box_stamp = np.array(center), self.now

    def require_return(self) -> None:
        assert (self.cycle.phase, self.waits) == ("wait", 1)
        assert self.joint_pos == pytest.approx(HOME)


def test_the_robot_carries_what_it_caught_and_returns():
    palms, _ = WorkcellGeometry(WORKCELL).palm_poses(torch.tensor(HOME[None], dtype=torch.float32))
    session = Session()
    session.throw(project(RGB_CAMERA, palms)[0][0, 0].tolist())
    session.run(HELD_TIME + 0.1)
    assert session.cycle.phase == "move"
    session.run(30.0)
    assert [*dict.fromkeys(session.says)][:2] == ["to near", "to the start pose"]
    session.require_return()


def test_the_robot_returns_from_a_miss_at_once():
    session = Session()
    session.joint_pos[0] += 0.2
    session.throw((10.0, 470.0))
    session.run(MISSED_TIME + 20.0)
    assert "to near" not in session.says
    session.require_return()


def test_a_stop_in_a_throw_or_a_motion_goes_on_when_the_robot_is_armed_again():
    session = Session()
    session.throw((300.0, 300.0))
    session.cycle.arm(session.joint_pos, session.now)  # the object may be in the hand
    session.run(1.0)
    assert session.says[-1] == "to near"
    session.cycle.arm(session.joint_pos, session.now + 1.0)
    before = session.joint_pos.copy()
    session.run(0.9)  # while the servo's ramp lasts
    assert session.joint_pos[:6] == pytest.approx(before[:6])
    session.run(30.0)
    session.require_return()


def test_two_throws_are_caught_without_touching_the_robot(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(stepped, "twin_profile", lambda _: PROFILE)
    monkeypatch.setattr(throw_cycle, "SHARE", 0.9)
    policy, _ = load_policy(None)
    cfg = RehearsalCfg(plain=True, throws=2, seed=100, after_catch="near")
    with in_step(cfg, task_of(policy, physics_hz=120.0), policy) as (twin, statistics):
        report = run_throws(cfg, twin.operator, lambda _: None)
    assert (report["success_rate"], report["problems"], statistics.stops) == (1.0, 0, {})


@pytest.mark.parametrize("name", ["../../escaped", "/etc/escaped", "a" * 1000, "nul\0"])
def test_the_name_of_a_profile_leads_to_no_other_folder(name: str):
    path = record_of_today(name)
    assert path.parent == USER_CACHE.expanduser()
    assert not path.exists()
