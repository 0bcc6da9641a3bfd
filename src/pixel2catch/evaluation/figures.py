"""Pictures of results as PNG files: learning curves, and rates as a coloured table."""

from collections.abc import Callable, Mapping, Sequence
from io import BytesIO
from math import ceil
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pixel2catch.evaluation.report import MAIN_RATES, Row

PALETTE = ("#0072B2", "#E69F00", "#CC79A7", "#D55E00", "#009E73", "#3C3C3C", "#56B4E9")
"""Colours for readers with any kind of colour vision. Source: Okabe and Ito 2008; grey: ours."""

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

DPI = 110  #: Pixels of an inch.
HEAT = "viridis"  #: Colours of rates. Source: Smith and van der Walt 2015, Matplotlib.
DARK = 60.0  #: Rate [%] below which a cell is dark and has white letters.
ROW_HEIGHT, COLUMN_WIDTH = 0.235, 0.5  #: Size of a cell [inch].


def curves_picture(
    edges: np.ndarray, curves: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]]
) -> bytes:
    """Draw T.R. and S.R. in training over transitions: mean over seeds, with one standard deviation.

    `edges` are those of the bins, `curves` have mean and deviation by method and name of the rate.
    """
    millions = (edges[1:] + edges[:-1]) / 2e6
    columns = min(6, len(curves), 100 // max(map(len, curves))) or 1
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 3.9 + 0.2 * ceil(len(curves) / columns)), layout="constrained")
        panels: Sequence[Axes] = figure.subplots(1, len(MAIN_RATES), sharey=True)
        for axes, (title, name) in zip(panels, MAIN_RATES.items(), strict=True):
            for number, (method, rates) in enumerate(curves.items()):
                mean, deviation = (100.0 * values for values in rates[name])
                color, line = PALETTE[number % len(PALETTE)], LINES[number // len(PALETTE) % len(LINES)]
                axes.fill_between(
                    millions, mean - deviation, mean + deviation, color=color, alpha=0.2, linewidth=0
                )
                drawn = {
                    "marker": "o" if np.isfinite(mean).sum() == 1 else "",
                    "markersize": 3,
                    "linewidth": 1.8,
                }
                axes.plot(
                    millions, mean, label=method.replace("_", " "), color=color, linestyle=line, **drawn
                )
            axes.set(title=f"{title} in training", xlabel="transitions [millions]")
            axes.set(xlim=(0.0, edges[-1] / 1e6), ylim=(0.0, 100.0))
            axes.grid()
        panels[0].set_ylabel("% of episodes")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=columns)
        return png(figure)


def heat_map(rows: Sequence[Row], by: tuple[str, str], mark: Callable[[Row], str]) -> bytes:
    """Draw the S.R. of rows as a coloured table.

    Args:
        rows: The results.
        by: Fields whose values are the lines and the columns.
        mark: Returns the text behind a rate.
    """
    down, across = (list(dict.fromkeys(row[field] for row in rows)) for field in by)
    rates = np.full((len(down), len(across)), np.nan)
    width = COLUMN_WIDTH + 0.09 * max(len(mark(row)) for row in rows)
    figure = Figure(figsize=(3.0 + width * len(across), 2.0 + ROW_HEIGHT * len(down)), layout="constrained")
    with matplotlib.rc_context({"font.size": 9}):
        axes = figure.subplots()
        for row in rows:
            i, j, rate = down.index(row[by[0]]), across.index(row[by[1]]), 100.0 * row["success_rate"]
            rates[i, j], color = rate, "white" if rate < DARK else "black"
            text = f"{rate:.0f} {mark(row)}".rstrip()
            axes.text(j + 0.5, i + 0.53, text, ha="center", va="center", color=color)
        image = axes.pcolormesh(rates, cmap=HEAT, vmin=0.0, vmax=100.0, edgecolors="white", linewidth=0.8)
        axes.set_yticks(np.arange(len(down)) + 0.5, down)
        axes.set_xticks(np.arange(len(across)) + 0.5, across, rotation=50, ha="left")
        axes.set_ylim(len(down), 0)
        axes.tick_params(length=0, top=False, labeltop=True, labelbottom=False)
        axes.spines[:].set_visible(False)
        bar = figure.colorbar(image, ax=axes, location="bottom", shrink=0.7, aspect=30, pad=0.01)
        bar.set_label("S.R. [% of throws]")
        return png(figure)


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG file."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()
