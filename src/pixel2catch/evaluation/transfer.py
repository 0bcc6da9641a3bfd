"""Transfer of policies to other physics engines: engines by restitutions, the same throws in all."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.grid import Json
from pixel2catch.evaluation.metrics import Metrics, metrics, paired_difference, pooled_counts, rate
from pixel2catch.evaluation.policy_cells import PolicyResult
from pixel2catch.evaluation.protocol import Trials
from pixel2catch.evaluation.report import Row, percent
from pixel2catch.evaluation.result_tables import RATES
from pixel2catch.evaluation.stress.suite import Axis, Level, Setting, part, together
from pixel2catch.evaluation.stress_report import ORDER_NOTE, compare_order, order_line
from pixel2catch.reports import Cells, Section
from pixel2catch.sim.factory import INELASTIC

AS_TRAINED = "as trained"  #: Label of the restitutions that the task draws.
PAIRED = {
    "tracking_rate": "is_tracked",
    "success_rate": "is_success",
    "verified_hold_rate": "is_verified",
}
"""Rates that are compared throw by throw, with the name of the event of each throw."""


def transfer_settings(engines: Sequence[str], restitutions: Sequence[float]) -> tuple[Setting, ...]:
    """Return engines by restitutions; without restitutions, they are drawn as in the task.

    Engines in which nothing bounces get the restitution 0 alone.

    Raises:
        InvalidValueError: If such an engine has no setting left, or home lacks one of the others'.
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
    """Return the metrics of all throws, and the events of each throw as texts of 0 and 1."""
    happened = vars(trials.record) | vars(trials)
    throws = {name: "".join(map(str, happened[name].int().tolist())) for name in PAIRED.values()}
    return {**metrics(trials), "throws": throws}


def rounds_of(results: Sequence[PolicyResult], num_rounds: int) -> list[PolicyResult]:
    """Return the rounds of each result, as results of their own; a single round is the result itself."""
    if num_rounds == 1:
        return list(results)
    return [
        replace(each, file=each.file.with_suffix("") / f"round-{number}.json", first_round=number)
        for each in results
        for number in range(num_rounds)
    ]


def pooled(contents: Sequence[Json]) -> Json:
    """Return the metrics of the rounds of a result together."""
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


def transfer_rows(results: Sequence[PolicyResult], num_rounds: int) -> list[Row]:
    """Return a row for each result whose rounds are all there; the engine of the first result is home.

    `success_rate_change` and its like have the difference from home over the same throws.
    """
    home, texts, rows = results[0].setting.axis.name, dict[tuple[str, str, str], Json](), list[Row]()
    for each in results:
        contents = [content for one in rounds_of([each], num_rounds) if (content := one.read())]
        if len(contents) < num_rounds:
            continue
        found, engine, label = pooled(contents), each.setting.axis.name, each.setting.level.label
        texts[each.policy.name, engine, label] = found["throws"]
        row: Json = {"policy": each.policy.name, "method": each.policy.method, "engine": engine, "home": home}
        row |= {"restitution": label, "trials": found["trials"], "failures": found["failures"]}
        row["max_penetration"] = found["max_penetration"]
        at_home = texts.get((each.policy.name, home, label))
        for name, event in PAIRED.items():
            row |= {name: found[name], f"{name}_interval": found[f"{name}_interval"]}
            if engine != home and at_home:
                row[f"{name}_change"] = paired_difference(at_home[event], found["throws"][event])
        rows.append(row)
    policies, labels = ([*dict.fromkeys(row[name] for row in rows)] for name in ("policy", "restitution"))
    return sorted(rows, key=lambda row: (policies.index(row["policy"]), labels.index(row["restitution"])))


def order_rows(rows: Sequence[Row]) -> Iterator[Row]:
    """Yield the order of the methods in every engine at every restitution, beside the real robot's."""
    for place in dict.fromkeys((row["engine"], row["restitution"]) for row in rows):
        if order := compare_order([row for row in rows if (row["engine"], row["restitution"]) == place]):
            yield {"engine": place[0], "restitution": place[1], **order}


def transfer_sections(rows: Sequence[Row], orders: Sequence[Row]) -> list[Section]:
    """Return the parts of the report: rates and differences from home, and the order of the methods."""
    from pixel2catch.evaluation.figures import heat_map

    text = (
        f"{rows[0]['trials']} throws each, the same in all engines; home is {rows[0]['home']}. Rates in % "
        "with their 95 % interval; difference of S.R. from home in points with its 95 % interval, number of "
        "throws lost and won by it, and p value of McNemar's exact test. Failures in % of the throws."
    )
    places = [
        row | {"place": f"{row['policy']}, restitution {row['restitution']}"} for row in map(dict, rows)
    ]
    picture = heat_map(places, ("place", "engine"), "policy", _difference, digits=1)
    lines = [_line(row) for row in rows]
    sections = [Section(title="Engines", text=text, rows=lines, pictures={"heatmap.png": picture})]
    if orders:
        lines = [
            {"engine": row["engine"], "restitution": row["restitution"], **order_line(row)} for row in orders
        ]
        sections.append(Section(title="Order of the methods", text=ORDER_NOTE, rows=lines))
    return sections


def _line(row: Row) -> Cells:
    line = {name: row[name] for name in ("policy", "restitution", "engine")}
    line |= {
        title: percent(row[name], row[f"{name}_interval"]) for title, name in RATES.items() if name in row
    }
    difference, counts, p = "home", "", ""
    if change := row.get("success_rate_change"):
        low, high = (100.0 * bound for bound in change["difference_interval"])
        difference = f"{_difference(row)} [{low:+.1f}, {high:+.1f}]"
        counts, p = f"{change['lost']}, {change['won']}", f"{change['p_value']:.2g}"
    line |= {"difference": difference, "lost, won": counts, "p": p}
    return line | {name.replace("_", " "): f"{100.0 * rate:.1f}" for name, rate in row["failures"].items()}


def _difference(row: Row) -> str:
    change = row.get("success_rate_change")
    return f"{100.0 * change['difference']:+.1f}" if change else ""
