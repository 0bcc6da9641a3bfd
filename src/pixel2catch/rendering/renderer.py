"""Pictures of the scene without a display: the camera's image, the object's mask, an outside view.

OpenGL comes from EGL or OSMesa (`find_gl_backend`). The command line takes MUJOCO_GL out of the environment
(`GL_VARIABLE`): if the library is missing, it makes `import mujoco` fail even where nothing is drawn.
"""

import copy
import importlib
import os
import subprocess
import sys
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Integer
from mujoco.rendering.classic import gl_context

from pixel2catch.checks import typed
from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.installation import GL_VARIABLE
from pixel2catch.robots.workcell import COLLISION_GROUP, VISUAL_GROUP
from pixel2catch.scene.constants import RGB_CAMERA

GL_BACKENDS = ("egl", "osmesa")  #: MuJoCo's without a display, preferred first: EGL also draws on a GPU.

EGL_DEVICE = "MUJOCO_EGL_DEVICE_ID"  #: MuJoCo's variable with the number of the device that EGL draws on.

DRAWN_GROUPS = (0, 1, 2, 3)  #: Table and floor, object, visual geoms, collision geoms of bodies without.
UNDRAWN_GROUP = max(DRAWN_GROUPS) + 1

_PROBE = """
import importlib, sys, mujoco
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(8, 8)
context.make_current()
drawing = mujoco.MjrContext(mujoco.MjSpec().compile(), mujoco.mjtFontScale.mjFONTSCALE_100.value)
drawing.free()
context.free()
"""


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """Point and direction of a view, and the size of its picture."""

    camera: str | None = None  #: A camera of the model, or None for a free one with the next four fields.
    lookat: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: In the middle of the picture, world frame [m].
    distance: float = 1.0  #: From the camera to that point [m].
    azimuth: float = 0.0  #: Direction of sight about the vertical, 0 along +x, 90 along +y [degrees].
    elevation: float = 0.0  #: Direction of sight above the horizontal [degrees].
    width: int = RGB_CAMERA.width  #: Of the picture [px], even.
    height: int = RGB_CAMERA.height  #: Of the picture [px], even.


RGB_VIEW = Viewpoint(camera="rgb")  #: View of the robot's camera.

PATH_RGBA = (1.0, 0.62, 0.1)  #: Colour of a path in the scene.
PATH_RADII = (0.004, 0.011)  #: Radius of the path at its start and its end [m].


@cache
def find_gl_backend() -> str:
    """Return the first of `GL_BACKENDS` that draws, each tried in a process of its own.

    A back end in MUJOCO_GL or PYOPENGL_PLATFORM is tried first. The latter excludes the other, because
    PyOpenGL has one platform per process. Raises DeviceUnavailableError, with Debian packages, if none draws.
    """
    bound = os.environ.get("PYOPENGL_PLATFORM", "").lower()
    preferred = bound or os.environ.get(GL_VARIABLE, os.environ.get("MUJOCO_GL", "")).lower()
    for name in sorted(GL_BACKENDS, key=lambda name: name != preferred):
        if bound in ("", name) and _draws(name):
            return name
    for variable in (EGL_DEVICE, "PYOPENGL_PLATFORM"):
        value = os.environ.get(variable)
        if value and any(_draws(name, variable) for name in GL_BACKENDS):
            raise DeviceUnavailableError(
                f"{variable} is '{value}', with which OpenGL does not draw here; it draws without: unset it."
            )
    raise DeviceUnavailableError(
        "no OpenGL without a display: neither EGL nor OSMesa works here. Install one, on Debian: "
        "'apt-get install libegl1 libgl1' (EGL) or 'apt-get install libosmesa6' (OSMesa)."
    )


def _draws(backend: str, *unset: str) -> bool:
    unset = ("MUJOCO_GL", "PYOPENGL_PLATFORM", *unset)
    environment = {name: value for name, value in os.environ.items() if name not in unset}
    command = [sys.executable, "-c", _PROBE, backend]
    try:
        subprocess.run(command, env=environment, capture_output=True, timeout=60, check=True)
    except subprocess.SubprocessError:
        return False
    return True


