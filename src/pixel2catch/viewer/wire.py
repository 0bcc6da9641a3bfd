"""Messages of a deployment on a page: the robot as a scene, and the rows of a status."""

from contextlib import suppress
from typing import Any, final

import numpy as np
import viser

from pixel2catch.errors import DeploymentError
from pixel2catch.rendering.camera import Exposure, Moment
from pixel2catch.rendering.room import Bystanders
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock, Transport
from pixel2catch.scene.scene import OBJECT_START, SceneCfg
from pixel2catch.servo.status_words import fault_words, verdict_words
from pixel2catch.twin.simulated_lab import Phase
from pixel2catch.viewer.scene import SceneView
from pixel2catch.workcells import find_workcell


@final
class WireScene:
    """Shows the robot by its joint states, and object and thrower of a twin; `update` refreshes it."""

    def __init__(
        self,
        server: viser.ViserServer,
        scene: SceneCfg,
        profile: Profile,
        transport: Transport,
        clock: Clock,
    ) -> None:
        """Add the scene to viser's page."""
        self._server, self._clock = server, clock
        joints = find_workcell(scene.workcell).joints
        self._parts, self._joint_pos = profile.robots, np.array([joint.home for joint in joints])
        topics = dict.fromkeys(part.state_topic for part in profile.robots)
        self._joints = [transport.subscription(topic, depth=20) for topic in topics]
        self._held_pos, self._held_until = np.array(OBJECT_START), clock.now()
        self.view = SceneView(server, scene)  #: The scene.

    def update(self, state: dict[str, Any]) -> None:
        """Move everything by new messages, and by the newest state of the twin, if any."""
        for subscription in self._joints:
            for message in subscription.take():
                with suppress(DeploymentError):  # unreadable messages are skipped
                    reading = messages.read_joint_state(message.data)
                    for part in self._parts:
                        part.merge(reading, self._joint_pos)
        with self._server.atomic():
            self._move(state)

    def _move(self, state: dict[str, Any]) -> None:
        self.view.show_bystanders(bool(state))  # their pose in a real laboratory is unknown
        now, phase = self._clock.now(), state.get("phase")
        pose = np.array(state.get("object_pose") or (*self._held_pos, 1.0, 0.0, 0.0, 0.0))
        if phase == Phase.HELD or phase == Phase.EMPTY:
            self._held_pos, self._held_until = pose[:3], now
        qpos = np.concatenate((self._joint_pos, pose))
        moment = Moment(qpos=qpos, qvel=np.zeros(len(qpos) - 1), time=now - self._held_until)
        thrower = Bystanders(release_pos=self._held_pos, phase=0.0)
        shown = Exposure(moment=moment, object_name=state.get("object"), thrower=thrower.joint_pos)
        self.view.show(shown)


def status_rows(status: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the entries of a status as rows of a name and a text."""
    return [
        ("servo", status.get("mode", "not heard of")),
        ("stopped by", _what(status.get("stopped_by"))),
        ("finds now", _what(status.get("found"))),
        ("commands held back by", listed(status.get("clamped"))),
        ("camera", verdict_words(status) or "no image yet"),
        ("box of the object [px]", listed([f"{edge:.0f}" for edge in status.get("box") or ()])),
        ("steps without a new image", str(status.get("num_missed", 0))),
    ]


def listed(values: Any) -> str:
    """Return the entries of a list in words; `nothing` if it is empty."""
    return ", ".join(map(str, values)) if isinstance(values, list) and values else "nothing"


def _what(names: Any) -> str:
    return listed([fault_words(str(name)).what for name in names or ()])
