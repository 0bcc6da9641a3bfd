"""A throw on a page: the scene, the camera's image, the curves, and the controls of time."""

import time
from collections.abc import Sequence
from threading import Condition

import numpy as np
import viser
from viser import uplot

from pixel2catch.camera.boxes import PIXEL_FEATURES
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.viewer.images import CameraImages, Picture
from pixel2catch.viewer.scene import SceneView
from pixel2catch.viewer.throws import PlayedThrow
from pixel2catch.workcells import find_workcell

PLOT_PERIOD = 0.25  #: Least time between two changes of the plots [s]. Source: ours, for slow browsers.
LEAST_WIDTH = 590  #: Least width of the scene beside both panels [px]: that of a page of 1300 px.
MOST_LATE = 0.1  #: Largest delay of pictures that is made up for [s]. Source: ours.
SPEEDS = {"real time": 1.0, "half": 0.5, "a quarter": 0.25, "a tenth": 0.1}  #: Speeds of time by name.

COLORS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#17becf")
SHOWN = (-0.7, 2.6)  #: Range of time of a plot [s].
PLOT_HEIGHT = 150  #: Height of a plot [px].
LEGEND_LINES = 6  #: Largest number of lines of a plot with a legend.


class Playback:
    """Paces the pictures of one thread; any thread may change the speed."""

    def __init__(self) -> None:
        """Begin in real time."""
        self._changed = Condition()
        self.speed = 1.0  #: Seconds on the page in a real second.
        self.is_paused = False  #: Whether time stands still.
        self._num_steps, self._is_interrupted, self._due = 0, False, 0.0

    def set_speed(self, speed: float) -> None:
        """Set the speed."""
        self._set(speed=speed)

    def pause(self, is_paused: bool) -> None:
        """Stop time, or continue."""
        self._set(is_paused=is_paused, _num_steps=0)

    def step(self) -> None:
        """Stop time after one more step."""
        self._set(is_paused=True, _num_steps=self._num_steps + 1)

    def interrupt(self) -> None:
        """End all waits until the next `begin`."""
        self._set(_is_interrupted=True)

    def begin(self) -> None:
        """Begin to play."""
        self._due = time.monotonic()
        self._set(_is_interrupted=False)

    def wait(self, duration: float) -> bool:
        """Wait until the next picture is due, this time after the last [s]; return whether to continue."""
        with self._changed:
            if not self.is_paused:
                self._due = max(self._due + duration / self.speed, time.monotonic() - MOST_LATE)
            while not self._is_interrupted:
                if self.is_paused:
                    self._due = time.monotonic()
                    if self._num_steps:
                        self._num_steps -= 1
                        break
                    self._changed.wait()
                elif (left := self._due - time.monotonic()) > 0:
                    self._changed.wait(left)
                else:
                    break
            return not self._is_interrupted

    def _set(self, **values: float) -> None:
        with self._changed:
            vars(self).update(values)
            self._changed.notify_all()


class Stage:
    """Shows throws while they happen, or again; one thread calls `show` and `end`."""

    def __init__(self, server: viser.ViserServer, scene: SceneCfg, playback: Playback) -> None:
        """Build the page of a scene; each page adds its own controls to `controls`."""
        self._server, self._playback = server, playback
        gui = server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(380)
        self.text = gui.add_markdown("")
        self._add_time_controls(gui)
        self.picture = Picture(gui, scene.camera)  #: The camera's image, with the box of the policy.
        self.controls = gui.add_folder("Throws")  #: Folder for the controls of a page.
        panel = gui.add_panel()
        self._plots_tab = panel.add_tab("Plots")
        panel.dock_left()
        panel.set_width(330)
        server.on_client_connect(lambda visitor: _fold(panel, visitor))
        self._plotted = 0.0
        self.is_playing = False  #: Whether a throw is being shown.
        self.num_pictures = 0  #: Number of pictures so far.
        self._open(scene)

    def set_scene(self, scene: SceneCfg) -> None:
        """Show a scene, if it differs from the present one."""
        if scene == self._scene:
            return
        self._images.close()
        self._plots.remove()
        self.view.remove()
        self._open(scene)

    def show(self, throw: PlayedThrow, number: int) -> bool:
        """Show a control step of a throw when it is due; return whether to continue."""
        frame, before = throw.frames[number], throw.frames[number - 1].exposure if number else None
        if before is None:
            self.view.show_path(throw.path)
            self.text.content = throw_text(throw)
        self._images.show(frame)
        count = 1 if before is None or self._playback.is_paused else max(1, round(1 / self._playback.speed))
        for i in range(count):
            with self._server.atomic():
                self.view.show(frame.exposure, before, (i + 1) / count)
            self.num_pictures += 1
            self.is_playing = True
            if not self._playback.wait(CONTROL_DT / count):
                self.is_playing = False
                return False
        if self._playback.is_paused or time.monotonic() > self._plotted + PLOT_PERIOD:
            self._plot(throw, number)
        return True

    def end(self, throw: PlayedThrow) -> None:
        """Show outcome and complete curves of a throw."""
        self.is_playing = False
        self.text.content = throw_text(throw)
        self._plot(throw, len(throw.frames) - 1)

    def replay(self, throw: PlayedThrow) -> None:
        """Show a throw again."""
        if all(self.show(throw, number) for number in range(len(throw.frames))):
            self.end(throw)

    def close(self) -> None:
        """End the thread that draws images."""
        self._images.close()

    def _add_time_controls(self, gui: viser.GuiApi) -> None:
        buttons = gui.add_button_group("time", ("pause", "go on", "one step"))

        def clicked(_: object) -> None:
            if buttons.value == "one step":
                self._playback.step()
            else:
                self._playback.pause(buttons.value == "pause")

        buttons.on_click(clicked)
        speed = gui.add_dropdown("speed", list(SPEEDS), initial_value="real time")
        speed.on_update(lambda _: self._playback.set_speed(SPEEDS[speed.value]))

    def _open(self, scene: SceneCfg) -> None:
        self._scene = scene
        self.view = SceneView(self._server, scene)  #: The scene.
        self._images = CameraImages(self.picture, scene)
        with self._plots_tab:
            self._plots = ThrowPlots(self._server.gui, find_workcell(scene.workcell))

    def _plot(self, throw: PlayedThrow, number: int) -> None:
        self._plots.show(throw, number)
        self._plotted = time.monotonic()


