"""The folder of a training run: where its files are, and how they are written."""

import contextlib
import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pixel2catch.circumstances import circumstances
from pixel2catch.errors import CheckpointError
from pixel2catch.files import plain, write_atomically


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Files of a run.

    `config.json` resolved configuration · `dynamics.json`, `camera.json` copies of what it was given ·
    `sessions.json` versions, revision, hardware of every start · `metrics.csv` and TensorBoard events ·
    `checkpoint.pt` to resume · `policy/` to use · `summary.json` how it ended.

    Attributes:
        path: The folder.
        inputs: Files that the run depends on, by the option that names them; some may be absent.
    """

    path: Path
    inputs: Mapping[str, Path | None] = dataclasses.field(default_factory=dict)

    @property
    def checkpoint(self) -> Path:
        """State of learning, for --resume."""
        return self.path / "checkpoint.pt"

    @property
    def policy(self) -> Path:
        """The policy, for every other command."""
        return self.path / "policy"

    def copy_of(self, name: str) -> Path:
        """Where the copy of an input is, if it was given."""
        return self.path / f"{name}.json"

    @contextlib.contextmanager
    def open(self, *, resume: bool) -> Iterator[None]:
        """Make the folder, or see that there is something to resume. Folders left empty go again at the end.

        Args:
            resume: Whether to go on with the run in the folder.

        Raises:
            CheckpointError: The folder holds a run already, holds none to resume or one with other inputs, or
                cannot be made.
        """
        if resume and not self.checkpoint.exists():
            raise CheckpointError(f"'{self.path}' holds no checkpoint to resume; start without --resume.")
        if not resume and (self.path / "config.json").exists():
            raise CheckpointError(f"'{self.path}' holds a run already; name another folder, or add --resume.")
        for name, given in self.inputs.items():
            if resume or self.copy_of(name).exists():
                self._require_same(name, given)
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

    def _require_same(self, name: str, given: Path | None) -> None:
        """See that an input is that of the folder: the same file, or none."""
        copy = self.copy_of(name)
        there = copy.read_bytes() if copy.exists() else None
        if there != (given.read_bytes() if given else None):
            which, fix = (
                ("no", f"without --{name}") if there is None else ("another", f"with --{name} {copy}")
            )
            raise CheckpointError(
                f"'{self.path}' has {which} {name} file; train {fix}, or name another folder."
            )

    def describe(self, config: Mapping[str, Any], num_processes: int) -> None:
        """Write the resolved configuration, copy the inputs, append this session's circumstances."""
        self.write_json("config.json", config)
        write_atomically(
            {self.copy_of(name): file.read_bytes() for name, file in self.inputs.items() if file}
        )
        sessions_file = self.path / "sessions.json"
        sessions = json.loads(sessions_file.read_text()) if sessions_file.exists() else []
        session = {**circumstances(), "processes": num_processes}
        self.write_json("sessions.json", [*sessions, {**session, "config": config}])

    def write_json(self, name: str, content: Any) -> None:
        """Write a JSON file, all or nothing."""
        write_atomically({self.path / name: (json.dumps(content, indent=2, default=plain) + "\n").encode()})
