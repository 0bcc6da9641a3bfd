"""`pixel2catch evaluate`: how often a policy catches."""

from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

from tyro.conf import Positional

from pixel2catch.checks import Count, Device, OutputFile, Seed
from pixel2catch.cli.console import prepare, progress_bar, results_console, suggest
from pixel2catch.cli.fields import SimulatedTask
from pixel2catch.files import json_text, write_atomically
from pixel2catch.reports import circumstances
from pixel2catch.shipped import DEFAULT_POLICY, PolicyPath


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Evaluate a policy: rounds of throws, and a test of every hold."""

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

    def run(self) -> None:
        result = self.result()
        if self.json:
            print(json_text(result), end="", flush=True)
        else:
            print_tables({" ".join(self.objects): result}, result["method"])
        if self.out:
            write_atomically({self.out: json_text(result)})
        suggest("play", self.policy or DEFAULT_POLICY)

    def result(self) -> dict[str, Any]:
        """Evaluate; return the metrics and the files that decide them."""
        from pixel2catch.evaluation.loading import fingerprint, load_policy, sha256
        from pixel2catch.evaluation.metrics import assess
        from pixel2catch.evaluation.protocol import EvaluationCfg, Trials
        from pixel2catch.scene.objects import select_objects

        device, successes = prepare(self.device), list[float]()
        policy, method = load_policy(self.policy, device)

        def on_round(trials: Trials) -> None:
            successes.append(float(trials.record.is_success.float().mean()))

        def on_share(share: float) -> None:
            bar.show(share, f"success rate so far {100 * fmean(successes):.1f} %" if successes else "")

        cfg = EvaluationCfg(
            objects=select_objects(self.objects),
            num_envs=self.num_envs,
            trials=self.trials,
            seed=self.seed,
            device=device,
            task=self.task.make(policy),
        )
        files = {"dynamics": self.task.dynamics, "camera": self.task.camera}
        source = {
            "policy": str(self.policy or "shipped"),
            "policy_sha256": fingerprint(self.policy),
            **{f"{name}_sha256": sha256(file) if file else None for name, file in files.items()},
        }
        with progress_bar(" ".join(self.objects)) as bar:
            metrics = assess(policy, method, cfg, on_round, on_share)
        return source | metrics | {"circumstances": circumstances()}


def print_tables(results: dict[str, dict[str, Any]], method: str) -> None:
    """Print the metrics of sets of objects, by name."""
    from pixel2catch.evaluation.report import result_tables

    for table in result_tables(results, method):
        results_console().print(table)
