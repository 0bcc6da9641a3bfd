"""What a training tells while it runs: console, CSV and TensorBoard."""

from collections.abc import Callable
from typing import Protocol

from pixel2catch.rl.config import TrainCfg
from pixel2catch.rl.console import TrainingConsole
from pixel2catch.rl.metrics import METRICS_FILE, CsvLog, Row, TensorBoardLog
from pixel2catch.rl.run_folder import RunFolder


class _File(Protocol):
    def write(self, row: Row) -> None: ...

    def close(self) -> None: ...


class TrainingLog:
    """Console, CSV and TensorBoard; a full disk is reported and does not end the training."""

    def __init__(self, cfg: TrainCfg, folder: RunFolder, transitions: int, *, is_silent: bool) -> None:
        """Begin to show and open the files.

        Args:
            cfg: The configuration of the training.
            folder: Where the files are.
            transitions: Transitions that are behind already.
            is_silent: Whether to show and write nothing, since another process does.
        """
        self.console = TrainingConsole(cfg.transitions, cfg.report_seconds, transitions, is_silent=is_silent)
        self._files: dict[str, _File] = {}
        if not is_silent:
            self._files["metrics"] = CsvLog(folder.path / METRICS_FILE, transitions)
            self._files["TensorBoard events"] = TensorBoardLog(folder.path, transitions)

    def __enter__(self) -> "TrainingLog":
        """Nothing more to open."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the files and leave the terminal as it was."""
        for name, file in self._files.items():
            self.attempt(name, file.close)
        self.console.close()

    def write(self, row: Row) -> None:
        """Show and write a row of metrics."""
        self.console.report(row)
        for name, file in self._files.items():
            self.attempt(name, lambda file=file: file.write(row))

    def attempt(self, what: str, write: Callable[[], None]) -> None:
        """Write something; if that fails, say so and go on."""
        try:
            write()
        except OSError as error:
            self.console.say(f"warning: could not write {what} ({error}); training goes on")
