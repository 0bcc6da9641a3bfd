"""Pictures of a comparison: learning curves, and success by object."""

from collections.abc import Sequence
from itertools import groupby
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pixel2catch.evaluation.comparison.summary import Curves, Row
from pixel2catch.evaluation.report import MAIN_RATES
from pixel2catch.methods import METHODS

PALETTE = ("#0072B2", "#E69F00", "#CC79A7", "#D55E00", "#009E73", "#3C3C3C", "#56B4E9")
"""Colours that people with any kind of colour vision tell apart. Source: Okabe and Ito 2008; grey: ours."""

MARKERS = "oDPsv^X<>p*hd8"  #: Marks beside the colours, for print without colour.
LINES = ("-", (0, (4, 1.5)))  #: Of the methods that come first and, in the same colours, of the others.

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


def look(method: str) -> dict[str, Any]:
    """Colour and mark of a method, the same in every picture of every study."""
    number = _number(method)
    return {"color": PALETTE[number % len(PALETTE)], "marker": MARKERS[number % len(MARKERS)]}


def line(method: str) -> dict[str, Any]:
    """Colour and dashes of a method's curve."""
    number = _number(method)
    dashes = LINES[number // len(PALETTE) % len(LINES)]
    return {"color": PALETTE[number % len(PALETTE)], "linestyle": dashes, "linewidth": 1.8}


def _number(method: str) -> int:
    names, name = list(METHODS), method.partition("+")[0]
    return names.index(name) if name in names else len(names)


def shown(name: str) -> str:
    """A name without underscores."""
    return name.replace("_", " ")


def curves_figure(curves: Curves) -> Figure:
    """T.R. and S.R. in training against transitions: mean over seeds, shaded one standard deviation."""
    millions = curves.transitions / 1e6
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 4.1), layout="constrained")
        panels: Sequence[Axes] = figure.subplots(1, len(MAIN_RATES), sharey=True)
        for axes, (title, name) in zip(panels, MAIN_RATES.items(), strict=True):
            for method in curves.rates:
                mean, deviation = (100.0 * values for values in curves.mean_and_deviation(method, name))
                drawn, between = line(method), (mean - deviation, mean + deviation)
                axes.fill_between(millions, *between, color=drawn["color"], alpha=0.2, linewidth=0)
                alone = {"marker": "o", "markersize": 3} if np.isfinite(mean).sum() == 1 else {}
                axes.plot(millions, mean, label=shown(method), **drawn, **alone)
            axes.set(title=f"{title} in training", xlabel="transitions [millions]")
            axes.set(xlim=(0.0, curves.edges[-1] / 1e6), ylim=(0.0, 100.0))
            axes.grid()
        panels[0].set_ylabel("% of episodes")
        _legend(figure, panels[0])
        return figure


def objects_figure(rows: Sequence[Row]) -> Figure:
    """S.R. by object: a mark and the 95 % interval for every method, seen objects above unseen ones."""
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
        _legend(figure, panels[0])
        return figure


def _draw_objects(axes: Axes, rows: Sequence[Row], methods: Sequence[str]) -> None:
    """Draw the rates of one set of objects, the methods beside each other in their order."""
    names = list(dict.fromkeys(row["object"] for row in rows))
    for number, method in enumerate(methods):
        own = [row for row in rows if row["method"] == method]
        offset = 0.7 * ((number + 0.5) / len(methods) - 0.5)
        rate = np.array([100.0 * row["success_rate"]["pooled"] for row in own])
        bounds = np.array([row["success_rate"]["interval"] for row in own]).reshape(-1, 2)
        axes.errorbar(
            rate,
            [names.index(row["object"]) + offset for row in own],
            xerr=np.maximum(0.0, np.stack((rate - 100.0 * bounds[:, 0], 100.0 * bounds[:, 1] - rate))),
            linestyle="none",
            elinewidth=1.2,
            markersize=4.5,
            label=shown(method),
            **look(method),
        )
    axes.set_yticks(range(len(names)), [shown(name) for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x")
    for border in range(1, len(names)):
        axes.axhline(border - 0.5, color="#E4E4E4", linewidth=0.8)


def _legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(6, len(labels)))
