"""What a person sees of a training: a progress bar on a terminal, one plain line a report otherwise."""

import time

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from pixel2catch.rl.metrics import Row


class TrainingConsole:
    """Shows progress towards a number of transitions."""

    def __init__(
        self, total: int, report_seconds: float, transitions: int = 0, *, is_silent: bool = False
    ) -> None:
        """Begin to show.

        Args:
            total: Transitions at the end.
            report_seconds: Time between two lines where there is no terminal [s].
            transitions: Transitions that are behind already.
            is_silent: Whether to show nothing.
        """
        self._console = Console(highlight=False, soft_wrap=True, quiet=is_silent)
        self._total, self._report_seconds, self._next_report = total, report_seconds, 0.0
        self._bar = Progress(
            TextColumn("training"),
            BarColumn(),
            TextColumn("{task.percentage:>5.1f} %"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task("", total=total, completed=transitions)
        self._bar.start()

    def report(self, row: Row) -> None:
        """Show the metrics of an update."""
        line = describe(row)
        self._bar.update(self._task, completed=row["transitions"], description=line)
        if not self._console.is_terminal and time.monotonic() >= self._next_report:
            self._next_report = time.monotonic() + self._report_seconds
            left = (self._total - row["transitions"]) / max(row["transitions_per_second"], 1e-9)
            share = f"{100 * row['transitions'] / self._total:.1f} %"
            self.say(
                f"{share} · {row['transitions'] / 1e6:.2f} M transitions · {line}"
                f" · {max(left, 0.0):.0f} s left"
            )

    def say(self, text: str) -> None:
        """Print a line."""
        self._console.print(text, markup=False)

    def close(self) -> None:
        """Stop the bar and leave the terminal as it was."""
        self._bar.stop()


def describe(row: Row) -> str:
    """Put the metrics that tell most into one short line: speed, rates and mean rewards."""
    parts = [f"{row['transitions_per_second'] / 1e3:.1f} k/s"]
    for name, value in row.items():
        if name.endswith("_rate"):
            shown = "-" if value != value else f"{100 * value:.1f} %"  # NaN: no episode has ended yet
            parts.append(f"{name.removesuffix('_rate')} {shown}")
        elif name.startswith("reward/"):
            parts.append(f"reward {name.removeprefix('reward/')} {value:+.4f}")
    return " · ".join(parts)