class Renderer(AbstractContextManager["Renderer"]):
    """Draws one model from one view with `mujoco.Renderer`; close it, or use it as a context manager.

    Fast settings: no multisampling, a shadow map of 1024 pixels, and shadows only on request.
    """

    @typed
    def __init__(
        self, model: mujoco.MjModel, view: Viewpoint = RGB_VIEW, *, shadows: bool = True, sky: bool = True
    ) -> None:
        """Open the drawing context; without the sky, a pixel that shows nothing is black."""
        # `mujoco.Renderer` opens its context with this class, which MUJOCO_GL would choose.
        gl_context.GLContext = importlib.import_module(f"mujoco.{find_gl_backend()}").GLContext
        self.model = copy.copy(model)  #: What is drawn; its geoms may be changed between two pictures.
        self.model.vis.quality.offsamples = 0
        self.model.vis.quality.shadowsize = 1024
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = view.width, view.height
        seen = np.unique(self.model.geom_bodyid[self.model.geom_group == VISUAL_GROUP])
        is_covered = np.isin(self.model.geom_bodyid, seen) & (self.model.geom_group == COLLISION_GROUP)
        self.model.geom_group[is_covered] = UNDRAWN_GROUP
        self._data, self._view, self._option = mujoco.MjData(self.model), view, mujoco.MjvOption()
        self._option.geomgroup[:] = [group in DRAWN_GROUPS for group in range(mujoco.mjNGROUP)]
        self._option.sitegroup[:] = 0
        self._renderer = mujoco.Renderer(self.model, view.height, view.width, max_geom=1000)
        flags = self._renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = sky
        flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False

    def object_mask(self, qpos: Float[np.ndarray, " nq"]) -> Bool[np.ndarray, "height width"]:
        """Return which pixels show the body `object` at these joint positions, upper row first."""
        self._renderer.enable_segmentation_rendering()
        try:
            shown, kind = np.moveaxis(self.image(qpos), -1, 0)
        finally:
            self._renderer.disable_segmentation_rendering()
        geoms = np.flatnonzero(self.model.geom_bodyid == self.model.body("object").id)
        return (kind == mujoco.mjtObj.mjOBJ_GEOM.value) & np.isin(shown, geoms)

    def close(self) -> None:
        self._renderer.close()

    def __exit__(self, *exception: object) -> None:
        self.close()

    def image(
        self,
        qpos: Float[np.ndarray, " nq"],
        view: Viewpoint | None = None,
        path: Float[np.ndarray, "num_points 3"] | None = None,
    ) -> Integer[np.ndarray, "height width _"]:
        """Return the picture of the model at these joint positions, red, green, blue, upper row first.

        The view may be another one of the same size. A path [m] is drawn into the scene.
        """
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)
        mujoco.mj_camlight(self.model, self._data)
        self._renderer.update_scene(self._data, _camera(view or self._view), self._option)
        if path is not None:
            _add_path(self._renderer.scene, path)
        return self._renderer.render()


def _add_path(scene: mujoco.MjvScene, path: np.ndarray) -> None:
    """Add a line to the scene that becomes thicker and less transparent towards its end."""
    weights = np.linspace(0.0, 1.0, len(path))
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    for start, end, weight in zip(path[:-1], path[1:], weights[1:], strict=True):
        geom = scene.geoms[scene.ngeom]
        color = np.array((*PATH_RGBA, 0.25 + 0.55 * weight), dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), color)
        mujoco.mjv_connector(geom, kind, np.interp(weight, (0.0, 1.0), PATH_RADII), start, end)
        geom.category, geom.emission = mujoco.mjtCatBit.mjCAT_DECOR, 0.5
        scene.ngeom += 1


def _camera(view: Viewpoint) -> mujoco.MjvCamera | str:
    if view.camera is not None:
        return view.camera
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE.value
    camera.lookat[:] = view.lookat
    camera.distance, camera.azimuth, camera.elevation = view.distance, view.azimuth, view.elevation
    return camera
