"""A web page that shows the twin, what the deployment sees and does, and has buttons to throw. Needs viser.

It only listens and asks on the network, as any other node; its process takes nothing from the twin's. One
button does all that an operator does for a throw; the others do it step by step.
"""

import json
import time
from collections import deque
from dataclasses import replace
from threading import Thread
from typing import Any, NoReturn

import mujoco
import numpy as np
import torch
import viser

from pixel2catch.camera.boxes import PIXEL_FEATURES, pixel_features
from pixel2catch.deployment.operator import newest
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock, RealClock, Transport, make_transport
from pixel2catch.scene import shapes
from pixel2catch.scene.objects import OBJECTS
from pixel2catch.scene.scene import OBJECT_RGBA, SceneCfg, build_model
from pixel2catch.scene.shapes import ConvexPart
from pixel2catch.twin.lab_node import COMMAND, STATE
from pixel2catch.twin.realtime import LAST, obey_parent
from pixel2catch.twin.rehearsal import RehearsalOperator, run_trial
from pixel2catch.workcells import find_workcell

HOST = "127.0.0.1"  #: The page is for this machine only; others come by a tunnel.
PERIOD = 1 / 15  #: Real time between two changes of the page [s]. Source: ours, light on a shared machine.
BOX_COLOR, LINE = (40, 220, 70), 2  #: Colour and width [px] of the box that the deployment sees.
REQUESTS = ("prepare", "throw", "protective_stop", "resume")  #: What the twin is asked for by buttons.

MAKERS = {
    mujoco.mjtGeom.mjGEOM_BOX: lambda x, y, z: shapes.box(2 * x, 2 * y, 2 * z),
    mujoco.mjtGeom.mjGEOM_CAPSULE: lambda x, y, _: shapes.capsule(x, 2 * y),
    mujoco.mjtGeom.mjGEOM_CYLINDER: lambda x, y, _: shapes.cylinder(x, 2 * y),
}
"""Shapes of the scene's geoms by their sizes."""


