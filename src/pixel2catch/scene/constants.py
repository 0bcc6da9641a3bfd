"""Constants of time, gravity and camera, each with its source.

Lengths in metres, angles in radians, quaternions (w, x, y, z). World frame: z up, x from the robot towards
the thrower. "paper" is Pixel2Catch (RA-L 2026), "release" its published configuration.
"""

from dataclasses import dataclass, replace
from typing import Annotated

from pixel2catch.checks import CAMERA_NAMES, UNIT_LENGTH, Within
from pixel2catch.robots.spec import Quat, Vec3

GRAVITY = 9.81  #: Standard value, as MuJoCo's default [m/s²].
PHYSICS_DT = 1.0 / 120.0  #: Physics time step [s]. Source: paper, 120 Hz.
DECIMATION = 4  #: Physics steps in a control step at the paper's 120 Hz. Others: `SceneCfg.decimation`.
CONTROL_DT = DECIMATION * PHYSICS_DT  #: Control time step [s]: the policy runs at 30 Hz. Source: paper.

OBJECT_RADIUS = 0.04  #: Of a ball with the volume of the largest object of the paper's task [m] (ours).

SPEED_MARGIN = 0.9
"""Largest commanded share of a joint's speed limit; coupling between joints needs the rest. Source: ours."""

OBJECT_POS, OBJECT_VEL = slice(-7, -4), slice(-6, -3)
"""Columns of the object's position in `qpos` and of its linear velocity in `qvel`, behind the robots'."""

PIXEL_CENTER = 0.5  #: Coordinate of the centre of the first pixel, along u and v [px]; 0 in ROS and OpenCV.


@dataclass(frozen=True, kw_only=True)
class CameraSpec:
    """A pinhole camera."""

    width: Annotated[int, Within(1, 8192)]  #: Image width [px].
    height: Annotated[int, Within(1, 8192)]  #: Image height [px].
    fx: Annotated[float, Within(1.0, 1e5)]  #: Focal length along x [px].
    fy: Annotated[float, Within(1.0, 1e5)]  #: Focal length along y [px].
    cx: Annotated[float, Within(-1e5, 1e5)]  #: Column of the optical axis [px].
    cy: Annotated[float, Within(-1e5, 1e5)]  #: Row of the optical axis [px].
    pos: Annotated[Vec3, Within(-100.0, 100.0)]  #: Position of the optical centre, world frame [m].
    #: Orientation of the optical frame in the world: z along the optical axis, x to the right, y down.
    quat: Annotated[Quat, Within(-1.01, 1.01), UNIT_LENGTH]

    @property
    def matrix(self) -> tuple[Vec3, Vec3, Vec3]:
        """Return the camera matrix, row by row [px]."""
        return (self.fx, 0.0, self.cx), (0.0, self.fy, self.cy), (0.0, 0.0, 1.0)


def quat_multiply(a: Quat, b: Quat) -> Quat:
    """Return the product of two rotations: first `b`, then `a`."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


FORWARD_TO_OPTICAL: Quat = (0.5, -0.5, 0.5, -0.5)
"""Orientation of the optical frame (z forward, x right, y down) in a frame with x forward, z up."""

RGB_CAMERA = CameraSpec(
    width=640,
    height=480,
    fx=618.163,
    fy=618.468,
    cx=328.451,
    cy=246.513,
    pos=(-0.39, 0.01, 2.2),
    quat=quat_multiply((0.96814764, 0.0, 0.25038000, 0.0), FORWARD_TO_OPTICAL),
)
"""The RGB camera behind and above the robot. Source: release (there with x forward and z up)."""

PEOPLE_CAMERA = replace(
    RGB_CAMERA,
    fx=417.03,
    fy=417.03,
    cx=320.0,
    cy=240.0,
    pos=(-0.8, 0.0, 1.6),
    quat=quat_multiply((0.99897391, 0.0, 0.04528951, 0.0), FORWARD_TO_OPTICAL),
)
"""A camera that sees throws of people from 4 m and the hand: 75° wide, 5.2° down. Source: ours, computed."""

CAMERAS: dict[str, CameraSpec] = dict(zip(CAMERA_NAMES, (RGB_CAMERA, PEOPLE_CAMERA), strict=True))
"""Cameras that a name stands for, in place of a file."""
