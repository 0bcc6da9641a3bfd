"""The scene on a page: robot, table, thrower, and an object with its path."""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import viser
from jaxtyping import Float
from mujoco import mjtGeom

from pixel2catch.rendering.camera import Exposure, room_positions
from pixel2catch.rendering.room import FLOOR_LEVEL, WALL_LEVEL, Bystanders, build_room
from pixel2catch.scene import shapes
from pixel2catch.scene.objects import OBJECTS
from pixel2catch.scene.scene import OBJECT_RGBA, OBJECT_START, SceneCfg
from pixel2catch.scene.shapes import ConvexPart
from pixel2catch.workcells import find_workcell

MAKERS: dict[int, Callable[[float, float, float], ConvexPart]] = {
    mjtGeom.mjGEOM_BOX.value: lambda x, y, z: shapes.box(2 * x, 2 * y, 2 * z),
    mjtGeom.mjGEOM_CAPSULE.value: lambda x, y, _: shapes.capsule(x, 2 * y),
    mjtGeom.mjGEOM_CYLINDER.value: lambda x, y, _: shapes.cylinder(x, 2 * y),
}
"""Functions that make the shape of a geom from its sizes, by type."""

ROOM_SEED = 0  #: Seed of the looks of the room on pages.
PLANE_SIZE = 5.0  #: Half a side of an infinite plane [m].
PLANE_THICKNESS = 1e-3  #: [m]
PLANE_LEVELS = {"floor": FLOOR_LEVEL, "wall": WALL_LEVEL}  #: Colours of planes by material.
LEAST_MOVE = 1e-5  #: Least change of a position [m] or quaternion that is sent to the browser.
SKY_LEVEL = (226, 232, 238)  #: Colour of the background.
SUN = (1.6, -2.2, 3.4)  #: Position of the light that casts shadows [m]; it shines towards the origin.
VIEW_POS, VIEW_AT = (0.2, -4.6, 2.6), (1.5, 0.0, 0.9)  #: Initial position and target of the view [m].
ROOT = "/scene"  #: Root node of the scene.
PATH_COLOR, CAMERA_COLOR = (255, 150, 30), (40, 90, 200)

FlightPath = Float[np.ndarray, "num_points 3"]


