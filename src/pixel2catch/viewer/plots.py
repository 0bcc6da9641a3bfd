"""Curves of a throw: box, commands, and height of the object."""

from collections.abc import Sequence

import numpy as np
import viser
from jaxtyping import Float
from viser import uplot

from pixel2catch.camera.boxes import PIXEL_FEATURES
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.viewer.throws import FlightPath, ThrowStep

COLORS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#17becf")
SHOWN = (-0.7, 2.6)  #: Range of time of a plot [s].
PLOT_HEIGHT = 150  #: Height of a plot [px].
LEGEND_LINES = 6  #: Largest number of lines of a plot with a legend.


def add_plot(
    gui: viser.GuiApi,
    title: str,
    names: Sequence[str],
    *,
    x: str = "s",
    limits: tuple[float, float] | None = SHOWN,
    heights: tuple[float, float] | None = None,
) -> viser.GuiUplotHandle:
    """Add an empty plot of named lines over time [s] or `x`; without limits it shows all values."""
    scales = {} if heights is None else {"y": uplot.Scale(auto=False, range=heights)}
    scale = uplot.Scale(time=False) if limits is None else uplot.Scale(time=False, auto=False, range=limits)
    series = [uplot.Series(label=x)]
    series += [
        uplot.Series(label=name, stroke=COLORS[i % len(COLORS)], width=1.5) for i, name in enumerate(names)
    ]
    return gui.add_uplot(
        data=tuple(np.zeros(1) for _ in series),
        series=tuple(series),
        title=title,
        height=PLOT_HEIGHT + 25 * (len(names) <= LEGEND_LINES),
        legend=uplot.Legend(show=len(names) <= LEGEND_LINES, live=False),
        scales=scales | {"x": scale},
    )


class ThrowPlots:
    """The plots of a throw; `show` updates them."""

    def __init__(self, gui: viser.GuiApi, workcell: WorkcellSpec) -> None:
        """Add the plots at the present place of the page."""
        self._path = add_plot(gui, "height of the object [m]", ("ballistic", "flown"))
        self._box = add_plot(gui, "box [shares of the image]", PIXEL_FEATURES[:4])
        self._change = add_plot(gui, "its change in a step [px]", PIXEL_FEATURES[4:])
        self._groups = [
            (
                workcell.columns(group.name),
                add_plot(gui, f"{group.name}: joint targets [rad]", [joint.name for joint in group.joints]),
            )
            for group in workcell.groups
        ]

    def remove(self) -> None:
        """Remove the plots from the page."""
        for plot in (self._path, self._box, self._change, *(plot for _, plot in self._groups)):
            plot.remove()

    def show(self, frames: Sequence[ThrowStep], path: FlightPath, flight_time: float) -> None:
        """Draw the control steps so far."""
        time = np.array([frame.time for frame in frames])
        flown = np.array([frame.object_pos[2] for frame in frames])
        until = np.linspace(0.0, flight_time, len(path))
        ballistic = np.interp(time, until, path[:, 2], right=np.nan)
        features = np.stack([frame.pixel_features for frame in frames], axis=1)
        targets = np.stack([frame.joint_pos_target for frame in frames], axis=1)
        self._path.data = tuple(map(_doubles, (time, ballistic, flown)))
        self._box.data = tuple(map(_doubles, (time, *features[:4])))
        self._change.data = tuple(map(_doubles, (time, *features[4:])))
        for columns, plot in self._groups:
            plot.data = tuple(map(_doubles, (time, *targets[columns])))


def _doubles(values: np.ndarray) -> Float[np.ndarray, " num_points"]:
    return np.ascontiguousarray(values, dtype=np.float64)
