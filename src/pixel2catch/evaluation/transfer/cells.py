"""The cells of a transfer matrix: engines by restitutions, the same throws in all."""

import time
from collections.abc import Sequence
from dataclasses import replace

from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.metrics import Metrics, metrics, pooled_counts, rate
from pixel2catch.evaluation.protocol import ROUND_STEPS, EvaluationCfg, Trials, round_steps
from pixel2catch.evaluation.stress.measuring import Json, Result, evaluation_of
from pixel2catch.evaluation.stress.suite import Axis, Level, Setting, part, together
from pixel2catch.sim.factory import INELASTIC

AS_TRAINED = "as trained"  #: Label of the restitutions that the task draws.
PAIRED = {
    "tracking_rate": "is_tracked",
    "success_rate": "is_success",
    "verified_hold_rate": "is_verified",
}
"""Rates that are compared throw by throw, and what is noted of every throw for them."""

PROBE_STEPS = 3  #: Control steps by which the time of a cell is estimated. Source: ours.


def transfer_settings(engines: Sequence[str], restitutions: Sequence[float]) -> tuple[Setting, ...]:
    """Engines by restitutions; without any of these, they are drawn as the task says.

    Engines in which nothing bounces get the restitution 0 alone.

    Raises:
        InvalidValueError: If that leaves such an engine without any, or home without one of the others'.
    """
    settings = []
    for engine in engines:
        values = [value for value in restitutions if value == 0.0 or engine not in INELASTIC]
        if len(values) < len(restitutions) and (not values or engine == engines[0]):
            raise InvalidValueError(
                f"nothing bounces in engine '{engine}': give --restitution 0 too, and another engine first"
            )
        steps = part("scene", engine=engine)
        drawn = {f"{value:g}": part("randomization", restitution=(value, value)) for value in values}
        levels = tuple(
            Level(label=label, change=together(steps, change), source="the caller's")
            for label, change in (drawn or {AS_TRAINED: together()}).items()
        )
        settings += Axis(name=engine, unit="", levels=levels).settings
    return tuple(settings)


def throw_metrics(trials: Trials) -> Metrics:
    """Metrics of all throws, and of each throw what happened: a text of 0 and 1."""
    happened = vars(trials.record) | vars(trials)
    throws = {name: "".join(map(str, happened[name].int().tolist())) for name in PAIRED.values()}
    return {**metrics(trials), "throws": throws}


def rounds_of(results: Sequence[Result], num_rounds: int) -> list[Result]:
    """Each round of each result, computed at once with others; of one round the results themselves."""
    if num_rounds == 1:
        return list(results)
    return [
        replace(each, file=each.file.with_suffix("") / f"round-{number}.json", skipped=number)
        for each in results
        for number in range(num_rounds)
    ]


def pooled(contents: Sequence[Json]) -> Json:
    """What `throw_metrics` found in the rounds of a result, together."""
    parts = [content["metrics"] for content in contents]
    found: Metrics = {"trials": sum(part["trials"] for part in parts)}
    for name in PAIRED:
        found |= rate(name, *pooled_counts(parts, name))
    found["throws"] = {name: "".join(part["throws"][name] for part in parts) for name in PAIRED.values()}
    found["failures"] = {
        name: sum(part["failures"][name] * part["trials"] for part in parts) / found["trials"]
        for name in parts[0]["failures"]
    }
    return found | {"max_penetration": max(part["max_penetration"] for part in parts)}


def estimated_seconds(results: Sequence[Result], cfg: EvaluationCfg) -> float:
    """How long results will take, one after the other [s]: a few steps of each engine tell."""
    engines = [each.setting.axis.name for each in results]
    seconds = {
        engine: _step_seconds(results[engines.index(engine)], cfg) for engine in dict.fromkeys(engines)
    }
    return ROUND_STEPS * cfg.trials * sum(seconds[engine] for engine in engines)


def _step_seconds(result: Result, cfg: EvaluationCfg) -> float:
    """Time of a control step of a cell [s]."""
    policy, method, evaluation = evaluation_of(result, cfg, cfg.device)
    env = evaluation.make_env(method)
    try:
        steps = round_steps(env, policy)
        next(steps)
        begin = time.perf_counter()
        for _ in range(PROBE_STEPS):
            next(steps)
        return (time.perf_counter() - begin) / PROBE_STEPS
    finally:
        env.close()
