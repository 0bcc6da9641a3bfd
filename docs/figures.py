"""The figures of docs/, drawn from the code that they explain: `python docs/figures.py` writes them all."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from numpy import ndarray

from drawn_scene import AIM, ARM, PATH, RELEASE, SIDE, TOP, VIEW, WOOD, arm_points, draw_scene, range_box
from pixel2catch.camera.pinhole import project
from pixel2catch.checks import Range
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.evaluation.figures import PALETTE, STYLE
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.mdp.observations import FIT_FEATURES, PIXEL_FEATURES, fit_boxes, pixel_features
from pixel2catch.mdp.throws import ThrowCfg, sample_paths
from pixel2catch.robots.geometry import arm_shape, chain_of
from pixel2catch.robots.workcell import TABLE
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.servo.laws import interpolated, limited_speed, moving_mean, speed_to
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.workspace import Workspace
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO, UR5E_POS

FOLDER = Path(__file__).parent / "figures"
SVG: dict[Any, Any] = STYLE | {"svg.fonttype": "none", "svg.hashsalt": "pixel2catch"}
POLICY = Path("catch_alone+fit")
OBJECT = "cube_s"
FEATURES_SEED = 4  #: A throw that crosses the image.
NUM_THROWS = 30  #: Throws that a median is of.
LONG = len(FIT_FEATURES)  #: Where the features of the long fit begin.
NUM_PATHS = 40  #: Paths that are drawn.
TRUTH, BOX, FIT, SHORT = PALETTE[5], PALETTE[3], PALETTE[0], PALETTE[6]

LATE: dict[str, dict[str, Any]] = {
    "nominal: 1 or 2 steps": {},
    "3 steps late": {"latency_steps": (3, 3)},
    "every second image": {"image_period": 2.0},
    "6 steps without an image": {"blackout_steps": 6},
}
"""Sensors by name; a step is a control step."""


@dataclass(frozen=True, kw_only=True)
class Flights:
    """Throws at the shipped policy: a row for each control step, a column for each throw."""

    steps: ndarray  #: Control steps since the release; none once the hand has touched the object.
    truth: ndarray  #: Where the object's centre is in the image (u, v) [px].
    box: ndarray  #: The newest measured box [px].
    features: ndarray  #: `PIXEL_FEATURES` of it.
    age: ndarray  #: Its age [ms].
    short: ndarray  #: Where the fit with the short memory puts the object now (u, v) [px].
    long: ndarray  #: Where the other one does [px].
    target: ndarray  #: Joint targets [rad].


def fly(cfg: CatchEnvCfg, num_throws: int = 1, seed: int = 0) -> Flights:
    """Throw, and keep what was seen until the object is at the hand."""
    policy, method = load_policy(POLICY)
    env = CatchEnv(replace(cfg, objects=(OBJECT,)), method, num_envs=num_throws, seed=seed)
    rows: list[tuple[ndarray, ...]] = []
    try:
        observation = env.reset()
        before, hover = None, env.episode.throw.hover_steps.clone()
        is_over = torch.zeros(num_throws, dtype=torch.bool)
        while not is_over.all():
            step = env.step(policy.act(observation.policy))
            observation, seen, truth = step.observation, step.measurement, env.world.privileged(step.log)
            is_over |= step.terminated | truth.is_touching.any(dim=1)
            pixel, _ = project(RGB_CAMERA, truth.object_pos[:, None])
            features = pixel_features(seen.box if before is None else before, seen.box, RGB_CAMERA)
            fits = fit_boxes(seen.boxes.box, seen.boxes.age, RGB_CAMERA)
            steps = torch.where(is_over, torch.nan, step.record.steps - hover)
            age = seen.boxes.age[:, 0] * (1e3 * CONTROL_DT)
            values = (steps, pixel[:, 0], seen.box, features, age, _pixels(fits), _pixels(fits[:, LONG:]))
            rows.append(tuple(value.clone().numpy() for value in (*values, step.joint_pos_target)))
            before = seen.box.clone()
    finally:
        env.close()
    columns = map(np.array, zip(*rows, strict=True))
    return Flights(**dict(zip(Flights.__annotations__, columns, strict=True)))


def _pixels(fit: torch.Tensor) -> torch.Tensor:
    """Where a fit puts the object in the image (u, v) [px]."""
    u, v = fit[:, 0], fit[:, 1]
    return torch.stack((RGB_CAMERA.fx * u + RGB_CAMERA.cx, RGB_CAMERA.fy * v + RGB_CAMERA.cy), dim=-1)


def task(**sensing: Any) -> CatchEnvCfg:
    """The task of an evaluation with other sensors."""
    return task_of(load_policy(POLICY)[0]).with_sensing(**sensing)


def throws() -> Figure:
    """Camera, robot and throws from release to aim."""
    cfg, arm = ThrowCfg(), arm_points()
    ranges = {
        "release": (cfg.release_x, cfg.release_y, cfg.release_z),
        "aim": (cfg.aim_x, cfg.aim_y, cfg.aim_z),
    }
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 7.4), layout="constrained")
        side, top = figure.subplots(2, 1, sharex=True, height_ratios=(2.45, 1.3))
        for axes, view in ((side, SIDE), (top, TOP)):
            draw_scene(axes, view, arm)
            for path in sample_paths(cfg, NUM_PATHS).numpy():
                axes.plot(*path[:, view].T, color=PATH, linewidth=0.8, alpha=0.45)
            for name, color in (("release", RELEASE), ("aim", AIM)):
                axes.add_patch(range_box(ranges[name][view[0]], ranges[name][view[1]], color))
        side.set(title="side view", ylabel="z [m]", ylim=(0.0, 2.45))
        top.set(title="top view", xlabel="x [m], from the robot to the thrower", ylabel="y [m]")
        top.set(xlim=(-0.65, 3.05), ylim=(-0.65, 0.65))
        _label(side, arm, ranges)
        return figure


def _label(axes: Axes, arm: ndarray, ranges: dict[str, tuple[Range, Range, Range]]) -> None:
    (release_x, _, release_z), (aim_x, _, aim_z) = ranges["release"], ranges["aim"]
    texts = (
        ("camera and its view", (RGB_CAMERA.pos[0] + 0.1, RGB_CAMERA.pos[2] + 0.03), "left", VIEW),
        ("palm at the start", (arm[-1, 0] + 0.1, arm[-1, 2] + 0.07), "center", "black"),
        ("robot", (arm[0, 0] - 0.1, arm[0, 2] + 0.08), "right", ARM),
        ("table", (TABLE.center[0], TABLE.center[2] - TABLE.thickness - 0.1), "center", "#7A6A4F"),
        ("release box", (sum(release_x) / 2, release_z[0] - 0.1), "center", RELEASE),
        ("aim box", (aim_x[0] - 0.03, aim_z[0] + 0.02), "right", AIM),
        (f"{NUM_PATHS} sampled throws", ((sum(aim_x) + sum(release_x)) / 4, 1.3), "center", PATH),
    )
    for text, place, align, color in texts:
        axes.text(*place, text, ha=align, color=color, bbox={"facecolor": "white", "linewidth": 0, "pad": 1})


def features() -> Figure:
    """What one throw looks like to a policy: boxes in the image, and the pixel features over time."""
    flight = fly(task(), seed=FEATURES_SEED)
    rows = ~np.isnan(flight.steps[:, 0])
    time = flight.steps[rows, 0] * CONTROL_DT
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    parts: Any = figure.subfigures(1, 2, width_ratios=(1.1, 1.0))
    image: Axes = parts[0].subplots()
    image.plot(*flight.truth[rows, 0].T, color=TRUTH, linewidth=1.0, label="centre of the object")
    for number, (x0, y0, x1, y1) in enumerate(flight.box[rows, 0]):
        label = "boxes that the policy gets" if number == 0 else None
        image.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=BOX, label=label))
    image.set(xlim=(0, RGB_CAMERA.width), ylim=(RGB_CAMERA.height, 0), xlabel="u [px]", ylabel="v [px]")
    image.set_aspect("equal")
    image.legend(loc="lower left", fontsize=8)
    panels = parts[1].subplots(3, 1, sharex=True)
    groups = (("cx", "cy"), ("dcx", "dcy"), ("dw", "dh"))
    labels = ("share of the image", "change [px]", "change [px]")
    for axes, names, label in zip(panels, groups, labels, strict=True):
        for name, color in zip(names, (PALETTE[0], PALETTE[1]), strict=True):
            values = flight.features[rows, 0, PIXEL_FEATURES.index(name)]
            axes.plot(time, values, color=color, label=name)
        axes.axvline(0.0, color=TRUTH, linewidth=0.8, linestyle=":")
        axes.set_ylabel(label, fontsize=8)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
        axes.grid()
    panels[-1].set_xlabel("time since the release [s] (dotted)")
    return figure


def latency() -> Figure:
    """How old boxes are, and what a fitted path makes of that, in the median of throws."""
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    panels = figure.subplots(2, len(LATE), sharex=True, sharey="row")
    for (age, error), (title, sensing) in zip(panels.T, LATE.items(), strict=True):
        flights = fly(task(**sensing), NUM_THROWS)
        centre = (flights.box[..., :2] + flights.box[..., 2:]) / 2
        steps = np.arange(-5, 22)
        rows = ~np.isnan(flights.steps[:, 0])
        time = flights.steps[rows, 0] * CONTROL_DT
        age.step(time, flights.age[rows, 0], where="post", color=BOX)
        age.set_title(title, fontsize=9)
        lines = (
            (centre, BOX, "newest box"),
            (flights.long, FIT, "long fit"),
            (flights.short, SHORT, "short fit"),
        )
        for where, color, label in lines:
            away = np.linalg.norm(where - flights.truth, axis=-1)
            error.plot(steps * CONTROL_DT, _by_step(flights, away, steps), color=color, label=label)
        error.set(xlabel="since the release [s]", xlim=(-0.2, 0.72), ylim=(0, 100))
        age.grid()
        error.grid()
    panels[0, 0].set_ylabel("age of the box\nin one throw [ms]", fontsize=9)
    panels[1, 0].set_ylabel("median distance from\nthe object's centre [px]", fontsize=9)
    panels[1, 0].legend(loc="upper left", fontsize=8)
    return figure


def _by_step(flights: Flights, values: ndarray, steps: ndarray) -> ndarray:
    """The median of values over all throws, by the control steps since the release."""
    return np.array([np.median(values[flights.steps == step]) for step in steps])


def servo() -> Figure:
    """From the policy's targets at 30 Hz to commands at 500 Hz: a throw, and a jump that is too large."""
    limits = ServoLimits.of(UR5E_ALLEGRO).joint_records.view(np.recarray)[1]
    flight = fly(task(), seed=FEATURES_SEED)
    jump = np.repeat((-1.9, -1.4), (6, 24))
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    panels = figure.subplots(2, 2, sharex="col")
    titles = ("shoulder lift in a throw", "a jump of 0.5 rad")
    for (position, speed), title, targets in zip(
        panels.T, titles, (flight.target[:, 0, 1], jump), strict=True
    ):
        time, command, rate = _commands(targets, limits)
        ticks = np.arange(len(targets)) * CONTROL_DT
        position.step(ticks, targets, where="post", color=BOX, label="targets, 30 Hz")
        position.plot(time, command, color=FIT, label="commands, 500 Hz")
        position.set_title(title, fontsize=9)
        speed.plot(time, rate, color=FIT)
        for bound in (-1, 1):
            speed.axhline(bound * limits.speed, color=TRUTH, linewidth=0.8, linestyle=":")
        speed.set_xlabel("time [s]")
        for axes in (position, speed):
            axes.grid()
    panels[0, 0].set_ylabel("position [rad]")
    panels[1, 0].set_ylabel("speed of the command [rad/s]\n(dotted: its limit)")
    panels[0, 0].legend(fontsize=8)
    return figure


