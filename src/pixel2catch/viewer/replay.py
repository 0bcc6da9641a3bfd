"""`pixel2catch replay --web`: a recorded deployment to look at: robot, images with the box, states."""

from pathlib import Path
from threading import Event

from pixel2catch.deployment.operator import newest
from pixel2catch.deployment.replay import BagPlayer
from pixel2catch.deployment.stepped import StepClock
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.viewer.config import PageCfg
from pixel2catch.viewer.playback import Playback
from pixel2catch.viewer.server import open_server
from pixel2catch.viewer.stage import add_time_controls
from pixel2catch.viewer.wire import WireView


class RecordingPage:
    """A page that plays a recording; `run` plays it until the page is closed."""

    def __init__(self, cfg: PageCfg, recording: Path, profile: Profile, camera: CameraSpec) -> None:
        """Serve the page.

        Raises:
            InvalidValueError: If this machine cannot listen on the page's address.
            PerceptionError: If the recording cannot be read.
        """
        self._recording, self._closed, self._wanted = recording, Event(), Event()
        self._clock = StepClock(lambda _: None)
        broker = Broker()
        laboratory, node = broker.node(self._clock), broker.node(self._clock)
        topics = {part.state_topic for part in profile.robots} | {profile.camera.image}
        self._node, self._topics = laboratory, topics | {profile.operator.status}
        with BagPlayer(recording, laboratory, self._topics):
            pass  # it can be read
        self.playback = Playback()  #: How time goes.
        self.server = open_server(cfg, "Pixel2Catch recording")
        server = self.server.viser
        self._statuses = node.subscription(profile.operator.status)
        scene = SceneCfg(workcell=profile.workcell, camera=camera)
        self.wire = WireView(server, scene, profile, node, self._clock)  #: What is shown.
        self.time_text = server.gui.add_markdown("")  #: How far it is.
        add_time_controls(server.gui, self.playback)
        server.gui.add_button("from the beginning").on_click(lambda _: self.begin())
        self.wire.add_states()
        self._wanted.set()

    def begin(self) -> None:
        """Play it from the beginning."""
        self.playback.interrupt()
        self._wanted.set()

    def run(self) -> None:
        """Play whenever that is asked for."""
        while True:
            self._wanted.wait()
            self._wanted.clear()
            if self._closed.is_set():
                return
            self.playback.begin()
            self._play()

    def close(self) -> None:
        """End `run`."""
        self._closed.set()
        self.begin()

    def free(self) -> None:
        """End the server."""
        self.server.close()

    def _play(self) -> None:
        status: dict[str, object] = {}
        with BagPlayer(self._recording, self._node, self._topics) as player:
            self._clock.time = player.start
            while not player.is_over and self.playback.wait(CONTROL_DT):
                self._clock.time += CONTROL_DT
                player.play(self._clock.time)
                status = newest(self._statuses, status)
                self.wire.update(status, {})
                self.time_text.content = f"**{self._clock.time - player.start:.1f} s**"
