"""The page of `pixel2catch replay --web`: robot, images and states of a recorded deployment."""

from contextlib import suppress
from pathlib import Path
from typing import Any, final

import numpy as np

from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.deployment.operator import newest
from pixel2catch.deployment.replay import BagPlayer
from pixel2catch.errors import DeploymentError
from pixel2catch.rendering.video import draw_box
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.servo.status_words import status_words
from pixel2catch.viewer.config import PageCfg
from pixel2catch.viewer.images import Picture
from pixel2catch.viewer.process import PlayingPage
from pixel2catch.viewer.server import open_server
from pixel2catch.viewer.stage import add_time_controls
from pixel2catch.viewer.wire import WireScene, status_rows


@final
class RecordingPage(PlayingPage):
    """A page that plays a recording; `run` plays until it is closed."""

    def __init__(self, cfg: PageCfg, recording: Path, profile: Profile, camera: CameraSpec) -> None:
        """Serve the page.

        Raises:
            InvalidValueError: This machine cannot listen on the page's address.
            PerceptionError: The recording cannot be read.
        """
        self._recording, self._clock = recording, StepClock(lambda _: None)
        broker = Broker()
        laboratory, node = broker.node(self._clock), broker.node(self._clock)
        topics = {part.state_topic for part in profile.robots} | {profile.camera.image}
        self._node, self._topics = laboratory, topics | {profile.operator.status}
        with BagPlayer(recording, laboratory, self._topics):
            pass  # the recording can be read
        super().__init__(open_server(cfg, "Pixel2Catch recording"))
        server = self.server.viser
        self._statuses = node.subscription(profile.operator.status)
        self._images = node.subscription(profile.camera.image)
        scene = SceneCfg(workcell=profile.workcell, camera=camera)
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(380)
        self.wire = WireScene(server, scene, profile, node, self._clock)  #: The robot.
        #: The newest image, with the box of the deployment.
        self.picture = Picture(server.gui, camera)
        self.words = server.gui.add_markdown("")  #: State of the deployment in words.
        self.time_text = server.gui.add_markdown("")  #: Time since the start.
        add_time_controls(server.gui, self.playback)
        server.gui.add_button("from the beginning").on_click(lambda _: self.begin())
        with server.gui.add_folder("Details", expand_by_default=False):
            self.table = server.gui.add_markdown("")  #: Other entries of the newest status.
        self._wanted.set()

    def _play(self) -> None:
        status: dict[str, Any] = {}
        with BagPlayer(self._recording, self._node, self._topics) as player:
            self._clock.time = player.start
            while not player.is_over and self.playback.wait(CONTROL_DT):
                self._clock.time += CONTROL_DT
                player.play(self._clock.time)
                status = newest(self._statuses.take(), status)
                self._show(status)
                self.time_text.content = f"**{self._clock.time - player.start:.1f} s**"

    def _show(self, status: dict[str, Any]) -> None:
        """Show new messages, and the newest status."""
        self.wire.update({})
        self.words.content = f"**{status_words(status).headline}** {status.get('message', '')}"
        rows = "\n".join(f"| {name} | {text} |" for name, text in status_rows(status))
        self.table.content = f"| | |\n|---|---|\n{rows}"
        for message in self._images.take():
            with suppress(DeploymentError):  # unreadable messages are skipped
                pixels = messages.read_image(message.data).pixels.copy()
                if box := status.get("box"):
                    draw_box(pixels, np.array(box, dtype=float))
                self.picture.show(pixels)
