"""A comparison of methods with several seeds each: its folder, its rows and its report."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from pixel2catch.errors import StudyError
from pixel2catch.evaluation.curves import Columns, Curves, gather, read_metrics
from pixel2catch.evaluation.grid import Json, differences
from pixel2catch.evaluation.loading import fingerprint
from pixel2catch.evaluation.metrics import Metrics, pooled_counts, rate, wilson_interval
from pixel2catch.evaluation.report import Row, percent, table, write_files, write_report
from pixel2catch.evaluation.result_tables import CONTACT_RATES, MAIN_RATES, PAPER, RATES
from pixel2catch.files import as_json, decoded, json_text, read_json_object, reading
from pixel2catch.reports import DASH, Cells, Section
from pixel2catch.scene.objects import OBJECT_GROUPS

GROUPS = ("seen", "unseen")  #: Sets of objects that every policy is evaluated on. Source: paper, Sec. V.
MAXIMA = ("max_joint_speed", "max_torque_share", "max_penetration")  #: Extremes over all throws of all seeds.
FILE = "study.json"

RATES_NOTE = (
    "T.R.: the palm is within 8 cm of the object once. S.R.: it is for 20 control steps in a row. "
    "Mean ± sample standard deviation over the seeds. The 95 % Wilson intervals are over the trials of all "
    "seeds and leave out the differences between seeds. Paper: mean ± deviation over 3 seeds. The paper's "
    "unseen objects are not published; ours are stand-ins."
)
QUALITY_NOTE = (
    "Verified hold: after the success the policy stops, two parts of the hand touch the object for 1 s, and "
    "the hold survives half a second of shaking. Speed, torque and penetration are the largest of all throws."
)
CURVES_NOTE = (
    "Rates in training: the policy is stochastic and all noise is on, so they are below those of the tables. "
    "Line: mean over the seeds; shaded: one standard deviation. Each point is the rate of all episodes that "
    "ended in a bin of transitions."
)
OBJECTS_NOTE = "S.R. of the deterministic policies over the throws of all seeds, with 95 % Wilson intervals."
TRAININGS_NOTE = "Trainings that run side by side on one device slow each other down."


@dataclass(frozen=True, kw_only=True)
class Training:
    """One training: name of the method, and seed of the training and of the evaluations of its policy."""

    method: str
    seed: int

    @property
    def name(self) -> str:
        """Name of the training and of its folder."""
        return f"{self.method}-seed{self.seed}"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The size and the configuration of a study."""

    methods: tuple[str, ...]  #: Names of the methods, in the order of the tables.
    seeds: int  #: Seeds of every method, from 0.
    configuration: Mapping[str, Any]  #: Everything else that changes results, by name.

    def runs(self) -> Iterator[Training]:
        """Yield all trainings; each method has one seed before any has two."""
        for seed in range(self.seeds):
            for method in self.methods:
                yield Training(method=method, seed=seed)


