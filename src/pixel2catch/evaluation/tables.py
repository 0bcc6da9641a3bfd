"""Results as tables for people, beside the numbers of the paper."""

from collections.abc import Mapping

from rich.table import Table

from pixel2catch.evaluation.metrics import Metrics
from pixel2catch.robot.objects import SEEN, UNSEEN

PAPER = {
    ("without_pf", SEEN): ((12.13, 1.27), (8.93, 1.04)),
    ("without_pf", UNSEEN): ((12.11, 1.9), (7.89, 1.46)),
    ("only_wh", SEEN): ((8.03, 0.6), (5.53, 0.51)),
    ("only_wh", UNSEEN): ((6.11, 0.35), (4.00, 0.17)),
    ("only_center", SEEN): ((87.07, 1.62), (81.27, 0.76)),
    ("only_center", UNSEEN): ((87.5, 1.53), (80.72, 0.38)),
    ("single_agent", SEEN): ((78.2, 1.32), (63.5, 0.85)),
    ("single_agent", UNSEEN): ((75.83, 2.00), (65.44, 2.25)),
    ("proposed", SEEN): ((89.97, 0.21), (84.13, 0.50)),
    ("proposed", UNSEEN): ((89.28, 0.79), (84.83, 1.17)),
}
"""T.R. and S.R. [%] by method and objects: mean and deviation over three seeds. Source: paper, Sec. V."""

MAIN_RATES = {"T.R.": "tracking_rate", "S.R.": "success_rate"}
"""The paper's rates, in the order of `PAPER`, and the metrics that they are."""

CONTACT_RATES = {"palm contact": "palm_contact_rate", "verified hold": "verified_hold_rate"}
"""Rates that ask for contact, which the paper does not have."""

RATES = MAIN_RATES | CONTACT_RATES
"""Columns of the tables and the metrics that they show."""


def results_table(results: Mapping[str, Metrics], method: str) -> Table:
    """Rates of one or several sets of objects, each beside the paper's where it has them.

    Args:
        results: Metrics by name of the set.
        method: The method that was evaluated.
    """
    table = Table(title=f"{method}: % of trials [95 % interval]; paper: mean ± deviation over 3 seeds")
    _add_columns(table, "objects")
    for name, result in results.items():
        table.add_row(name, *_cells(result))
        paper = PAPER.get((method, tuple(result["objects_thrown"])))
        if paper:
            table.add_row("  paper", "", *(f"{mean:.2f} ± {deviation:.2f}" for mean, deviation in paper))
    return table


def objects_table(result: Metrics) -> Table:
    """Rates object by object."""
    table = Table(title="by object")
    _add_columns(table, "object")
    for name, rates in result["objects"].items():
        table.add_row(name, *_cells(rates))
    return table


def quality_table(results: Mapping[str, Metrics]) -> Table:
    """Failure modes, quality of contacts and holds, one column per set of objects."""
    table = Table(title="failures and contact")
    table.add_column("")
    for name in results:
        table.add_column(name, justify="right")
    columns = [_quality(result) for result in results.values()]
    for name in columns[0]:
        table.add_row(name, *(column[name] for column in columns))
    return table


def _add_columns(table: Table, first: str) -> None:
    table.add_column(first)
    for name in ("trials", *RATES):
        table.add_column(name, justify="right")


def _cells(rates: Metrics) -> list[str]:
    cells = [f"{rates['trials']}"]
    for name in RATES.values():
        low, high = (100 * bound for bound in rates[f"{name}_interval"])
        cells.append(f"{100 * rates[name]:.1f} [{low:.0f}, {high:.0f}]")
    return cells


def _quality(result: Metrics) -> dict[str, str]:
    def scaled(name: str, factor: float, unit: str, digits: int = 1) -> str:
        return "-" if result[name] is None else f"{factor * result[name]:.{digits}f} {unit}"

    return {
        **{f"failed: {name}".replace("_", " "): f"{100 * v:.1f} %" for name, v in result["failures"].items()},
        "robot touched the table": scaled("table_contact_rate", 100, "%"),
        "robot touched itself": scaled("self_contact_rate", 100, "%"),
        "  control steps of that, a trial": scaled("self_contact_steps", 1, "steps"),
        "height of the first contact": scaled("contact_height", 100, "cm"),
        "mean penetration": scaled("mean_penetration", 1000, "mm"),
        "largest penetration": scaled("max_penetration", 1000, "mm"),
        "largest penetration of the table": scaled("max_table_penetration", 1000, "mm"),
        "largest arm joint speed": scaled("max_joint_speed", 1, "rad/s"),
        "largest torque, share of limit": scaled("max_torque_share", 100, "%"),
        "mean arm joint speed in the hold": scaled("hold_speed", 1, "rad/s", 3),
        "mean hand torque in the hold, share of limit": scaled("hold_torque_share", 100, "%"),
        "peak deceleration of the object, median": scaled("peak_deceleration", 1, "m/s²"),
    }
