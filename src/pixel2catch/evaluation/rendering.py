"""Pictures of the scene without a display: the camera's image, the object's mask, an outside view, videos.

OpenGL comes from EGL or OSMesa, whichever works on this machine (`find_gl_backend`). MuJoCo's environment
variable MUJOCO_GL is never set: with the library missing it makes `import mujoco` itself fail, even where
nothing is drawn.
"""

import copy
import importlib
import os
import subprocess
import sys
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import av
import mujoco
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pixel2catch.errors import DeviceUnavailableError, InvalidValueError
from pixel2catch.robot.constants import RGB_CAMERA

GL_BACKENDS = ("egl", "osmesa")
"""MuJoCo's back ends that need no display, in the order of preference: EGL also draws on a GPU."""

OBJECT_BODY = "object"

DRAWN_GROUPS = (0, 1, 2, 3)
"""Geom groups in a picture: table and floor, object, what is only seen, robot."""

_PROBE = """
import importlib, sys, mujoco
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(8, 8)
context.make_current()
drawing = mujoco.MjrContext(mujoco.MjSpec().compile(), mujoco.mjtFontScale.mjFONTSCALE_100.value)
drawing.free()
context.free()
"""


@dataclass(frozen=True, kw_only=True)
class View:
    """From where to draw.

    Args:
        camera: Name of a camera of the model, or None for a free camera, which the next four place.
        lookat: Point in the middle of the picture, world frame [m].
        distance: From the camera to that point [m].
        azimuth: Direction of sight about the vertical, 0 along +x, 90 along +y [degrees].
        elevation: Direction of sight above the horizontal [degrees].
        width: Of the picture [px], even.
        height: Of the picture [px], even.
    """

    camera: str | None = None
    lookat: tuple[float, float, float] = (0.0, 0.0, 0.0)
    distance: float = 1.0
    azimuth: float = 0.0
    elevation: float = 0.0
    width: int = RGB_CAMERA.width
    height: int = RGB_CAMERA.height


RGB_VIEW = View(camera="rgb")
"""What the robot's camera sees."""

OUTSIDE_VIEW = View(lookat=(1.3, 0.0, 1.05), distance=3.6, azimuth=105.0, elevation=-12.0)
"""Robot, table and the whole throw, from the side."""


@cache
def find_gl_backend() -> str:
    """Return the first back end of `GL_BACKENDS` that draws, tried in a process of its own.

    A back end named by MUJOCO_GL or PYOPENGL_PLATFORM is tried first; the latter excludes the other, because
    PyOpenGL binds one platform per process.

    Raises:
        DeviceUnavailableError: If none works; the message names the Debian packages to install.
    """
    bound = os.environ.get("PYOPENGL_PLATFORM", "").lower()
    wished = bound or os.environ.get("MUJOCO_GL", "").lower()
    candidates = sorted(GL_BACKENDS, key=lambda name: name != wished)
    for name in candidates[:1] if bound in GL_BACKENDS else candidates:
        if _draws(name):
            return name
    raise DeviceUnavailableError(
        "no OpenGL without a display: neither EGL nor OSMesa works here. Install one, on Debian: "
        "'apt-get install libegl1 libgl1' (EGL) or 'apt-get install libosmesa6' (OSMesa)."
    )


def _draws(backend: str) -> bool:
    """Return whether a process of its own can open a drawing context with this back end."""
    environment = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    command = [sys.executable, "-c", _PROBE, backend]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, timeout=60, check=False)
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


