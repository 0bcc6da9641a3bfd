"""Cells of stress and transfer studies: policies under settings, the same throws for all.

OUT/cells/POLICY/SETTING.json has the metrics of a policy under a setting, and everything that decides them. A
result that was obtained otherwise is refused before anything is computed, and never overwritten.
"""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path

import torch

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.tasks import find_task
from pixel2catch.errors import InvalidValueError, StudyError
from pixel2catch.evaluation.grid import Json, StudyCell, differences, read_row
from pixel2catch.evaluation.loading import fingerprint, load_policy, task_of
from pixel2catch.evaluation.metrics import metrics
from pixel2catch.evaluation.protocol import Actor, EvaluationCfg, Trials, evaluate
from pixel2catch.evaluation.stress import Axis, Level, Setting, part, together
from pixel2catch.files import as_json, json_text, write_atomically
from pixel2catch.methods import METHODS, Method
from pixel2catch.policy import leaves
from pixel2catch.reports import circumstances, provenance
from pixel2catch.shipped import shipped_policies
from pixel2catch.sim.factory import INELASTIC
from pixel2catch.workcells import find_workcell

AS_TRAINED = "as trained"  #: Label of the restitutions that the task draws.
EVENTS = {"tracking_rate": "is_tracked", "success_rate": "is_success", "verified_hold_rate": "is_verified"}
"""Rates that are compared throw by throw, with the name of the event of each throw."""


@dataclass(frozen=True, kw_only=True)
class PolicyEntry:
    """A policy of a study."""

    name: str  #: Name in tables and folders.
    folder: Path  #: Its folder or file.
    method: str  #: Name of the method that it was trained with.
    task: CatchEnvCfg = field(default_factory=CatchEnvCfg)  #: Task of its training, with its camera.


def find_policies(folders: Sequence[Path]) -> tuple[PolicyEntry, ...]:
    """Return the policies in these folders, or all shipped ones if there are none.

    Each has the name of its ONNX file, its folder, or the run folder around it. Equal names raise.
    """
    found = []
    for folder in folders or shipped_policies().values():
        policy, method = load_policy(folder)
        path = folder.resolve()
        path = path.parent if path.name == "policy" else path
        name = path.name if path.is_dir() else path.stem
        if name in (each.name for each in found):
            raise InvalidValueError(f"two policies have the name '{name}'; rename one of their folders.")
        task = find_task(policy.contract.task)
        task = task if method.is_levelled else task.with_camera(task_of(policy).sensing.camera)
        found.append(PolicyEntry(name=name, folder=folder, method=method.name, task=task))
    if not folders:
        found.sort(key=lambda each: (list(METHODS).index(each.method.partition("+")[0]), each.name))
    return tuple(found)


def transfer_settings(engines: Sequence[str], restitutions: Sequence[float]) -> tuple[Setting, ...]:
    """Return engines by restitutions; without restitutions, they are drawn as in the task.

    Engines in which nothing bounces get the restitution 0 alone; one must be left, and home has all others.
    """
    for engine in (each for each in engines if each in INELASTIC):
        if any(restitutions) and (0.0 not in restitutions or engine == engines[0]):
            raise InvalidValueError(
                f"nothing bounces in engine '{engine}': give --restitution 0 too, and another engine first"
            )
    drawn = {f"{value:g}": part("randomization", restitution=(value, value)) for value in restitutions}
    return tuple(
        Setting(
            axis=Axis(name=engine, unit="", levels=()),
            level=Level(
                label=label, change=together(part("scene", engine=engine), change), source="the caller's"
            ),
        )
        for label, change in (drawn or {AS_TRAINED: together()}).items()
        for engine in engines
        if label in ("0", AS_TRAINED) or engine not in INELASTIC
    )


def cell_file(out: Path, policy: PolicyEntry, setting: Setting) -> Path:
    """Return the file with the metrics of a policy under a setting, in the folder of a study."""
    return out / "cells" / policy.name / f"{setting.name}.json"


def policy_cells(
    policies: Sequence[PolicyEntry],
    settings: Sequence[Setting],
    out: Path,
    cfg: EvaluationCfg,
    *,
    is_alone: bool = True,
) -> list[StudyCell]:
    """Return the cells of a study, setting by setting; the task of `cfg` is replaced by that of each policy.

    A cell that is alone may use all processors. Raises StudyError if a result was obtained otherwise.
    """
    cells = []
    for setting, entry in product(settings, policies):
        policy, method = load_policy(entry.folder)
        evaluation = replace(cfg, task=setting.level.change(task_of(policy)))
        origin = {
            "policy": entry.name,
            "method": method.name,
            "policy_sha256": fingerprint(entry.folder),
            "setting": setting.name,
            "evaluation": as_json(asdict(evaluation)),
        }
        file = cell_file(out, entry, setting)
        _require_same(file, origin)
        work = partial(measure, entry.folder, evaluation, is_alone, origin, file)
        cells.append(StudyCell(name=f"{entry.name}-{setting.name}", work=work, is_done=file.exists))
    return cells


def measure(folder: Path, cfg: EvaluationCfg, is_alone: bool, origin: Json, file: Path, device: str) -> None:
    """Evaluate a policy on a device, and write the metrics to a file, behind what decides them."""
    torch.set_num_threads(1)
    if device.startswith("cuda"):
        torch.cuda.set_device(device)  # where PyTorch and Warp capture their graphs
    trials = throw_rounds(*load_policy(folder, device), replace(cfg, device=device), is_alone=is_alone)
    workcell = find_workcell(cfg.task.scene.workcell)
    happened = vars(trials.record) | vars(trials) | {"is_success": trials.record.is_success}
    digits = {name: "".join(map(str, happened[name].int().tolist())) for name in EVENTS.values()}
    of_row = {"seed": cfg.seed, **provenance(circumstances(), workcell.name)}
    content = origin | {"metrics": metrics(trials, workcell) | {"throws": digits} | of_row}
    write_atomically({file: json_text(content)})


def throw_rounds(actor: Actor, method: Method, cfg: EvaluationCfg, *, is_alone: bool = True) -> Trials:
    """Evaluate a policy, each round with a seed of its own, so that all policies get the same throws.

    Disturbances are drawn after the throws, which are therefore those of the nominal setting. A policy that
    is alone may use all processors, others use one each.
    """
    processors = os.sched_getaffinity(0)
    if not is_alone:  # physics that is built on one processor has one thread, later on any free processor
        os.sched_setaffinity(0, {min(processors)})
    try:
        env = cfg.make_env(method)
    finally:
        os.sched_setaffinity(0, processors)
    return evaluate(actor, method, cfg, env=env, is_seeded=True)


def _require_same(file: Path, origin: Json) -> None:
    """Refuse a result that was obtained otherwise."""
    if (found := read_row(file)) is None:
        return
    before = dict(leaves(found | {"metrics": None}))
    if changes := differences(before, dict(leaves(origin | {"metrics": None})), "there"):
        raise StudyError(
            f"'{file}' was obtained otherwise ({changes}); give its values, or name another --out."
        )