def throw_text(throw: PlayedThrow) -> str:
    """Return number, object and outcome of a throw, in Markdown."""
    outcome = f" **{throw.outcome}**" if throw.outcome else ""
    return f"throw {throw.number}: {throw.object_name}{outcome}"


def _fold(panel: viser.PanelHandle, visitor: viser.ClientHandle) -> None:
    """Expand a panel for a new browser, and minimize it once if the scene beside it is too narrow."""
    folded: list[bool] = []
    panel.expand()

    def check(camera: viser.CameraHandle) -> None:
        if not folded and camera.image_width < LEAST_WIDTH:
            folded.append(True)
            panel.minimize()

    visitor.camera.on_update(check)


class ThrowPlots:
    """The plots of a throw; `show` updates them."""

    def __init__(self, gui: viser.GuiApi, workcell: WorkcellSpec) -> None:
        """Add the plots at the present place of the page."""
        self._path = _add_plot(gui, "height of the object [m]", ("ballistic", "flown"))
        self._box = _add_plot(gui, "box [shares of the image]", PIXEL_FEATURES[:4])
        self._change = _add_plot(gui, "its change in a step [px]", PIXEL_FEATURES[4:])
        self._groups = [
            (
                workcell.columns(group.name),
                _add_plot(gui, f"{group.name}: joint targets [rad]", [joint.name for joint in group.joints]),
            )
            for group in workcell.groups
        ]

    def remove(self) -> None:
        """Remove the plots from the page."""
        for plot in (self._path, self._box, self._change, *(plot for _, plot in self._groups)):
            plot.remove()

    def show(self, throw: PlayedThrow, number: int) -> None:
        """Draw the curves of a throw up to a control step."""
        frames, path = throw.frames[: number + 1], throw.path
        time = np.array([frame.time for frame in frames])
        flown = np.array([frame.object_pos[2] for frame in frames])
        until = np.linspace(0.0, throw.flight_time, len(path))
        ballistic = np.interp(time, until, path[:, 2], right=np.nan)
        features = np.stack([frame.pixel_features for frame in frames], axis=1)
        targets = np.stack([frame.joint_pos_target for frame in frames], axis=1)
        drawn = [(self._path, (ballistic, flown)), (self._box, features[:4]), (self._change, features[4:])]
        drawn += [(plot, targets[columns]) for columns, plot in self._groups]
        for plot, curves in drawn:
            plot.data = tuple(np.ascontiguousarray(each, dtype=np.float64) for each in (time, *curves))


def _add_plot(gui: viser.GuiApi, title: str, names: Sequence[str]) -> viser.GuiUplotHandle:
    """Add an empty plot of named lines over time [s]."""
    series = [uplot.Series(label="s")]
    series += [
        uplot.Series(label=name, stroke=COLORS[i % len(COLORS)], width=1.5) for i, name in enumerate(names)
    ]
    has_legend = len(names) <= LEGEND_LINES
    return gui.add_uplot(
        data=tuple(np.zeros(1) for _ in series),
        series=tuple(series),
        title=title,
        height=PLOT_HEIGHT + 25 * has_legend,
        legend=uplot.Legend(show=has_legend, live=False),
        scales={"x": uplot.Scale(time=False, auto=False, range=SHOWN)},
    )