class Renderer:
    """Draws one model from one view; close it, or use it as a context manager.

    Fast settings: no multisampling, a shadow map of 1024 pixels, and shadows only where asked for.

    Args:
        model: The model; it is copied, its drawing settings are not touched.
        view: From where to draw.
        shadows: Whether to draw shadows, about three times slower without a GPU.
        sky: Whether to draw the sky; without it a pixel that shows nothing is black.

    Attributes:
        model: The copy, which is drawn; what its geoms are may be changed between two pictures.

    Raises:
        DeviceUnavailableError: If no OpenGL back end works.
    """

    def __init__(
        self, model: mujoco.MjModel, view: View = RGB_VIEW, *, shadows: bool = True, sky: bool = True
    ) -> None:
        """Open the drawing context."""
        gl_module = importlib.import_module(f"mujoco.{find_gl_backend()}")
        self.model = copy.copy(model)
        self.model.vis.quality.offsamples = 0
        self.model.vis.quality.shadowsize = 1024
        self.model.vis.global_.offwidth = view.width
        self.model.vis.global_.offheight = view.height
        self._data = mujoco.MjData(self.model)
        self._camera = _camera(self.model, view)
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = [group in DRAWN_GROUPS for group in range(mujoco.mjNGROUP)]
        self._option.sitegroup[:] = 0
        self._scene = mujoco.MjvScene(self.model, maxgeom=1000)
        self._flags = {
            mujoco.mjtRndFlag.mjRND_SHADOW: shadows,
            mujoco.mjtRndFlag.mjRND_SKYBOX: sky,
            mujoco.mjtRndFlag.mjRND_REFLECTION: False,
        }
        self._rect = mujoco.MjrRect(0, 0, view.width, view.height)
        self._gl: Any = gl_module.GLContext(view.width, view.height)
        self._gl.make_current()
        self._drawing: Any = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._drawing)

    def image(self, qpos: Float[np.ndarray, " nq"]) -> UInt8[np.ndarray, "height width 3"]:
        """Return the picture of the model at these joint positions, red, green, blue, upper row first."""
        return self._draw(qpos, self._flags)

    def object_mask(self, qpos: Float[np.ndarray, " nq"]) -> Bool[np.ndarray, "height width"]:
        """Return which pixels show the body `object` at these joint positions, upper row first."""
        flags = {mujoco.mjtRndFlag.mjRND_SEGMENT: True, mujoco.mjtRndFlag.mjRND_IDCOLOR: True}
        colors = self._draw(qpos, flags)
        owner = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY.value, OBJECT_BODY)
        mask = np.zeros(colors.shape[:2], dtype=bool)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            is_geom = geom.objtype == mujoco.mjtObj.mjOBJ_GEOM.value
            if is_geom and geom.segid >= 0 and self.model.geom_bodyid[geom.objid] == owner:
                low, high = (geom.segid + 1) % 256, (geom.segid + 1) // 256
                mask |= (colors[..., 0] == low) & (colors[..., 1] == high)
        return mask

    def close(self) -> None:
        """Free the drawing context; the renderer cannot draw any more."""
        if self._drawing is not None:
            self._gl.make_current()
            self._drawing.free()
            self._gl.free()
        self._drawing = self._gl = None

    def __enter__(self) -> "Renderer":
        """Return the renderer itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the renderer."""
        self.close()

    def _draw(self, qpos: np.ndarray, flags: dict[mujoco.mjtRndFlag, bool]) -> np.ndarray:
        """Draw with these flags on top of MuJoCo's own."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)
        mujoco.mj_camlight(self.model, self._data)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self.model, self._data, self._option, None, self._camera, everything, self._scene
        )
        before = self._scene.flags.copy()
        for flag, value in flags.items():
            self._scene.flags[flag.value] = value
        self._gl.make_current()
        mujoco.mjr_render(self._rect, self._scene, self._drawing)
        pixels = np.empty((self._rect.height, self._rect.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._drawing)
        self._scene.flags[:] = before
        return np.ascontiguousarray(pixels[::-1])


def _camera(model: mujoco.MjModel, view: View) -> mujoco.MjvCamera:
    """Return MuJoCo's camera of a view."""
    camera = mujoco.MjvCamera()
    if view.camera is None:
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE.value
        camera.lookat[:] = view.lookat
        camera.distance, camera.azimuth, camera.elevation = view.distance, view.azimuth, view.elevation
        return camera
    camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
    camera.fixedcamid = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA.value, view.camera)
    if camera.fixedcamid < 0:
        names = [model.camera(i).name for i in range(model.ncam)]
        raise InvalidValueError(f"the model has no camera '{view.camera}'. Valid: {', '.join(names)}.")
    return camera


class VideoWriter:
    """Writes pictures of one size to an H.264 file; close it, or use it as a context manager.

    Args:
        path: The file; its ending names the container, such as .mp4.
        fps: Pictures per second.
        crf: Constant rate factor, lower is better and larger.
    """

    def __init__(self, path: Path, *, fps: int = 30, crf: int = 23) -> None:
        """Open the file.

        Raises:
            InvalidValueError: If the folder does not exist, or the ending names no format.
        """
        if not path.parent.is_dir():
            raise InvalidValueError(f"cannot write '{path}': there is no folder '{path.parent}'.")
        try:
            self._container = av.open(str(path), "w")
        except ValueError as error:
            raise InvalidValueError(f"cannot write '{path}': {error}; end its name in .mp4.") from error
        options = {"crf": str(crf)}
        self._stream: Any = self._container.add_stream("libx264", rate=Fraction(fps), options=options)
        self._stream.pix_fmt = "yuv420p"
        self._is_sized = False

    def write(self, image: UInt8[np.ndarray, "height width 3"]) -> None:
        """Append one picture (red, green, blue).

        Raises:
            InvalidValueError: If height or width is odd, which the format cannot store.
        """
        height, width = image.shape[:2]
        if height % 2 or width % 2:
            raise InvalidValueError(f"video pictures need an even width and height, got {width} x {height}.")
        if not self._is_sized:
            self._stream.width, self._stream.height = width, height
            self._is_sized = True
        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))

    def close(self) -> None:
        """Write what is left and close the file."""
        if self._is_sized:
            self._container.mux(self._stream.encode())
        self._container.close()

    def __enter__(self) -> "VideoWriter":
        """Return the writer itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the file."""
        self.close()
