"""The folder of a training run, and the checkpoint in it, from which a training goes on as if uninterrupted.

The environments are not part of a checkpoint: a resumed training begins with new episodes.
"""

import contextlib
import dataclasses
import io
import json
import pickle
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import torch

from pixel2catch import files
from pixel2catch.archives import open_archive
from pixel2catch.circumstances import circumstances
from pixel2catch.errors import CheckpointError, InvalidValueError
from pixel2catch.learning.mappo import Mappo
from pixel2catch.policy import PolicyContract

FORMAT_VERSION = 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a training is."""

    transitions: int = 0  #: Transitions learnt from.
    seconds: float = 0.0  #: Wall-clock time spent, over all sessions [s].


def save_checkpoint(path: Path, mappo: Mappo, contract: PolicyContract, progress: Progress) -> None:
    """Write the state of learning, all or nothing.

    Raises:
        OSError: It could not be written; the checkpoint that was there before is still there.
    """
    random = {"cpu": torch.get_rng_state()}
    if mappo.cfg.device.startswith("cuda"):
        random["cuda"] = torch.cuda.get_rng_state(mappo.cfg.device)
    state = {
        "format_version": FORMAT_VERSION,
        "contract": json.dumps(contract.to_dict()),
        "progress": dataclasses.asdict(progress),
        "mappo": mappo.state_dict(),
        "random": random,
    }
    buffer = io.BytesIO()
    torch.save(state, buffer)
    files.write_atomically({path: buffer.getvalue()})


def load_checkpoint(path: Path, mappo: Mappo, contract: PolicyContract) -> Progress:
    """Put a learner and the random generators into the saved state.

    Raises:
        CheckpointError: The file is missing or damaged, or does not fit this learner.
        PolicyMismatchError: It was trained under another contract; the message names the fields.
    """
    fix = "Start without --resume, or with the configuration that it was begun with."
    with files.reading("checkpoint", path, fix, CheckpointError):
        state = _read(path, mappo.cfg.device)
        saved = PolicyContract.from_dict(files.json_object(state["contract"]))
        progress = files.decoded(Progress, state["progress"])
    saved.require(contract)
    if saved.task != contract.task:
        raise CheckpointError(
            f"checkpoint '{path}' is of a training for the task '{saved.task}'; train with --task "
            f"{saved.task}, or name another folder."
        )
    with files.reading("checkpoint", path, fix, CheckpointError):
        try:
            mappo.load_state_dict(state["mappo"])
            torch.set_rng_state(state["random"]["cpu"].cpu())
            if "cuda" in state["random"] and mappo.cfg.device.startswith("cuda"):
                torch.cuda.set_rng_state(state["random"]["cuda"].cpu(), mappo.cfg.device)
        except RuntimeError as error:
            raise InvalidValueError(f"it does not fit this configuration: {error}") from error
    return progress


def _read(path: Path, device: str) -> dict[str, Any]:
    data = files.read_bytes(path, files.MOST_WEIGHTS)
    try:
        open_archive(data, files.MOST_WEIGHTS).close()
        state = torch.load(io.BytesIO(data), map_location=device, weights_only=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError, BadZipFile) as error:
        raise InvalidValueError(f"it is damaged ({error})") from error
    version = state.get("format_version") if isinstance(state, dict) else None
    if version != FORMAT_VERSION:
        raise InvalidValueError(f"it has format {version}, this code reads {FORMAT_VERSION}")
    return state


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Files of a run.

    `config.json` resolved configuration · `dynamics.json`, `camera.json` copies of what it was given ·
    `sessions.json` versions, revision, hardware of every start · `metrics.csv` and TensorBoard events ·
    `checkpoint.pt` to resume · `policy/` to use · `summary.json` how it ended.
    """

    path: Path  #: The folder.
    #: Files that the run depends on, by the option that names them; some may be absent.
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
        files.write_atomically(
            {self.copy_of(name): file.read_bytes() for name, file in self.inputs.items() if file}
        )
        sessions_file = self.path / "sessions.json"
        sessions = files.parse_json(files.read_text(sessions_file)) if sessions_file.exists() else []
        session = {**circumstances(), "processes": num_processes}
        self.write_json("sessions.json", [*sessions, {**session, "config": config}])

    def write_json(self, name: str, content: Any) -> None:
        """Write a JSON file, all or nothing."""
        files.write_atomically({self.path / name: files.json_text(content).encode()})
