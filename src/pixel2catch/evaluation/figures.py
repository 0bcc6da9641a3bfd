"""Pictures of results: learning curves, rates of objects, rates as a coloured table."""

from collections.abc import Callable, Sequence
from itertools import groupby, pairwise
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pixel2catch.evaluation.curves import Curves
from pixel2catch.evaluation.report import Row
from pixel2catch.evaluation.result_tables import MAIN_RATES
from pixel2catch.methods import METHODS

PALETTE = ("#0072B2", "#E69F00", "#CC79A7", "#D55E00", "#009E73", "#3C3C3C", "#56B4E9")
"""Colours for readers with any kind of colour vision. Source: Okabe and Ito 2008; grey: ours."""

MARKERS = "oDPsv^X<>p*hd8"  #: Marks beside the colours, for print without colour.
LINES = ("-", (0, (4, 1.5)))  #: Line styles: of the first methods, and of others in the same colours.

STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#5B5B5B",
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "lines.solid_capstyle": "round",
}

HEAT = "viridis"  #: Colours of rates. Source: Smith and van der Walt 2015, Matplotlib.
DARK = 60.0  #: Rate [%] below which a cell is dark and has white letters.
ROW_HEIGHT, COLUMN_WIDTH = 0.235, 0.5  #: Size of a cell [inch].


def look(method: str) -> dict[str, Any]:
    """Return colour, mark and line style of a method, the same in every picture."""
    names, name = list(METHODS), method.partition("+")[0]
    number = names.index(name) if name in names else len(names)
    return {
        "color": PALETTE[number % len(PALETTE)],
        "marker": MARKERS[number % len(MARKERS)],
        "linestyle": LINES[number // len(PALETTE) % len(LINES)],
    }


def curves_figure(curves: Curves) -> Figure:
    """Draw T.R. and S.R. in training over transitions: mean over seeds, with one standard deviation."""
    millions = curves.transitions / 1e6
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 4.1), layout="constrained")
        panels: Sequence[Axes] = figure.subplots(1, len(MAIN_RATES), sharey=True)
        for axes, (title, name) in zip(panels, MAIN_RATES.items(), strict=True):
            for method in curves.rates:
                mean, deviation = (100.0 * values for values in curves.mean_and_deviation(method, name))
                drawn, between = look(method), (mean - deviation, mean + deviation)
                axes.fill_between(millions, *between, color=drawn["color"], alpha=0.2, linewidth=0)
                is_point = np.isfinite(mean).sum() == 1
                drawn |= {"marker": "o" if is_point else "", "markersize": 3, "linewidth": 1.8}
                axes.plot(millions, mean, label=method.replace("_", " "), **drawn)
            axes.set(title=f"{title} in training", xlabel="transitions [millions]")
            axes.set(xlim=(0.0, curves.edges[-1] / 1e6), ylim=(0.0, 100.0))
            axes.grid()
        panels[0].set_ylabel("% of episodes")
        _add_legend(figure, panels[0])
        return figure


def objects_figure(rows: Sequence[Row]) -> Figure:
    """Draw the S.R. of each object with its 95 % interval, a mark for each method, seen objects on top."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    objects = list(dict.fromkeys((row["objects"], row["object"]) for row in rows))
    groups = {name: len(list(members)) for name, members in groupby(objects, key=lambda each: each[0])}
    height = max(0.32, 0.09 * len(methods)) * len(objects) + 1.6
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, height), layout="constrained")
        panels = figure.subplots(
            len(groups), 1, sharex=True, squeeze=False, height_ratios=list(groups.values())
        )[:, 0]
        for axes, group in zip(panels, groups, strict=True):
            _draw_objects(axes, [row for row in rows if row["objects"] == group], methods)
            axes.set_title(f"{group} objects", loc="left", fontsize=10)
        panels[-1].set(xlabel="S.R. [% of throws], 95 % interval", xlim=(-1.0, 101.0))
        _add_legend(figure, panels[0])
        return figure


def _draw_objects(axes: Axes, rows: Sequence[Row], methods: Sequence[str]) -> None:
    names = list(dict.fromkeys(row["object"] for row in rows))
    for number, method in enumerate(methods):
        own = [row for row in rows if row["method"] == method]
        style: dict[str, Any] = look(method) | {"linestyle": "none"}
        offset = 0.7 * ((number + 0.5) / len(methods) - 0.5)
        rate = np.array([100.0 * row["success_rate"] for row in own])
        bounds = np.array([row["success_rate_interval"] for row in own]).reshape(-1, 2)
        axes.errorbar(
            rate,
            [names.index(row["object"]) + offset for row in own],
            xerr=np.maximum(0.0, np.stack((rate - 100.0 * bounds[:, 0], 100.0 * bounds[:, 1] - rate))),
            elinewidth=1.2,
            markersize=4.5,
            label=method.replace("_", " "),
            **style,
        )
    axes.set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x")
    for border in range(1, len(names)):
        axes.axhline(border - 0.5, color="#E4E4E4", linewidth=0.8)


def heat_map(
    rows: Sequence[Row], by: tuple[str, str], group: str, mark: Callable[[Row], str], digits: int = 0
) -> Figure:
    """Draw the S.R. of rows as a coloured table.

    Args:
        rows: The results.
        by: Fields whose values are the lines and the columns.
        group: Field by which thick lines part the lines of the table.
        mark: Returns the text behind a rate.
        digits: Digits of the rates behind the point.
    """
    down, across = (list(dict.fromkeys(row[field] for row in rows)) for field in by)
    groups = {row[by[0]]: row[group] for row in rows}
    rates = np.full((len(down), len(across)), np.nan)
    width = COLUMN_WIDTH + 0.09 * (digits + max(len(mark(row)) for row in rows))
    figure = Figure(figsize=(3.0 + width * len(across), 2.0 + ROW_HEIGHT * len(down)), layout="constrained")
    with matplotlib.rc_context({"font.size": 9}):
        axes = figure.subplots()
        for row in rows:
            i, j, rate = down.index(row[by[0]]), across.index(row[by[1]]), 100.0 * row["success_rate"]
            rates[i, j], color = rate, "white" if rate < DARK else "black"
            text = f"{rate:.{digits}f} {mark(row)}".rstrip()
            axes.text(j + 0.5, i + 0.53, text, ha="center", va="center", color=color)
        image = axes.pcolormesh(rates, cmap=HEAT, vmin=0.0, vmax=100.0)
        axes.set_yticks(np.arange(len(down)) + 0.5, down)
        axes.set_xticks(np.arange(len(across)) + 0.5, across, rotation=50, ha="left")
        axes.set_ylim(len(down), 0)
        axes.tick_params(length=0, top=False, labeltop=True, labelbottom=False)
        axes.spines[:].set_visible(False)
        for i, (above, below) in enumerate(pairwise(groups.values()), start=1):
            axes.axhline(i, color="white", linewidth=0.6 if above == below else 4.0)
        for j in range(1, len(across)):
            axes.axvline(j, color="white", linewidth=1.2)
        bar = figure.colorbar(image, ax=axes, location="bottom", shrink=0.7, aspect=30, pad=0.01)
        bar.set_label("S.R. [% of throws]")
        bar.outline.set_visible(False)  # type: ignore[operator]
    return figure


def _add_legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(6, len(labels)))
