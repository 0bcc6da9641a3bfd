"""`pixel2catch deploy`: let a policy catch with a robot, or with its digital twin."""

import gc
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional

from pixel2catch.checks import NewFolder, OutputFile, require_only, require_used
from pixel2catch.cli.console import say, saying_changes
from pixel2catch.cli.link import Link
from pixel2catch.files import json_text, printable
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest
from pixel2catch.perception.factory import PerceptionArgs
from pixel2catch.shipped import PolicyPath

if TYPE_CHECKING:
    from pixel2catch.deployment.policy_pipeline import PolicyPipeline
    from pixel2catch.ros2.profile import Profile
    from pixel2catch.scene.constants import CameraSpec


def make_pipeline(
    perception: PerceptionArgs,
    policy_path: Path | None,
    profile: "Profile",
    camera: "CameraSpec",
    *,
    is_live: bool,
) -> "PolicyPipeline":
    """Build perception and policy for a robot and a camera, a live one or a recorded one."""
    from pixel2catch.deployment.policy_pipeline import PolicyController, PolicyPipeline
    from pixel2catch.evaluation.loading import load_policy, region_remark
    from pixel2catch.perception.regions import RobotMask
    from pixel2catch.workcells import find_workcell

    policy, method = load_policy(policy_path)
    for remark in region_remark(method, camera):
        say(remark)
    workcell = find_workcell(profile.workcell)
    controller = PolicyController(policy, workcell, camera)
    profile.require(policy.contract.commands)
    prompter = perception.make_prompter(camera)
    segmenter = perception.make_segmenter(is_live=is_live, say=say)
    return PolicyPipeline(controller, segmenter, prompter, camera, RobotMask(workcell, camera))


@dataclass(frozen=True, kw_only=True)
class Deploy:
    """Catch with a robot. See docs/deployment.md.

    The robot stays where it is until an operator arms it on /pixel2catch/arm and holds the dead-man's switch
    on /pixel2catch/dead_man; any fault stops it until it is armed again. It runs until Ctrl-C, and prints
    what ended it; the exit status is 0 if the recording is complete and nothing else ended it.
    """

    #: Folder of a policy or of its training run, an ONNX file, or a shipped name. Default: catch_alone+fit.
    policy: Positional[PolicyPath | None] = None
    #: New folder for a rosbag2 (MCAP) of images (JPEG), joint states, decisions and commands.
    record: NewFolder | None = None
    json: bool = False  #: Print the summary as one JSON object, and each status as a line of JSON.
    dry_run: bool = False  #: Send nothing to the robot, and announce no command.
    #: New file, such as my_lab.yaml, for a copy of the --profile with its comments, as the start of your own.
    #: Nothing else is done.
    write_profile: Annotated[Path, OutputFile((".yaml", ".yml"), is_new=True)] | None = None
    #: Place of the profile over which the robot releases what it caught. It then returns to its start pose
    #: and waits for the next throw, armed. These motions have a quarter of a catch's speed at most.
    after_catch: str | None = None
    #: Before the throws, each joint moves by some degrees, and the encoder that follows is compared with the
    #: profile. At a terminal this is asked once a day, if a robot can be reached.
    joint_check: bool = False
    perception: PerceptionArgs = field(default_factory=PerceptionArgs)  #: How the object is found.
    link: Link = field(default_factory=Link)  #: The network of the robot, and the limits of its motion.

    def run(self) -> None:
        with needs_extra("deployment"):
            from pixel2catch.deployment.control_loop import ControlLoop
            from pixel2catch.deployment.follower import check_joints
            from pixel2catch.deployment.throw_cycle import ThrowCycle
            from pixel2catch.servo import link
            from pixel2catch.servo.status_words import sentence
        if self.write_profile:
            require_only(self, ("write_profile", "profile"), "with --write-profile")
            self.link.robot.write_copy(self.write_profile)
            return
        is_check_due = self._is_check_due()
        link.set_niceness(link.CONTROL_LOOP)
        self.perception.prepare()
        notes: list[str] = []
        camera, profile = self.perception.camera_spec(notes), self.link.robot.load()
        pipeline = make_pipeline(self.perception, self.policy, profile, camera, is_live=True)
        for note in notes:
            say(note)
        if self.perception.checkpoint is None:  # a large network may use all cores for long
            link.set_real_time(link.LOOP_PRIORITY)
        hear, begin, stop = saying_changes(), time.monotonic(), StopRequest()

        def report(status: dict[str, Any]) -> None:
            if self.json:
                print(json_text(status, indent=None), end="", flush=True)
            else:
                hear(sentence(status), self.link.clock * (time.monotonic() - begin))

        with ExitStack() as stack:
            executor = stack.enter_context(ThreadPoolExecutor(1, thread_name_prefix="perception"))
            limits, place = self.link.limits(profile), self.after_catch
            cycle = ThrowCycle(pipeline, profile, limits, camera, place) if place is not None else None
            connection = self.link.connect(
                profile, limits, stack, self.record, "jpeg", is_dry_run=self.dry_run
            )
            gc.collect()
            gc.freeze()  # later collections skip what exists now
            with stop:
                if is_check_due:
                    check_joints(connection, profile, limits, lambda: stop.is_set, report)
                loop = ControlLoop(pipeline, camera, connection, profile, executor, cycle=cycle)
                loop.run(lambda: stop.is_set, report)
        summary = loop.statistics.summary()
        words = "\n".join([*summary_lines(summary), f"ended by {stop.by}\n"])
        ended = {"summary": summary, "ended_by": stop.by}
        print(json_text(ended, indent=None) if self.json else words, end="")
        if connection.recording:
            connection.recording.require_whole()

    def _is_check_due(self) -> bool:
        """Return whether the joints are to be checked now; at a terminal, a person decides."""
        from pixel2catch.deployment.follower import record_of_today

        require_used(self, ("joint_check", "after_catch"), not self.dry_run, "with --dry-run")
        name = self.link.robot.load().name
        if self.joint_check or self.dry_run or self.link.is_twin or record_of_today(name).exists():
            return self.joint_check
        if sys.stdin.isatty():
            return input("Check the joints, each by some degrees? [Y/n] ").strip().lower() in ("", "y", "yes")
        say("the joints of this profile were not checked today: add --joint-check")
        return False


def summary_lines(summary: dict[str, Any]) -> Iterator[str]:
    """Yield the summary of a deployment in words."""
    from pixel2catch.servo.status_words import fault_words

    yield (
        "{num_steps} control steps, {num_missed} without a new image, {num_overruns} too long; "
        "{num_ticks} servo ticks, {num_late_ticks} late".format(**summary)
    )
    for name in ("image_to_command_ms", "thinking_ms", "servo_tick_ms"):
        if values := summary[name]:
            times = ", ".join(f"{key} {values[key]:.2f}" for key in ("p50", "p90", "p99", "max"))
            yield f"{name.removesuffix('_ms').replace('_', ' ')} [ms]: {times}"
    if ages := [f"{name} {values['p50']:.1f}" for name, values in summary["stages_ms"].items() if values]:
        yield f"median age of an image [ms]: {', '.join(ages)}"
    for name, words in (("stops", "stopped"), ("refusals", "arming refused")):
        for reasons, count in summary[name].items():
            yield f"{words} {count} x: {'; '.join(fault_words(each)[0] for each in reasons.split(', '))}"
    for name, words in (("stop_requests", "stop requested by"), ("refused_prompts", "prompts refused of")):
        for sender, count in summary[name].items():
            yield f"{words} {printable(sender)}: {count} x"
