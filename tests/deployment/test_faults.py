"""A whole deployment in a laboratory in which things go wrong, in time that passes only while it steps."""

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from random import Random
from typing import Any

import numpy as np
import pytest
from arming import Arming
from camera_lab import CameraLab
from loop_lab import PROFILE, EverythingRed
from servo_rows import LIMITS

from mutation import changed_bytes
from pixel2catch.deployment.image_subscriber import NUM_EQUAL
from pixel2catch.deployment.policy_pipeline import FADE_STEPS, PolicyController, make_pipeline
from pixel2catch.deployment.stepped import StepClock, SteppedLoop, SteppedServo, perception_times
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.perception.tracker import Prompter
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.servo.limits import LOSS_TIME, STOP_TIME
from pixel2catch.servo.process import ServoSetup
from pixel2catch.workcells import find_workcell

ARM = PROFILE.robots[0].command_topic
NUM_CHANGES = 12  #: Of a message of each topic.


class Watcher(Arming):
    """Deployment and laboratory: hears what the one says and does, and tells the other what goes wrong."""

    def __init__(self) -> None:
        self.clock, self.broker = StepClock(self.wait_until), Broker()
        self.clock.time = 1000.0
        self.start_laboratory()
        node = self.broker.node(self.clock)
        self._statuses = node.subscription(PROFILE.operator.status, 50)
        self._commands = node.subscription(ARM, 50, only_watches=True)
        self.statuses: list[dict[str, Any]] = []
        self.commands: list[tuple[float, np.ndarray]] = []
        policy, _ = load_policy(None)
        prompter = Prompter()
        pipeline = make_pipeline(
            PolicyController(policy, find_workcell(PROFILE.workcell)),
            EverythingRed(),
            prompter,
            RGB_CAMERA,
            None,
        )
        nodes = self.broker.node(self.clock), self.broker.node(self.clock)
        self.servo = SteppedServo(ServoSetup(profile=PROFILE, limits=LIMITS), nodes, self.clock, None)
        self.loop = SteppedLoop(self.servo, RGB_CAMERA, pipeline, perception_times(0.01))
        self.does_policy_hang = self.is_laboratory_gone = False

    def start_laboratory(self) -> None:
        self.lab_node, self.is_laboratory_gone = self.broker.node(self.clock), False
        self._laboratory = CameraLab(self.lab_node, PROFILE, self.clock)

    def kill_laboratory(self) -> None:
        self.lab_node.close()
        self.is_laboratory_gone = True

    def say(self, word: str) -> None:
        """Tell the laboratory."""
        self._laboratory.faults[word]()

    def wait_until(self, moment: float) -> None:
        while self.clock.time < moment - 1e-9:
            self.clock.time += LIMITS.dt
            if not self.is_laboratory_gone:
                self._laboratory.step()
            self.servo.tick()
            if not self.does_policy_hang:
                self.loop.look()
            self._listen()

    def until(self, holds: Callable[[], bool], seconds: float = 3.0) -> None:
        """Listen until something holds."""
        end = self.clock.time + seconds
        while not holds():
            assert self.clock.time < end, self.statuses[-1:]
            self.wait(LIMITS.dt)

    def wait(self, seconds: float) -> None:
        self.wait_until(self.clock.time + seconds)

    def _listen(self) -> None:
        self.statuses += [json.loads(messages.read_text(message.data)) for message in self._statuses.take()]
        self.commands += [
            (message.arrival, messages.read_float_array(message.data)) for message in self._commands.take()
        ]

    @property
    def time(self) -> float:
        return self.clock.time

    @property
    def status(self) -> dict[str, Any]:
        return self.statuses[-1] if self.statuses else {"mode": "", "found": []}

    def run(self) -> None:
        """The operator arms and points, and the policy moves the arm."""
        self.arm()
        self.say("point")
        self.until(lambda: self.status["mode"] == "run")

    def stopped_by(self) -> list[str]:
        """Wait for the stop, and for the commands to stand still, which must not take too long."""
        self.until(lambda: self.status["mode"] == "stopped")
        reasons = self.status["stopped_by"]
        self.require_standstill(self.clock.time + STOP_TIME)
        return reasons

    def require_standstill(self, since: float) -> None:
        self.wait_until(since + STOP_TIME)
        late = [command for arrival, command in self.commands if arrival > since]
        assert len(late) > 10
        assert not np.diff(late, axis=0).any()


@pytest.fixture
def watcher() -> Iterator[Watcher]:
    """Over all that is commanded, no command passes a limit."""
    watcher = Watcher()
    with closing(watcher.servo):
        yield watcher
    arm, commands = PROFILE.robots[0].ids, np.array([command for _, command in watcher.commands])
    assert len(commands) > 50
    assert (commands >= LIMITS.joints.lower[arm] - 1e-9).all()
    assert (commands <= LIMITS.joints.upper[arm] + 1e-9).all()


@pytest.mark.parametrize(
    ("fault", "reasons"),
    [
        ("camera killed", {"image stale"}),
        ("publisher frozen", {"joints stale"}),
        ("NaN joint", {"joints not finite"}),
        ("joint missing", {"joints stale"}),
        ("joints repeated", {"tracking error"}),
        ("images late", {"image stale"}),
        ("wrong image size", {"perception unsound"}),
        ("image frozen", {"perception unsound"}),
        ("another camera", {"perception unsound"}),
        ("stamps go back", {"perception unsound"}),
        ("box jumps", {"perception unsound"}),
        ("protective stop", {"safety mode"}),
        ("slider", {"speed scaling"}),
        ("switch let go", {"dead man"}),
    ],
)
def test_a_fault_stops_the_robot(fault: str, reasons: set[str], watcher: Watcher):
    watcher.run()
    watcher.say(fault)
    assert set(watcher.stopped_by()) == reasons


