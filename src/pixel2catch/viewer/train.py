"""The page of `pixel2catch train --web`: curves, remaining time, and throws of the newest policy."""

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import viser

from pixel2catch.learning.log import METRICS_FILE, read_rows
from pixel2catch.viewer.config import PageCfg, PlayCfg
from pixel2catch.viewer.play import PlayPage
from pixel2catch.viewer.plots import add_plot
from pixel2catch.viewer.server import open_server

PERIOD = 2.0  #: Time between two reads of the metrics [s]. Source: ours, less than an update.
RATES = ("tracking_rate", "success_rate")  #: Metrics of the first plot, if the run has them.
REWARD = "reward/"  #: Prefix of the metrics of the second plot.


class TrainingCurves:
    """Curves and progress of a run; `update` reads its metrics."""

    def __init__(self, gui: viser.GuiApi, run: Path, transitions: int) -> None:
        """Add them to the page of a run with this number of transitions."""
        self._gui, self._run, self._transitions = gui, run, transitions
        self._folder = gui.add_folder("Training", order=-1.0)
        with self._folder:
            self.text = gui.add_markdown("no update yet")
        self._plots: dict[tuple[str, ...], viser.GuiUplotHandle] = {}
        self.num_rows = 0  #: Number of shown rows of metrics.

    def update(self) -> None:
        """Read the run's metrics, and show new rows."""
        rows = read_rows(self._run / METRICS_FILE)
        if len(rows) == self.num_rows:
            return
        self.num_rows = len(rows)
        last = {name: float(value or "nan") for name, value in rows[-1].items()}
        self.text.content = progress_text(last, self._transitions)
        if not self._plots:
            with self._folder:
                rates = tuple(name for name in RATES if name in last)
                rewards = tuple(name for name in last if name.startswith(REWARD))
                for title, names, heights in (
                    ("rates, over million transitions", rates, (0.0, 1.0)),
                    ("rewards of a step", rewards, None),
                ):
                    self._plots[names] = add_plot(
                        self._gui, title, names, x="M", limits=None, heights=heights
                    )
        million = np.array([float(row["transitions"]) for row in rows]) / 1e6
        for names, plot in self._plots.items():
            columns = (np.array([float(row[name] or "nan") for row in rows]) for name in names)
            plot.data = (million, *columns)


def progress_text(row: dict[str, float], transitions: int) -> str:
    """Return progress and remaining time in words, from the newest row of metrics."""
    left = max(transitions - row["transitions"], 0.0) / max(row["transitions_per_second"], 1e-9)
    minutes, seconds = divmod(round(left), 60)
    share = 100 * row["transitions"] / transitions
    rates = ", ".join(f"{name.replace('_', ' ')} {100 * row[name]:.1f} %" for name in RATES if name in row)
    return f"**{share:.1f} %**, {minutes} min {seconds:02d} s left; {rates}"


def serve_training(cfg: PageCfg, run: Path, transitions: int) -> None:
    """Serve the page of a run until this process ends; throws begin with the first policy."""
    server = open_server(cfg, "Pixel2Catch training")
    print(f"the training's page: {server.address}", file=sys.stderr, flush=True)
    curves = TrainingCurves(server.viser.gui, run, transitions)
    policy = run / "policy" / "policy.json"
    while not policy.exists():
        curves.update()
        time.sleep(PERIOD)
    page = PlayPage(PlayCfg(page=cfg, policy=run), server)
    page.throw()
    with ThreadPoolExecutor(1) as pool:
        playing = pool.submit(page.run)
        while not playing.done():
            curves.update()
            time.sleep(PERIOD)
        playing.result()
