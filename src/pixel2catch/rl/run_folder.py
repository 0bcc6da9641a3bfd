"""The folder of a training run: where its files are, and under which circumstances they came about."""

import contextlib
import dataclasses
import datetime
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from pixel2catch.errors import CheckpointError
from pixel2catch.files import write_atomically

_PACKAGES = ("pixel2catch", "torch", "skrl", "mujoco", "mujoco-warp", "warp-lang", "numpy")


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Files of a run.

    `config.json` resolved configuration · `sessions.json` versions, revision, hardware of every start ·
    `metrics.csv` and TensorBoard events · `checkpoint.pt` to resume · `policy/` to use ·
    `summary.json` how it ended.
    """

    path: Path

    @property
    def checkpoint(self) -> Path:
        """State of learning, for --resume."""
        return self.path / "checkpoint.pt"

    @property
    def policy(self) -> Path:
        """The policy, for every other command."""
        return self.path / "policy"

    @contextlib.contextmanager
    def open(self, *, resume: bool) -> Iterator[None]:
        """Make the folder, or see that there is something to resume. Folders left empty go again at the end.

        Raises:
            CheckpointError: The folder holds a run already, holds none to resume, or cannot be made.
        """
        if resume and not self.checkpoint.exists():
            raise CheckpointError(f"'{self.path}' holds no checkpoint to resume; start without --resume.")
        if not resume and (self.path / "config.json").exists():
            raise CheckpointError(f"'{self.path}' holds a run already; name another folder, or add --resume.")
        made = [folder for folder in (self.path, *self.path.parents) if not folder.exists()]
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CheckpointError(f"cannot make the run folder '{self.path}': {error.strerror}.") from error
        try:
            yield
        finally:
            with contextlib.suppress(OSError):  # the first that is not empty ends it
                for folder in made:
                    folder.rmdir()

    def describe(self, config: Mapping[str, Any], num_processes: int) -> None:
        """Write the resolved configuration and append this session's circumstances."""
        self.write_json("config.json", config)
        sessions_file = self.path / "sessions.json"
        sessions = json.loads(sessions_file.read_text()) if sessions_file.exists() else []
        session = {**circumstances(), "processes": num_processes}
        self.write_json("sessions.json", [*sessions, {**session, "config": config}])

    def write_json(self, name: str, content: Any) -> None:
        """Write a JSON file, all or nothing. What JSON does not know is written as text."""
        write_atomically({self.path / name: (json.dumps(content, indent=2, default=str) + "\n").encode()})


def circumstances() -> dict[str, Any]:
    """Return when, with which versions and on which machine this process runs."""
    return {
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": sys.argv,
        "git_revision": _git_revision(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in _PACKAGES},
        "platform": platform.platform(),
        "cpu_cores": os.cpu_count(),
        "gpus": [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())],
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _git_revision() -> str | None:
    """Return the revision that this package's source is at, with "+" if it was changed since."""
    git = ["git", "-C", str(Path(__file__).parent)]
    try:
        revision = subprocess.run(
            [*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True
        ).stdout
        changes = subprocess.run(
            [*git, "status", "--porcelain", "-uno"], capture_output=True, text=True, check=True
        ).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    return revision.strip() + ("+" if changes.strip() else "")
