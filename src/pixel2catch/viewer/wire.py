"""What is on the wire of a deployment, on a page: the robot, the camera's image, the states."""

from collections import deque
from contextlib import suppress
from typing import Any

import numpy as np
import torch
import viser

from pixel2catch.camera.boxes import PIXEL_FEATURES, pixel_features
from pixel2catch.errors import DeploymentError
from pixel2catch.rendering.camera import Exposure, Moment
from pixel2catch.rendering.room import Bystanders
from pixel2catch.rendering.video import draw_box
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock, Transport
from pixel2catch.scene.scene import OBJECT_START, SceneCfg
from pixel2catch.twin.simulated_lab import Phase
from pixel2catch.viewer.images import Picture
from pixel2catch.viewer.scene import SceneView
from pixel2catch.workcells import find_workcell


class WireView:
    """Shows what a node hears; `update` makes it current."""

    def __init__(
        self,
        server: viser.ViserServer,
        scene: SceneCfg,
        profile: Profile,
        transport: Transport,
        clock: Clock,
    ) -> None:
        """Add scene and image to the page; the states follow with `add_states`."""
        self._server, self._clock, self._camera = server, clock, scene.camera
        joints = find_workcell(scene.workcell).joints
        self._parts, self._joint_pos = profile.robots, np.array([joint.home for joint in joints])
        topics = dict.fromkeys(part.state_topic for part in profile.robots)
        self._joints = [transport.subscription(topic, depth=20) for topic in topics]
        self._images = transport.subscription(profile.camera.image)
        self._boxes: deque[list[float]] = deque(maxlen=2)
        self._held_pos, self._held_until = np.array(OBJECT_START), clock.now()
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(380)
        self.view = SceneView(server, scene)  #: The scene.
        #: The newest image, with the box that the deployment sees.
        self.picture = Picture(server.gui, self._camera)

    def add_states(self) -> None:
        """Add the table of states where the page is being built."""
        self.text = self._server.gui.add_markdown("")  #: The states.

    def update(self, status: dict[str, Any], state: dict[str, Any]) -> None:
        """Show what has arrived, by the newest status of the deployment and state of the twin."""
        for subscription in self._joints:
            for message in subscription.take():
                with suppress(DeploymentError):  # a message that cannot be read shows nothing
                    reading = messages.read_joint_state(message.data)
                    for part in self._parts:
                        part.merge(reading, self._joint_pos)
        with self._server.atomic():
            self._move(state)
            self._tell(status, state)

    def _move(self, state: dict[str, Any]) -> None:
        """Move robot, object and thrower to where they are."""
        self.view.show_bystanders(bool(state))  # of a real laboratory nobody knows where they are
        now, phase = self._clock.now(), state.get("phase")
        pose = np.array(state.get("object_pose") or (*self._held_pos, 1.0, 0.0, 0.0, 0.0))
        if phase == Phase.HELD or phase == Phase.EMPTY:
            self._held_pos, self._held_until = pose[:3], now
        qpos = np.concatenate((self._joint_pos, pose))
        moment = Moment(qpos=qpos, qvel=np.zeros(len(qpos) - 1), time=now - self._held_until)
        thrower = Bystanders(release_pos=self._held_pos, phase=0.0)
        shown = Exposure(moment=moment, object_name=state.get("object"), thrower=thrower.joint_pos)
        self.view.show(shown)

    def _tell(self, status: dict[str, Any], state: dict[str, Any]) -> None:
        """Show the newest image with the box, and all states."""
        box = status.get("box")
        if box:
            self._boxes.append(box)
        for message in self._images.take():
            with suppress(DeploymentError):
                pixels = messages.read_image(message.data).pixels.copy()
                if box:
                    draw_box(pixels, np.array(box, dtype=float))
                self.picture.show(pixels)
        rows = {**self._features(), **{f"deploy: {name}": value for name, value in status.items()}}
        rows |= {f"twin: {name}": value for name, value in state.items() if name != "object_pose"}
        table = "\n".join(f"| {name} | {_short(value)} |" for name, value in rows.items())
        self.text.content = f"| | |\n|---|---|\n{table}"

    def _features(self) -> dict[str, str]:
        """What a policy reads of the boxes that the deployment sees."""
        if len(self._boxes) < 2:
            return {}
        before, now = (torch.tensor([box], dtype=torch.float32) for box in self._boxes)
        values = pixel_features(before, now, self._camera)[0].tolist()
        return {name: f"{value:.2f}" for name, value in zip(PIXEL_FEATURES, values, strict=True)}


def _short(value: Any) -> str:
    """A state as people read it: numbers with three digits."""
    if isinstance(value, list):
        return ", ".join(map(_short, value))
    return f"{value:.3g}" if isinstance(value, float) else str(value)
