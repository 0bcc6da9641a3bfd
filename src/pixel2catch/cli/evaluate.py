"""`pixel2catch evaluate`: how often a policy catches."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from pixel2catch.checks import Count, Device, OutputFile, Seed
from pixel2catch.cli.console import evaluating, results_console, say
from pixel2catch.cli.device import prepare
from pixel2catch.cli.fields import SimulatedTask
from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.files import json_text
from pixel2catch.shipped import PolicyPath

if TYPE_CHECKING:
    from pixel2catch.camera.image import Pixels
    from pixel2catch.evaluation.protocol import EvaluationCfg
    from pixel2catch.evaluation.recorded_throws import ThrowCollection


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Evaluate a policy: rounds of throws with all noise and randomisation, and a test of every hold."""

    #: Folder of a policy or of its training run, an ONNX file, or a shipped name. Default: catch_alone+fit.
    policy: Positional[PolicyPath | None] = None
    #: What is thrown: seen, unseen, real, sizes, names of objects, or several of them.
    objects: tuple[str, ...] = ("seen",)
    num_envs: Count = 100  #: Throws in a round.
    trials: Count = 10  #: Rounds.
    seed: Seed = 0  #: Seed of everything that is drawn.
    device: Device = "cpu"  #: Where to simulate: cpu, cuda, cuda:1, ...
    task: SimulatedTask = field(default_factory=SimulatedTask)  #: What is simulated.
    json: bool = False  #: Print all metrics as one JSON object.
    #: File that gets the same JSON object, all of it or nothing.
    out: Annotated[Path, OutputFile()] | None = None
    #: HTML file that gets a page of it, with charts, a map of the throws and stills of every kind of miss.
    html: Annotated[Path, OutputFile((".html",))] | None = None

    def run(self) -> None:
        """Evaluate and print."""
        from pixel2catch.evaluation.loading import fingerprint, load_policy, sha256
        from pixel2catch.evaluation.metrics import assess
        from pixel2catch.evaluation.protocol import EvaluationCfg
        from pixel2catch.evaluation.recorded_throws import ThrowCollection
        from pixel2catch.evaluation.report import write_files
        from pixel2catch.evaluation.result_tables import result_tables
        from pixel2catch.scene.objects import select_objects

        device = prepare(self.device)
        policy, method = load_policy(self.policy, device)
        cfg = EvaluationCfg(
            objects=select_objects(self.objects),
            num_envs=self.num_envs,
            trials=self.trials,
            seed=self.seed,
            device=device,
            task=self.task.make(policy, "evaluate"),
        )
        files = {"dynamics": self.task.dynamics, "camera": self.task.camera}
        source = {
            "policy": str(self.policy or "shipped"),
            "policy_sha256": fingerprint(self.policy),
            **{f"{name}_sha256": sha256(file) if file else None for name, file in files.items()},
            "robot_model_sha256": [sha256(file) for file in self.task.robot_model],
        }
        collection = ThrowCollection()
        on_throws = collection.add if self.html else None
        with evaluating(" ".join(self.objects)) as watch:
            result = source | assess(policy, method, cfg, *watch, on_throws)
        if self.json:
            print(json_text(result), end="", flush=True)
        else:
            for table in result_tables({" ".join(self.objects): result}, method.name):
                results_console().print(table)
        if self.out:
            write_files(self.out.parent, {self.out.name: json_text(result)})
        if self.html:
            from pixel2catch.evaluation.page import evaluation_page

            strips = _strips(collection, cfg)
            text = evaluation_page(" ".join(self.objects), result, cfg, collection, strips)
            write_files(self.html.parent, {self.html.name: text})
            say(f"wrote {self.html}")


def _strips(collection: "ThrowCollection", cfg: "EvaluationCfg") -> "dict[str, Pixels]":
    """Draw stills of the example of each outcome; return nothing without graphics."""
    from pixel2catch.rendering.film import strips

    examples = collection.misses_first
    try:
        pictures = strips([*examples.values()], cfg.task.scene, has_inset=False)
    except DeviceUnavailableError:
        return {}
    return dict(zip(examples, pictures, strict=True))