@dataclass(frozen=True)
class ComparisonFolder:
    """Files of a comparison.

    `study.json`: plan and sessions. `runs/METHOD-seedS/`: trainings. `evaluations/METHOD-seedS-GROUP.json`.
    `logs/`: what trainings and evaluations print. `report/`: tables and pictures.
    """

    path: Path

    def run(self, run: Training) -> Path:
        """Return the folder of a training."""
        return self.path / "runs" / run.name

    def evaluation(self, run: Training, group: str) -> Path:
        """Return the file with the metrics of a policy on a set of objects."""
        return self.path / "evaluations" / f"{run.name}-{group}.json"

    def metrics(self, run: Training) -> Path:
        """Return the log of a training, with one row for each update."""
        return self.run(run) / "metrics.csv"

    def summary(self, run: Training) -> Json | None:
        """Return how a training ended, or nothing as long as it is not finished."""
        summary = _read(self.run(run) / "summary.json") or {}
        return summary if summary.get("status") == "finished" else None

    def result(self, run: Training, group: str) -> Metrics | None:
        """Return the metrics of a policy on a set of objects; nothing if absent or of another policy."""
        result = _read(self.evaluation(run, group))
        has_policy = (self.run(run) / "policy").is_dir()
        if result is None or (has_policy and result.get("policy_sha256") != fingerprint(self.run(run))):
            return None
        return result

    def results(self, plan: Plan, method: str, group: str) -> list[Metrics]:
        """Return the metrics of all seeds of a method that there are."""
        found = (self.result(Training(method=method, seed=seed), group) for seed in range(plan.seeds))
        return [result for result in found if result is not None]

    def plan(self) -> Plan:
        """Return the plan, with all methods and seeds that were ever added.

        Raises:
            StudyError: If there is no study.
        """
        content = self._content()
        if content is None:
            raise StudyError(f"'{self.path}' holds no {FILE}; name another folder with --out.")
        with reading("study", self.path / FILE, "Mend it, or name another folder with --out.", StudyError):
            return decoded(Plan, content["plan"])

    def sessions(self) -> list[Json]:
        """Return time, command and machine of each session of the study."""
        return (self._content() or {"sessions": []})["sessions"]

    def open(self, plan: Plan, sessions: Sequence[Json]) -> None:
        """Begin a study, or continue it, with new methods or seeds or without; add sessions.

        Raises:
            StudyError: If the configuration differs, or the folder holds results without a study.
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
        before, asked = self.plan(), as_json(plan.configuration)
        if changes := differences(before.configuration, asked, "in the study"):
            raise StudyError(
                f"the study in '{self.path}' was begun with another configuration ({changes}); "
                "give its values, or name another folder with --out."
            )
        longer, shorter = sorted((before.methods, plan.methods), key=len, reverse=True)
        methods = tuple(dict.fromkeys((*longer, *shorter)))
        return Plan(methods=methods, seeds=max(before.seeds, plan.seeds), configuration=asked)


def _read(path: Path) -> Json | None:
    """Return the content of a JSON file; nothing if it is absent or incomplete."""
    try:
        return read_json_object(path)
    except (FileNotFoundError, ValueError):
        return None


def write_comparison(folder: ComparisonFolder) -> list[Cells]:
    """Write the report of the results that there are, and return the table of the rates.

    Raises:
        StudyError: If there is no study.
        OSError: If it cannot be written; an earlier report is then unchanged.
    """
    from pixel2catch.evaluation.figures import curves_picture, heat_map

    plan = folder.plan()
    data: dict[str, list[Row]] = {
        "results": list(summary_rows(folder, plan)),
        "objects": list(object_rows(folder, plan)),
        "trainings": list(training_rows(folder, plan)),
        "sessions": list(folder.sessions()),
    }
    results, objects, curves = data["results"], data["objects"], all_curves(folder, plan)
    rates, trainings = rates_table(results), [_training_line(row) for row in data["trainings"]]
    configuration = [{"name": name, "value": f"{value}"} for name, value in plan.configuration.items()]
    sections = [
        Section(title="Results", text=RATES_NOTE, rows=rates),
        Section(title="Holds and contact", text=QUALITY_NOTE, rows=quality_table(results)),
    ]
    if curves:
        pictures = {"curves.png": curves_picture(curves)}
        sections.append(Section(title="Learning curves", text=CURVES_NOTE, pictures=pictures))
    if objects:
        by, pictures = (
            ("object", "method"),
            {"objects.png": heat_map(objects, ("object", "method"), "objects")},
        )
        lines = table(objects, by, _percent)
        sections.append(Section(title="S.R. by object", text=OBJECTS_NOTE, rows=lines, pictures=pictures))
    sections += [
        Section(title="Trainings", text=TRAININGS_NOTE, rows=trainings),
        Section(title="Configuration", rows=configuration),
    ]
    write_report(folder.path / "report", "Comparison of methods", sections, data)
    return rates


def summary_rows(folder: ComparisonFolder, plan: Plan) -> Iterator[Row]:
    """Yield a row for every method and set of objects with results."""
    for method in plan.methods:
        for group in GROUPS:
            if results := folder.results(plan, method, group):
                yield {
                    "method": method,
                    "objects": group,
                    "seeds": len(results),
                    "trials": sum(result["trials"] for result in results),
                    **{name: pooled(results, name) for name in RATES.values()},
                    **{name: max(result[name] for result in results) for name in MAXIMA},
                    "paper": _paper(method, group),
                }


def object_rows(folder: ComparisonFolder, plan: Plan) -> Iterator[Row]:
    """Yield a row for every object, seen ones first, and method, over the trials of all seeds."""
    for group in GROUPS:
        results = {method: folder.results(plan, method, group) for method in plan.methods}
        for name in OBJECT_GROUPS[group]:
            for method, seeds in results.items():
                thrown = [result["objects"][name] for result in seeds if name in result["objects"]]
                if thrown:
                    row: Json = {"object": name, "objects": group, "method": method}
                    row["trials"] = sum(rates["trials"] for rates in thrown)
                    for metric in MAIN_RATES.values():
                        row |= rate(metric, *pooled_counts(thrown, metric))
                    yield row


def training_rows(folder: ComparisonFolder, plan: Plan) -> Iterator[Row]:
    """Yield a row for every finished training."""
    for run in plan.runs():
        if summary := folder.summary(run):
            row = {name: summary[name] for name in ("transitions", "seconds")}
            yield {"method": run.method, "seed": run.seed} | row


def all_curves(folder: ComparisonFolder, plan: Plan) -> Curves | None:
    """Return the curves of all trainings with a log, or nothing without any."""
    logs: dict[str, list[Columns]] = {}
    for run in plan.runs():
        if (path := folder.metrics(run)).exists() and len((columns := read_metrics(path))["transitions"]):
            logs.setdefault(run.method, []).append(columns)
    return gather({method: logs[method] for method in plan.methods if method in logs}) if logs else None


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
    numbers = PAPER.get((method, OBJECT_GROUPS[group]))
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
            line[f"{title} [%]"] = _spread(row[name])
            line[f"{title}, 95 % interval"] = f"[{100 * low:.1f}, {100 * high:.1f}]"
            line[f"{title}, paper"] = _spread(row["paper"] and row["paper"][name], digits=2)
        lines.append(line)
    return lines


def quality_table(rows: Sequence[Row]) -> list[Cells]:
    """Return contact rates and extremes, with units."""
    return [
        {
            "method": row["method"],
            "objects": row["objects"],
            "trials": str(row["trials"]),
            **{f"{title} [%]": _spread(row[name]) for title, name in CONTACT_RATES.items()},
            "largest joint speed [rad/s]": f"{row['max_joint_speed']:.2f}",
            "largest torque [% of limit]": f"{100 * row['max_torque_share']:.1f}",
            "deepest penetration [mm]": f"{1000 * row['max_penetration']:.1f}",
        }
        for row in rows
    ]


def _training_line(row: Row) -> Cells:
    return {
        "method": row["method"],
        "seed": str(row["seed"]),
        "transitions": f"{row['transitions']:,}",
        "duration [min]": f"{row['seconds'] / 60:.1f}",
    }


def _percent(row: Row) -> str:
    return percent(row["success_rate"], row["success_rate_interval"], digits=1)


def _spread(rate: Row | None, digits: int = 1) -> str:
    """Return mean ± deviation in percent; a dash for a missing number."""
    if rate is None:
        return DASH
    deviation = DASH if rate["deviation"] is None else f"{100 * rate['deviation']:.{digits}f}"
    return f"{100 * rate['mean']:.{digits}f} ± {deviation}"
