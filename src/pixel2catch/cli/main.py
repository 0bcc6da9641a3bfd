"""Entry point of the command line: parses, runs one command, and reports errors in one line."""

import errno
import importlib.metadata
import sys
from collections.abc import Sequence
from typing import Annotated, Union

import tyro

from pixel2catch.checks import require_valid
from pixel2catch.cli.bench import Bench
from pixel2catch.cli.calibrate import Calibrate
from pixel2catch.cli.catch import Catch
from pixel2catch.cli.console import say_on_terminal
from pixel2catch.cli.deploy import Deploy
from pixel2catch.cli.doctor import Doctor
from pixel2catch.cli.evaluate import Evaluate
from pixel2catch.cli.excite import Excite
from pixel2catch.cli.export import Export
from pixel2catch.cli.help import plain_help
from pixel2catch.cli.identify import Identify
from pixel2catch.cli.label import Label
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
from pixel2catch.cli.transfer import Transfer
from pixel2catch.cli.twin import Twin
from pixel2catch.errors import Pixel2CatchError, UnknownNameError
from pixel2catch.interruption import Terminated, raise_on_termination
from pixel2catch.own_files import import_files, take_option

COMMANDS = (
    Train,
    Evaluate,
    Stress,
    Transfer,
    Reproduce,
    Play,
    Catch,
    Excite,
    Record,
    Identify,
    Calibrate,
    Track,
    Label,
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
EXIT_TERMINATED = 143  #: Exit status after a termination signal, likewise.

OUT_OF_MEMORY = ("out of memory", "can't allocate memory", "bad_alloc")
"""How libraries say in an error that memory is short."""


def main(args: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status; the arguments are those of the process if absent."""
    args = take_option(sys.argv[1:] if args is None else args)
    if args == ["--version"]:
        print(f"pixel2catch {importlib.metadata.version('pixel2catch')}")
        return 0
    try:
        with raise_on_termination():
            command = parse(args)
            require_valid(command)
            say_on_terminal(f"{type(command).__name__.lower()}: starting ...")
            import_files()
            command.run()
            sys.stdout.flush()
    except (Pixel2CatchError, OSError, MemoryError, RuntimeError) as error:
        if isinstance(error, BrokenPipeError):
            return 0
        print(f"pixel2catch: error: {_sentence(error)}", file=sys.stderr)
        return EXIT_ERROR
    except Terminated:
        print("pixel2catch: terminated", file=sys.stderr)
        return EXIT_TERMINATED
    except KeyboardInterrupt:
        print("pixel2catch: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


def _sentence(error: Exception) -> str:
    """What an error says to a user; one that is our mistake is raised again."""
    if isinstance(error, OSError) and error.strerror:
        place = f"'{error.filename}': " if error.filename else ""
        fix = "; free some space, or write elsewhere" if error.errno in (errno.ENOSPC, errno.EFBIG) else ""
        return f"{place}{error.strerror}{fix}"
    if isinstance(error, Pixel2CatchError | OSError):
        return str(error)
    if isinstance(error, MemoryError) or any(words in str(error).lower() for words in OUT_OF_MEMORY):
        first = next(iter(str(error).splitlines()), "")
        return f"memory is short ({first or 'none left'}); give fewer --num-envs, --throws or --jobs"
    raise error


def parse(args: Sequence[str]):
    """Return the command that arguments name, with its options; tyro prints help and mistakes, and exits.

    `--env.FIELD VALUE` is `--env FIELD VALUE`: only a command that has begun looks up the fields, for what
    declares them takes seconds to import.

    Raises:
        UnknownNameError: If there is no such command.
    """
    args = [part for arg in args for part in (("--env", arg[6:]) if arg.startswith("--env.") else (arg,))]
    commands = {command.__name__.lower(): command for command in COMMANDS}
    if args and not args[0].startswith("-") and args[0] not in commands:
        raise UnknownNameError("command", args[0], commands)
    names = [Annotated[command, tyro.conf.subcommand(name)] for name, command in commands.items()]
    return tyro.cli(
        Union[*names],  # type: ignore[valid-type]
        prog="pixel2catch",
        description=DESCRIPTION,
        args=args,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone),
        registry=plain_help(),
    )


if __name__ == "__main__":
    sys.exit(main())
