"""A servo and a laboratory on a stage: in memory, in time that passes only while the servo sleeps."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import groupby, repeat

from servo_rows import LIMITS
from wire_lab import WireLab

from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock
from pixel2catch.servo.link import Fault, LoopEnd, Mode, ServoEnd, flag_names
from pixel2catch.servo.process import Servo, ServoSetup


class ClockOfScript(Clock):
    """Time passes only while the servo sleeps; then the laboratory steps, and the script goes on."""

    def __init__(self) -> None:
        self.time = 1000.0
        self.script: Iterator[None] = iter(())
        self.sleep: Callable[[], None] = lambda: None

    def now(self) -> float:
        return self.time

    def stamp(self) -> float:
        return 1.7e9 + self.time

    def sleep_until(self, moment: float) -> None:
        self.time = moment
        self.sleep()


class Cut(Exception):  # noqa: N818
    """Nothing of interest follows."""


class Stage:
    """A servo and a laboratory in memory; `play` runs the servo while a script, tick by tick, says what else
    happens."""

    def __init__(self, profile: Profile, ends: tuple[LoopEnd, ServoEnd], is_dry_run: bool = False) -> None:
        self.clock, self.broker = ClockOfScript(), Broker()
        loop, end = ends
        setup = ServoSetup(profile=profile, limits=LIMITS, is_dry_run=is_dry_run)
        self.node = self.broker.node(self.clock)
        self.servo = Servo(end, self.node, setup, self.clock)
        self.laboratory = self.broker.node(self.clock)
        self.lab = WireLab(self.laboratory, loop, profile, self.clock)

    def play(self, script: Iterator[None]) -> None:
        """Run until the script is over and the robot stands."""

        def sleep() -> None:
            self.lab.step()
            if next(script, Cut) is Cut:
                self.servo.end()

        self.clock.sleep = sleep
        with suppress(Cut):
            self.servo.run()
        self.lab.step()

    def armed(self, num_ticks: int = 5) -> Iterator[None]:
        """Everybody is heard of, and the operator arms."""
        yield from wait(11)
        self.lab.ask_to_arm()
        yield from wait(num_ticks)
        assert self.mode in (Mode.ARMED, Mode.RAMP, Mode.RUN)

    def pressed_anew(self) -> Iterator[None]:
        """The operator lets go of the switch, and presses it again."""
        for is_held in (False, True):
            self.lab.is_held = is_held
            yield from wait(26)

    @property
    def mode(self) -> int:
        return self.lab.ticks[-1].mode

    @property
    def modes(self) -> list[int]:
        """The modes in their order."""
        return [mode for mode, _ in groupby(command.mode for command in self.lab.ticks)]

    @property
    def refused(self) -> tuple[str, ...]:
        """Why the last request to arm was refused that was."""
        return next(
            tuple(flag_names(Fault, each.refused)) for each in reversed(self.lab.ticks) if each.refused
        )

    @property
    def stopped_by(self) -> tuple[str, ...]:
        """Why it was stopped first."""
        return next(
            tuple(flag_names(Fault, each.stopped_by)) for each in self.lab.ticks if each.mode == Mode.STOPPED
        )


def wait(num_ticks: int) -> Iterator[None]:
    return repeat(None, num_ticks)
