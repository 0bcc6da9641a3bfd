"""The page of `pixel2catch play --web`: throws to play with, in one process."""

import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import final

import torch
import viser

from pixel2catch.errors import Pixel2CatchError
from pixel2catch.evaluation.metrics import wilson_interval
from pixel2catch.evaluation.stress import select_settings
from pixel2catch.interruption import StopRequest
from pixel2catch.scene.objects import OBJECT_GROUPS, OBJECTS, select_objects
from pixel2catch.shipped import shipped_policies
from pixel2catch.viewer import PageCfg
from pixel2catch.viewer.server import open_server
from pixel2catch.viewer.stage import Playback, Stage
from pixel2catch.viewer.throws import PlayedThrow, ThrowOrder, ThrowPlayer

NUM_KEPT = 50  #: Number of throws that can be shown again.
BETWEEN_THROWS = 0.7  #: Time between two repeated throws [s].
GREEN, RED = (47, 158, 68), (224, 49, 49)  #: Colours of catches and misses.


@final
class PlayPage:
    """The page; `run` plays until it is closed."""

    def __init__(self, cfg: PageCfg, thrower: ThrowPlayer, first: ThrowOrder, seed: int = 0) -> None:
        """Serve the page; the first throw has the seed, the next throw the next seed."""
        self._thrower, self._seed = thrower, seed
        select_objects(first.objects)  # an error before the page is served
        scene = thrower.task(first).scene
        self.throws: dict[int, PlayedThrow] = {}  #: Throws that can be shown again, by number.
        self._counts: Counter[tuple[ThrowOrder, bool]] = Counter()
        self._again: PlayedThrow | None = None  #: Throw to show again.
        self.playback = Playback()  #: Pace of time.
        self._closed, self._wanted = Event(), Event()
        self.server = open_server(cfg, "Pixel2Catch")
        site = self.server.viser
        site.on_client_connect(
            lambda _: self._wanted.set() if self.is_repeated.value or not thrower.num_throws else None
        )
        self.stage = Stage(site, scene, self.playback)  #: The throw on the page.
        self._add_controls(site.gui, first)

    @property
    def order(self) -> ThrowOrder:
        return ThrowOrder(
            policy=self.policy.value, objects=self.objects.value, disturbance=self.disturbance.value
        )

    def run(self) -> None:
        torch.set_num_threads(1)
        while True:
            self._wanted.wait()
            self._wanted.clear()
            if self._closed.is_set():
                return
            self.playback.begin()
            self._play()

    def close(self) -> None:
        self._closed.set()
        self._begin()

    def _begin(self) -> None:
        """Play what is requested; interrupt what is played now."""
        self.playback.interrupt()
        self._wanted.set()

    def _play(self) -> None:
        again, self._again = self._again, None
        try:
            if again is None:
                self._throw()
            else:
                self.stage.replay(again)
        except Pixel2CatchError as error:
            self.stage.text.content = f"**{error}**"
            return
        if again is None and self.is_repeated.value and self.server.viser.get_clients():
            self.playback.wait(BETWEEN_THROWS * self.playback.speed)
            self._wanted.set()

    def throw(self) -> None:
        """Begin a throw now; a running one is discarded."""
        self._again = None
        self._begin()

    def show_again(self, number: int) -> None:
        self.is_repeated.value = False
        self._again = self.throws[number]
        self._begin()

    def free(self) -> None:
        self.stage.close()
        self._thrower.close()
        self.server.close()

    def _throw(self) -> None:
        order, played = self.order, None
        self.stage.set_scene(self._thrower.task(order).scene)
        for played in self._thrower.run(order, self._seed + self._thrower.num_throws):
            if not self.stage.show(played, len(played.steps) - 1):
                return
        if played is not None:
            self.stage.show_text(played)
            self._keep(played)

    def _keep(self, played: PlayedThrow) -> None:
        self._counts[played.order, played.is_success] += 1
        self._show_rates()
        self.throws[played.number] = played
        with self.list:
            button = self.server.viser.gui.add_button(
                f"{played.number}  {played.object_name}: {played.outcome}",
                color=GREEN if played.is_success else RED,
                order=-played.number,
                hint=f"{played.order.policy}, {played.order.disturbance}: show it again",
            )
        button.on_click(lambda _: self.show_again(played.number))
        self._buttons.append(button)
        if len(self._buttons) > NUM_KEPT:
            self._buttons.pop(0).remove()
            del self.throws[min(self.throws)]

    def _show_rates(self) -> None:
        caught, missed = (self._counts[self.order, is_success] for is_success in (True, False))
        self.rates.content = rates_text(caught, caught + missed)

    def _add_controls(self, gui: viser.GuiApi, first: ThrowOrder) -> None:
        self.rates = gui.add_markdown(rates_text(0, 0))
        gui.add_button("throw", color="green").on_click(lambda _: self.throw())
        self.is_repeated = gui.add_checkbox("one throw after the other", True)
        self.is_repeated.on_update(lambda _: self._wanted.set() if self.is_repeated.value else None)
        disturbances = [each.title for each in select_settings(())]
        self.policy, self.objects, self.disturbance = (
            gui.add_dropdown(label, list(dict.fromkeys((chosen, *others))), initial_value=chosen, hint=hint)
            for label, chosen, others, hint in (
                ("policy", first.policy, shipped_policies(), None),
                ("object", first.objects, (*OBJECT_GROUPS, *OBJECTS), None),
                ("made harder", first.disturbance, disturbances, "as by pixel2catch stress"),
            )
        )
        for handle in (self.policy, self.objects, self.disturbance):
            handle.on_update(lambda _: self._show_rates())
        self.list = gui.add_folder("Throws")
        self._buttons: list[viser.GuiButtonHandle] = []


def serve_until_interrupted(cfg: PageCfg, thrower: ThrowPlayer, first: ThrowOrder, seed: int) -> None:
    """Serve the page, and print its address, until Ctrl-C."""
    with StopRequest() as stop, ThreadPoolExecutor(1) as pool:
        page = PlayPage(cfg, thrower, first, seed)
        print(f"open {page.server.address} in a browser; Ctrl-C ends it", flush=True)
        playing = pool.submit(page.run)
        while not (stop.is_set or playing.done()):
            time.sleep(0.1)
        page.close()
        playing.exception()
        page.free()
        playing.result()


def rates_text(caught: int, throws: int) -> str:
    """Return the success rate so far, with its 95 % interval."""
    if not throws:
        return "**S.R.** no throw like this yet"
    low, high = wilson_interval(caught, throws)
    rate, interval = f"{100 * caught / throws:.0f} %", f"{100 * low:.0f} to {100 * high:.0f} %"
    return f"**S.R. {rate}** ({interval}): {caught} of {throws}"
