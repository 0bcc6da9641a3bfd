"""`pixel2catch replay`: let perception and policy decide again on a recorded deployment."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from pixel2catch.checks import NewFolder
from pixel2catch.cli.deploy import make_pipeline, summary_lines
from pixel2catch.cli.link import Robot
from pixel2catch.files import json_text, write_atomically
from pixel2catch.installation import needs_extra
from pixel2catch.perception.factory import PerceptionArgs
from pixel2catch.shipped import PolicyPath

REPORT = "report.json"  #: File in the output folder with the comparison and all times.


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Decide again on a recorded deployment, step by step.

    Images, joint states and operator are recorded; nothing is sent to a robot. With the recorded policy and
    perception the targets are the recorded ones, except for the effects of JPEG and of perception times.
    """

    recording: Positional[Path]  #: Recording of `deploy --record` or `rehearse --record`, with images.
    out: NewFolder  #: New folder for the recording (MCAP) of the new decisions and report.json.
    #: Folder of a policy or of its training run, an ONNX file, or a shipped name. Default: catch_alone+fit.
    policy: PolicyPath | None = None
    robot: Robot = field(default_factory=Robot)  #: The recorded robot.
    perception: PerceptionArgs = field(default_factory=PerceptionArgs)  #: How the object is found.

    def run(self) -> None:
        with needs_extra("deployment"):
            from pixel2catch.deployment.replay import compare, recorded_targets, replay
            from pixel2catch.workcells import find_workcell
        notes: list[str] = []
        profile, camera = self.robot.load(), self.perception.camera_spec(notes)
        self.perception.prepare()
        pipeline = make_pipeline(self.perception, self.policy, profile, camera, is_live=False)
        statistics = replay(self.recording, self.out, profile, camera, pipeline)
        then, now = recorded_targets(self.recording), recorded_targets(self.out)
        report = {
            "deploy": statistics.summary(),
            "decided": compare(then, now, find_workcell(profile.workcell)),
        }
        write_atomically({self.out / REPORT: json_text(report)})
        print("\n".join([*notes, *_lines(report)]))


def _lines(report: dict[str, Any]) -> Iterator[str]:
    yield from summary_lines(report["deploy"])
    same = report["decided"]
    counts = f"{same['num_then']} recorded, {same['num_now']} in the replay, {same['num_both']} in both"
    yield f"images with targets: {counts}"
    for part, difference in same.items():
        if not part.startswith("num_"):
            median, most = difference["median"], difference["max"]
            yield f"{part}: difference of the targets [rad]: median {median:.4f}, max {most:.4f}"
