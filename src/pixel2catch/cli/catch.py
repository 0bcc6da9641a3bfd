"""`pixel2catch catch`: evaluate the shipped policy in a few minutes on a CPU, as `make catch` does."""

from dataclasses import dataclass
from pathlib import Path

from pixel2catch.checks import Count, FilmPath
from pixel2catch.cli.console import say, suggest
from pixel2catch.cli.evaluate import Evaluate, print_tables
from pixel2catch.cli.play import Play
from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.shipped import DEFAULT_POLICY


@dataclass(frozen=True, kw_only=True)
class Catch:
    """Evaluate the default policy, and write a short film."""

    throws: Count = 150  #: Number of throws of seen objects, and of unseen objects.
    video: FilmPath = Path("catch.mp4")  #: The film, as .mp4, .webp or .gif, or stills as .png.

    def run(self) -> None:
        rounds = max(1, round(self.throws / 500))
        say(f"throwing {self.throws:,} seen and {self.throws:,} unseen objects, on the CPU ...")
        print_tables(
            {
                name: Evaluate(objects=(name,), num_envs=self.throws // rounds, trials=rounds).result()
                for name in ("seen", "unseen")
            },
            DEFAULT_POLICY,
        )
        try:
            Play(out=self.video, throws=2).run()
        except DeviceUnavailableError as error:
            print(f"no film: {error}")
        suggest("play", "--web")
