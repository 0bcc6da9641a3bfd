"""Commands in processes of their own, forked from one in which what takes long to import is imported."""

import os
import sys
from collections.abc import Mapping
from multiprocessing import get_context
from pathlib import Path
from subprocess import CompletedProcess
from tempfile import TemporaryDirectory

from domains import PATIENCE

CONTEXT = get_context("forkserver")
CONTEXT.set_forkserver_preload(["pixel2catch.cli.main", "pixel2catch.evaluation.loading"])


def pixel2catch(*args: str | Path, folder: Path | None = None, **environment: str) -> "CompletedProcess[str]":
    """Run a command with the folder as working directory, and with some variables of the environment."""
    words = [str(arg) for arg in args]
    with TemporaryDirectory() as place:
        files = [Path(place) / name for name in ("stdout", "stderr")]
        process = CONTEXT.Process(target=_run, args=(words, files, folder or Path.cwd(), environment))
        process.start()
        process.join(PATIENCE)
        if process.exitcode is None:
            process.kill()
            raise AssertionError(f"{words} goes on and on")
        return CompletedProcess(words, process.exitcode, *(file.read_text() for file in files))


def _run(words: list[str], files: list[Path], folder: Path, environment: Mapping[str, str]) -> None:
    from pixel2catch.cli.main import main

    for number, file in enumerate(files, start=1):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), number)
    os.environ.update(environment)
    os.chdir(folder)
    sys.argv = ["pixel2catch", *words]
    sys.exit(main(words))
