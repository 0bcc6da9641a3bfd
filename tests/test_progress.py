"""What is said of work that takes long."""

import io

import pytest
from rich.console import Console

from pixel2catch import progress


class Clock:
    """Time that is stepped."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now


def lines(monkeypatch: pytest.MonkeyPatch, reports: list[tuple[float, float]]) -> list[str]:
    """What 1000 parts of work print, of which so many are done after so many seconds."""
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    out = io.StringIO()
    with progress.ProgressBar("work", 1000.0, console=Console(file=out), line_seconds=0.0) as bar:
        for clock.now, done in reports:
            bar.show(done)
    return out.getvalue().splitlines()


def test_time_before_the_first_report_tells_no_speed(monkeypatch: pytest.MonkeyPatch):
    """A minute of compilation, then 20 parts a second: the rest takes 50 s, not 17 hours."""
    shown = lines(monkeypatch, [(60.0, 1.0), (65.0, 101.0)])
    assert shown == ["work: 0.1 %", "work: 10.1 % · 45 s left"]


def test_long_work_is_announced_once(monkeypatch: pytest.MonkeyPatch):
    shown = lines(monkeypatch, [(1.0, 1.0), (6.0, 6.0), (12.0, 12.0)])
    assert shown == [
        "work: 0.1 %",
        "work: this takes about 17 min",
        "work: 0.6 % · 17 min left",
        "work: 1.2 % · 16 min left",
    ]


def test_a_report_of_nothing_done_tells_no_speed(monkeypatch: pytest.MonkeyPatch):
    assert lines(monkeypatch, [(5.0, 0.0), (6.0, 10.0)]) == ["work: 0.0 %", "work: 1.0 %"]
