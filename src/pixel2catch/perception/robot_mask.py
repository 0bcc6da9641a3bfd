"""The pixels that show the robots, from their projected model."""

import cv2
import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from pixel2catch.camera.image import Mask
from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.errors import PerceptionError
from pixel2catch.robots.geometry import bare_model
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene import shapes
from pixel2catch.scene.constants import RGB_CAMERA, CameraSpec

NEAREST = 0.05  #: Nearer points are left out [m].

MARGIN = 4  #: Margin around the robot [px]. Source: ours, for errors of camera and clocks.

HIDDEN = 0.002
"""A geom that protrudes less than this from another one of its body is left out [m]. Source: ours."""


class RobotMask:
    """Projects robots into the camera's image. Every geom is convex: its image is the hull of its corners."""

    def __init__(
        self, workcell: WorkcellSpec, camera: CameraSpec = RGB_CAMERA, *, margin: int = MARGIN
    ) -> None:
        """Compute the corners of every geom, visual ones included; the margin is in pixels."""
        self._size, self._margin = (camera.height, camera.width), margin
        self._projection = nominal_projection(camera, torch.zeros(0, dtype=torch.float64))
        self._model = bare_model(workcell, visuals=True)
        self._data = mujoco.MjData(self._model)
        corners = [_corners(self._model, geom) for geom in range(self._model.ngeom)]
        self._geoms = _outermost(self._model, corners)
        most = max(map(len, corners))
        # All geoms get the same number of corners: the last one is repeated, which does not change the hull.
        self._corners = np.stack(
            [np.pad(corners[geom], ((0, most - len(corners[geom])), (0, 0)), "edge") for geom in self._geoms]
        )

    def at(self, joint_pos: Float[np.ndarray, " num_joints"]) -> Mask:
        """Return the pixels of the robot at joint positions, in joint order [rad].

        Raises:
            PerceptionError: They are not finite.
        """
        if not np.isfinite(joint_pos).all():
            raise PerceptionError(f"joint positions must be finite, got {joint_pos}: check the joint states.")
        self._data.qpos[:] = joint_pos
        mujoco.mj_kinematics(self._model, self._data)
        matrix, center = self._projection.matrix.numpy(), self._projection.center.numpy()
        turn = matrix @ self._data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        place = (self._data.geom_xpos[self._geoms] - center) @ matrix.T
        points = self._corners @ turn.swapaxes(1, 2) + place[:, None]
        is_near = points[..., 2] > NEAREST
        # OpenCV fills a pixel if the hull reaches its middle, which is (0, 0) in the first pixel.
        pixels = points[..., :2] / np.where(is_near, points[..., 2], np.inf)[..., None] - 0.5
        rounded = np.rint(np.clip(pixels, -1e4, 1e4)).astype(np.int32)
        canvas = np.zeros(self._size, dtype=np.uint8)
        in_front = (
            rounded if is_near.all() else (row[seen] for row, seen in zip(rounded, is_near, strict=True))
        )
        hulls = [cv2.convexHull(corners) for corners in in_front if len(corners)]
        for hull in hulls:
            cv2.fillConvexPoly(canvas, hull, 1)
        if self._margin:
            cv2.polylines(canvas, hulls, isClosed=True, color=1, thickness=2 * self._margin + 1)
        return canvas.view(bool)


def _outermost(model: mujoco.MjModel, corners: list[np.ndarray]) -> Int[np.ndarray, " num_seen"]:
    """The geoms that protrude from all others of their body by more than `HIDDEN`."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    turns = data.geom_xmat.reshape(-1, 3, 3)
    places = [points @ turn.T + pos for points, turn, pos in zip(corners, turns, data.geom_xpos, strict=True)]
    hulls, body = [ConvexHull(points) for points in places], model.body_weldid[model.geom_bodyid]
    kept: list[int] = []
    for geom in sorted(range(model.ngeom), key=lambda geom: -hulls[geom].volume):
        planes = [hulls[other].equations for other in kept if body[other] == body[geom]]
        reach = [(places[geom] @ plane[:, :3].T + plane[:, 3]).max() for plane in planes]
        if min(reach, default=np.inf) > HIDDEN:
            kept.append(geom)
    return np.array(kept)


def _corners(model: mujoco.MjModel, geom: int) -> Float[np.ndarray, "num_corners 3"]:
    """Corners of a convex geom in its own frame [m]."""
    x, y, z = model.geom_size[geom]
    match mujoco.mjtGeom(model.geom_type[geom]):
        case mujoco.mjtGeom.mjGEOM_BOX:
            return shapes.box(2 * x, 2 * y, 2 * z).vertices
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            return shapes.capsule(x, 2 * y).vertices
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            return shapes.cylinder(x, 2 * y).vertices
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return shapes.sphere(x).vertices
        case kind:
            raise PerceptionError(f"the robot has a geom of type {kind.name}, which cannot be projected yet.")
