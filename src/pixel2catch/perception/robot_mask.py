"""Which pixels show the robot: its model, projected."""

import cv2
import mujoco
import numpy as np
import torch
from jaxtyping import Float

from pixel2catch.camera.pinhole import project
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.segmenter import Mask
from pixel2catch.robot import shapes
from pixel2catch.robot.allegro import Handedness
from pixel2catch.robot.constants import JOINTS, RGB_CAMERA, CameraSpec
from pixel2catch.robot.scene import SceneCfg, build_model

ROOT_BODY = "base_link"

NEAREST = 0.05
"""Points nearer to the camera's plane are left out [m]."""

MARGIN = 4
"""Pixels about the robot that are taken for it, too. Source: ours, for errors of camera and clocks."""


class RobotMask:
    """Projects the robot of the simulation, with what is only seen of it, into the camera's image.

    Every geom is convex, so its picture is the hull of its projected corners.
    """

    def __init__(
        self, camera: CameraSpec = RGB_CAMERA, *, handedness: Handedness = "left", margin: int = MARGIN
    ) -> None:
        """Compute the corners of every geom.

        Args:
            camera: The camera.
            handedness: Which hand.
            margin: Pixels about the robot that are taken for it, too.
        """
        self._camera, self._margin = camera, margin
        self._model = build_model(SceneCfg(handedness=handedness, visuals=True))
        self._data = mujoco.MjData(self._model)
        self._columns = [self._model.joint(joint.name).qposadr[0] for joint in JOINTS]
        root = self._model.body(ROOT_BODY).rootid[0]
        self._geoms = np.flatnonzero(self._model.body_rootid[self._model.geom_bodyid] == root)
        corners = [_corners(self._model, geom) for geom in self._geoms.tolist()]
        self._corners = np.concatenate(corners)
        self._ends = np.cumsum([len(points) for points in corners])[:-1]
        self._owner = np.repeat(self._geoms, [len(points) for points in corners])

    def at(self, joint_pos: Float[np.ndarray, " num_joints"]) -> Mask:
        """Return the pixels of the robot.

        Args:
            joint_pos: Positions of arm and hand in joint order [rad].

        Raises:
            PerceptionError: If they are not finite.
        """
        if not np.isfinite(joint_pos).all():
            raise PerceptionError(f"joint positions must be finite, got {joint_pos}: check the joint states.")
        self._data.qpos[self._columns] = joint_pos
        mujoco.mj_kinematics(self._model, self._data)
        turn = self._data.geom_xmat[self._owner].reshape(-1, 3, 3)
        points = np.einsum("nij,nj->ni", turn, self._corners) + self._data.geom_xpos[self._owner]
        pixels, depth = project(self._camera, torch.from_numpy(points)[None])
        # A pixel is filled if the hull reaches its middle, which OpenCV calls (0, 0) in the first pixel.
        rounded = np.rint(np.clip(pixels[0].numpy() - 0.5, -1e4, 1e4)).astype(np.int32)
        canvas = np.zeros((self._camera.height, self._camera.width), dtype=np.uint8)
        parts = zip(np.split(rounded, self._ends), np.split(depth[0].numpy(), self._ends), strict=True)
        for corners, distance in parts:
            self._fill(canvas, corners[distance > NEAREST])
        return canvas > 0

    def _fill(self, canvas: np.ndarray, corners: np.ndarray) -> None:
        """Draw the hull of one geom's corners and a line about it."""
        if not len(corners):
            return
        hull = cv2.convexHull(corners)
        cv2.fillConvexPoly(canvas, hull, 1)
        if self._margin:
            cv2.polylines(canvas, [hull], isClosed=True, color=1, thickness=2 * self._margin + 1)


def _corners(model: mujoco.MjModel, geom: int) -> Float[np.ndarray, "num_corners 3"]:
    """Corners of a convex geom in its own frame [m]."""
    x, y, z = model.geom_size[geom]
    kind = mujoco.mjtGeom(model.geom_type[geom])
    makers = {
        mujoco.mjtGeom.mjGEOM_BOX: lambda: shapes.box(2 * x, 2 * y, 2 * z),
        mujoco.mjtGeom.mjGEOM_CAPSULE: lambda: shapes.capsule(x, 2 * y),
        mujoco.mjtGeom.mjGEOM_CYLINDER: lambda: shapes.cylinder(x, 2 * y),
        mujoco.mjtGeom.mjGEOM_SPHERE: lambda: shapes.sphere(x),
    }
    if kind not in makers:
        raise PerceptionError(f"the robot has a geom of type {kind.name}, which cannot be projected yet.")
    return makers[kind]().vertices