def _commands(targets: ndarray, limits: np.record) -> tuple[ndarray, ndarray, ndarray]:
    """Times [s], positions [rad] and speeds [rad/s] of the commands that follow targets."""
    start = end = position = targets[0]
    velocity, begun, newest, rows = 0.0, 0.0, -1, [(0.0, position)]
    recent = np.full(limits.window, position)
    for tick in range(round(len(targets) * CONTROL_DT / limits.dt)):
        now = tick * limits.dt
        if (number := int(now / CONTROL_DT + 1e-9)) > newest:
            start = interpolated(start, end, now - begun, CONTROL_DT)
            end, begun, newest = targets[number], now, number
        goal = interpolated(start, end, now - begun + limits.dt + limits.delay, CONTROL_DT)
        velocity = limited_speed(position, velocity, speed_to(position, goal, limits), limits)
        position += velocity * limits.dt
        rows.append((now + limits.dt, moving_mean(recent, position, limits)))
    time, command = np.array(rows).T
    return time, command, np.diff(command, prepend=command[0]) / limits.dt


def reach() -> float:
    """How far arm and hand reach from the axis of the base, of many poses [m]."""
    poses = torch.rand(20_000, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    chain = chain_of(UR5E_ALLEGRO, UR5E_ALLEGRO.palms[0])
    palm = chain.link_poses((2.0 * poses - 1.0) * torch.pi)[:, -1, :3, 3].numpy()
    shape = arm_shape(UR5E_ALLEGRO, UR5E_ALLEGRO.palms[0])
    hand = float(np.linalg.norm(np.abs(shape.hand_center) + shape.hand_half))
    return float(np.linalg.norm((palm - UR5E_POS)[:, :2], axis=1).max()) + hand


def laboratory() -> Figure:
    """Where table, robot, camera and thrower are, with the distances to measure."""
    throw, space, arm, far = ThrowCfg(), Workspace(workcell=UR5E_ALLEGRO), arm_points(), reach()
    figure = Figure(figsize=(9.0, 9.6), layout="constrained")
    side, top = figure.subplots(2, 1, sharex=True, height_ratios=(1.0, 1.05))
    ranges = (throw.release_x, throw.release_y, throw.release_z)
    for axes, (across, up) in ((side, SIDE), (top, TOP)):
        draw_scene(axes, (across, up), arm)
        corner = space.lower[across], space.lower[up]
        size = space.upper[across] - corner[0], space.upper[up] - corner[1]
        axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor=FIT, linestyle="--", linewidth=1.2))
        axes.add_patch(range_box(ranges[across], ranges[up], RELEASE))
    _measure_side(side, throw, arm, space)
    _measure_top(top, throw, far, space)
    side.set(title="side view", ylabel="height over the floor z [m]", ylim=(-0.3, 2.5), xlim=(-1.35, 3.35))
    top.set(title="top view", xlabel="x [m], from the robot's base to the thrower", ylabel="y [m]")
    top.set(ylim=(-1.55, 1.45))
    return figure


