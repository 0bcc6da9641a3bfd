"""A whole deployment in a laboratory in which things go wrong, in stepped time."""

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from random import Random
from typing import Any

import numpy as np
import pytest
from camera_lab import Arming, CameraLab
from loop_lab import PROFILE, EverythingRed
from servo_rows import LIMITS

from mutation import changed_bytes
from pixel2catch.deployment.control_loop import ControlLoop, StepClock, SteppedServo
from pixel2catch.deployment.perception import NUM_EQUAL
from pixel2catch.deployment.policy_pipeline import FADE_STEPS, PolicyController, PolicyPipeline
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.perception.tracker import Prompter
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.servo.limits import LOSS_TIME, STOP_TIME
from pixel2catch.servo.process import ServoSetup
from pixel2catch.workcells import find_workcell

ARM = PROFILE.robots[0].command_topic
NUM_CHANGES = 6  #: Of a message of each topic.


class SteppedBench(Arming):
    """Deployment and laboratory: receives statuses and commands, and controls the laboratory."""

    def __init__(self) -> None:
        self.clock, self.broker = StepClock(self.wait_until), Broker()
        self.clock.time = 1000.0
        self.lab_node = self.broker.node(self.clock)
        self._laboratory = CameraLab(self.lab_node, PROFILE, self.clock)
        node = self.broker.node(self.clock)
        self._statuses = node.subscription(PROFILE.operator.status, 50)
        self._commands = node.subscription(ARM, 50, only_watches=True)
        self.status: dict[str, Any] = {"mode": "", "found": []}
        self.commands: list[tuple[float, np.ndarray]] = []
        policy, _ = load_policy(None)
        controller = PolicyController(policy, find_workcell(PROFILE.workcell))
        pipeline = PolicyPipeline(controller, EverythingRed(), Prompter())
        nodes = self.broker.node(self.clock), self.broker.node(self.clock)
        self.servo = SteppedServo(ServoSetup(profile=PROFILE, limits=LIMITS), nodes, self.clock, None)
        connection = self.servo.connection
        self.loop = ControlLoop(pipeline, RGB_CAMERA, connection, PROFILE, perception_time=lambda: 0.01)
        self.does_policy_hang = False

    def say(self, word: str) -> None:
        self._laboratory.faults[word]()

    def wait_until(self, moment: float) -> None:
        while self.clock.time < moment - 1e-9:
            self.clock.time += LIMITS.dt
            self._laboratory.step()
            self.servo.tick()
            if not self.does_policy_hang:
                self.loop.poll()
            for message in self._statuses.take():
                self.status = json.loads(messages.read_text(message.data))
            self.commands += [
                (each.arrival, messages.read_float_array(each.data)) for each in self._commands.take()
            ]

    def until(self, holds: Callable[[], bool], seconds: float = 3.0) -> None:
        end = self.clock.time + seconds
        while not holds():
            assert self.clock.time < end, self.status
            self.wait(LIMITS.dt)

    def wait(self, seconds: float) -> None:
        self.wait_until(self.clock.time + seconds)

    def run(self) -> None:
        """The operator arms and points, and the policy moves the arm."""
        self.arm()
        self.say("point")
        self.until(lambda: self.status["mode"] == "run")

    def speed(self, seconds: float) -> float:
        """Speed of the arm's commands for some time [rad/s]."""
        num = len(self.commands)
        self.wait(seconds)
        change = np.abs(np.diff([command for _, command in self.commands[num:]], axis=0)).max(axis=1)
        return float(change.mean()) / LIMITS.dt

    def require_standstill(self, since: float) -> None:
        self.wait_until(since + STOP_TIME)
        late = [command for arrival, command in self.commands if arrival > since]
        assert len(late) > 10
        assert not np.diff(late, axis=0).any()


