"""`pixel2catch replay`: let perception and policy decide once more on a recorded deployment."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from pixel2catch.checks import NewFolder, NotNegative
from pixel2catch.cli.deploy import Vision
from pixel2catch.cli.link import Robot
from pixel2catch.errors import InvalidValueError
from pixel2catch.files import json_text
from pixel2catch.installation import needs_extra
from pixel2catch.shipped import PolicyPath
from pixel2catch.viewer.config import PageCfg

if TYPE_CHECKING:
    from pixel2catch.ros2.profile import Profile
    from pixel2catch.scene.constants import CameraSpec


@dataclass(frozen=True, kw_only=True)
class Replay:
    """What this policy and perception would have decided in a deployment that was recorded, step by step.

    Images, joint states and the operator are those of then; nothing is sent to any robot. With the same
    policy and perception the targets are those of then, but for what JPEG and the perception's times change.
    """

    recording: Positional[Path]  #: What `deploy --record` or `rehearse --record` wrote, with images.
    #: New folder for the recording (MCAP) of what was decided now; needed but with --web.
    out: NewFolder | None = None
    web: bool = False  #: Whether to serve a page that shows the recording, instead of deciding once more.
    page: PageCfg = field(default_factory=PageCfg)  #: Where that page is served.
    #: Folder of a policy or of its training run, an ONNX file, or a shipped name. Default: catch_alone+fit.
    policy: PolicyPath | None = None
    perception_ms: NotNegative = 10.0  #: Time that perception takes for an image.
    json: bool = False  #: Print the report as one JSON object.
    robot: Robot = field(default_factory=Robot)  #: The robot of then.
    vision: Vision = field(default_factory=Vision)  #: What looks for the object.

    def run(self) -> None:
        """Replay, compare and report."""
        with needs_extra("deployment"):
            from pixel2catch.deployment.replay import compare, recorded_targets, replay
            from pixel2catch.workcells import find_workcell
        notes: list[str] = []
        profile, camera = self.robot.load(), self.vision.perception.camera_spec(notes)
        if self.web:
            return self._show(profile, camera)
        if self.out is None:
            raise InvalidValueError(
                "there is no folder to write to: add --out FOLDER, or --web to look at the recording."
            )
        self.vision.perception.prepare()
        pipeline = self.vision.make_pipeline(self.policy, profile, camera, is_live=False)
        perception_time = 1e-3 * self.perception_ms
        statistics = replay(self.recording, self.out, profile, camera, pipeline, perception_time)
        then, now = recorded_targets(self.recording), recorded_targets(self.out)
        report = {
            "deploy": statistics.summary(),
            "decided": compare(then, now, find_workcell(profile.workcell)),
        }
        print(json_text(report) if self.json else "\n".join([*notes, *_lines(report)]) + "\n", end="")

    def _show(self, profile: "Profile", camera: "CameraSpec") -> None:
        """Show the recording until Ctrl-C."""
        with needs_extra("viewer"):
            from pixel2catch.viewer.process import serve_until_interrupted
            from pixel2catch.viewer.replay import RecordingPage
        serve_until_interrupted(lambda: RecordingPage(self.page, self.recording, profile, camera))


def _lines(report: dict[str, Any]) -> Iterator[str]:
    from pixel2catch.cli.deploy import lines

    yield from lines(report["deploy"])
    same = report["decided"]
    yield f"decided on {same['num_then']} images then, {same['num_now']} now, {same['num_both']} both times"
    for part, differs in same.items():
        if not part.startswith("num_"):
            median, most = differs["median"], differs["max"]
            yield f"{part}: targets differ by {median:.4f} rad in the median, {most:.4f} at most"