def _measure_side(axes: Axes, throw: ThrowCfg, arm: ndarray, space: Workspace) -> None:
    """Heights, and distances from the base."""
    (camera_x, _, camera_z), height = RGB_CAMERA.pos, TABLE.center[2]
    edge = TABLE.center[0] + TABLE.size[0] / 2
    axes.axhline(0.0, color=TRUTH, linewidth=2)
    for x in (TABLE.center[0] - TABLE.size[0] / 2 + 0.04, edge - 0.04):
        axes.plot((x, x), (0.0, height - TABLE.thickness), color=WOOD, linewidth=5, solid_capstyle="butt")
    _dimension(axes, (camera_x - 0.35, 0.0), (camera_x - 0.35, camera_z), f"camera {camera_z:.2f}")
    _dimension(axes, (edge + 0.12, 0.0), (edge + 0.12, height), f"table {height:.2f}")
    _dimension(axes, (camera_x, -0.12), (0.0, -0.12), f"{-camera_x:.2f}")
    _dimension(axes, (0.0, -0.12), (throw.release_x[0], -0.12), f"base to line {throw.release_x[0]:.2f}")
    low, high = throw.release_z
    _dimension(axes, (throw.release_x[1] + 0.15, 0.0), (throw.release_x[1] + 0.15, low), f"{low:.2f}")
    axes.text(camera_x + 0.12, camera_z + 0.1, f"camera, {_tilt():.0f}° down", color="#7A5600")
    axes.text(arm[-1, 0] + 0.08, arm[-1, 2] + 0.06, "palm at the start")
    axes.text(
        sum(throw.release_x) / 2, high + 0.07, f"release, {low:.2f} to {high:.2f}", ha="center", color=RELEASE
    )
    axes.text(space.upper[0] - 0.03, space.upper[2] - 0.11, "space of the hand", ha="right", color=FIT)


