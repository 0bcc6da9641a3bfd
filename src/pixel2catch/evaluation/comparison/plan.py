"""A comparison of methods with several seeds each: what belongs to it, and where it lies."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pixel2catch.errors import StudyError
from pixel2catch.evaluation.loading import fingerprint
from pixel2catch.evaluation.metrics import Metrics
from pixel2catch.evaluation.report import differences, write_files
from pixel2catch.files import as_json, decoded, json_text, read_json_object, reading

GROUPS = ("seen", "unseen")  #: Sets of objects that every policy is evaluated on. Source: paper, Sec. V.

FILE = "study.json"

Json = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Run:
    """One training: name of the method, and seed of the training and of the evaluations of its policy."""

    method: str
    seed: int

    @property
    def name(self) -> str:
        """Name of the training and of its folder."""
        return f"{self.method}-seed{self.seed}"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a study asks."""

    methods: tuple[str, ...]  #: Names of the methods, in the order of the tables.
    seeds: int  #: Seeds of every method, from 0.
    configuration: Mapping[str, Any]  #: Everything else that changes results, by name.

    def runs(self) -> Iterator[Run]:
        """All trainings, seed by seed: each method has one seed before any has two."""
        for seed in range(self.seeds):
            for method in self.methods:
                yield Run(method=method, seed=seed)


@dataclass(frozen=True)
class ComparisonFolder:
    """Files of a comparison.

    `study.json` what is asked, and every session that worked at it · `runs/METHOD-seedS/` trainings ·
    `evaluations/METHOD-seedS-GROUP.json` · `logs/` what the commands printed · `report/` tables and pictures.
    """

    path: Path

    @property
    def report(self) -> Path:
        """Folder of the tables and pictures."""
        return self.path / "report"

    @property
    def logs(self) -> Path:
        """Folder of what the commands printed."""
        return self.path / "logs"

    def run(self, run: Run) -> Path:
        """Folder of a training."""
        return self.path / "runs" / run.name

    def evaluation(self, run: Run, group: str) -> Path:
        """Metrics of a policy on a set of objects."""
        return self.path / "evaluations" / f"{run.name}-{group}.json"

    def metrics(self, run: Run) -> Path:
        """Log of a training: one row an update."""
        return self.run(run) / "metrics.csv"

    def summary(self, run: Run) -> Json | None:
        """How a training ended, or nothing as long as it has not."""
        return _read(self.run(run) / "summary.json")

    def is_trained(self, run: Run) -> bool:
        """Whether a training is finished."""
        return (self.summary(run) or {}).get("status") == "finished"

    def prepare(self, run: Run) -> bool:
        """Clear away a training without a checkpoint; return whether there is one to resume."""
        has_checkpoint = (self.run(run) / "checkpoint.pt").exists()
        if not has_checkpoint:
            shutil.rmtree(self.run(run), ignore_errors=True)
        return has_checkpoint

    def result(self, run: Run, group: str) -> Metrics | None:
        """Metrics of a policy on a set of objects, or nothing if they are not there or of another policy."""
        result = _read(self.evaluation(run, group))
        has_policy = (self.run(run) / "policy").is_dir()
        if result is None or (has_policy and result.get("policy_sha256") != fingerprint(self.run(run))):
            return None
        return result

    def plan(self) -> Plan:
        """What the study asks, all that was ever added included.

        Raises:
            StudyError: If there is no study.
        """
        content = self._content()
        if content is None:
            raise StudyError(f"'{self.path}' holds no {FILE}; name another folder with --out.")
        with reading("study", self.path / FILE, "Mend it, or name another folder with --out.", StudyError):
            plan = content["plan"]
            return decoded(Plan, plan | {"configuration": _current(plan["configuration"])})

    def sessions(self) -> list[Json]:
        """When, how and where the study was worked at."""
        return (self._content() or {"sessions": []})["sessions"]

    def open(self, plan: Plan, sessions: Sequence[Json]) -> None:
        """Begin a study, or go on with one; methods and seeds may be new to it.

        A session that does anything is given with its versions and machine.

        Raises:
            StudyError: If its results would not be comparable, or the results there are of no study.
        """
        if any(self.path.glob("runs/*")) or any(self.path.glob("evaluations/*")):
            plan = self._extended(plan)
        asked = {"methods": plan.methods, "seeds": plan.seeds, "configuration": plan.configuration}
        content = {"plan": asked, "sessions": [*self.sessions(), *sessions]}
        write_files(self.path, {FILE: json_text(content)})

    def _content(self) -> Json | None:
        file = self.path / FILE
        content = _read(file)
        if content is None and file.exists():
            raise StudyError(f"'{file}' is damaged; mend it, or name another folder with --out.")
        return content

    def _extended(self, plan: Plan) -> Plan:
        """The plan with what the study asked before."""
        before = self.plan()
        asked = as_json(plan.configuration)
        changes = differences(before.configuration, asked, "in the study")
        if changes:
            raise StudyError(
                f"the study in '{self.path}' was begun with another configuration ({changes}); "
                "give the values that it has, or name another folder with --out."
            )
        longer, shorter = sorted((before.methods, plan.methods), key=len, reverse=True)
        methods = tuple(dict.fromkeys((*longer, *shorter)))
        return Plan(methods=methods, seeds=max(before.seeds, plan.seeds), configuration=asked)


MOVED = {
    "training physics_hz": "training physics_stages",
    "training cone": "training env.scene.cone",
    "training multiccd": "training env.scene.multiccd",
    "training latency_steps": "training env.sensing.latency_steps",
}
"""Entries of the configurations of earlier studies, and their names in this revision."""


def _current(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """Return a configuration of any revision as this one writes it."""
    if not MOVED.keys() & configuration.keys():
        return dict(configuration)
    return {"training value_loss": "clipped"} | {
        MOVED.get(key, key): each for key, each in configuration.items()
    }


def _read(path: Path) -> Json | None:
    """Content of a JSON file, nothing if it is absent or incomplete."""
    try:
        return read_json_object(path)
    except (FileNotFoundError, ValueError):
        return None
