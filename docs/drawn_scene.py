"""Robot, table and camera from the side and from above, for the figures of docs/."""

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from numpy import ndarray

from pixel2catch.checks import Range
from pixel2catch.evaluation.figures import PALETTE
from pixel2catch.robots.workcell import TABLE
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.workcells import find_workcell

SIDE, TOP = (0, 2), (0, 1)  #: Coordinates of the two views.

RELEASE, AIM, PATH = PALETTE[3], PALETTE[4], PALETTE[0]
ARM, WOOD, VIEW = "#5B5B5B", "#C9B79C", "#B07C00"
CHAIN = ("base_link", "shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link")
"""Bodies that the arm is drawn through; the palm comes last."""

VIEW_LENGTH = 5.0  #: How far the edges of the camera's view are drawn [m]: beyond the picture.


def arm_points() -> ndarray:
    """Positions [m] along the arm in its start pose, from the base to the palm."""
    scene = SceneCfg()
    model = build_model(scene)
    data = mujoco.MjData(model)
    home = [joint.home for joint in find_workcell(scene.workcell).joints]
    data.qpos[: len(home)] = home
    mujoco.mj_kinematics(model, data)
    return np.array([*(data.body(name).xpos for name in CHAIN), data.site("palm").xpos])


def draw_scene(axes: Axes, view: tuple[int, int], arm: ndarray) -> None:
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


def _view_edges(view: tuple[int, int]) -> ndarray:
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
