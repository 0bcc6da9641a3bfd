"""`pixel2catch evaluate`: how often a policy catches."""

import json
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from pixel2catch.cli.fields import EvaluatedTask, FieldOptions


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Evaluate a policy: rounds of throws with all noise and randomisation, and a test of every hold."""

    #: Folder of a policy or of its training run, an ONNX file, or a shipped name. Default: catch_alone+fit.
    policy: Positional[Path | None] = None
    #: What is thrown: seen, unseen, real, names of objects, or several of them.
    objects: tuple[str, ...] = ("seen",)
    num_envs: int = 100  #: Throws in a round.
    trials: int = 10  #: Rounds.
    seed: int = 0  #: Seed of everything that is drawn.
    device: str = "cpu"  #: Where to simulate: cpu, cuda, cuda:1, ...
    physics_hz: float = 600.0  #: Physics steps in a second; training's default is the paper's 120.
    #: Dynamics file of the robot that is simulated, as `identify` writes it. Default: the nominal robot, also
    #: for a policy that was trained with a dynamics file.
    dynamics: Path | None = None
    #: Camera file of the camera that is simulated, as `calibrate` writes it: what that camera would do to the
    #: policy. Default: the camera that the policy was trained for, known exactly.
    camera: Path | None = None
    #: Any field of the task, also as --env.throws.peak-z 1.5 1.9. All fields: evaluate --env.help.
    env: FieldOptions = ()
    json: bool = False  #: Print all metrics as one JSON object.
    out: Path | None = None  #: File that gets the same JSON object, all of it or nothing.
    #: HTML file that gets a page of it, with charts, a map of the throws and stills of every kind of miss.
    html: Path | None = None

    def run(self) -> None:
        """Evaluate and print."""
        from pixel2catch.files import require_file, write_atomically

        if self.html:
            require_file(self.html, (".html",))

        from pixel2catch.cli.console import results_console, round_reporter, say
        from pixel2catch.cli.device import prepare
        from pixel2catch.evaluation.loading import camera_remark, fingerprint, load_policy, sha256, task_of
        from pixel2catch.evaluation.metrics import assess
        from pixel2catch.evaluation.protocol import EvaluationCfg
        from pixel2catch.evaluation.report import objects_table, quality_table, results_table
        from pixel2catch.evaluation.throw_collection import ThrowCollection
        from pixel2catch.scene.objects import select_objects

        prepare(self.device)
        policy, method = load_policy(self.policy, self.device)
        task = task_of(policy, self.physics_hz, self.dynamics, self.camera)
        cfg = EvaluationCfg(
            objects=select_objects(self.objects),
            num_envs=self.num_envs,
            trials=self.trials,
            seed=self.seed,
            device=self.device,
            task=EvaluatedTask(options=self.env, command="evaluate")(task),
        )
        files = {"dynamics": self.dynamics, "camera": self.camera}
        source = {
            "policy": str(self.policy or "shipped"),
            "policy_sha256": fingerprint(self.policy),
            **{f"{name}_sha256": sha256(file) if file else None for name, file in files.items()},
        }
        if self.out:
            self.out.parent.mkdir(parents=True, exist_ok=True)
        for remark in camera_remark(policy, cfg.task):
            say(remark)
        report, collection = round_reporter(" ".join(self.objects), self.trials), ThrowCollection()
        on_throws = collection.add if self.html else None
        result = source | assess(policy, method, cfg, report, on_throws)
        text = json.dumps(result, indent=2) + "\n"
        if self.out:
            write_atomically({self.out: text.encode()})
        if self.html:
            from pixel2catch.evaluation.page import write_page

            write_page(self.html, " ".join(self.objects), result, cfg, collection)
            say(f"wrote {self.html}")
        if self.json:
            print(text, end="")
            return
        console, named = results_console(), {" ".join(self.objects): result}
        console.print(results_table(named, method.name))
        console.print(objects_table(result))
        console.print(quality_table(named))
