"""`pixel2catch export`: a policy as an ONNX file, throws or recordings as a data set of LeRobot."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from pixel2catch.checks import Count, Seed
from pixel2catch.cli.console import prepare, say
from pixel2catch.cli.link import Robot
from pixel2catch.errors import InvalidValueError
from pixel2catch.files import require_free_file, write_atomically
from pixel2catch.installation import needs_extra
from pixel2catch.shipped import DEFAULT_POLICY


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a policy as one ONNX file, or what policies do as a data set.

    --format onnx: networks, input statistics and the whole contract in a file that other commands take in the
    place of a policy's folder. --format lerobot: throws of a policy in simulation, or the recording of a
    deployment, as a data set of LeRobot (format 3.0).
    """

    #: Folder of a policy or of its training run, or a shipped name; with --format lerobot also a recording of
    #: `deploy --record` or `rehearse --record`. Default: catch_alone+fit.
    source: Positional[Path | None] = None
    format: Literal["onnx", "lerobot"] = "onnx"  #: Format of the output.
    #: The file, or the data set's new folder. Default: the source's name in the working directory.
    out: Path | None = None
    #: For throws: what is thrown: seen, unseen, real, sizes, or names of objects. Default: seen.
    objects: tuple[str, ...] = ()
    throws: Count = 100  #: For throws: how many.
    seed: Seed = 0  #: For throws: seed of everything that is drawn.
    #: For throws: draw the images of the robot's camera, which takes seconds a throw. Recorded images are
    #: always exported.
    images: bool = False
    robot: Robot = field(default_factory=Robot)  #: For a recording: the robot that was recorded.

    def run(self) -> None:
        """Write the file or the data set."""
        source = self.source or Path(DEFAULT_POLICY)
        name = source.resolve().parent.name if source.name == "policy" else source.stem
        if self.format == "onnx" and (self.objects or self.images or self.throws != Export.throws):
            raise InvalidValueError("--objects, --throws and --images need --format lerobot; add it.")
        if self.format == "onnx":
            self._write_policy(self.out or Path(f"{name}.onnx"))
        else:
            self._write_data(self.out or Path(f"{name}-lerobot"))

    def _write_policy(self, out: Path) -> None:
        from pixel2catch.evaluation.loading import load_policy
        from pixel2catch.policy.onnx_policy import SUFFIX, largest_difference, to_onnx

        if out.suffix != SUFFIX:
            raise InvalidValueError(f"out is '{out}'; end the name in {SUFFIX}.")
        prepare("cpu")
        policy, _ = load_policy(self.source)
        require_free_file(out)
        data = to_onnx(policy)
        write_atomically({out: data})
        difference = largest_difference(policy, data)
        print(
            f"wrote {out}: {policy.contract.method}, {len(data) / 1e6:.1f} MB; actions differ from the "
            f"original's by {difference:.1e} at most, on 10,000 random inputs"
        )

    def _write_data(self, out: Path) -> None:
        from pixel2catch.ros2.bags import is_bag

        with needs_extra("lerobot"):
            import pyarrow  # noqa: F401 (what writes the files)
        prepare("cpu")
        if self.source is not None and is_bag(self.source):
            with needs_extra("deployment"):
                from pixel2catch.datasets.recordings import write_recording
            num_runs, num_steps = write_recording(out, self.source, self.robot.load())
            print(f"wrote {out}: {num_runs} runs of the policy, {num_steps} control steps")
            return
        from pixel2catch.datasets.throws import write_throws
        from pixel2catch.evaluation.loading import load_policy, task_of
        from pixel2catch.evaluation.protocol import EvaluationCfg
        from pixel2catch.rendering.renderer import find_gl_backend
        from pixel2catch.scene.objects import select_objects

        policy, method = load_policy(self.source)
        cfg = EvaluationCfg(
            objects=select_objects(self.objects or ("seen",)),
            num_envs=self.throws,
            trials=1,
            seed=self.seed,
            task=task_of(policy),
        )
        if self.images:
            find_gl_backend()
        say(f"throwing {self.throws} times ...")
        counts = write_throws(out, cfg, policy, method, images=self.images)
        print("wrote {}: {} throws, {} caught; {} control steps".format(out, *counts))
