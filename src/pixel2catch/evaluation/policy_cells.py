"""Cells of stress and transfer studies: policies under settings, the same throws for all.

OUT/cells/POLICY/SETTING.json has the metrics of a policy under a setting, and everything that decides them. A
result that was obtained otherwise is refused before anything is computed, and never overwritten.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import torch

from pixel2catch.envs.cfg import current_fields
from pixel2catch.errors import InvalidValueError, StudyError
from pixel2catch.evaluation.grid import Json, StudyCell, differences, read_row
from pixel2catch.evaluation.loading import fingerprint, load_policy, task_of
from pixel2catch.evaluation.metrics import metrics
from pixel2catch.evaluation.protocol import Actor, EvaluationCfg, Trials, evaluate
from pixel2catch.evaluation.report import write_files
from pixel2catch.evaluation.stress.suite import Axis, Level, Setting, part, together
from pixel2catch.files import as_json, json_text
from pixel2catch.methods import METHODS, Method
from pixel2catch.policy import leaves
from pixel2catch.shipped import shipped_policies
from pixel2catch.sim.factory import INELASTIC

AS_TRAINED = "as trained"  #: Label of the restitutions that the task draws.
EVENTS = {
    "tracking_rate": "is_tracked",
    "success_rate": "is_success",
    "verified_hold_rate": "is_verified",
}
"""Rates that are compared throw by throw, with the name of the event of each throw."""


@dataclass(frozen=True, kw_only=True)
class PolicyEntry:
    """A policy of a study."""

    name: str  #: Name in tables and folders.
    folder: Path  #: Its folder or file.
    method: str  #: Name of the method that it was trained with.
    task: str = "nominal"  #: Name of the task that it was trained for.


@dataclass(frozen=True, kw_only=True)
class PolicyResult:
    """A policy under a setting, and the file of its metrics."""

    policy: PolicyEntry
    setting: Setting
    file: Path

    @property
    def name(self) -> str:
        """Name of the cell."""
        return f"{self.policy.name}-{self.setting.name}"

    def read(self) -> Json | None:
        """Return the content of the file, if it is there."""
        return read_row(self.file)


def find_policies(folders: Sequence[Path]) -> tuple[PolicyEntry, ...]:
    """Return the policies in these folders, or all shipped ones if there are none.

    Raises:
        PolicyMismatchError: If a policy does not fit this code.
        InvalidValueError: If two have the same name.
    """
    found = [_entry(folder) for folder in folders or shipped_policies().values()]
    if not folders:
        found.sort(key=lambda each: (list(METHODS).index(each.method.partition("+")[0]), each.name))
    names = [each.name for each in found]
    for name in names:
        if names.count(name) > 1:
            raise InvalidValueError(f"two policies have the name '{name}'; rename one of their folders.")
    return tuple(found)


def _entry(folder: Path) -> PolicyEntry:
    """Return a policy, named after its ONNX file, its folder, or the run folder around it."""
    policy, method = load_policy(folder)
    resolved = folder.resolve()
    name = resolved.name if resolved.is_dir() else resolved.stem
    name = resolved.parent.name if resolved.name == "policy" else name
    return PolicyEntry(name=name, folder=folder, method=method.name, task=policy.contract.task)


def transfer_settings(engines: Sequence[str], restitutions: Sequence[float]) -> tuple[Setting, ...]:
    """Return engines by restitutions; without restitutions, they are drawn as in the task.

    Engines in which nothing bounces get the restitution 0 alone.

    Raises:
        InvalidValueError: If such an engine has no setting left, or home lacks one of the others'.
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


def plan_results(
    policies: Sequence[PolicyEntry], settings: Sequence[Setting], out: Path
) -> tuple[PolicyResult, ...]:
    """Return all results of a study, setting by setting."""
    return tuple(
        PolicyResult(
            policy=policy, setting=setting, file=out / "cells" / policy.name / f"{setting.name}.json"
        )
        for setting in settings
        for policy in policies
    )


def policy_cells(
    results: Sequence[PolicyResult], cfg: EvaluationCfg, *, is_alone: bool = True
) -> list[StudyCell]:
    """Return the cells of results.

    Args:
        results: The results.
        cfg: The evaluation; its task is replaced by that of each policy.
        is_alone: Whether one cell at a time is computed and may use all processors.

    Raises:
        StudyError: If a result was obtained otherwise or is damaged.
    """
    cells = []
    for each in results:
        origin = _origin(each, cfg)
        _require_same(each, origin)
        work = partial(measure, each, cfg, origin, is_alone)
        cells.append(StudyCell(name=each.name, work=work, is_done=each.file.exists))
    return cells


def measure(result: PolicyResult, cfg: EvaluationCfg, origin: Json, is_alone: bool, device: str) -> None:
    """Compute a result on a device, and write it."""
    torch.set_num_threads(1)
    trials = throw_rounds(*evaluation_of(result, cfg, device), is_alone=is_alone)
    content = origin | {"metrics": metrics(trials) | {"throws": throw_texts(trials)}}
    write_files(result.file.parent, {result.file.name: json_text(content)})


def throw_texts(trials: Trials) -> dict[str, str]:
    """Return the events of each throw as texts of 0 and 1."""
    happened = vars(trials.record) | vars(trials)
    return {name: "".join(map(str, happened[name].int().tolist())) for name in EVENTS.values()}


def throw_rounds(actor: Actor, method: Method, cfg: EvaluationCfg, *, is_alone: bool = True) -> Trials:
    """Evaluate a policy, each round with a seed of its own, so that all policies get the same throws.

    Disturbances are drawn after the throws, which are therefore those of the nominal setting. A policy that
    is alone may use all processors, others use one each.
    """
    with nullcontext() if is_alone else _one_processor():
        env = cfg.make_env(method)
    return evaluate(actor, method, cfg, env=env, is_seeded=True)


def evaluation_of(
    result: PolicyResult, cfg: EvaluationCfg, device: str
) -> tuple[Actor, Method, EvaluationCfg]:
    """Return the policy of a result on a device, its method, and its evaluation."""
    policy, method = load_policy(result.policy.folder, device)
    task = result.setting.level.change(task_of(policy))
    return policy, method, replace(cfg, device=device, task=task)


@contextmanager
def _one_processor() -> Iterator[None]:
    """Physics that is built within steps in the calling thread alone, later on any free processor."""
    processors = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(processors)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, processors)


def _origin(result: PolicyResult, cfg: EvaluationCfg) -> Json:
    """Everything that decides the metrics of a result, as JSON."""
    _, method, evaluation = evaluation_of(result, cfg, "cpu")
    evaluation = replace(evaluation, device=cfg.device)
    return {
        "policy": result.policy.name,
        "method": method.name,
        "policy_sha256": fingerprint(result.policy.folder),
        "setting": result.setting.name,
        "evaluation": as_json(asdict(evaluation)),
    }


def _require_same(result: PolicyResult, origin: Json) -> None:
    found = result.read()
    if found is None:
        return
    evaluation = found.get("evaluation", {})
    evaluation = evaluation | {"task": current_fields(evaluation.get("task", {}))}
    found = found | {"evaluation": evaluation}
    before, now = (dict(leaves(each | {"metrics": None})) for each in (found, origin))
    if changes := differences(before, now, "there"):
        raise StudyError(
            f"'{result.file}' was obtained otherwise ({changes}); give its values, or name another folder "
            "with --out."
        )
