"""Pictures of results as PNG files: learning curves."""

from collections.abc import Mapping, Sequence
from io import BytesIO
from math import ceil
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pixel2catch.evaluation.report import MAIN_RATES

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
                marker = "o" if np.isfinite(mean).sum() == 1 else ""
                style = {"color": color, "linestyle": line, "linewidth": 1.8, "marker": marker}
                axes.plot(millions, mean, label=method.replace("_", " "), markersize=3, **style)
            axes.set(title=f"{title} in training", xlabel="transitions [millions]")
            axes.set(xlim=(0.0, edges[-1] / 1e6), ylim=(0.0, 100.0))
            axes.grid()
        panels[0].set_ylabel("% of episodes")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=columns)
        return png(figure)


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG file."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()
