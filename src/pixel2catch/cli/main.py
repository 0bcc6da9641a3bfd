"""Entry point of the command line: parses, runs one command, and reports errors in one line."""

import errno
import importlib.metadata
import io
import os
import shutil
import sys
from collections.abc import Collection, Sequence
from importlib import import_module
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
    *("deploy", "home", "release", "operate", "twin", "rehearse", "replay"),
    *("export", "scene", "bench", "doctor"),
)
"""Each is a module beside this one, with a class of its name, which is loaded where it is needed."""

REMOVED = {
    "label": "label the video with CVAT or Label Studio, and give their file to 'track VIDEO --truth FILE'",
    "transfer": "run 'stress --engines mujoco physx'",
}
"""Commands that are gone, and what to do instead."""

REMOVED_OPTIONS = (
    ("bench", "--json --plot", "give --out FILE.json"),
    ("bench", "--seconds", "give --updates"),
    ("calibrate", "--board-pose --num-views", "leave it out; the board's pose is found, 15 views are taken"),
    ("calibrate", "--chessboard", "give images of the printed board, or a .yaml of ROS's camera_calibration"),
    ("calibrate", "--image-topic --source", "give --live for the robot's camera, or a table of images"),
    ("catch", "--seed", "run 'pixel2catch evaluate --seed' and 'pixel2catch play --seed'"),
    ("deploy", "--seconds", "end it with Ctrl-C, or run 'timeout -s INT 60 pixel2catch deploy'"),
    ("deploy record operate calibrate", "--transport", "leave it out; give --network ros for rclpy"),
    ("deploy replay", "--mask-robot --no-mask-robot --record-images", "leave it out; it is always done"),
    ("deploy replay track", "--point", "give --box, a box around the object"),
    ("deploy replay track", "--saturation --value", "leave it out; grey and dark pixels are left out"),
    ("deploy replay track", "sam2+background", "give --segmenter sam2 or --segmenter background"),
    ("doctor", "--camera", "run 'pixel2catch track 0 --seconds 3'"),
    ("doctor", "--checkpoint", "run 'pixel2catch track VIDEO --segmenter sam2 --checkpoint FOLDER'"),
    ("evaluate", "--html", "give --out FILE.json; 'pixel2catch play' draws throws"),
    (
        "export",
        "--format --images --objects --seed --throws --profile",
        "leave it out; export writes policies as ONNX only",
    ),
    ("export", "--web-demo", "run 'python companions/web_demo/export.py FOLDER'"),
    ("identify", "--filter", "give --free filter_gain filter_lookahead latency"),
    ("identify", "--hold-out", "leave it out; the last recording judges the fit"),
    ("identify", "--physics-hz", "leave it out; the fit has 480 Hz"),
    ("operate", "--hold --arm --stop", "give --keys HOLD ARM STOP"),
    (
        "evaluate stress play scene",
        "--robot-model --surface",
        "run companions/makers_bodies/makers_bodies.py",
    ),
    ("play", "--layout --meshes --view", "leave it out; every film has the robot's view in a corner"),
    ("play operate twin", "--host --port", "give --address HOST:PORT"),
    ("record", "--dry-run", "leave it out; a recording needs motion"),
    ("calibrate rehearse replay stress track", "--json", "read the .json file that it writes"),
    ("rehearse twin", "--domain", "set ROS_DOMAIN_ID"),
    ("replay", "--perception-ms", "leave it out; a replay takes 10 ms for an image"),
    ("replay", "--web --host --port", "open the recording with a viewer of MCAP files"),
    ("reproduce", "--evaluation-physics-hz", "evaluations have 600 Hz"),
    ("reproduce", "--physics-hz", "give --training physics_stages=120,120,240 or env.scene.physics_hz=120"),
    ("reproduce", "--report-only", "leave it out; the same command writes the report again"),
    ("reproduce", "--transitions", "give --training transitions=NUMBER"),
    ("reproduce stress", "--launcher", "leave it out; --slurm alone selects the cluster"),
    (
        "track",
        "--mask-robot --joint-states --workcell",
        "leave it out; give --region, or run 'replay' for a recording of deploy",
    ),
    ("train", "--cone", "give --env.scene.cone"),
    ("train", "--latency-steps", "give --env.sensing.latency-steps"),
    ("train", "--multiccd --no-multiccd", "give --env.scene.multiccd True or --env.scene.multiccd False"),
    ("evaluate stress train", "--physics-hz", "give --env.scene.physics-hz, or --physics-stages"),
    ("train", " ".join(f"--{name.replace('_', '-')}" for name in HIDDEN), "set it by 'reproduce --training'"),
    ("train", "--web --host --port", "run 'pixel2catch play RUN --web'; RUN/metrics.csv has the curves"),
    ("twin", "--draw-dynamics", "run 'excite --rehearse FOLDER' and give --dynamics FOLDER/truth.json"),
)
"""Commands, their options that are gone, and what to do instead. See docs/changes.md."""

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
        InvalidValueError: The command was removed; the message names the new way.
        Pixel2CatchError: What the options' defaults come from cannot be read, such as a run to resume.
    """
    if args and args[0] in REMOVED:
        raise InvalidValueError(f"there is no command '{args[0]}'; {REMOVED[args[0]]}.")
    given = {arg.partition("=")[0] for arg in args[1:]}
    for commands, options, fix in REMOVED_OPTIONS:
        if args and args[0] in commands.split() and (found := given & {*options.split()}):
            raise InvalidValueError(f"there is no '{args[0]} {min(found)}'; {fix}.")
    if args and not args[0].startswith("-") and args[0] not in COMMANDS:
        raise UnknownNameError("command", args[0], COMMANDS)
    if args and args[0] in COMMANDS:
        return parse_options(args[0], args[1:])
    kinds = [Annotated[load_command(name), tyro.conf.subcommand(name)] for name in COMMANDS]
    return tyro.cli(
        Union[*kinds],  # type: ignore[valid-type]
        prog="pixel2catch",
        description=DESCRIPTION,
        args=args,
        config=(tyro.conf.DisallowNone,),
        registry=option_rules(),
    )


def parse_options(name: str, args: Sequence[str], hidden: Collection[str] = HIDDEN) -> Any:
    """Return a command with its options; `hidden` names fields that are none."""
    kind = load_command(name)
    return tyro.cli(
        kind,
        prog=f"pixel2catch {name}",
        args=["--help"] if HELP in args else args,
        default=default_of(kind, args),
        config=(tyro.conf.DisallowNone,),
        registry=option_rules(hidden),
    )


def load_command(name: str) -> Any:
    """The class of a command."""
    return getattr(import_module(f"pixel2catch.cli.{name}"), name.capitalize())


if __name__ == "__main__":
    sys.exit(main())
