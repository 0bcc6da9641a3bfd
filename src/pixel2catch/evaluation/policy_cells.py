"""Cells and reports of stress and transfer studies: policies under settings, the same throws for all.

OUT/cells/POLICY/SETTING.json has the metrics of a policy under a setting, and everything that decides them. A
result that was made otherwise is refused before anything is computed, and never overwritten.
"""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from statistics import fmean

import torch

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.tasks import find_task
from pixel2catch.errors import InvalidValueError, StudyError
from pixel2catch.evaluation.grid import Json, StudyCell, differences, read_row
from pixel2catch.evaluation.loading import fingerprint, load_policy, task_of
from pixel2catch.evaluation.metrics import metrics, paired_difference
from pixel2catch.evaluation.protocol import Actor, EvaluationCfg, Trials, evaluate
from pixel2catch.evaluation.report import RATES, Row, difference_cells, percent, table
from pixel2catch.evaluation.stress import Axis, Level, Setting, is_trained_on, part, together
from pixel2catch.files import as_json, json_text, write_atomically
from pixel2catch.methods import METHODS, Method
from pixel2catch.policy import leaves
from pixel2catch.reports import Section, circumstances, provenance
from pixel2catch.shipped import shipped_policies
from pixel2catch.sim.factory import INELASTIC
from pixel2catch.workcells import find_workcell

AS_TRAINED = "as trained"  #: Label of the restitutions that the task draws.
EVENTS = {"tracking_rate": "is_tracked", "success_rate": "is_success", "verified_hold_rate": "is_verified"}
"""Rates that are compared throw by throw, with the name of the event of each throw."""

KEPT = (
    *("trials", *EVENTS, *(f"{name}_interval" for name in EVENTS), "failures", "max_penetration"),
    *(f"closed_loop_hold_rate{kind}" for kind in ("", "_interval", "_trials")),
    *("reachable_rate", "reachable", "seed", "revision", "hardware", "behaviour"),
)
"""Metrics in the rows."""

UNTRAINED = "†"  #: Mark of a setting that a policy was not trained on.


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

    A cell that is alone may use all processors. Raises StudyError if a result was made otherwise.
    """
    cells = []
    for setting, entry in product(settings, policies):
        policy, method = load_policy(entry.folder)
        evaluation = replace(cfg, task=setting.changed(task_of(policy)))
        origin = {
            "policy": entry.name,
            "method": method.name,
            "policy_sha256": fingerprint(entry.folder),
            "setting": setting.name,
            "evaluation": as_json(asdict(evaluation)),
        }
        file = cell_file(out, entry, setting)
        if found := read_row(file):
            before, now = (dict(leaves(each | {"metrics": None})) for each in (found, origin))
            if changes := differences(before, now, "there"):
                fix = "give its values, or name another --out"
                raise StudyError(f"'{file}' was made otherwise ({changes}); {fix}.")
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


def result_rows(
    policies: Sequence[PolicyEntry], settings: Sequence[Setting], out: Path, home: Axis | None = None
) -> list[Row]:
    """Return a row for each result that there is in the folder of a study, setting by setting.

    `success_rate_change` and its like have the difference over the same throws from the nominal setting, or
    from the same level of a home axis.
    """
    rows, found = list[Row](), dict[tuple[str, str], Json]()
    for setting, policy in product(settings, policies):
        if content := read_row(cell_file(out, policy, setting)):
            found[policy.name, setting.name] = content["metrics"]
    for setting, policy in product(settings, policies):
        metrics, level = found.get((policy.name, setting.name)), setting.level
        at = replace(setting, axis=home).name if home else "nominal"
        if metrics is None:
            continue
        row = {
            "setting": setting.name,
            "axis": setting.axis.name,
            "level": level.label,
            "unit": setting.axis.unit,
            "title": setting.title,
            "source": level.source,
            "method": policy.method,
            "task": policy.task.name,
            "policy": policy.name,
            "is_trained_on": is_trained_on(policy.task, level.change),
            **{name: metrics[name] for name in KEPT if name in metrics},
        }
        throws, at_home = (one.get("throws") for one in (metrics, found.get((policy.name, at), {})))
        if at != setting.name and throws and at_home:
            for name, event in EVENTS.items():
                row[f"{name}_change"] = paired_difference(at_home[event], throws[event])
        rows.append(row)
    return rows


def stress_sections(rows: Sequence[Row]) -> list[Section]:
    """Return the parts of the report: S.R. by setting and policy, and the sources."""
    text = (
        f"S.R. [%], {rows[0]['trials']} throws each, 95 % interval. {UNTRAINED}: the policy was not trained "
        "on that disturbance."
    )
    lines = table(rows, "title", "policy", _percent)
    policies = dict.fromkeys(row["policy"] for row in rows)
    means = {name: fmean(r["success_rate"] for r in rows if r["policy"] == name) for name in policies}
    lines.append({"title": "mean over settings", **{n: f"{100 * mean:.1f}" for n, mean in means.items()}})
    sources = {row["title"]: row["source"] for row in rows}
    return [
        Section(title="Success rates", text=text, rows=lines),
        Section(title="Sources", rows=[{"title": name, "source": each} for name, each in sources.items()]),
    ]


def transfer_sections(rows: Sequence[Row]) -> list[Section]:
    """Return the parts of the report: rates and differences from home."""
    text = (
        f"{rows[0]['trials']} throws each, the same in all engines; home is {rows[0]['axis']}. Rates in % "
        "with their 95 % interval; difference of S.R. from home in points with its 95 % interval, number of "
        "throws lost and won by it, and p value of McNemar's exact test. Failures in % of the throws."
    )
    lines = [
        {"policy": row["policy"], "restitution": row["level"], "engine": row["axis"]}
        | {title: percent(row, name) for title, name in RATES.items() if name in row}
        | difference_cells(row.get("success_rate_change"))
        | {name.replace("_", " "): f"{100.0 * rate:.1f}" for name, rate in row["failures"].items()}
        for row in sorted(rows, key=lambda row: row["policy"])
    ]
    return [Section(title="Engines", text=text, rows=lines)]


def _percent(row: Row) -> str:
    mark = "" if row["is_trained_on"] else f" {UNTRAINED}"
    return percent(row, "success_rate") + mark
