"""A comparison of methods with several seeds each: its folder, its rows and its report."""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pixel2catch import files
from pixel2catch.errors import InvalidValueError, StudyError
from pixel2catch.evaluation import report
from pixel2catch.evaluation.grid import Json, differences
from pixel2catch.evaluation.loading import fingerprint
from pixel2catch.evaluation.metrics import Metrics, pooled_counts, welch_difference, wilson_interval
from pixel2catch.evaluation.report import MAIN_RATES, RATES, Row
from pixel2catch.reports import Cells, Section
from pixel2catch.scene.objects import OBJECT_GROUPS

GROUPS = ("seen", "unseen")  #: Sets of objects that every policy is evaluated on. Source: paper, Sec. V.
MAXIMA = ("max_joint_speed", "max_torque_share", "max_penetration")  #: Extremes over all throws of all seeds.
FILE = "study.json"
EVALUATION_SEED = 200_000
"""Seed of evaluations of training seed 0. Source: ours, see experiments/studies.toml."""

COLUMNS = ("transitions", "episodes", *MAIN_RATES.values())  #: Columns of `metrics.csv` for the curves.
NUM_BINS = 60  #: Most bins from the start to the end of the longest training. Source: ours.
MOST_METRICS = 2**26  #: Largest size of a `metrics.csv` [bytes]; long trainings have 100,000. Source: ours.

Columns = Mapping[str, Float[ndarray, " _"]]  #: One value for each update; trainings differ in length.
Curves = tuple[Float[ndarray, " num_edges"], dict[str, dict[str, tuple[ndarray, ndarray]]]]
"""Edges of bins [transitions]; by method and name of a rate, mean and sample deviation over seeds in each
bin, NaN where a seed has no value."""

RATES_NOTE = (
    "T.R.: the palm is within 8 cm of the object once. S.R.: it is for 20 control steps in a row. "
    "Mean ± sample standard deviation over the seeds. The 95 % Wilson intervals are over the trials of all "
    "seeds and leave out the differences between seeds. Paper: mean ± deviation over 3 seeds. The paper's "
    "unseen objects are not published; ours are stand-ins."
)
QUALITY_NOTE = (
    "Verified hold: after the success the policy stops, two parts of the hand touch the object for 1 s, and "
    "the hold survives half a second of shaking. Closed-loop hold: the policy goes on instead, for 2 s of "
    "shaking, in every third throw. Speed, torque and penetration are the largest of all throws."
)
DIFFERENCES_NOTE = (
    "Difference of the means over the seeds in points, with its 95 % interval by Welch's t test, without a "
    "correction for several comparisons."
)
CURVES_NOTE = (
    "Rates in training: the policy is stochastic and all noise is on, so they are below those of the tables. "
    "Line: mean over the seeds with a log; shaded: one standard deviation. Each point is the rate of all "
    "episodes that ended in a bin of transitions."
)


