"""Metrics of trials: rates with their intervals, failure modes, quality of contacts."""

import time
from collections.abc import Callable, Mapping, Sequence
from math import comb, isfinite, sqrt
from statistics import NormalDist, fmean, variance
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from pixel2catch.envs.episode import FAILURES, MAXIMA, failure
from pixel2catch.errors import NonFiniteError
from pixel2catch.evaluation.protocol import Actor, EvaluationCfg, Trials, evaluate
from pixel2catch.methods import Method
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.scene.objects import OBJECTS
from pixel2catch.workcells import find_workcell

Metrics = dict[str, Any]
Z_95 = NormalDist().inv_cdf(0.975)
"""Half the width of the middle 95 % of the normal distribution, in standard deviations."""


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % interval of a rate over at least one trial. Source: Wilson 1927, the score interval.

    It is written out because importing scipy.stats is slow.
    """
    square = Z_95**2
    middle = (successes + square / 2) / (trials + square)
    half = Z_95 * sqrt(successes * (trials - successes) / trials + square / 4) / (trials + square)
    return middle - half if successes else 0.0, middle + half if successes < trials else 1.0


def rate(name: str, count: int, trials: int) -> Metrics:
    """Return a rate by its name, and its interval."""
    return {name: count / trials, f"{name}_interval": list(wilson_interval(count, trials))}


def paired_difference(home: str, other: str) -> Metrics:
    """Return the difference of two rates over the same trials, given as texts of 0 and 1: other minus home.

    The interval is that of Agresti and Min (2005, Statistics in Medicine 24, 729: half a trial more in each
    of the four cells), the p value that of McNemar's exact test.
    """
    pairs = list(zip(home, other, strict=True))
    lost, won, n = pairs.count(("1", "0")), pairs.count(("0", "1")), len(pairs) + 2
    middle = (won - lost) / n
    half = Z_95 * sqrt(won + lost + 1 - (won - lost) ** 2 / n) / n
    as_few = sum(comb(lost + won, number) for number in range(min(lost, won) + 1))
    return {
        "lost": lost,
        "won": won,
        "difference": (won - lost) / len(pairs),
        "difference_interval": [max(middle - half, -1.0), min(middle + half, 1.0)],
        "p_value": min(2 * as_few / 2 ** (lost + won), 1.0),
    }


def welch_difference(values: Sequence[float], others: Sequence[float]) -> Metrics:
    """Return the difference of two means of independent values with its 95 % interval. Source: Welch 1947."""
    from scipy.stats import t  # takes a second

    parts = [(variance(each) / len(each), len(each) - 1) for each in (values, others)]
    square, mean = sum(part for part, _ in parts), fmean(values) - fmean(others)
    spread = sum(part**2 / freedom for part, freedom in parts)
    half = float(t.ppf(0.975, square**2 / spread)) * sqrt(square) if spread else 0.0
    return {"difference": mean, "difference_interval": [mean - half, mean + half]}


def pooled_counts(rates: Sequence[Mapping[str, Any]], name: str) -> tuple[int, int]:
    """Return the number of events of a rate, and of trials, over several metrics."""
    trials = [each.get(f"{name}_trials", each["trials"]) for each in rates]
    return sum(round(each[name] * own) for each, own in zip(rates, trials, strict=True)), sum(trials)


def assess(
    actor: Actor,
    method: Method,
    cfg: EvaluationCfg,
    on_round: Callable[[Trials], None] = lambda _: None,
    on_share: Callable[[float], None] = lambda _: None,
) -> Metrics:
    """Evaluate a policy and return its metrics, with how they were obtained; arguments as of `evaluate`."""
    started = time.perf_counter()
    trials = evaluate(actor, method, cfg, on_round, on_share)
    return {
        "method": method.name,
        "objects_thrown": list(cfg.objects),
        "num_envs": cfg.num_envs,
        "rounds": cfg.trials,
        "seed": cfg.seed,
        "device": cfg.device,
        "workcell": cfg.task.scene.workcell,
        "engine": cfg.task.scene.engine,
        "physics_hz": cfg.task.scene.physics_hz,
        **metrics(trials, find_workcell(cfg.task.scene.workcell)),
        "seconds": time.perf_counter() - started,
    }


def metrics(trials: Trials, workcell: WorkcellSpec) -> Metrics:
    """Return the metrics of all trials by name, and the rates of each object under `objects`.

    If an arm can reach only some throws in time, `reachable` has the rates of these.

    Speed and torques of the holds are None without a success: of each finger joint the root mean square
    over all of them, as a share of its limit. The median force on the object is that of trials in which the
    hand touched it, None in engines that report no forces. What is not finite raises NonFiniteError.
    """
    names, record, num_trials = tuple(OBJECTS), trials.record, len(trials.is_verified)
    object_id, everything = record.object_id, torch.ones_like(trials.is_verified)
    modes, caught = torch.where(record.is_success, -1, failure(record)), record.is_success
    maxima = {name: float(getattr(record, name).max()) for name in MAXIMA}
    for name, value in maxima.items():
        if not isfinite(value):
            raise NonFiniteError(f"{name} is {value}: the simulation diverged.")
    forces, held = record.max_object_force[record.is_hand_contact], int(trials.hold_steps.sum())
    shares = (trials.torque_squares.double().sum(dim=0) / max(held, 1)).sqrt().tolist()
    fingers = [joint.name for group in workcell.groups if group.role == "hand" for joint in group.joints]
    tested = trials.closed_loop[trials.closed_loop >= 0]
    name, num_held = "closed_loop_hold_rate", int(tested.sum())
    num_reachable = int(trials.is_reachable.sum())
    return {
        **_rates(trials, everything),
        "reachable_rate": num_reachable / num_trials,
        **({"reachable": _rates(trials, trials.is_reachable)} if 0 < num_reachable < num_trials else {}),
        **(rate(name, num_held, len(tested)) | {f"{name}_trials": len(tested)} if len(tested) else {}),
        "table_contact_rate": int(record.is_table_contact.sum()) / num_trials,
        "self_contact_rate": int(record.is_self_contact.sum()) / num_trials,
        "robot_contact_rate": int(record.is_robot_contact.sum()) / num_trials,
        "failures": {name: int((modes == i).sum()) / num_trials for i, name in enumerate(FAILURES)},
        "mean_penetration": _mean(record.penetration_sum, record.contact_steps),
        **maxima,
        "median_object_force": float(forces.median()) if forces.any() else None,
        "arm_limit_time": CONTROL_DT * int(trials.limit_steps.sum()) / num_trials,
        "hold_torque": dict(zip(fingers, shares, strict=True)) if held else None,
        "hold_speed": _mean(record.hold_speed[caught], caught),
        "objects": {names[i]: _rates(trials, object_id == i) for i in sorted(set(object_id.tolist()))},
    }


def _rates(trials: Trials, rows: Bool[Tensor, " num_trials"]) -> Metrics:
    """Return rates over some of the trials with intervals, and the mean number of palms at held objects."""
    record, num_trials = trials.record, int(rows.sum())
    events = {
        "tracking_rate": record.is_tracked,
        "success_rate": record.is_success,
        "palm_contact_rate": record.is_palm_contact,
        "verified_hold_rate": trials.is_verified,
    }
    result: Metrics = {"trials": num_trials}
    for name, happened in events.items():
        result |= rate(name, int((happened & rows).sum()), num_trials)
    caught = record.is_success & rows
    return result | {"hold_palms": _mean(record.hold_palms[caught], caught)}


def _mean(sums: Tensor, counts: Tensor) -> float | None:
    """Return all sums divided by all counts; None if the counts are 0."""
    total = int(counts.sum())
    return float(sums.double().sum()) / total if total else None
