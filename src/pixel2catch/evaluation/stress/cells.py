"""The stress suite: every policy under every setting, the same throws for all, cell by cell.

    OUT/cells/POLICY/SETTING.json    metrics of a policy under a setting, and how they were obtained

A cell is written all at once. Cells that are there are not computed again; cells that were obtained otherwise
are refused before anything is computed, and never overwritten.
"""

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pixel2catch.errors import InvalidValueError, StudyError
from pixel2catch.evaluation.loading import fingerprint, load_policy, shipped_policies, task_of
from pixel2catch.evaluation.metrics import Metrics, metrics
from pixel2catch.evaluation.protocol import EvaluationCfg
from pixel2catch.evaluation.rounds import Actor, Trials, run_round
from pixel2catch.evaluation.stress.axes import Setting
from pixel2catch.files import plain, write_atomically
from pixel2catch.methods import METHODS, Method
from pixel2catch.policy import leaves
from pixel2catch.robot.objects import OBJECTS

Json = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class StressCfg:
    """How each cell is obtained.

    Attributes:
        objects: Names of the objects; each throw draws one.
        num_envs: Throws in a round.
        trials: Rounds.
        seed: Seed of the first round; the next round has the next one.
        device: "cpu" or a CUDA device.
        physics_hz: Physics steps in a second.
    """

    objects: tuple[str, ...]
    num_envs: int = 100
    trials: int = 2
    seed: int = 0
    device: str = "cpu"
    physics_hz: float = 600.0


@dataclass(frozen=True, kw_only=True)
class Contestant:
    """A policy of the suite.

    Attributes:
        name: Its name in tables and folders.
        folder: Where it is.
        method: The method that it was trained with.
    """

    name: str
    folder: Path
    method: str


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A policy under a setting.

    Attributes:
        contestant: The policy.
        setting: The setting.
        file: Its metrics.
    """

    contestant: Contestant
    setting: Setting
    file: Path

    def read(self) -> Json | None:
        """Its metrics, if they are there.

        Raises:
            StudyError: If the file is damaged.
        """
        try:
            return json.loads(self.file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise StudyError(f"'{self.file}' is damaged ({error}); delete it.") from error


def find_contestants(folders: Sequence[Path]) -> tuple[Contestant, ...]:
    """The policies in these folders, or all that are shipped if there are none.

    Raises:
        PolicyMismatchError: If a policy does not fit this code, or none is shipped.
        InvalidValueError: If two have the same name.
    """
    found = [_contestant(folder) for folder in folders or shipped_policies().values()]
    if not folders:
        found.sort(key=lambda each: (list(METHODS).index(each.method), each.name))
    names = [each.name for each in found]
    for name in names:
        if names.count(name) > 1:
            raise InvalidValueError(f"two policies are called '{name}'; rename one of their folders.")
    return tuple(found)


def plan_cells(contestants: Sequence[Contestant], settings: Sequence[Setting], out: Path) -> tuple[Cell, ...]:
    """All cells, setting by setting."""
    return tuple(
        Cell(
            contestant=contestant,
            setting=setting,
            file=out / "cells" / contestant.name / f"{setting.name}.json",
        )
        for setting in settings
        for contestant in contestants
    )


def run_cells(
    cells: Sequence[Cell], cfg: StressCfg, on_cell: Callable[[int, Cell, Metrics], None] = lambda *_: None
) -> tuple[Json, ...]:
    """Compute the cells that are not there, and return all.

    Args:
        cells: The cells.
        cfg: How they are obtained.
        on_cell: Called with number, cell and metrics of every cell that was computed.

    Raises:
        StudyError: If a cell was obtained otherwise; nothing was computed then.
    """
    origins = [_origin(cell, cfg) for cell in cells]
    for cell, origin in zip(cells, origins, strict=True):
        _require_same(cell, origin)
    results = []
    for number, (cell, origin) in enumerate(zip(cells, origins, strict=True), start=1):
        result = cell.read()
        if result is None:
            result = origin | {"metrics": _measure(cell, cfg)}
            cell.file.parent.mkdir(parents=True, exist_ok=True)
            write_atomically({cell.file: (json.dumps(result, indent=2) + "\n").encode()})
            on_cell(number, cell, result["metrics"])
        results.append(result)
    return tuple(results)


def throw_rounds(actor: Actor, method: Method, cfg: EvaluationCfg) -> Trials:
    """Evaluate a policy, each round with a seed of its own: then all policies get the same throws.

    Rounds end when every hold is decided, so that without this the throws of the second would depend on the
    policy. What a setting disturbs is drawn after the throws, so that they are those of the nominal setting.
    """
    env = cfg.make_env(method)
    rounds = []
    try:
        for number in range(cfg.trials):
            env.seed(cfg.seed + number)
            rounds.append(run_round(env, actor))
    finally:
        env.close()
    return Trials.concatenate(rounds)


def _evaluation(cell: Cell, cfg: StressCfg, device: str) -> tuple[Actor, Method, EvaluationCfg]:
    """The policy and what is thrown at it."""
    policy, method = load_policy(cell.contestant.folder, device)
    return (
        policy,
        method,
        EvaluationCfg(
            objects=cfg.objects,
            num_envs=cfg.num_envs,
            trials=cfg.trials,
            seed=cfg.seed,
            device=device,
            task=cell.setting.level.change(task_of(policy, cfg.physics_hz)),
        ),
    )


def _measure(cell: Cell, cfg: StressCfg) -> Metrics:
    """Metrics of a cell."""
    return metrics(throw_rounds(*_evaluation(cell, cfg, cfg.device)), tuple(OBJECTS))


def _origin(cell: Cell, cfg: StressCfg) -> Json:
    """Everything that decides a cell's metrics, as JSON."""
    _, method, evaluation = _evaluation(cell, cfg, "cpu")
    evaluation = dataclasses.replace(evaluation, device=cfg.device)
    return {
        "policy": cell.contestant.name,
        "method": method.name,
        "policy_sha256": fingerprint(cell.contestant.folder),
        "setting": cell.setting.name,
        "evaluation": json.loads(json.dumps(dataclasses.asdict(evaluation), default=plain)),
    }


def _require_same(cell: Cell, origin: Json) -> None:
    """See that a cell that is there was obtained as it would be now.

    Raises:
        StudyError: With the fields that differ.
    """
    found = cell.read()
    if found is None:
        return
    before, now = dict(leaves(found | {"metrics": None})), dict(leaves(origin | {"metrics": None}))
    changes = [
        f"{name}: {before.get(name)} there, {now.get(name)} now"
        for name in sorted({*before, *now})
        if before.get(name) != now.get(name)
    ]
    if changes:
        raise StudyError(
            f"'{cell.file}' was obtained otherwise ({'; '.join(changes)}); give the values that it has, or "
            "name another folder with --out."
        )


def _contestant(folder: Path) -> Contestant:
    """The policy in a folder or in the run folder around it; it is called as the folder of the run."""
    _, method = load_policy(folder)
    resolved = folder.resolve()
    name = resolved.parent.name if resolved.name == "policy" else resolved.name
    return Contestant(name=name, folder=folder, method=method.name)
