"""What several seeds of a method amount to: mean and deviation over seeds, intervals over all trials."""

from collections.abc import Iterator, Sequence
from statistics import fmean, stdev
from typing import Any

from pixel2catch.evaluation.metrics import Metrics, wilson_interval
from pixel2catch.evaluation.study.plan import GROUPS, Plan, Run, StudyFolder
from pixel2catch.evaluation.tables import MAIN_RATES, PAPER, RATES
from pixel2catch.robot.objects import OBJECT_GROUPS

MAXIMA = ("max_joint_speed", "max_torque_share", "max_penetration")
"""Extremes that the tables show: the largest of all seeds."""

Row = dict[str, Any]


def mean_and_deviation(values: Sequence[float]) -> tuple[float, float | None]:
    """Mean and sample deviation (divisor n - 1); one value has no deviation."""
    return fmean(values), stdev(values) if len(values) > 1 else None


def pooled(rates: Sequence[Metrics], name: str) -> Row:
    """One rate over several seeds.

    Args:
        rates: Trials and rates of each seed.
        name: Name of the rate.

    Returns:
        `mean` and `deviation` over the seeds, 95 % `interval` over all trials, and the `values`.
    """
    values = [result[name] for result in rates]
    mean, deviation = mean_and_deviation(values)
    interval = wilson_interval(*_counts(rates, name))
    return {"mean": mean, "deviation": deviation, "interval": list(interval), "values": values}


def summary_rows(folder: StudyFolder, plan: Plan) -> Iterator[Row]:
    """One row for every method and set of objects of which there are results."""
    for method in plan.methods:
        for group in GROUPS:
            results = _results(folder, plan, method, group)
            if results:
                yield {
                    "method": method,
                    "objects": group,
                    "seeds": len(results),
                    "trials": sum(result["trials"] for result in results),
                    **{name: pooled(results, name) for name in RATES.values()},
                    **{name: max(result[name] for result in results) for name in MAXIMA},
                    "paper": _paper(method, group),
                }


def object_rows(folder: StudyFolder, plan: Plan) -> Iterator[Row]:
    """One row for every object, seen ones first, and method of which there are results."""
    results = {
        (group, method): _results(folder, plan, method, group) for group in GROUPS for method in plan.methods
    }
    for group in GROUPS:
        for name in OBJECT_GROUPS[group]:
            for method in plan.methods:
                thrown = [r["objects"][name] for r in results[group, method] if name in r["objects"]]
                if thrown:
                    trials = sum(rates["trials"] for rates in thrown)
                    yield {"object": name, "objects": group, "method": method, "trials": trials} | {
                        metric: _overall(thrown, metric) for metric in MAIN_RATES.values()
                    }


def training_rows(folder: StudyFolder, plan: Plan) -> Iterator[Row]:
    """One row for every finished training."""
    for run in plan.runs():
        summary = folder.summary(run)
        if summary is not None and folder.is_trained(run):
            row = {name: summary[name] for name in ("transitions", "seconds")}
            yield {"method": run.method, "seed": run.seed} | row


def _results(folder: StudyFolder, plan: Plan, method: str, group: str) -> list[Metrics]:
    """Metrics of the seeds that have been evaluated."""
    found = (folder.result(Run(method=method, seed=seed), group) for seed in range(plan.seeds))
    return [result for result in found if result is not None]


def _overall(rates: Sequence[Metrics], name: str) -> Row:
    """Rate over all trials with its interval: seeds have thrown an object unequally often."""
    successes, trials = _counts(rates, name)
    return {"pooled": successes / trials, "interval": list(wilson_interval(successes, trials))}


def _counts(rates: Sequence[Metrics], name: str) -> tuple[int, int]:
    """How often it happened in how many trials, over all seeds."""
    trials = sum(result["trials"] for result in rates)
    return sum(round(result[name] * result["trials"]) for result in rates), trials


def _paper(method: str, group: str) -> Row | None:
    """The paper's T.R. and S.R. as mean and deviation, if it has them."""
    numbers = PAPER.get((method, OBJECT_GROUPS[group]))
    if numbers is None:
        return None
    return {
        name: {"mean": round(mean / 100, 6), "deviation": round(deviation / 100, 6)}
        for name, (mean, deviation) in zip(MAIN_RATES.values(), numbers, strict=True)
    }
