"""What every page shows of a throw: the scene, the camera's image, the curves, and how fast time goes."""

import time

import numpy as np
import viser

from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.viewer.images import CameraImages, Picture
from pixel2catch.viewer.playback import Playback
from pixel2catch.viewer.plots import ThrowPlots
from pixel2catch.viewer.scene import SceneView
from pixel2catch.viewer.throws import FlightPath, Frame, PlayedThrow
from pixel2catch.workcells import find_workcell

PLOT_PERIOD = 0.25  #: Least time between two changes of the plots [s]. Source: ours, light in the browser.
RATE_PERIOD = 1.0  #: Time over which pictures are counted [s].
SPEEDS = {"real time": 1.0, "half": 0.5, "a quarter": 0.25, "a tenth": 0.1}  #: How fast time can go.


class Stage:
    """Shows throws as they happen, or again; one thread calls `begin`, `show` and `end`."""

    def __init__(self, server: viser.ViserServer, scene: SceneCfg, playback: Playback) -> None:
        """Build the page of a scene; what is special to a page goes into `controls`."""
        self._server, self._playback = server, playback
        gui = server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(380)
        self.text = gui.add_markdown("")
        self.speed = add_time_controls(gui, playback)  #: How fast time goes, by a name of `SPEEDS`.
        self.rate_text = gui.add_markdown("")
        self.picture = Picture(gui, scene.camera)  #: The camera's image, with the box of the policy.
        self.controls = gui.add_folder("Throws")  #: Where a page adds what is its own.
        panel = gui.add_panel()
        self._plots_tab = panel.add_tab("Plots")
        panel.dock_left()
        panel.set_width(330)
        self._frames: list[Frame] = []
        self._path: FlightPath = np.zeros((1, 3))
        self._flight_time = 0.0
        self._plotted, self._counted = 0.0, (time.monotonic(), 0)
        self.is_playing = False  #: Whether a throw is being shown.
        self.num_pictures = 0  #: Pictures so far.
        self._open(scene)

    def set_scene(self, scene: SceneCfg) -> None:
        """Show another scene, if it is another one."""
        if scene == self._scene:
            return
        self._images.close()
        self._plots.remove()
        self.view.remove()
        self._open(scene)

    def tell(self, text: str) -> None:
        """Say what happens, in Markdown."""
        self.text.content = text

    def begin(self, path: FlightPath, flight_time: float) -> None:
        """Begin to show a throw that should fly along a path."""
        self._frames, self._path, self._flight_time = [], path, flight_time
        self.view.show_path(path)

    def show(self, frame: Frame) -> bool:
        """Show the next control step of a throw when its time has come; return whether to go on."""
        before = self._frames[-1].exposure if self._frames else None
        self._frames.append(frame)
        self._images.show(frame)
        count = 1 if before is None or self._playback.is_paused else max(1, round(1 / self._playback.speed))
        for i in range(count):
            with self._server.atomic():
                self.view.show(frame.exposure, before, (i + 1) / count)
            self._count()
            self.is_playing = True
            if not self._playback.wait(CONTROL_DT / count):
                self.is_playing = False
                return False
        if self._playback.is_paused or time.monotonic() > self._plotted + PLOT_PERIOD:
            self._plot()
        return True

    def end(self) -> None:
        """Show all of the curves of a throw that is over."""
        self.is_playing = False
        self._plot()

    def replay(self, played: PlayedThrow) -> None:
        """Show a throw again."""
        self.begin(played.path, played.flight_time)
        self.tell(f"again: throw {played.number}: {played.object_name} **{played.outcome}**")
        for frame in played.frames:
            if not self.show(frame):
                return
        self.end()

    def close(self) -> None:
        """End the drawing."""
        self._images.close()

    def _open(self, scene: SceneCfg) -> None:
        self._scene = scene
        self.view = SceneView(self._server, scene)  #: The scene.
        self._images = CameraImages(self.picture, scene)
        with self._plots_tab:
            self._plots = ThrowPlots(self._server.gui, find_workcell(scene.workcell))

    def _plot(self) -> None:
        self._plots.show(self._frames, self._path, self._flight_time)
        self._plotted = time.monotonic()

    def _count(self) -> None:
        self.num_pictures += 1
        (before, num_before), now = self._counted, time.monotonic()
        if now > before + RATE_PERIOD:
            rate = (self.num_pictures - num_before) / (now - before)
            self.rate_text.content = f"{rate:.0f} pictures/s"
            self._counted = now, self.num_pictures


def add_time_controls(gui: viser.GuiApi, playback: Playback) -> viser.GuiDropdownHandle[str]:
    """Add what makes time stand still, go on, go slower or step by step."""
    buttons = gui.add_button_group("time", ("pause", "go on", "one step"))

    def clicked(_: object) -> None:
        if buttons.value == "one step":
            playback.step()
        else:
            playback.pause(buttons.value == "pause")

    buttons.on_click(clicked)
    speed = gui.add_dropdown("speed", list(SPEEDS), initial_value="real time")
    speed.on_update(lambda _: playback.set_speed(SPEEDS[speed.value]))
    return speed
