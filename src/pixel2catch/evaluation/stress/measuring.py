"""Measuring the results of the stress suite: the same throws for all, in one process or in several.

A result is written all at once. Results that are there are not computed again; results that were obtained
otherwise are refused before anything is computed, and never overwritten. None depends on the number of
processes: it has seeds of its own, and the physics is the same on any number of threads.

OUT/cells/POLICY/SETTING.json    metrics of a policy under a setting, and how they were obtained
"""

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pixel2catch.envs.cfg import current_fields
from pixel2catch.errors import InvalidValueError, StudyError
from pixel2catch.evaluation.cluster import in_jobs
from pixel2catch.evaluation.loading import fingerprint, load_policy, task_of
from pixel2catch.evaluation.metrics import Metrics, metrics
from pixel2catch.evaluation.protocol import Actor, EvaluationCfg, Trials, evaluate
from pixel2catch.evaluation.report import differences, write_files
from pixel2catch.evaluation.stress.suite import Setting
from pixel2catch.files import as_json, json_text, read_json_object
from pixel2catch.interruption import end_with_parent
from pixel2catch.methods import METHODS, Method
from pixel2catch.own_files import import_files
from pixel2catch.policy import leaves
from pixel2catch.shipped import shipped_policies

if TYPE_CHECKING:
    from submitit import AutoExecutor

Json = dict[str, Any]
Returned = TypeVar("Returned")

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What libraries read, as they are loaded, for the number of their threads."""


@dataclass(frozen=True, kw_only=True)
class PolicyEntry:
    """A policy of the suite."""

    name: str  #: Its name in tables and folders.
    folder: Path  #: Where it is.
    method: str  #: Name of the method that it was trained with.
    task: str = "nominal"  #: Name of the task that it was trained for.


@dataclass(frozen=True, kw_only=True)
class Result:
    """A policy under a setting, and the file of its metrics."""

    policy: PolicyEntry
    setting: Setting
    file: Path
    skipped: int = 0  #: Rounds that come before its first, in other results.

    def read(self) -> Json | None:
        """Its metrics, if they are there.

        Raises:
            StudyError: If the file is damaged.
        """
        try:
            return read_json_object(self.file)
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise StudyError(f"'{self.file}' is damaged ({error}); delete it.") from error


def find_policies(folders: Sequence[Path]) -> tuple[PolicyEntry, ...]:
    """The policies in these folders, or all that are shipped if there are none.

    Raises:
        PolicyMismatchError: If a policy does not fit this code, or none is shipped.
        InvalidValueError: If two have the same name.
    """
    found = [_entry(folder) for folder in folders or shipped_policies().values()]
    if not folders:
        found.sort(key=lambda each: (list(METHODS).index(each.method.partition("+")[0]), each.name))
    names = [each.name for each in found]
    for name in names:
        if names.count(name) > 1:
            raise InvalidValueError(f"two policies are called '{name}'; rename one of their folders.")
    return tuple(found)


def plan_results(
    policies: Sequence[PolicyEntry], settings: Sequence[Setting], out: Path
) -> tuple[Result, ...]:
    """All results, setting by setting."""
    return tuple(
        Result(policy=policy, setting=setting, file=out / "cells" / policy.name / f"{setting.name}.json")
        for setting in settings
        for policy in policies
    )


def measure(
    results: Sequence[Result],
    cfg: EvaluationCfg,
    say: Callable[[str], None] = lambda _: None,
    jobs: int = 1,
    on_share: Callable[[float], None] = lambda _: None,
    summarize: Callable[[Trials], Metrics] = metrics,
    executor: "AutoExecutor | None" = None,
) -> tuple[Json, ...]:
    """Compute the results that are not there, so many jobs at once, and return all.

    Of the task only the physics rate counts, the rest is each policy's. Each job is a process of its own;
    only on the CPU there may be more than one. `say` is told of every one that was computed, as soon as it
    was; `on_share` the share of them that is done, more often. What is kept of the throws is what
    `summarize`, a module's function, makes of them. With an executor every
    result is a job of its cluster, on any device, and all are handed over at once.

    Raises:
        InvalidValueError: If there can not be so many jobs.
        StudyError: If a result was obtained otherwise, nothing was computed then; or if a process was ended.
    """
    if jobs < 1 or (jobs > 1 and cfg.device != "cpu"):
        raise InvalidValueError(
            f"{jobs} jobs were asked for on '{cfg.device}'; give --jobs 1, or more with --device cpu"
        )
    origins = [_origin(each, cfg) for each in results]
    for each, origin in zip(results, origins, strict=True):
        _require_same(each, origin)
    contents = [each.read() for each in results]
    missing = [number for number, content in enumerate(contents) if content is None]
    jobs = min(jobs, len(missing))
    calls = [(results[number], cfg, summarize) for number in missing]

    def alone(index: int) -> Metrics:
        return _measure(*calls[index], True, lambda share: on_share((index + share) / len(calls)))

    if executor:
        measured = in_jobs(executor, _begin, _measure, calls)
    elif jobs > 1:
        measured = in_processes(jobs, _measure, calls)
    else:
        measured = ((index, alone(index)) for index in range(len(calls)))
    for done, (index, found) in enumerate(measured, start=1):
        on_share(done / len(missing))
        number = missing[index]
        each, content = results[number], origins[number] | {"metrics": found}
        write_files(each.file.parent, {each.file.name: json_text(content)})
        contents[number] = content
        title, success = f"{each.policy.name}, {each.setting.title}", 100 * found["success_rate"]
        say(f"{number + 1} of {len(results)}: {title}: success rate {success:.1f} %")
    return tuple(content for content in contents if content is not None)


def throw_rounds(
    actor: Actor,
    method: Method,
    cfg: EvaluationCfg,
    *,
    is_alone: bool = True,
    on_share: Callable[[float], None] = lambda _: None,
) -> Trials:
    """Evaluate a policy, each round with a seed of its own: then all policies get the same throws.

    What a setting disturbs is drawn after the throws, so that they are those of the nominal setting. A policy
    that is alone may use all processors; else it uses one.
    """
    with nullcontext() if is_alone else _one_processor():
        env = cfg.make_env(method)
    return evaluate(actor, method, cfg, on_share=on_share, env=env, is_seeded=True)


def _measure(
    result: Result,
    cfg: EvaluationCfg,
    summarize: Callable[[Trials], Metrics],
    is_alone: bool = False,
    on_share: Callable[[float], None] = lambda _: None,
) -> Metrics:
    evaluation = evaluation_of(result, cfg, cfg.device)
    return summarize(throw_rounds(*evaluation, is_alone=is_alone, on_share=on_share))


@contextmanager
def _one_processor() -> Iterator[None]:
    """Physics that is built here steps in the calling thread alone, on whatever processor is free later."""
    processors = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(processors)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, processors)


def _entry(folder: Path) -> PolicyEntry:
    """The policy in a folder or in the run folder around it, or an ONNX file, after which it is called."""
    policy, method = load_policy(folder)
    resolved = folder.resolve()
    name = resolved.name if resolved.is_dir() else resolved.stem
    name = resolved.parent.name if resolved.name == "policy" else name
    return PolicyEntry(name=name, folder=folder, method=method.name, task=policy.contract.task)


def evaluation_of(result: Result, cfg: EvaluationCfg, device: str) -> tuple[Actor, Method, EvaluationCfg]:
    """What a result takes: its policy on a device, the method, and what is thrown at it."""
    policy, method = load_policy(result.policy.folder, device)
    task = result.setting.level.change(task_of(policy, cfg.task.scene.physics_hz))
    return policy, method, replace(cfg, device=device, task=task, seed=cfg.seed + result.skipped)


def _origin(result: Result, cfg: EvaluationCfg) -> Json:
    """Everything that decides a result's metrics, as JSON."""
    _, method, evaluation = evaluation_of(result, cfg, "cpu")
    evaluation = replace(evaluation, device=cfg.device)
    return {
        "policy": result.policy.name,
        "method": method.name,
        "policy_sha256": fingerprint(result.policy.folder),
        "setting": result.setting.name,
        "evaluation": as_json(asdict(evaluation)),
    }


