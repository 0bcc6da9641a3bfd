"""How time goes on a page: in real time, slower, not at all, or step by step."""

import time
from threading import Condition

MOST_LATE = 0.1  #: Time that is made up for when pictures are late [s]; what is more is lost. Source: ours.


class Playback:
    """Makes one thread wait for its pictures; any thread may change how fast they come."""

    def __init__(self) -> None:
        """Real time."""
        self._changed = Condition()
        self._speed, self._is_paused, self._num_steps = 1.0, False, 0
        self._is_interrupted = False
        self._due = 0.0

    @property
    def speed(self) -> float:
        """Seconds that pass on the page in a real one."""
        return self._speed

    @property
    def is_paused(self) -> bool:
        """Whether time stands still."""
        return self._is_paused

    def set_speed(self, speed: float) -> None:
        """Let time go so fast."""
        self._set(_speed=speed)

    def pause(self, is_paused: bool) -> None:
        """Let time stand still, or go on."""
        self._set(_is_paused=is_paused, _num_steps=0)

    def step(self) -> None:
        """Stand still after one step more."""
        self._set(_is_paused=True, _num_steps=self._num_steps + 1)

    def interrupt(self) -> None:
        """Let no one wait any more until the next `begin`."""
        self._set(_is_interrupted=True)

    def begin(self) -> None:
        """Begin to play something."""
        self._due = time.monotonic()
        self._set(_is_interrupted=False)

    def wait(self, duration: float) -> bool:
        """Wait until the next picture is due, so long after the one before [s]; whether to go on."""
        with self._changed:
            if not self._is_paused:
                self._due = max(self._due + duration / self._speed, time.monotonic() - MOST_LATE)
            while not self._is_interrupted:
                if self._is_paused:
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
