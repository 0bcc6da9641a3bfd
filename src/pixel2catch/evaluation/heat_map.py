"""Rates as a picture: a table whose cells are coloured."""

from collections.abc import Sequence
from itertools import pairwise
from math import isnan

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from pixel2catch.evaluation.report import png

PALETTE = "viridis"  #: For any kind of colour vision. Source: Smith and van der Walt 2015, Matplotlib.
DARK = 60.0  #: Rate [%] under which a cell is dark enough for white letters.
ROW_HEIGHT, COLUMN_WIDTH = 0.235, 0.95  #: Size of a cell [inch].


def heat_map(
    rates: Sequence[Sequence[float]],
    marks: Sequence[Sequence[str]],
    rows: Sequence[str],
    columns: Sequence[str],
    groups: Sequence[str],
    label: str,
    digits: int = 0,
) -> bytes:
    """Rates [%] in coloured cells, each with a mark behind it, as a PNG file.

    Rows and columns have titles; thick lines part rows of different groups. The label is that of the colours;
    digits are those of the rates behind the point; cells of nan stay empty.
    """
    width = COLUMN_WIDTH * len(columns) + 0.45 * max(len(m) for row in marks for m in row) / 8
    figure = Figure(figsize=(3.0 + width, 1.5 + ROW_HEIGHT * len(rates)), layout="constrained")
    with matplotlib.rc_context({"font.size": 9}):
        axes = figure.subplots()
        image = axes.pcolormesh(np.array(rates), cmap=PALETTE, vmin=0.0, vmax=100.0)
        axes.set_yticks(np.arange(len(rows)) + 0.5, rows)
        axes.set_xticks(np.arange(len(columns)) + 0.5, columns)
        axes.set_ylim(len(rows), 0)
        axes.tick_params(length=0, top=False, labeltop=True, labelbottom=False)
        axes.spines[:].set_visible(False)
        for i, row in enumerate(rates):
            for j, rate in enumerate(row):
                color = "white" if rate < DARK else "black"
                text = "" if isnan(rate) else f"{rate:.{digits}f}"
                axes.text(j + 0.5, i + 0.53, text, ha="center", va="center", color=color)
                axes.text(j + 0.72, i + 0.56, marks[i][j], ha="left", va="center", color=color)
        for i, (above, below) in enumerate(pairwise(groups), start=1):
            axes.axhline(i, color="white", linewidth=0.6 if above == below else 4.0)
        for j in range(1, len(columns)):
            axes.axvline(j, color="white", linewidth=1.2)
        bar = figure.colorbar(image, ax=axes, location="bottom", shrink=0.7, aspect=30, pad=0.01)
        bar.set_label(label)
        bar.outline.set_visible(False)  # type: ignore[operator]
    return png(figure)
