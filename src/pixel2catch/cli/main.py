"""Entry point of the command line: parses, runs one command, and reports errors in one line."""

import errno
import importlib.metadata
import io
import os
import shutil
import sys
import tomllib
from collections.abc import Sequence
from importlib import import_module
from importlib.resources import files
from typing import Annotated, Any, Union

import tyro

from pixel2catch.checks import require_valid
from pixel2catch.cli.console import say
from pixel2catch.cli.fields import HELP, HIDDEN, default_of, option_rules
from pixel2catch.errors import InvalidValueError, Pixel2CatchError, UnknownNameError
from pixel2catch.interruption import Terminated, raise_on_termination
from pixel2catch.own_files import import_files, take_option

COMMANDS = (
    *("train", "evaluate", "stress", "reproduce", "play", "catch"),
    *("excite", "record", "identify", "calibrate", "track"),
    *("deploy", "home", "release", "operate", "trials", "twin", "rehearse", "replay"),
    *("export", "scene", "bench", "doctor"),
)
"""Each is a module beside this one, with a class of its name, which is loaded where it is needed."""

REMOVED = "removed.toml"
"""Names of commands and options that are gone, and what to do instead. See docs/changes.md."""

DESCRIPTION = """Catch thrown objects with an arm and a hand from one RGB camera.

'pixel2catch COMMAND --help' explains a command, 'pixel2catch --version' prints the version.
'pixel2catch --import FILE.py COMMAND ...' knows the methods, objects, robots and disturbances that a Python
file of yours defines."""

EXIT_ERROR = 2  #: Exit status of an error that the user can mend.
EXIT_INTERRUPTED = 130  #: Exit status after Ctrl-C, as shells have it.
EXIT_TERMINATED = 143  #: Exit status after SIGTERM or SIGHUP; shells have it for SIGTERM.

LEAST_COLUMNS = 40  #: Width of help in narrower terminals [characters]; the parser hangs in very narrow ones.

OUT_OF_MEMORY = ("out of memory", "can't allocate memory", "bad_alloc")
"""How libraries say in an error that memory is short."""


def main(args: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status; the arguments are those of the process if absent."""
    try:
        _prepare_terminal()
        args = take_option(sys.argv[1:] if args is None else args)
        if args == ["--version"]:
            print(f"pixel2catch {importlib.metadata.version('pixel2catch')}")
            return 0
        with raise_on_termination():
            command = parse(args)
            require_valid(command)
            if sys.stderr.isatty():
                say(f"{type(command).__name__.lower()}: starting ...")
            import_files()
            command.run()
            sys.stdout.flush()
    except (Pixel2CatchError, OSError, MemoryError, RuntimeError) as error:
        if isinstance(error, BrokenPipeError):
            return 0
        say(f"pixel2catch: error: {_sentence(error)}")
        return EXIT_ERROR
    except Terminated:
        print("pixel2catch: terminated", file=sys.stderr)
        return EXIT_TERMINATED
    except KeyboardInterrupt:
        print("pixel2catch: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


def _prepare_terminal() -> None:
    """Write what an encoding lacks as '?', and give help enough columns.

    Raises:
        InvalidValueError: Standard output is closed, so that results would be lost.
    """
    if sys.stdout is None:
        raise InvalidValueError("standard output is closed; redirect it to a file or to /dev/null.")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    if shutil.get_terminal_size().columns < LEAST_COLUMNS:
        os.environ["COLUMNS"] = str(LEAST_COLUMNS)


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

    Raises:
        UnknownNameError: There is no such command.
        InvalidValueError: The command or an option was removed; the message names the new way.
        Pixel2CatchError: What the options' defaults come from cannot be read, such as a run to resume.
    """
    if args and not args[0].startswith("-"):
        _require_present(*args)
        return parse_options(args[0], args[1:])
    kinds = [Annotated[load_command(name), tyro.conf.subcommand(name)] for name in COMMANDS]
    return _parsed(Union[*kinds], "pixel2catch", args, description=DESCRIPTION)


def parse_options(name: str, args: Sequence[str]) -> Any:
    """Return a command with its options, also with those that only `reproduce --training` sets."""
    kind = load_command(name)
    asked = ["--help"] if HELP in args else args
    return _parsed(kind, f"pixel2catch {name}", asked, default=default_of(kind, args))


def _parsed(kind: Any, prog: str, args: Sequence[str], **options: Any) -> Any:
    rules, config = option_rules(), (tyro.conf.DisallowNone,)
    return tyro.cli(kind, prog=prog, args=args, config=config, registry=rules, **options)


def _require_present(command: str, *args: str) -> None:
    """Raise the error of a command that is gone or unknown, or of an option that is gone."""
    removed = tomllib.loads(files("pixel2catch.cli").joinpath(REMOVED).read_text("utf-8"))
    if fix := removed["commands"].get(command):
        raise InvalidValueError(f"there is no command '{command}'; {fix}.")
    if command not in COMMANDS:
        raise UnknownNameError("command", command, COMMANDS)
    hidden = " ".join(f"--{name.replace('_', '-')}" for name in HIDDEN)
    given = {arg.partition("=")[0] for arg in args}
    for commands, options, fix in (
        *removed["options"],
        ("train", hidden, "set it by 'reproduce --training'"),
    ):
        if command in commands.split() and (found := given & {*options.split()}):
            raise InvalidValueError(f"there is no '{command} {min(found)}'; {fix}.")


def load_command(name: str) -> Any:
    """The class of a command."""
    return getattr(import_module(f"pixel2catch.cli.{name}"), name.capitalize())