@pytest.fixture
def bench() -> Iterator[SteppedBench]:
    """At the end, no command was beyond a limit."""
    bench = SteppedBench()
    with closing(bench.servo):
        yield bench
    arm, commands = PROFILE.robots[0].ids, np.array([command for _, command in bench.commands])
    assert len(commands) > 50
    assert (commands >= LIMITS.joints.lower[arm] - 1e-9).all()
    assert (commands <= LIMITS.joints.upper[arm] + 1e-9).all()


def test_a_fault_of_the_images_stops_the_robot_until_it_is_armed_again(bench: SteppedBench):
    """`test_servo_faults` has the faults that the servo finds in its own inputs."""
    bench.run()
    for fault, reason in (("camera killed", "image stale"), ("box jumps", "perception unsound")):
        bench.say(fault)
        bench.until(lambda: bench.status["mode"] == "stopped")
        assert bench.status["stopped_by"] == [reason]
        bench.require_standstill(bench.clock.time + STOP_TIME)
        bench.run()
    bench.say("image frozen")
    begin = bench.clock.time
    bench.until(lambda: bench.status["mode"] == "stopped")
    assert bench.status["stopped_by"] == ["perception unsound"]
    assert bench.clock.time - begin < (NUM_EQUAL + 2) * CONTROL_DT
    assert "is frozen" in bench.status["message"]


def test_a_policy_that_hangs_stops_the_robot(bench: SteppedBench):
    """The control loop is suspended; the servo is not."""
    bench.run()
    bench.does_policy_hang = True
    bench.require_standstill(bench.clock.time + LIMITS.target_age + 1.1 * STOP_TIME)
    bench.does_policy_hang = False
    bench.until(lambda: bench.status["mode"] == "stopped")
    assert {"policy late", "image stale"} & set(bench.status["stopped_by"])


def test_no_message_on_any_topic_ends_it(bench: SteppedBench):
    """Each is changed at random and received by servo and control loop; then the robot can be armed again."""
    others, info = bench.broker.node(bench.clock), PROFILE.camera.info
    assert info is not None
    others.publisher(info).publish(messages.camera_info(RGB_CAMERA, 0.0))
    others.publisher(PROFILE.operator.stop).publish(messages.boolean(False))
    bench.run()
    valid = [(each, each.last) for each in (*bench.lab_node.publishers, *others.publishers) if each.last]
    assert len({each.topic.type for each, _ in valid}) == 9
    random = Random(0)
    for publisher, good in NUM_CHANGES * valid:
        publisher.publish(changed_bytes(good, random))
        bench.wait(LIMITS.dt)
        publisher.publish(good)
    bench.run()


def test_a_hidden_object_is_waited_for_at_rest_and_lost_after_a_while(bench: SteppedBench):
    """Seen again in time, the policy goes on; later, the robot has to be armed again."""
    bench.run()
    assert bench.status["object"] == "seen"
    bench.say("object gone")
    bench.until(lambda: bench.status["object"] == "searching")
    bench.wait((FADE_STEPS + 3) * CONTROL_DT)
    assert bench.speed(0.3) < 1e-6
    bench.say("none")
    bench.until(lambda: bench.status["object"] == "seen")
    assert bench.speed(0.3) > 1e-3
    assert bench.status["mode"] == "run"
    bench.say("object gone")
    begin = bench.clock.time
    bench.until(lambda: bench.status["mode"] == "stopped", 2.0 * LOSS_TIME)
    assert bench.clock.time - begin == pytest.approx(LOSS_TIME, abs=0.2)
    assert (bench.status["stopped_by"], bench.status["object"]) == (["object lost"], "lost")
    bench.say("none")
    bench.until(lambda: bench.status["object"] == "seen")
    bench.wait(0.2)
    assert bench.status["mode"] == "stopped"


def test_an_armed_robot_waits_for_its_first_object_as_long_as_the_switch_is_held(bench: SteppedBench):
    bench.arm()
    bench.say("object gone")
    bench.wait(LOSS_TIME + 0.2)
    assert (bench.status["mode"], bench.status["object"]) == ("armed", "never seen")