def _measure_top(axes: Axes, throw: ThrowCfg, far: float, space: Workspace) -> None:
    """Extents seen from above, and where nobody stands."""
    axes.add_patch(Circle(UR5E_POS[:2], far, fill=False, edgecolor=BOX, linewidth=1.6))
    axes.axvline(throw.release_x[0], color=RELEASE, linewidth=1.6, linestyle=(0, (6, 3)))
    left, right = (TABLE.center[0] + sign * TABLE.size[0] / 2 for sign in (-1, 1))
    below = -TABLE.size[1] / 2 - 0.08
    _dimension(axes, (left, below), (right, below), f"{TABLE.size[0]:.2f}")
    _dimension(
        axes, (left - 0.08, -TABLE.size[1] / 2), (left - 0.08, TABLE.size[1] / 2), f"{TABLE.size[1]:.2f}"
    )
    low, high = throw.release_y
    _dimension(axes, (throw.release_x[1] + 0.1, low), (throw.release_x[1] + 0.1, high), f"{high - low:.2f}")
    _dimension(axes, (0.0, 1.32), (throw.release_x[0], 1.32), f"{throw.release_x[0]:.2f}")
    axes.text(0.0, -far - 0.12, f"reach of arm and hand {far:.2f} m: nobody inside", ha="center", color=BOX)
    axes.text(throw.release_x[0] + 0.05, -1.2, "thrower: behind\nthis line", color=RELEASE)
    axes.text(space.lower[0] + 0.05, space.upper[1] - 0.12, "space of the hand", color=FIT)