@dataclass(frozen=True, kw_only=True)
class Training:
    """One training: name of the method, with the settings of a sweep behind it, and seed."""

    method: str
    seed: int

    @property
    def name(self) -> str:
        return f"{self.method.replace(' ', '-').replace('/', '%2F')}-seed{self.seed}"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The size and the configuration of a study."""

    methods: tuple[str, ...]  #: The methods of `Training`, in the order of the tables.
    seeds: int  #: Seeds of every method, from 0.
    configuration: Mapping[str, Any]  #: Everything else that changes results, by name.
    sessions: tuple[dict[str, Any], ...] = ()  #: Time, command and machine of each session of the study.

    def runs(self) -> Iterator[Training]:
        """Yield all trainings; each method has one seed before any has two."""
        for seed, method in product(range(self.seeds), self.methods):
            yield Training(method=method, seed=seed)


@dataclass(frozen=True)
class ComparisonFolder:
    """Files of a comparison.

    `study.json`: plan and sessions. `runs/METHOD-seedS/`: trainings. `evaluations/METHOD-seedS-GROUP.json`.
    `logs/`: what trainings and evaluations print. `report/`: tables and pictures.
    """

    path: Path

    def run(self, run: Training) -> Path:
        return self.path / "runs" / run.name

    def evaluation(self, run: Training, group: str) -> Path:
        """Return the file with the metrics of a policy on a set of objects."""
        return self.path / "evaluations" / f"{run.name}-{group}.json"

    def metrics(self, run: Training) -> Path:
        """Return the log of a training, with one row for each update."""
        return self.run(run) / "metrics.csv"

    def is_trained(self, run: Training) -> bool:
        """Return whether a training is finished; without its folder, whether its policy is evaluated."""
        if not self.run(run).exists():
            return all(self.result(run, group) for group in GROUPS)
        return (_read(self.run(run) / "summary.json") or {}).get("status") == "finished"

    def result(self, run: Training, group: str) -> Metrics | None:
        """Return the metrics of a policy on a set of objects; nothing if absent or of another policy."""
        result = _read(self.evaluation(run, group))
        has_policy = (self.run(run) / "policy").is_dir()
        if result is None or (has_policy and result.get("policy_sha256") != fingerprint(self.run(run))):
            return None
        return result

    def plan(self) -> Plan:
        """Return the plan, with all methods, seeds and sessions that were ever added."""
        file, fix = self.path / FILE, "Mend it, or name another folder with --out."
        if not file.exists():
            raise StudyError(f"'{self.path}' holds no {FILE}; name another folder with --out.")
        with files.reading("study", file, fix, StudyError):
            content = files.read_json_object(file)
            return files.decoded(Plan, content["plan"] | {"sessions": content["sessions"]})

    def open(self, plan: Plan) -> None:
        """Begin a study, or continue it, with new methods or seeds or without; add the plan's sessions.

        Raises StudyError if the configuration differs, or the folder holds results without a study.
        """
        methods, seeds, sessions = plan.methods, plan.seeds, plan.sessions
        if any(self.path.glob("runs/*")) or any(self.path.glob("evaluations/*")):
            before = self.plan()
            if changes := differences(
                before.configuration, files.as_json(plan.configuration), "in the study"
            ):
                fix = "give its values, or another --out"
                raise StudyError(f"'{self.path}' was begun with another configuration ({changes}); {fix}.")
            longer, shorter = sorted((before.methods, methods), key=len, reverse=True)
            methods = tuple(dict.fromkeys((*longer, *shorter)))
            seeds, sessions = max(before.seeds, seeds), (*before.sessions, *sessions)
        asked = {"methods": methods, "seeds": seeds, "configuration": plan.configuration}
        files.write_atomically({self.path / FILE: files.json_text({"plan": asked, "sessions": sessions})})


def _read(path: Path) -> Json | None:
    """Return the content of a JSON file; nothing if it is absent or incomplete."""
    try:
        return files.read_json_object(path)
    except (FileNotFoundError, ValueError):
        return None


def write_comparison(folder: ComparisonFolder) -> list[Cells]:
    """Write the report of the results that there are, and return the table of the rates."""
    from pixel2catch.evaluation.figures import curves_picture

    plan = folder.plan()
    results, curves = list(summary_rows(folder, plan)), all_curves(folder, plan)
    rates, changes = rates_table(results), list(difference_rows(results))
    data = {"results": results, "differences": changes, "sessions": plan.sessions}
    configuration = [{"name": name, "value": f"{value}"} for name, value in plan.configuration.items()]
    sections = [
        Section(title="Results", text=RATES_NOTE, rows=rates),
        Section(title="Holds and contact", text=QUALITY_NOTE, rows=quality_table(results)),
    ]
    if changes:
        rows = [
            {name: row[name] for name in ("pair", "objects")}
            | {title: report.difference(row[name]) for title, name in RATES.items() if name in row}
            for row in changes
        ]
        sections.append(Section(title="Differences", text=DIFFERENCES_NOTE, rows=rows))
    if curves:
        pictures = {"curves.png": curves_picture(*curves)}
        sections.append(Section(title="Learning curves", text=CURVES_NOTE, pictures=pictures))
    sections.append(Section(title="Configuration", rows=configuration))
    report.write_report(folder.path / "report", "Comparison of methods", sections, data)
    return rates


def summary_rows(folder: ComparisonFolder, plan: Plan) -> Iterator[Row]:
    """Yield a row for every method and set of objects with results, over all of its seeds."""
    for method, group in product(plan.methods, GROUPS):
        runs = (run for run in plan.runs() if run.method == method)
        if results := [each for run in runs if (each := folder.result(run, group)) is not None]:
            yield {
                "method": method,
                "objects": group,
                "seeds": len(results),
                "trials": sum(result["trials"] for result in results),
                **{name: pooled(results, name) for name in RATES.values() if all(name in r for r in results)},
                **{name: max(result[name] for result in results) for name in MAXIMA},
                "paper": _paper(method, group),
            }


def difference_rows(rows: Sequence[Row]) -> Iterator[Row]:
    """Yield the differences of methods with several seeds, or of settings that differ in one, by objects."""
    for (first, second), group in product(combinations(dict.fromkeys(r["method"] for r in rows), 2), GROUPS):
        pair = [row for row in rows if row["method"] in (first, second) and row["objects"] == group]
        is_close = len({*first.split()} ^ {*second.split()}) <= 2
        if is_close and len(pair) == 2 and min(row["seeds"] for row in pair) > 1:
            yield {
                "pair": f"{first} - {second}",
                "objects": group,
                **{
                    name: welch_difference(*(row[name]["values"] for row in pair))
                    for name in RATES.values()
                    if all(name in row for row in pair)
                },
            }


def all_curves(folder: ComparisonFolder, plan: Plan) -> Curves | None:
    """Return the curves of all trainings with a log, or nothing without any."""
    logs: dict[str, list[Columns]] = {}
    for run in plan.runs():
        if (path := folder.metrics(run)).exists() and len((columns := read_metrics(path))["transitions"]):
            logs.setdefault(run.method, []).append(columns)
    return learning_curves({name: logs[name] for name in plan.methods if name in logs}) if logs else None


def read_metrics(path: Path) -> Columns:
    """Return the `COLUMNS` of a `metrics.csv`, whose last line may be incomplete."""
    with files.reading("metrics", path, "Train again, or take the file out of the study."):
        try:
            table = csv.DictReader(io.StringIO(files.read_text(path, MOST_METRICS)))
            rows = [[float(row[name] or "nan") for name in COLUMNS] for row in table]
        except csv.Error as error:
            raise InvalidValueError(f"it is no table ({error})") from error
    return dict(zip(COLUMNS, np.array(rows).reshape(-1, len(COLUMNS)).T, strict=True))


def binned(columns: Columns, name: str, edges: Float[ndarray, " num_edges"]) -> Float[ndarray, " num_bins"]:
    """Return the rate over all episodes that ended in each bin.

    Empty bins between others are interpolated; empty bins at the ends are NaN.
    """
    has_rate = columns["episodes"] > 0
    episodes, rate = columns["episodes"][has_rate], columns[name][has_rate]
    transitions = columns["transitions"][has_rate]
    total, _ = np.histogram(transitions, edges, weights=episodes)
    events, _ = np.histogram(transitions, edges, weights=episodes * rate)
    filled = np.flatnonzero(total)
    if len(filled) == 0:
        return np.full(len(total), np.nan)
    bins = np.arange(len(total))
    return np.interp(bins, filled, events[filled] / total[filled], left=np.nan, right=np.nan)


def learning_curves(logs: Mapping[str, Sequence[Columns]]) -> Curves:
    """Return the curves of all methods on common bins, from the metrics of the seeds of each."""
    columns = [each for seeds in logs.values() for each in seeds]
    longest = max((each["transitions"] for each in columns), key=lambda transitions: transitions[-1])
    edges, rates = np.linspace(0.0, longest[-1], min(NUM_BINS, len(longest)) + 1), {}
    for method, seeds in logs.items():
        for name in MAIN_RATES.values():
            values = np.stack([binned(each, name, edges) for each in seeds])
            deviation = values.std(axis=0, ddof=1) if len(seeds) > 1 else 0.0 * values[0]
            rates.setdefault(method, {})[name] = values.mean(axis=0), deviation
    return edges, rates


def pooled(rates: Sequence[Metrics], name: str) -> Json:
    """Return a rate over seeds: `mean`, `deviation`, `values`, and the 95 % `interval` over all trials."""
    values = [result[name] for result in rates]
    return {
        "mean": fmean(values),
        "deviation": stdev(values) if len(values) > 1 else None,  # divisor n - 1
        "interval": list(wilson_interval(*pooled_counts(rates, name))),
        "values": values,
    }


def _paper(method: str, group: str) -> Row | None:
    numbers = report.PAPER.get((method, OBJECT_GROUPS[group]))
    if numbers is None:
        return None
    return {
        name: {"mean": round(mean / 100, 6), "deviation": round(deviation / 100, 6)}
        for name, (mean, deviation) in zip(MAIN_RATES.values(), numbers, strict=True)
    }


def rates_table(rows: Sequence[Row]) -> list[Cells]:
    """Return T.R. and S.R. with deviation, interval, and the paper's numbers."""
    lines = []
    for row in rows:
        line = {name: str(row[name]) for name in ("method", "objects", "seeds")}
        for title, name in MAIN_RATES.items():
            low, high = row[name]["interval"]
            line[f"{title} [%]"] = report.spread(row[name])
            line[f"{title}, 95 % interval"] = f"[{100 * low:.1f}, {100 * high:.1f}]"
            line[f"{title}, paper"] = report.spread(row["paper"] and row["paper"][name], digits=2)
        lines.append(line)
    return lines


def quality_table(rows: Sequence[Row]) -> list[Cells]:
    """Return contact rates and extremes, with units."""
    return [
        {
            "method": row["method"],
            "objects": row["objects"],
            "trials": str(row["trials"]),
            **{f"{title} [%]": report.spread(row.get(name)) for title, name in report.CONTACT_RATES.items()},
            "largest joint speed [rad/s]": f"{row['max_joint_speed']:.2f}",
            "largest torque [% of limit]": f"{100 * row['max_torque_share']:.1f}",
            "deepest penetration [mm]": f"{1000 * row['max_penetration']:.1f}",
        }
        for row in rows
    ]
