"""How time goes on a page."""

import time
from concurrent.futures import ThreadPoolExecutor

from domains import PATIENCE
from pixel2catch.viewer.stage import Playback


def test_late_pictures_are_not_made_up_for_without_end():
    playback = Playback()
    playback.begin()
    time.sleep(0.3)
    begin = time.monotonic()
    for _ in range(10):
        playback.wait(0.05)
    assert time.monotonic() - begin > 0.3  # 0.5 s, of which 0.1 s may be made up for


def test_single_steps_while_time_stands_still():
    playback = Playback()
    playback.begin()
    playback.pause(True)
    with ThreadPoolExecutor(1) as pool:
        waits = [pool.submit(playback.wait, 0.01) for _ in range(3)]
        playback.step()
        assert waits[0].result(PATIENCE)
        assert not waits[1].done()
        playback.step()
        assert waits[1].result(PATIENCE)
        playback.pause(False)
        assert waits[2].result(PATIENCE)


def test_nobody_waits_after_an_interruption():
    playback = Playback()
    playback.begin()
    playback.pause(True)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(playback.wait, 1000.0)
        playback.interrupt()
        assert not waiting.result(PATIENCE)
    assert not playback.wait(1000.0)
    playback.begin()
    playback.pause(False)
    assert playback.wait(0.0)