def _tilt() -> float:
    """How far the camera looks down from level [°]."""
    _, x, y, _ = RGB_CAMERA.quat
    return -float(np.degrees(np.arcsin(1.0 - 2.0 * (x * x + y * y))))


def _dimension(axes: Axes, start: tuple[float, float], end: tuple[float, float], text: str) -> None:
    """A double arrow with its length [m]."""
    style: dict[str, Any] = {
        "arrowstyle": "<->",
        "color": TRUTH,
        "shrinkA": 0,
        "shrinkB": 0,
        "linewidth": 0.9,
    }
    axes.annotate("", start, end, arrowprops=style)
    middle = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    turn = 90 if start[0] == end[0] else 0
    place = {"facecolor": "white", "linewidth": 0, "pad": 0.8}
    axes.text(*middle, text, ha="center", va="center", rotation=turn, fontsize=9, bbox=place)


FIGURES: dict[str, Callable[[], Figure]] = {
    "throws": throws,
    "features": features,
    "latency": latency,
    "servo": servo,
    "laboratory": laboratory,
}


def write(folder: Path = FOLDER, names: Iterable[str] = FIGURES) -> None:
    """Draw figures into a folder."""
    folder.mkdir(exist_ok=True)
    torch.set_num_threads(1)
    for name in names:
        with matplotlib.rc_context(SVG):
            FIGURES[name]().savefig(folder / f"{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    write()
