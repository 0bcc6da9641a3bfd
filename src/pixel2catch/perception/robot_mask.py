"""Which pixels show the robots: their model, projected."""

import cv2
import mujoco
import numpy as np
import torch
from jaxtyping import Float

from pixel2catch.camera.pinhole import project
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.segmenter import Mask
from pixel2catch.robots.geometry import bare_model
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene import shapes
from pixel2catch.scene.constants import RGB_CAMERA, CameraSpec

NEAREST = 0.05  #: Points nearer to the camera's plane are left out [m].

MARGIN = 4
"""Pixels about the robot that are taken for it, too. Source: ours, for errors of camera and clocks."""


class RobotMask:
    """Projects robots into the camera's image. Every geom is convex, and seen as the hull of its corners."""

    def __init__(
        self, workcell: WorkcellSpec, camera: CameraSpec = RGB_CAMERA, *, margin: int = MARGIN
    ) -> None:
        """Compute the corners of every geom, also of those that are only seen; the margin is in pixels."""
        self._camera, self._margin = camera, margin
        self._model = bare_model(workcell, visuals=True)
        self._data = mujoco.MjData(self._model)
        corners = [_corners(self._model, geom) for geom in range(self._model.ngeom)]
        sizes = [len(points) for points in corners]
        self._corners, self._ends = np.concatenate(corners), np.cumsum(sizes)[:-1]
        self._owner = np.repeat(np.arange(self._model.ngeom), sizes)

    def at(self, joint_pos: Float[np.ndarray, " num_joints"]) -> Mask:
        """Return the pixels of the robot at these positions of its joints, in joint order [rad].

        Raises:
            PerceptionError: If they are not finite.
        """
        if not np.isfinite(joint_pos).all():
            raise PerceptionError(f"joint positions must be finite, got {joint_pos}: check the joint states.")
        self._data.qpos[:] = joint_pos
        mujoco.mj_kinematics(self._model, self._data)
        turn = self._data.geom_xmat[self._owner].reshape(-1, 3, 3)
        points = np.einsum("nij,nj->ni", turn, self._corners) + self._data.geom_xpos[self._owner]
        pixels, depth = project(self._camera, torch.from_numpy(points)[None])
        # A pixel is filled if the hull reaches its middle, which OpenCV calls (0, 0) in the first pixel.
        rounded = np.rint(np.clip(pixels[0].numpy() - 0.5, -1e4, 1e4)).astype(np.int32)
        canvas = np.zeros((self._camera.height, self._camera.width), dtype=np.uint8)
        parts = zip(np.split(rounded, self._ends), np.split(depth[0].numpy(), self._ends), strict=True)
        for corners, distance in parts:
            if not (distance > NEAREST).any():
                continue
            hull = cv2.convexHull(corners[distance > NEAREST])
            cv2.fillConvexPoly(canvas, hull, 1)
            if self._margin:
                cv2.polylines(canvas, [hull], isClosed=True, color=1, thickness=2 * self._margin + 1)
        return canvas > 0


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
