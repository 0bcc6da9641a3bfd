"""Entry point of the command line: parses, runs one command, and reports errors in one line."""

import errno
import importlib.metadata
import io
import os
import shutil
import sys
from collections.abc import Sequence
from importlib import import_module
from inspect import cleandoc
from typing import Annotated, Any, Union

import tyro

from pixel2catch.checks import require_valid
from pixel2catch.cli.console import say
from pixel2catch.cli.fields import default_of, option_rules, require_once
from pixel2catch.errors import InvalidValueError, Pixel2CatchError, UnknownNameError
from pixel2catch.installation import GL_VARIABLE
from pixel2catch.interruption import Terminated, raise_on_termination
from pixel2catch.own_files import announced, import_files, in_words, place_of, take_option

GROUPS = {
    "Learning and simulation": ("train", "evaluate", "stress", "reproduce", "play", "catch"),
    "Models of a laboratory": ("excite", "record", "identify", "calibrate", "track"),
    "Robot and twin": ("deploy", "home", "release", "operate", "trials", "twin", "rehearse", "replay"),
    "Tools": ("export", "scene", "doctor"),
}
"""Commands. Each is a module beside this one with a class of its name, loaded where it is needed."""

COMMANDS = tuple(name for names in GROUPS.values() for name in names)

DESCRIPTION = """Catch thrown objects with an arm and a hand from one RGB camera.

usage: pixel2catch [--import FILE.py] COMMAND [OPTIONS]
{commands}
pixel2catch COMMAND --help     explains a command.
pixel2catch --version          prints the version.
pixel2catch --import FILE.py   adds the methods, objects, robots and disturbances of a Python file of yours.
pixel2catch --tyro-print-completion bash   prints a script that completes commands and options (zsh, too).
"""

HELP, HELP_ALL = ("-h", "--help"), ("--help-all", "--env.help")
"""Options that print help; the latter print all options of a command, and all fields of the task."""

EXIT_ERROR = 2  #: Exit status of an error that the user can mend.
EXIT_INTERRUPTED = 130  #: Exit status after Ctrl-C, as shells have it.
EXIT_TERMINATED = 143  #: Exit status after SIGTERM or SIGHUP; shells have it for SIGTERM.

LEAST_COLUMNS = 40  #: Width of help in narrower terminals [characters]; the parser hangs in very narrow ones.

OUT_OF_MEMORY = ("out of memory", "can't allocate memory", "bad_alloc")
"""How libraries say in an error that memory is short."""


def main(args: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status; the arguments are those of the process if absent."""
    try:
        _prepare_environment()
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
    except (Exception, SystemExit) as error:
        if isinstance(error, BrokenPipeError):
            return 0
        say(f"pixel2catch: error: {_sentence(error)}")
        return EXIT_ERROR
    except KeyboardInterrupt as error:
        is_terminated = isinstance(error, Terminated)
        say(f"pixel2catch: {'terminated' if is_terminated else 'interrupted'}")
        return EXIT_TERMINATED if is_terminated else EXIT_INTERRUPTED
    return 0


def _prepare_environment() -> None:
    """Set encodings, the width of help and what MuJoCo draws with; refuse a closed standard output."""
    if None in (sys.stdout, sys.stderr):
        raise InvalidValueError("standard output or error is closed; redirect it to a file or to /dev/null.")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    if shutil.get_terminal_size().columns < LEAST_COLUMNS:
        os.environ["COLUMNS"] = str(LEAST_COLUMNS)
    if backend := os.environ.pop("MUJOCO_GL", None):  # with it, importing MuJoCo may need OpenGL
        os.environ[GL_VARIABLE] = backend


def _sentence(error: Exception | SystemExit) -> str:
    """What an error says to a user; one that is our mistake is raised again."""
    is_known = isinstance(error, Pixel2CatchError | OSError | SystemExit)
    is_short = not is_known and any(words in str(error).lower() for words in OUT_OF_MEMORY)
    if is_short or isinstance(error, MemoryError):
        first = next(iter(str(error).splitlines()), "")
        return f"memory is short ({first or 'none left'}); give fewer --num-envs, --throws or --jobs"
    if place_of(error) or (announced() and not is_known):
        return f"{in_words(error)}; correct {', '.join(announced())}."
    if isinstance(error, OSError) and error.strerror:
        place = f"'{error.filename}': " if error.filename else ""
        fix = "; free some space, or write elsewhere" if error.errno in (errno.ENOSPC, errno.EFBIG) else ""
        return f"{place}{error.strerror}{fix}"
    if isinstance(error, Pixel2CatchError | OSError):
        return str(error)
    raise error


def parse(args: Sequence[str]):
    """Return the command that arguments name, with its options; tyro prints help and mistakes, and exits."""
    if not args or args[0] in HELP:
        lines = list[str]()
        for title, names in GROUPS.items():
            docs = {name: load_command(name).__doc__.splitlines()[0] for name in names}
            lines += ["", f"{title}:", *(f"  {name:10} {doc}" for name, doc in docs.items())]
        commands = "\n".join([*lines, ""])
        print(DESCRIPTION.format(commands=commands), end="", file=None if args else sys.stderr)
        raise SystemExit(0 if args else EXIT_ERROR)
    if not args[0].startswith("-"):
        if args[0] not in COMMANDS:
            raise UnknownNameError("command", args[0], COMMANDS)
        return parse_options(args[0], args[1:])
    kinds = [Annotated[load_command(name), tyro.conf.subcommand(name)] for name in COMMANDS]
    return _parsed(Union[*kinds], "pixel2catch", args)


def parse_options(name: str, args: Sequence[str]) -> Any:
    """Return a command with its options."""
    kind = load_command(name)
    require_once(args)
    options = {"default": default_of(kind, args), "description": cleandoc(kind.__doc__)}
    asked = HELP[:1] if {*HELP_ALL} & {*args} else args
    return _parsed(kind, f"pixel2catch {name}", asked, is_brief=bool({*HELP} & {*args}), **options)


def _parsed(kind: Any, prog: str, args: Sequence[str], *, is_brief: bool = True, **options: Any) -> Any:
    rules, config = option_rules(is_brief=is_brief), (tyro.conf.DisallowNone,)
    return tyro.cli(kind, prog=prog, args=args, config=config, registry=rules, **options)


def load_command(name: str) -> Any:
    """The class of a command."""
    return getattr(import_module(f"pixel2catch.cli.{name}"), name.capitalize())
