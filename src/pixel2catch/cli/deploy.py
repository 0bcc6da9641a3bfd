"""`pixel2catch deploy`: let a policy catch with a robot, or with its digital twin."""

import gc
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from pixel2catch.checks import NewFolder, Positive
from pixel2catch.cli.console import say, saying_changes
from pixel2catch.cli.link import Link
from pixel2catch.files import json_text
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest
from pixel2catch.perception.factory import PerceptionArgs
from pixel2catch.shipped import PolicyPath

if TYPE_CHECKING:
    from pixel2catch.deployment.control_loop import ControlLoop
    from pixel2catch.deployment.policy_pipeline import PolicyPipeline
    from pixel2catch.ros2.profile import Profile
    from pixel2catch.ros2.transport import Clock
    from pixel2catch.scene.constants import CameraSpec


@dataclass(frozen=True, kw_only=True)
class Vision:
    """What looks for the object beside a robot."""

    mask_robot: bool = True  #: Ignore motion where the robot is in the image.
    perception: PerceptionArgs = field(default_factory=PerceptionArgs)  #: What looks for the object.

    def make_pipeline(
        self, policy_path: Path | None, profile: "Profile", camera: "CameraSpec", *, is_live: bool
    ) -> "PolicyPipeline":
        """Perception and policy, for this robot and camera, a live one or one that was recorded."""
        from pixel2catch.deployment.policy_pipeline import PolicyController, make_pipeline
        from pixel2catch.evaluation.loading import load_policy
        from pixel2catch.perception.robot_mask import RobotMask
        from pixel2catch.workcells import find_workcell

        policy, _ = load_policy(policy_path)
        workcell = find_workcell(profile.workcell)
        controller = PolicyController(policy, workcell, camera)
        profile.require(policy.contract.commands)
        robot = RobotMask(workcell, camera) if self.mask_robot else None
        prompter = self.perception.make_prompter(camera)
        segmenter = self.perception.make_segmenter(is_live=is_live, say=say)
        return make_pipeline(controller, segmenter, prompter, camera, robot)


@dataclass(frozen=True, kw_only=True)
class Deploy:
    """Catch with a robot: camera images and joint states in, joint commands out. See docs/deployment.md.

    The robot stays where it is until an operator arms it on /pixel2catch/arm and holds the dead-man's switch
    on /pixel2catch/dead_man; whatever goes wrong stops it until it is armed again. It runs until Ctrl-C, and
    says what has ended it; the exit status is 0 if the recording is whole and nothing else has ended it.
    """

    #: Folder of a policy or of its training run, an ONNX file, or a shipped name. Default: catch_alone+fit.
    policy: Positional[PolicyPath | None] = None
    #: New folder for a rosbag2 (MCAP) of all that was seen, decided and commanded.
    record: NewFolder | None = None
    #: How images are recorded; raw ones are 27 MB a second.
    record_images: Literal["jpeg", "raw", "none"] = "jpeg"
    seconds: Positive | None = None  #: When to end. Default: at Ctrl-C.
    json: bool = False  #: Print the summary as one JSON object, and each status as a line of JSON.
    vision: Vision = field(default_factory=Vision)  #: What looks for the object.
    link: Link = field(default_factory=Link)  #: How the robot is reached, and how fast it may be.

    def run(self) -> None:
        """Deploy until the end, and say what happened."""
        with needs_extra("deployment"):
            from pixel2catch.deployment.control_loop import ControlLoop
            from pixel2catch.deployment.image_subscriber import ImageSubscriber
            from pixel2catch.servo.link import CONTROL_LOOP, LOOP_PRIORITY, set_niceness, set_real_time
        set_niceness(CONTROL_LOOP)
        self.vision.perception.prepare()
        notes: list[str] = []
        camera, profile = self.vision.perception.camera_spec(notes), self.link.robot.load()
        pipeline = self.vision.make_pipeline(self.policy, profile, camera, is_live=True)
        for note in notes:
            say(note)
        if self.vision.perception.checkpoint is None:  # a large network may want all cores, and for long
            set_real_time(LOOP_PRIORITY)
        with ExitStack() as stack:
            executor = stack.enter_context(ThreadPoolExecutor(1, thread_name_prefix="perception"))
            connection = self.link.connect(profile, self.record, self.record_images, stack)
            clock = connection.clock
            images = ImageSubscriber(
                connection.transport, profile.camera, camera, clock, assumes_age=pipeline.knows_age
            )
            control_loop = ControlLoop(pipeline, images, connection, profile.operator, executor)
            ended_by = self._loop(control_loop, clock)
        summary = control_loop.statistics.summary()
        print(
            json_text({"summary": summary, "ended_by": ended_by}, indent=None)
            if self.json
            else "\n".join([*lines(summary), f"ended by {ended_by}", ""]),
            end="",
        )
        if connection.recording:
            connection.recording.require_whole()

    def _loop(self, control_loop: "ControlLoop", clock: "Clock") -> str:
        """Run until a signal, which is returned, or the time is over, and say when something changes."""
        from pixel2catch.servo.status_words import sentence

        gc.collect()
        gc.freeze()  # what there is now stays: it need not be looked through again and again
        begin, hear = clock.now(), saying_changes()

        def report(status: dict[str, Any]) -> None:
            if self.json:
                print(json_text(status, indent=None), end="", flush=True)
            else:
                hear(sentence(status), clock.now() - begin)

        with StopRequest() as stop:
            end = begin + (inf if self.seconds is None else self.seconds)
            control_loop.run(lambda: stop.is_set or clock.now() > end, report)
        return stop.by or "--seconds"


def lines(summary: dict[str, Any]) -> Iterator[str]:
    """What happened, in words."""
    yield (
        f"{summary['num_steps']} control steps, {summary['num_missed']} without a new image, "
        f"{summary['num_overruns']} too long; {summary['num_ticks']} servo ticks, "
        f"{summary['num_late_ticks']} late"
    )
    for name in ("image_to_command_ms", "thinking_ms", "servo_tick_ms"):
        if values := summary[name]:
            times = ", ".join(f"{key} {values[key]:.2f}" for key in ("p50", "p90", "p99", "max"))
            yield f"{name.removesuffix('_ms').replace('_', ' ')} [ms]: {times}"
    ages = [f"{name} {values['p50']:.1f}" for name, values in summary["stages_ms"].items() if values]
    if ages:
        yield f"age of an image [ms], in the median: {', '.join(ages)}"
    for name in ("stops", "refusals", "clamps", "stop_requests", "refused_prompts"):
        for reason, count in summary[name].items():
            yield f"{name.replace('_', ' ')}: {reason}: {count}"
