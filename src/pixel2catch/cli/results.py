"""`pixel2catch results`: the studies behind the documents, and the tables that are made of them."""

import datetime
import runpy
import shlex
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tyro.conf import Positional

from pixel2catch.cli.console import results_console, say
from pixel2catch.errors import InvalidValueError, StudyError
from pixel2catch.reports import terminal_table


@dataclass(frozen=True, kw_only=True)
class Results:
    """Compute missing studies of the documents, and write their tables.

    The working directory is a checkout; its experiments/studies.toml declares the studies. What has a file
    is not computed again: delete the file to measure again. Studies for a GPU are computed where one is.
    """

    studies: Positional[tuple[str, ...]] = ()  #: Names of studies. Default: all.
    list: bool = False  #: Only show each study with its state.
    check: bool = False  #: Only compare the documents with the files; status 2 if anything differs.

    def run(self) -> None:
        from pixel2catch.cli.studies import make_slots, run_grid
        from pixel2catch.evaluation.grid import StudyCell, StudyGrid
        from pixel2catch.evaluation.studies import Studies
        from pixel2catch.files import write_atomically

        if self.list and self.check:
            raise InvalidValueError("--list and --check were given; give one of them")
        declared = Studies.load(Path())
        names = self.studies or tuple(declared.studies)
        chosen = {name: declared.study(name) for name in names}
        if self.list:
            rows = [
                {"study": name, "state": declared.state(name), "device": each.device}
                | {"hours": f"{each.hours:g}", "question": each.question}
                for name, each in chosen.items()
            ]
            return results_console().print(terminal_table("studies", rows))
        if self.check:
            if problems := [*declared.problems(datetime.datetime.now(datetime.UTC).date())]:
                raise StudyError("\n".join(problems))
            return say(f"{len(declared.tables)} tables agree with their files")
        here = {"cpu", *(["cuda"] if _has_cuda() else [])}
        for name in (name for name, each in chosen.items() if each.device not in here):
            if declared.state(name).startswith("missing"):
                say(f"study '{name}' needs a GPU: run 'pixel2catch results {name}' on a machine with one")
        files = {f: c for each in chosen.values() if each.device in here for f, c in each.commands.items()}
        grid = StudyGrid(
            [
                StudyCell(name=file, work=partial(run_command, text), is_done=declared.file(file).exists)
                for file, text in files.items()
            ]
        )
        run_grid(grid, make_slots(("cpu",), 1, (), Path(), is_reused=False), "results")
        write_atomically({path: text.encode() for path, text in Studies.load(Path()).pages.items()})
        grid.require_whole()


def run_command(text: str, _: str) -> None:
    """Run a command of this package, or a Python script, in this process."""
    from pixel2catch.cli.main import main

    program, *sys.argv = shlex.split(text)
    if program == "python":
        runpy.run_path(sys.argv[0], run_name="__main__")
        return
    sys.argv = [program, *sys.argv]
    if status := main(sys.argv[1:]):
        raise StudyError(f"'{text}' ended with status {status}")


def _has_cuda() -> bool:
    import torch

    return torch.cuda.is_available()
