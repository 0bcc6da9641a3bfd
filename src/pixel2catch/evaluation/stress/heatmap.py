"""The stress suite as one picture: settings by policies, S.R. written in the cells."""

from itertools import pairwise
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pixel2catch.evaluation.report import png

PALETTE = "viridis"
"""A sequential palette for any kind of colour vision. Source: Smith and van der Walt 2015, Matplotlib."""

DARK = 60.0
"""S.R. [%] under which a cell is dark enough for white letters."""

UNTRAINED = "*"
"""Mark of a setting that a policy was not trained on."""

ROW_HEIGHT, COLUMN_WIDTH = 0.235, 0.95
"""Size of a cell [inch]."""


def heatmap(table: dict[str, Any]) -> bytes:
    """The picture as a PNG file.

    Args:
        table: What `report.make_table` returned.
    """
    settings, names = list(table["settings"].values()), list(table["policies"])
    rates = [[100.0 * row["rates"][name]["success_rate"] for name in names] for row in settings]
    rates.append([100.0 * table["mean"][name] for name in names])
    marks = [["" if row["rates"][name]["is_trained_on"] else UNTRAINED for name in names] for row in settings]
    marks.append([""] * len(names))
    titles, axes_names = [row["title"] for row in settings], [row["axis"] for row in settings]
    figure = Figure(
        figsize=(3.0 + COLUMN_WIDTH * len(names), 1.5 + ROW_HEIGHT * len(rates)), layout="constrained"
    )
    with matplotlib.rc_context({"font.size": 9}):
        axes = figure.subplots()
        image = axes.pcolormesh(np.array(rates), cmap=PALETTE, vmin=0.0, vmax=100.0)
        _label(axes, [*titles, "mean over settings"], names)
        _write_numbers(axes, rates, marks)
        _separate(axes, [*axes_names, "mean"], len(names))
        bar = figure.colorbar(image, ax=axes, location="bottom", shrink=0.7, aspect=30, pad=0.01)
        bar.set_label(f"S.R. [% of throws]; {UNTRAINED} not trained on")
        bar.outline.set_visible(False)  # type: ignore[operator]
    return png(figure)


def _label(axes: Axes, titles: list[str], names: list[str]) -> None:
    axes.set_yticks(np.arange(len(titles)) + 0.5, titles)
    axes.set_xticks(np.arange(len(names)) + 0.5, [name.replace("_", "\n") for name in names])
    axes.set_ylim(len(titles), 0)
    axes.tick_params(length=0, top=False, labeltop=True, labelbottom=False)
    for side in axes.spines.values():
        side.set_visible(False)


def _write_numbers(axes: Axes, rates: list[list[float]], marks: list[list[str]]) -> None:
    for i, row in enumerate(rates):
        for j, rate in enumerate(row):
            color = "white" if rate < DARK else "black"
            axes.text(j + 0.5, i + 0.53, f"{rate:.0f}", ha="center", va="center", color=color)
            axes.text(j + 0.72, i + 0.56, marks[i][j], ha="left", va="center", color=color)


def _separate(axes: Axes, groups: list[str], num_columns: int) -> None:
    """White lines: thin between cells, thick between axes of the suite."""
    for i, (above, below) in enumerate(pairwise(groups), start=1):
        axes.axhline(i, color="white", linewidth=0.6 if above == below else 4.0)
    for j in range(1, num_columns):
        axes.axvline(j, color="white", linewidth=1.2)
