"""Pictures of a comparison: learning curves, success by object, and the throws beside robot and camera."""

from collections.abc import Sequence
from itertools import groupby
from typing import Any

import matplotlib
import mujoco
import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy import ndarray

from pixel2catch.evaluation.comparison.summary import Curves, Row
from pixel2catch.evaluation.report import MAIN_RATES
from pixel2catch.mdp.throws import Range, ThrowCfg, sample_throws
from pixel2catch.methods import METHODS
from pixel2catch.robots.workcell import TABLE
from pixel2catch.scene.constants import GRAVITY, RGB_CAMERA
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.workcells import find_workcell

PALETTE = ("#0072B2", "#E69F00", "#CC79A7", "#D55E00", "#009E73", "#3C3C3C", "#56B4E9")
"""Colours that people with any kind of colour vision tell apart. Source: Okabe and Ito 2008; grey: ours."""

MARKERS = "oDPsv^X"  #: Marks beside the colours, for print without colour.

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

NUM_THROWS = 40  #: Paths that are drawn.
SIDE, TOP = (0, 2), (0, 1)  #: Coordinates of the two views.

RELEASE, AIM, PATH = PALETTE[3], PALETTE[4], PALETTE[0]
ARM, WOOD, VIEW = "#5B5B5B", "#C9B79C", "#B07C00"
CHAIN = ("base_link", "shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link")
"""Bodies that the arm is drawn through; the palm comes last."""

VIEW_LENGTH = 5.0  #: How far the edges of the camera's view are drawn [m]: beyond the picture.


def look(method: str) -> dict[str, Any]:
    """Colour and mark of a method, the same in every picture of every study."""
    names, name = list(METHODS), method.partition("+")[0]
    number = names.index(name) if name in names else len(names)
    return {"color": PALETTE[number % len(PALETTE)], "marker": MARKERS[number % len(MARKERS)]}


def shown(name: str) -> str:
    """A name without underscores."""
    return name.replace("_", " ")


