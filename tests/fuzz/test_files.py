"""Files of every kind, changed at random: an error or a value, soon, and in little memory."""

import gc
import random
import resource
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import pytest
from valid import KINDS, Kind

from pixel2catch.errors import Pixel2CatchError

NUM_CHANGES = 8  #: Changed files of each kind in the test that takes seconds.
MANY_SECONDS = 25.0  #: Time for each kind in the slow test [s].
LONGEST_TIME = 5.0  #: Of the processor for a file [s]: one second on a machine that is five times faster.
MOST_MEMORY = 500 * 2**10  #: That a kind of file may add to the process at its peak [KiB].
LONGEST_MESSAGE = 10_000  #: Characters of an error.


@pytest.fixture(scope="module", autouse=True)
def closed_files() -> Iterator[None]:
    """Close the files that libraries left open: they warn here, and not in later tests."""
    yield
    gc.collect()


def read_changed(kind: Kind, folder: Path, goes_on: Callable[[int], bool]) -> None:
    """Change a file and read it, many times; a number gives the same change in each run."""
    file = kind.write(folder)
    valid = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    kind.read(file)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in count():
        if not goes_on(number):
            break
        for path, content in valid.items():
            path.write_bytes(content)
        file.write_bytes(kind.change(valid[file], random.Random(number)))
        start = time.thread_time()
        try:
            kind.read(file)
        except Pixel2CatchError as error:
            message = str(error)
            assert len(message) < LONGEST_MESSAGE
        assert time.thread_time() - start < LONGEST_TIME, number
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak < MOST_MEMORY


@pytest.mark.parametrize("seconds", [0.0, pytest.param(MANY_SECONDS, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", KINDS)
@pytest.mark.filterwarnings("ignore")  # of libraries
def test_a_changed_file_is_read_or_refused(name: str, seconds: float, tmp_path: Path):
    end = time.monotonic() + seconds
    read_changed(KINDS[name], tmp_path, lambda number: number < NUM_CHANGES or time.monotonic() < end)
