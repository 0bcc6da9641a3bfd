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
from pixel2catch.files import plain, write_atomically

_PACKAGES = ("pixel2catch", "torch", "skrl", "mujoco", "mujoco-warp", "warp-lang", "numpy")


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Files of a run.

    `config.json` resolved configuration · `dynamics.json` of the robot, unless it was nominal ·
    `sessions.json` versions, revision, hardware of every start · `metrics.csv` and TensorBoard events ·
    `checkpoint.pt` to resume · `policy/` to use · `summary.json` how it ended.
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

    @property
    def dynamics(self) -> Path:
        """Copy of the dynamics file of the robot, unless it was nominal."""
        return self.path / "dynamics.json"

    @contextlib.contextmanager
    def open(self, *, resume: bool, dynamics: Path | None = None) -> Iterator[None]:
        """Make the folder, or see that there is something to resume. Folders left empty go again at the end.

        Args:
            resume: Whether to go on with the run in the folder.
            dynamics: Dynamics file of the robot; nominal if absent.

        Raises:
            CheckpointError: The folder holds a run already, holds none to resume or one of other dynamics, or
                cannot be made.
        """
        if resume and not self.checkpoint.exists():
            raise CheckpointError(f"'{self.path}' holds no checkpoint to resume; start without --resume.")
        if not resume and (self.path / "config.json").exists():
            raise CheckpointError(f"'{self.path}' holds a run already; name another folder, or add --resume.")
        if resume or self.dynamics.exists():
            self._require_dynamics(dynamics)
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

    def _require_dynamics(self, given: Path | None) -> None:
        """See that the given dynamics are those of the folder: that file, or none."""
        there = self.dynamics.read_bytes() if self.dynamics.exists() else None
        if there != (given.read_bytes() if given else None):
            fix = f"with --dynamics {self.dynamics}" if there else "without --dynamics"
            raise CheckpointError(
                f"'{self.path}' is of a robot with other dynamics; train {fix}, or name another folder."
            )

    def describe(self, config: Mapping[str, Any], num_processes: int, dynamics: Path | None = None) -> None:
        """Write the resolved configuration, copy the dynamics, append this session's circumstances."""
        self.write_json("config.json", config)
        if dynamics:
            write_atomically({self.dynamics: dynamics.read_bytes()})
        sessions_file = self.path / "sessions.json"
        sessions = json.loads(sessions_file.read_text()) if sessions_file.exists() else []
        session = {**circumstances(), "processes": num_processes}
        self.write_json("sessions.json", [*sessions, {**session, "config": config}])

    def write_json(self, name: str, content: Any) -> None:
        """Write a JSON file, all or nothing."""
        write_atomically({self.path / name: (json.dumps(content, indent=2, default=plain) + "\n").encode()})


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