def curves_figure(curves: Curves) -> Figure:
    """T.R. and S.R. in training against transitions: mean over seeds, shaded one standard deviation."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 4.1), layout="constrained")
        panels: Sequence[Axes] = figure.subplots(1, len(MAIN_RATES), sharey=True)
        for axes, (title, name) in zip(panels, MAIN_RATES.items(), strict=True):
            for method in curves.rates:
                _draw_curve(axes, curves, method, name)
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


def _draw_curve(axes: Axes, curves: Curves, method: str, name: str) -> None:
    mean, deviation = (100.0 * values for values in curves.mean_and_deviation(method, name))
    millions, color = curves.transitions / 1e6, look(method)["color"]
    axes.fill_between(millions, mean - deviation, mean + deviation, color=color, alpha=0.2, linewidth=0)
    alone = {"marker": "o", "markersize": 3} if np.isfinite(mean).sum() == 1 else {}
    axes.plot(millions, mean, color=color, linewidth=1.8, label=shown(method), **alone)


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


def throws_figure(cfg: ThrowCfg, seed: int = 0) -> Figure:
    """Draw throws from release to aim."""
    paths, arm = sample_paths(cfg, NUM_THROWS, seed), arm_points()
    ranges = {
        "release": (cfg.release_x, cfg.release_y, cfg.release_z),
        "aim": (cfg.aim_x, cfg.aim_y, cfg.aim_z),
    }
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 7.4), layout="constrained")
        side, top = figure.subplots(2, 1, sharex=True, height_ratios=(2.45, 1.3))
        for axes, view in ((side, SIDE), (top, TOP)):
            draw_scene(axes, view, arm)
            for path in paths:
                axes.plot(*path[:, view].T, color=PATH, linewidth=0.8, alpha=0.45)
            for name, color in (("release", RELEASE), ("aim", AIM)):
                axes.add_patch(range_box(ranges[name][view[0]], ranges[name][view[1]], color))
        side.set(title="side view", ylabel="z [m]", ylim=(0.0, 2.45))
        top.set(title="top view", xlabel="x [m], from the robot to the thrower", ylabel="y [m]")
        top.set(xlim=(-0.65, 3.05), ylim=(-0.65, 0.65))
        _label(side, arm, ranges)
        return figure


def sample_paths(cfg: ThrowCfg, num_throws: int, seed: int) -> Float[ndarray, "num_throws num_points 3"]:
    """Positions [m] on sampled paths, at equal times from the release to the aim."""
    throw = sample_throws(cfg, num_throws, torch.Generator().manual_seed(seed))
    pos, lin_vel, flight_time = (
        each.double().numpy() for each in (throw.pos, throw.lin_vel, throw.flight_time())
    )
    time = np.linspace(0.0, flight_time, 60, axis=1)[..., None]
    return pos[:, None] + lin_vel[:, None] * time - 0.5 * GRAVITY * time**2 * np.array((0.0, 0.0, 1.0))


def arm_points() -> Float[ndarray, "num_points 3"]:
    """Positions [m] along the arm in its start pose, from the base to the palm."""
    scene = SceneCfg()
    model = build_model(scene)
    data = mujoco.MjData(model)
    home = [joint.home for joint in find_workcell(scene.workcell).joints]
    data.qpos[: len(home)] = home
    mujoco.mj_kinematics(model, data)
    return np.array([*(data.body(name).xpos for name in CHAIN), data.site("palm").xpos])


def draw_scene(axes: Axes, view: tuple[int, int], arm: Float[ndarray, "num_points 3"]) -> None:
    """Draw table, arm, palm and camera, in one scale on both axes."""
    sides = [(TABLE.center[i] - TABLE.size[i] / 2, TABLE.center[i] + TABLE.size[i] / 2) for i in (0, 1)]
    box = (*sides, (TABLE.center[2] - TABLE.thickness, TABLE.center[2]))
    axes.add_patch(range_box(box[view[0]], box[view[1]], WOOD))
    for edge in _view_edges(view):
        axes.plot(*edge.T, color=VIEW, linewidth=1.0, linestyle=(0, (5, 4)))
    axes.plot(*np.array(RGB_CAMERA.pos)[list(view)], marker="s", markersize=7, color=VIEW, linestyle="none")
    axes.plot(*arm[:, view].T, color=ARM, linewidth=4, marker="o", markersize=5)
    axes.plot(*arm[-1, list(view)], marker="o", markersize=8, color="black", linestyle="none")
    axes.set_aspect("equal")
    axes.grid()


def _view_edges(view: tuple[int, int]) -> Float[ndarray, "2 2 2"]:
    """Edges of the camera's view: of its middle column from the side, of its middle row from above."""
    camera = RGB_CAMERA
    w, x, y, z = camera.quat
    axis = np.array((2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)))[list(view)]
    left = np.array((-axis[1], axis[0])) / np.linalg.norm(axis)
    pixels = {SIDE: (camera.cy, camera.height, camera.fy), TOP: (camera.cx, camera.width, camera.fx)}
    center, size, focal = pixels[view]
    start = np.array(camera.pos)[list(view)]
    slopes = (center / focal, (center - size) / focal)
    return np.array([(start, start + VIEW_LENGTH * (axis + slope * left)) for slope in slopes])


def range_box(horizontal: Range, vertical: Range, color: str) -> Rectangle:
    """A rectangle that spans two ranges [m]."""
    corner, size = (horizontal[0], vertical[0]), (horizontal[1] - horizontal[0], vertical[1] - vertical[0])
    return Rectangle(corner, *size, facecolor=color, edgecolor=color, alpha=0.55, linewidth=1.5)


def _label(
    axes: Axes, arm: Float[ndarray, "num_points 3"], ranges: dict[str, tuple[Range, Range, Range]]
) -> None:
    (release_x, _, release_z), (aim_x, _, aim_z) = ranges["release"], ranges["aim"]
    texts = (
        ("camera and its view", (RGB_CAMERA.pos[0] + 0.1, RGB_CAMERA.pos[2] + 0.03), "left", VIEW),
        ("palm at the start", (arm[-1, 0] + 0.1, arm[-1, 2] + 0.07), "center", "black"),
        ("robot", (arm[0, 0] - 0.1, arm[0, 2] + 0.08), "right", ARM),
        ("table", (TABLE.center[0], TABLE.center[2] - TABLE.thickness - 0.1), "center", "#7A6A4F"),
        ("release box", (sum(release_x) / 2, release_z[0] - 0.1), "center", RELEASE),
        ("aim box", (aim_x[0] - 0.03, aim_z[0] + 0.02), "right", AIM),
        (f"{NUM_THROWS} sampled throws", ((sum(aim_x) + sum(release_x)) / 4, 1.3), "center", PATH),
    )
    for text, place, align, color in texts:
        axes.text(*place, text, ha=align, color=color, bbox={"facecolor": "white", "linewidth": 0, "pad": 1})