class Page:
    """The page; `update` makes it current."""

    def __init__(
        self, port: int, scene: SceneCfg, profile: Profile, transport: Transport, clock: Clock
    ) -> None:
        """Serve the page of a scene, by the clock of twin and deployment."""
        self._operator = RehearsalOperator(transport, profile.operator, clock)
        self.console = self._operator.console  #: One for the page and its throws: the servo heeds no second.
        self.trial: Thread | None = None  #: The throw that goes on by itself, or did.
        joints = find_workcell(scene.workcell).joints
        self._parts, self._joint_pos = profile.robots, np.array([joint.home for joint in joints])
        self._camera = scene.camera
        self._model = build_model(replace(scene, visuals=True))
        self._data = mujoco.MjData(self._model)
        self._joints = transport.subscription(profile.robots[0].state_topic, depth=20)
        self._images = transport.subscription(profile.camera.image)
        self._states = transport.subscription(STATE)
        self._commands = transport.publisher(COMMAND)
        self._wishes: deque[dict[str, Any]] = deque()
        self._state: dict[str, Any] = {}
        self._boxes: deque[list[float]] = deque(maxlen=2)
        self._server = viser.ViserServer(HOST, port, label="Pixel2Catch twin", verbose=False)
        self._build_scene()
        self._build_panel()

    @property
    def address(self) -> str:
        """Where it is served."""
        return f"http://{HOST}:{self._server.get_port()}"

    def update(self) -> None:
        """Show what has arrived, and send what was clicked."""
        while self._wishes:
            self._commands.publish(messages.text(json.dumps(self._wishes.popleft())))
        self._state = newest(self._states, self._state)
        if not self._is_in_trial:
            self._operator.watch()
        for message in self._joints.take():
            reading = messages.read_joint_state(message.data)
            for part in self._parts:
                part.merge(reading, self._joint_pos)
        with self._server.atomic():
            self._move()
            self._tell()

    def ask(self, name: str) -> None:
        """Ask the twin for one of `REQUESTS`, with the next update; any thread may call this."""
        wish: dict[str, Any] = {"do": name}
        if name == "prepare":
            wish["seed"] = self._next_seed()
        self._wishes.append(wish)

    def catch(self) -> None:
        """Do all that an operator does for a throw, beside the page; nothing while that goes on."""
        if not self._is_in_trial:
            self.trial = Thread(target=run_trial, args=(self._operator, self._next_seed()), daemon=True)
            self.trial.start()

    @property
    def _is_in_trial(self) -> bool:
        return self.trial is not None and self.trial.is_alive()

    def point(self) -> None:
        """Point at the object, if the camera sees it."""
        if box := self._state.get("box"):
            self.console.point(box)

    def hold(self, is_held: bool) -> None:
        """Hold the dead-man's switch, or let it go."""
        self.console.holds = is_held

    def _next_seed(self) -> int:
        seed = int(self.seed.value)
        self.seed.value += 1
        return seed

    def close(self) -> None:
        """End the page."""
        self._server.stop()

    def _build_scene(self) -> None:
        """Every body as a frame with its geoms; every object, though only one is shown."""
        scene, model = self._server.scene, self._model
        scene.add_grid("/floor", 8.0, 8.0)
        self.bodies: dict[str, viser.FrameHandle] = {}  #: What is shown of every body, by its name.
        for geom in range(model.ngeom):
            body = int(model.geom_bodyid[geom])
            maker = MAKERS.get(mujoco.mjtGeom(model.geom_type[geom]))
            if maker is None:  # the floor, and the object
                continue
            name = model.body(body).name
            if name not in self.bodies:
                self.bodies[name] = scene.add_frame(f"/{name}", show_axes=False)
            pose = {"position": model.geom_pos[geom], "wxyz": model.geom_quat[geom]}
            self._add_mesh(f"/{name}/{geom}", maker(*model.geom_size[geom]), model.geom_rgba[geom], **pose)
        self.thrown = scene.add_frame("/object", show_axes=False, visible=False)
        self._looks = {name: scene.add_frame(f"/object/{name}", show_axes=False) for name in OBJECTS}
        for name, spec in OBJECTS.items():
            for i, part in enumerate(spec.parts):
                self._add_mesh(f"/object/{name}/{i}", part, np.array(OBJECT_RGBA))

    def _add_mesh(self, name: str, part: ConvexPart, rgba: np.ndarray, **pose: Any) -> None:
        corners = part.faces.reshape(-1, 3)
        triangles = np.arange(len(corners)).reshape(-1, 3)
        color = np.rint(255 * rgba[:3]).astype(np.uint8)
        self._server.scene.add_mesh_simple(name, corners, triangles, color=color, side="double", **pose)

    def _build_panel(self) -> None:
        """The camera's image, the states, the buttons."""
        gui = self._server.gui
        self.picture = gui.add_image(np.zeros((self._camera.height, self._camera.width, 3), np.uint8))
        self.text = gui.add_markdown("")
        self.seed = gui.add_number("seed of the next throw", 0, min=0, step=1)
        gui.add_button("throw and catch").on_click(lambda _: self.catch())
        with gui.add_folder("step by step", expand_by_default=False):
            switch = gui.add_checkbox("hold the dead-man's switch", False)
            switch.on_update(lambda _: self.hold(switch.value))
            for name in REQUESTS:
                gui.add_button(name.replace("_", " ")).on_click(lambda _, name=name: self.ask(name))
            gui.add_button("arm").on_click(lambda _: self.console.arm())
            gui.add_button("point at the object").on_click(lambda _: self.point())
            gui.add_button("stop").on_click(lambda _: self.console.stop())

    def _move(self) -> None:
        """Move robot and object to where they are."""
        self._data.qpos[: len(self._joint_pos)] = self._joint_pos
        mujoco.mj_kinematics(self._model, self._data)
        for name, frame in self.bodies.items():
            body = self._data.body(name)
            frame.position, frame.wxyz = body.xpos.copy(), body.xquat.copy()
        pose, thrown = self._state.get("object_pose"), self._state.get("object")
        self.thrown.visible = thrown is not None
        if pose and thrown:
            self.thrown.position, self.thrown.wxyz = np.array(pose[:3]), np.array(pose[3:])
            for name, look in self._looks.items():
                look.visible = name == thrown

    def _tell(self) -> None:
        """Show the newest image with the box, and all states."""
        status = self.console.status
        box = status.get("box")
        if box:
            self._boxes.append(box)
        for message in self._images.take():
            self.picture.image = with_box(messages.read_image(message.data).pixels, box)
        rows = {**self._features(), **{f"deploy: {name}": value for name, value in status.items()}}
        rows |= {f"twin: {name}": value for name, value in self._state.items() if name != "object_pose"}
        table = "\n".join(f"| {name} | {value} |" for name, value in rows.items())
        self.text.content = f"| | |\n|---|---|\n{table}"

    def _features(self) -> dict[str, str]:
        """What a policy reads of the boxes that the deployment sees."""
        if len(self._boxes) < 2:
            return {}
        before, now = (torch.tensor([box], dtype=torch.float32) for box in self._boxes)
        values = pixel_features(before, now, self._camera)[0].tolist()
        return {name: f"{value:.2f}" for name, value in zip(PIXEL_FEATURES, values, strict=True)}


def with_box(pixels: np.ndarray, box: list[float] | None) -> np.ndarray:
    """A copy of an image with the outline of a box [px]; as it is without one."""
    if not box:
        return pixels
    marked = pixels.copy()
    xmin, ymin, xmax, ymax = (max(round(edge), 0) for edge in box)
    inside = marked[ymin + LINE : ymax - LINE, xmin + LINE : xmax - LINE].copy()
    marked[ymin:ymax, xmin:xmax] = BOX_COLOR
    marked[ymin + LINE : ymax - LINE, xmin + LINE : xmax - LINE] = inside
    return marked


def serve_page(port: int, scene: SceneCfg, profile: Profile, rate: float) -> NoReturn:
    """Serve the page until this process is ended; if the port is taken, on one of the next."""
    obey_parent(LAST)
    torch.set_num_threads(1)
    clock = RealClock(rate)
    with make_transport("dds", "pixel2catch_page", loopback=True, clock=clock) as node:
        page = Page(port, scene, profile, node, clock)
        while True:
            page.update()
            time.sleep(PERIOD)
