"""What is printed of work that takes long."""

import io
from threading import Event

import pytest
from rich.console import Console

from domains import PATIENCE
from pixel2catch.progress import ProgressBar, heartbeat


@pytest.mark.parametrize(
    ("reports", "lines"),
    [
        # a minute of compilation, then 20 parts a second: the rest takes 45 s, not 17 hours
        ([(60.0, 1.0), (65.0, 101.0)], ["work: 0.1 %", "work: 10.1 % · 0:00:45 left"]),
        ([(5.0, 0.0), (6.0, 10.0)], ["work: 0.0 %", "work: 1.0 %"]),
    ],
)
def test_time_before_the_first_report_tells_no_speed(reports: list[tuple[float, float]], lines: list[str]):
    """Parts of 1000 that are done, and the time since the start [s]."""
    clock, out = [0.0], io.StringIO()
    console = Console(file=out, get_time=lambda: clock[0])
    with ProgressBar("work", 1000.0, console=console, line_seconds=0.0) as bar:
        for clock[0], done in reports:
            bar.show(done)
    assert out.getvalue().splitlines() == lines


def test_a_long_step_is_named_until_the_next():
    """The thread prints the name and the time of the step; nothing of a step that has ended."""
    printed = Event()

    class Out(io.StringIO):
        def write(self, text: str) -> int:
            printed.set()
            return super().write(text)

    clock, out = [100.0], Out()
    with heartbeat(Console(file=out, get_time=lambda: clock[0]), seconds=0.001) as begin:
        begin("compiling kernels")
        clock[0] = 140.0
        assert printed.wait(PATIENCE)
        begin("")
    assert {*out.getvalue().splitlines()} <= {"compiling kernels: 0 s", "compiling kernels: 40 s"}