class SceneView:
    """One scene on a page; `show` moves it."""

    def __init__(self, server: viser.ViserServer, scene: SceneCfg) -> None:
        self._nodes, self._model = server.scene, build_room(scene, next(iter(OBJECTS)), ROOM_SEED)
        self._data = mujoco.MjData(self._model)
        self._root = self._nodes.add_frame(ROOT, show_axes=False)
        self._light()
        server.initial_camera.position, server.initial_camera.look_at = VIEW_POS, VIEW_AT
        server.initial_camera.fov = np.radians(50.0)
        self.bodies: dict[str, viser.FrameHandle] = {}  #: Nodes of the bodies, by name.
        for geom in range(self._model.ngeom):
            self._add_geom(geom)
        #: Node of the object.
        self.thrown = self._nodes.add_frame(f"{ROOT}/object", show_axes=False, visible=False)
        self._looks = {
            name: self._nodes.add_frame(f"{ROOT}/object/{name}", show_axes=False) for name in OBJECTS
        }
        for name, spec in OBJECTS.items():
            for i, part in enumerate(spec.scaled(scene.object_scale).parts):
                self._add_part(
                    f"{ROOT}/object/{name}/{i}", part, OBJECT_RGBA[:3], is_smooth=name.startswith("ball")
                )
        home = [joint.home for joint in find_workcell(scene.workcell).joints]
        waiting = Bystanders(release_pos=np.array(OBJECT_START), phase=0.0).joint_pos(-1.0)
        self._place(np.concatenate((home, self._model.qpos0[len(home) : -len(waiting)], waiting)))
        camera = scene.camera
        self._nodes.add_camera_frustum(
            f"{ROOT}/camera",
            fov=2.0 * np.arctan(0.5 * camera.height / camera.fy),
            aspect=camera.width / camera.height,
            scale=0.12,
            color=CAMERA_COLOR,
            position=camera.pos,
            wxyz=camera.quat,
        )

    def show(self, exposure: Exposure, before: Exposure | None = None, share: float = 1.0) -> None:
        """Move everything to an exposure, or to a share of the way from an earlier exposure."""
        now = self._positions(exposure)
        if before is not None and share < 1.0:
            way, start = np.zeros(self._model.nv), self._positions(before)
            mujoco.mj_differentiatePos(self._model, way, 1.0, start, now)
            mujoco.mj_integratePos(self._model, start, way, share)
            now = start
        self._place(now)
        self.thrown.visible = exposure.object_name is not None
        if exposure.object_name is not None:
            body = self._data.body("object")
            _move(self.thrown, body.xpos, body.xquat)
            for name, look in self._looks.items():
                if look.visible != (name == exposure.object_name):
                    look.visible = name == exposure.object_name

    def remove(self) -> None:
        self._root.remove()

    def show_path(self, path: FlightPath) -> None:
        """Draw the path of the object as dashes; nothing if it has fewer than two points."""
        dashes = np.stack([path[:-1], 0.4 * path[:-1] + 0.6 * path[1:]], axis=1)
        self._nodes.add_line_segments(f"{ROOT}/path", points=dashes, colors=PATH_COLOR, thickness=0.012)

    def _place(self, qpos: np.ndarray) -> None:
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        for name, frame in self.bodies.items():
            body = self._data.body(name)
            _move(frame, body.xpos, body.xquat)

    def _positions(self, exposure: Exposure) -> np.ndarray:
        return room_positions(self._model, exposure.moment, 0.0, exposure.thrower)

    def _light(self) -> None:
        nodes = self._nodes
        nodes.configure_default_lights(enabled=False)
        nodes.configure_environment_map(None)
        nodes.set_background_image(np.full((1, 1, 3), SKY_LEVEL, np.uint8), format="png")
        nodes.add_light_hemisphere(
            f"{ROOT}/sky", sky_color=(255, 255, 255), ground_color=(150, 140, 130), intensity=2.0
        )
        nodes.add_light_directional(f"{ROOT}/sun", position=SUN, intensity=2.2, cast_shadow=True)

    def _add_geom(self, geom: int) -> None:
        """Add a geom to its body, unless it is the object's, which changes."""
        model = self._model
        body = model.body(int(model.geom_bodyid[geom])).name
        if body not in self.bodies and body != "object":
            self.bodies[body] = self._nodes.add_frame(f"{ROOT}/{body}", show_axes=False)
        name, kind, size = f"{ROOT}/{body}/{geom}", int(model.geom_type[geom]), model.geom_size[geom]
        pose = {"position": model.geom_pos[geom], "wxyz": model.geom_quat[geom]}
        if kind == mjtGeom.mjGEOM_PLANE:
            color = np.array(PLANE_LEVELS[model.mat(int(model.geom_matid[geom])).name], np.uint8)
            x, y = (2.0 * (half or PLANE_SIZE) for half in size[:2])
            self._nodes.add_box(name, color, (x, y, PLANE_THICKNESS), cast_shadow=False, **pose)
        elif kind in MAKERS:
            is_smooth = kind == mjtGeom.mjGEOM_CAPSULE
            self._add_part(name, MAKERS[kind](*size), model.geom_rgba[geom][:3], is_smooth=is_smooth, **pose)

    def _add_part(
        self,
        name: str,
        part: ConvexPart,
        rgb: tuple[float, ...] | np.ndarray,
        *,
        is_smooth: bool,
        **pose: Any,
    ) -> None:
        corners, faces = np.unique(part.faces.reshape(-1, 3), axis=0, return_inverse=True)
        faces, (red, green, blue) = faces.reshape(-1, 3), (round(255 * float(value)) for value in rgb)
        self._nodes.add_mesh_simple(
            name, corners, faces, color=(red, green, blue), flat_shading=not is_smooth, **pose
        )


def _move(frame: viser.FrameHandle, pos: np.ndarray, quat: np.ndarray) -> None:
    if np.abs(frame.position - pos).max() > LEAST_MOVE:
        frame.position = pos.copy()
    if np.abs(frame.wxyz - quat).max() > LEAST_MOVE:
        frame.wxyz = quat.copy()