def test_a_stop_is_latched_until_somebody_arms(watcher: Watcher):
    watcher.run()
    watcher.say("protective stop")
    watcher.stopped_by()
    watcher.say("none")
    watcher.until(lambda: not {"safety mode", "joints stale"} & set(watcher.status["found"]))
    num = len(watcher.statuses)
    watcher.until(lambda: len(watcher.statuses) > num + 20)
    assert {status["mode"] for status in watcher.statuses[num:]} == {"stopped"}
    watcher.run()


def test_joints_in_another_order_change_nothing(watcher: Watcher):
    watcher.run()
    watcher.say("joints shuffled")
    num = len(watcher.statuses)
    watcher.until(lambda: len(watcher.statuses) > num + 20)
    assert watcher.status["mode"] == "run"


def test_a_policy_that_hangs_stops_the_robot(watcher: Watcher):
    """The control loop sleeps; the servo does not."""
    watcher.run()
    watcher.does_policy_hang = True
    watcher.require_standstill(watcher.clock.time + LIMITS.target_age + 1.1 * STOP_TIME)
    watcher.does_policy_hang = False
    watcher.until(lambda: watcher.status["mode"] == "stopped")
    assert {"policy late", "image stale"} & set(watcher.status["stopped_by"])


def test_a_killed_laboratory_stops_everything_and_a_new_one_can_be_armed(watcher: Watcher):
    watcher.run()
    watcher.kill_laboratory()
    watcher.until(lambda: watcher.status["mode"] == "stopped")
    assert {"joints stale", "image stale", "no subscriber"} & set(watcher.status["stopped_by"])
    watcher.start_laboratory()
    watcher.run()


def test_no_message_on_any_topic_ends_it(watcher: Watcher):
    """Each is changed at random, and heard by servo and control loop; mended, the robot is armed again."""
    others, info = watcher.broker.node(watcher.clock), PROFILE.camera.info
    assert info is not None
    others.publisher(info).publish(messages.camera_info(RGB_CAMERA, 0.0))
    others.publisher(PROFILE.operator.stop).publish(messages.boolean(False))
    watcher.run()
    valid = [(each, each.last) for each in (*watcher.lab_node.publishers, *others.publishers) if each.last]
    assert len({each.topic.type for each, _ in valid}) == 9
    random = Random(0)
    for publisher, good in NUM_CHANGES * valid:
        publisher.publish(changed_bytes(good, random))
        watcher.wait(LIMITS.dt)
        publisher.publish(good)
    watcher.say("none")
    watcher.run()


def test_somebody_else_who_commands_the_robot_stops_it(watcher: Watcher):
    watcher.run()
    other = watcher.broker.node(watcher.clock).publisher(ARM)
    other.publish(messages.float_array(watcher.commands[-1][1]))
    watcher.until(lambda: watcher.status["mode"] == "stopped")
    assert "other publisher" in watcher.status["stopped_by"]
    num_commands = len(watcher.commands)
    watcher.wait(STOP_TIME)
    assert len(watcher.commands) == num_commands  # it does not fight


def speed(watcher: Watcher, seconds: float) -> float:
    """How fast an arm's commands are for some time [rad/s]."""
    num = len(watcher.commands)
    watcher.wait(seconds)
    moved = np.abs(np.diff([command for _, command in watcher.commands[num:]], axis=0)).max(axis=1)
    return float(moved.mean()) / LIMITS.dt


def test_a_frozen_image_stops_the_robot_within_a_few_images_and_says_why(watcher: Watcher):
    watcher.run()
    watcher.say("image frozen")
    begin = watcher.clock.time
    watcher.until(lambda: watcher.status["mode"] == "stopped")
    assert watcher.clock.time - begin < (NUM_EQUAL + 2) * CONTROL_DT
    assert "is frozen" in watcher.status["message"]


def test_without_an_object_the_robot_waits_armed_for_as_long_as_the_switch_is_held(watcher: Watcher):
    watcher.say("object gone")
    watcher.wait(0.3)
    watcher.say("arm")
    watcher.until(lambda: watcher.status["mode"] == "armed")
    watcher.wait(LOSS_TIME + 0.2)
    assert (watcher.status["mode"], watcher.status["object"]) == ("armed", "never seen")


def test_an_object_that_is_hidden_for_a_while_is_waited_for_at_rest(watcher: Watcher):
    """Seen again, the policy goes on; nobody has to arm."""
    watcher.run()
    assert watcher.status["object"] == "seen"
    watcher.say("object gone")
    watcher.until(lambda: watcher.status["object"] == "searching")
    watcher.wait((FADE_STEPS + 3) * CONTROL_DT)
    assert speed(watcher, 0.3) < 1e-6
    watcher.say("none")
    watcher.until(lambda: watcher.status["object"] == "seen")
    assert speed(watcher, 0.3) > 1e-3
    assert watcher.status["mode"] == "run"


def test_an_object_that_is_gone_for_long_is_lost_and_whoever_goes_there_is_no_object(watcher: Watcher):
    watcher.run()
    watcher.say("object gone")
    begin = watcher.clock.time
    watcher.until(lambda: watcher.status["mode"] == "stopped", 2.0 * LOSS_TIME)
    assert watcher.clock.time - begin == pytest.approx(LOSS_TIME, abs=0.2)
    assert (watcher.status["stopped_by"], watcher.status["object"]) == (["object lost"], "lost")
    watcher.say("none")
    watcher.until(lambda: watcher.status["object"] == "seen")
    watcher.wait(0.2)
    assert watcher.status["mode"] == "stopped"
