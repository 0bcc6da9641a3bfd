"""Entry point of the command line: parses, runs one command, and reports errors in one line."""

import importlib.metadata
import sys
from collections.abc import Sequence
from typing import Annotated, Union

import tyro

from pixel2catch.cli.bench import Bench
from pixel2catch.cli.calibrate import Calibrate
from pixel2catch.cli.catch import Catch
from pixel2catch.cli.deploy import Deploy
from pixel2catch.cli.doctor import Doctor
from pixel2catch.cli.evaluate import Evaluate
from pixel2catch.cli.excite import Excite
from pixel2catch.cli.export import Export
from pixel2catch.cli.identify import Identify
from pixel2catch.cli.operate import Operate
from pixel2catch.cli.play import Play
from pixel2catch.cli.record import Record
from pixel2catch.cli.rehearse import Rehearse
from pixel2catch.cli.replay import Replay
from pixel2catch.cli.reproduce import Reproduce
from pixel2catch.cli.scene import Scene
from pixel2catch.cli.stress import Stress
from pixel2catch.cli.track import Track
from pixel2catch.cli.train import Train
from pixel2catch.cli.twin import Twin
from pixel2catch.errors import Pixel2CatchError
from pixel2catch.own_files import import_files, take_option

COMMANDS = (
    Train,
    Evaluate,
    Stress,
    Reproduce,
    Play,
    Catch,
    Excite,
    Record,
    Identify,
    Calibrate,
    Track,
    Deploy,
    Operate,
    Twin,
    Rehearse,
    Replay,
    Export,
    Scene,
    Bench,
    Doctor,
)

DESCRIPTION = """Catch thrown objects with an arm and a hand from one RGB camera.

'pixel2catch COMMAND --help' explains a command, 'pixel2catch --version' prints the version.
'pixel2catch --import FILE.py COMMAND ...' knows the methods, objects, robots and disturbances that a Python
file of yours defines; so does FILE.py:NAME in place of a name."""

EXIT_ERROR = 2  #: Exit status of an error that the user can mend.
EXIT_INTERRUPTED = 130  #: Exit status after Ctrl-C, as shells have it.


def main(args: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status; the arguments are those of the process if absent."""
    args = take_option(sys.argv[1:] if args is None else args)
    if args == ["--version"]:
        print(f"pixel2catch {importlib.metadata.version('pixel2catch')}")
        return 0
    try:
        command = parse(args)
        import_files()
        command.run()
    except (Pixel2CatchError, OSError) as error:
        if isinstance(error, BrokenPipeError):
            return 0
        print(f"pixel2catch: error: {error}", file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        print("pixel2catch: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


def parse(args: Sequence[str]):
    """Return the command that arguments name, with its options; tyro prints help and mistakes, and exits.

    `--env.FIELD VALUE` is `--env FIELD VALUE`: only a command that has begun looks up the fields, for what
    declares them takes seconds to import.
    """
    args = [part for arg in args for part in (("--env", arg[6:]) if arg.startswith("--env.") else (arg,))]
    names = [Annotated[command, tyro.conf.subcommand(command.__name__.lower())] for command in COMMANDS]
    return tyro.cli(
        Union[*names],  # type: ignore[valid-type]
        prog="pixel2catch",
        description=DESCRIPTION,
        args=args,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )


if __name__ == "__main__":
    sys.exit(main())