def _require_same(result: Result, origin: Json) -> None:
    """Refuse a result that is there and was obtained otherwise than it would be now."""
    found = result.read()
    if found is None:
        return
    evaluation = found.get("evaluation", {})
    evaluation = evaluation | {"task": current_fields(evaluation.get("task", {}))}
    found = found | {"evaluation": evaluation}
    before, now = (dict(leaves(each | {"metrics": None})) for each in (found, origin))
    if changes := differences(before, now, "there"):
        raise StudyError(
            f"'{result.file}' was obtained otherwise ({changes}); give the values that it has, or "
            "name another folder with --out."
        )


def in_processes(
    jobs: int, function: Callable[..., Returned], calls: Sequence[tuple[Any, ...]]
) -> Iterator[tuple[int, Returned]]:
    """Yield number and returned value of every call of a module's function as soon as it is done.

    The processes are new ones of one thread each, and end with this one or with the first error.

    Raises:
        StudyError: If a process was ended from outside.
    """
    context = get_context("spawn")
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin)
    try:
        with _one_thread_each():
            numbers = {pool.submit(function, *call): number for number, call in enumerate(calls)}
        for future in as_completed(numbers):
            yield numbers[future], future.result()
    except KeyboardInterrupt:
        for process in active_children():  # the pool itself would wait for what they are doing
            process.terminate()
        raise
    except BrokenProcessPool as error:
        raise StudyError(
            f"one of {jobs} processes was ended from outside; if memory was short, give fewer --jobs. What "
            "was finished is kept: the same command goes on from there."
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _begin() -> None:
    import torch

    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it without a word of its own
    torch.set_num_threads(1)
    import_files()  # before a disturbance of one's own is sent here
    end_with_parent()


@contextmanager
def _one_thread_each() -> Iterator[None]:
    before = {name: os.environ[name] for name in THREADS if name in os.environ}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name in THREADS:
            del os.environ[name]
        os.environ.update(before)
