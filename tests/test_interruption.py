"""Signals that ask a command to end."""

import signal
from collections.abc import Iterator

import pytest

from pixel2catch.interruption import StopRequest, Terminated, raise_on_termination


@pytest.fixture(autouse=True)
def closed_terminal() -> Iterator[None]:
    """What a command does about a closed terminal is what the system does, not what nohup asked for."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_asks_to_stop_in_order(number: signal.Signals):
    with StopRequest() as stop:
        signal.raise_signal(number)
        assert (stop.is_set, stop.by) == (True, number.name)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_termination_unwinds_so_that_no_process_that_was_started_stays(number: signal.Signals):
    with pytest.raises(Terminated), raise_on_termination():
        signal.raise_signal(number)


def test_who_goes_on_without_a_terminal_is_let():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with raise_on_termination(), StopRequest() as stop:
        signal.raise_signal(signal.SIGHUP)
        assert not stop.is_set
