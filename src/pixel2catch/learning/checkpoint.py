"""`RunFolder`, the files of a training run, and `Checkpoint`, from which a training resumes.

The environments are not part of a checkpoint: a resumed training begins with new episodes.
"""

import dataclasses
import io
import json
import pickle
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import torch

from pixel2catch import files
from pixel2catch.arrays import open_archive
from pixel2catch.errors import CheckpointError, InvalidValueError
from pixel2catch.learning.config import CONFIG_FILE
from pixel2catch.learning.mappo import Mappo
from pixel2catch.policy import PolicyContract
from pixel2catch.reports import circumstances

FORMAT_VERSION = 2
FIX = "Start without --resume, or with the configuration that it was started with."


@dataclasses.dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a training is."""

    transitions: int = 0  #: Transitions that were used.
    seconds: float = 0.0  #: Wall-clock time spent, over all sessions [s].


def save_checkpoint(path: Path, mappo: Mappo, contract: PolicyContract, progress: Progress) -> None:
    """Write the state of learning, all or nothing; the previous checkpoint stays where that fails."""
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """The state of a training that was read from a file."""

    path: Path  #: The file.
    contract: PolicyContract  #: What the policy needs to act.
    progress: Progress  #: How far the training is.
    state: dict[str, Any]  #: State of the learner and of the random generators.

    @classmethod
    def load(cls, path: Path, device: str) -> "Checkpoint":
        """Read what `save_checkpoint` wrote. Raise CheckpointError if the file is missing or damaged."""
        with files.reading("checkpoint", path, FIX, CheckpointError):
            data = files.read_bytes(path, files.MOST_WEIGHTS)
            try:
                open_archive(data, files.MOST_WEIGHTS).close()
                state = torch.load(io.BytesIO(data), map_location=device, weights_only=True)
            except (RuntimeError, EOFError, pickle.UnpicklingError, BadZipFile) as error:
                raise InvalidValueError(f"it is damaged ({error})") from error
            files.take_version(state if isinstance(state, dict) else {}, FORMAT_VERSION)
            return cls(
                path=path,
                contract=PolicyContract.from_dict(files.json_object(state["contract"])),
                progress=files.decoded(Progress, state["progress"]),
                state=state,
            )

    def restore(self, mappo: Mappo) -> None:
        """Put a learner and the random generators into this state.

        Raises PolicyMismatchError for another contract, CheckpointError for another learner.
        """
        self.contract.require(mappo.contract)
        random, device = self.state["random"], mappo.cfg.device
        with files.reading("checkpoint", self.path, FIX, CheckpointError):
            try:
                mappo.load_state_dict(self.state["mappo"])
                torch.set_rng_state(random["cpu"].cpu())
                if "cuda" in random and device.startswith("cuda"):
                    torch.cuda.set_rng_state(random["cuda"].cpu(), device)
            except RuntimeError as error:
                raise InvalidValueError(f"it does not fit this configuration: {error}") from error


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Files of a run.

    `config.json` resolved configuration, with the values of dynamics and camera files · `sessions.json`
    versions, revision, hardware of every start · `metrics.csv` and TensorBoard events · `checkpoint.pt` to
    resume · `policy/` to use · `summary.json` how it ended.
    """

    path: Path  #: The folder.

    @property
    def checkpoint(self) -> Path:
        """File with the state of the learner, which --resume reads."""
        return self.path / "checkpoint.pt"

    @property
    def policy(self) -> Path:
        """The policy, for every other command."""
        return self.path / "policy"

    @contextmanager
    def open(self, *, resume: bool) -> Iterator[None]:
        """Make the folder, or check that it can be resumed; at the end remove folders that stayed empty."""
        if resume and not self.checkpoint.exists():
            raise CheckpointError(f"'{self.path}' holds no checkpoint to resume; start without --resume.")
        if not resume and (self.path / CONFIG_FILE).exists():
            raise CheckpointError(f"'{self.path}' holds a run already; name another folder, or add --resume.")
        with files.held_folder(self.path, is_new=False):
            yield

    def describe(self, config: Mapping[str, Any], num_processes: int) -> None:
        """Write the resolved configuration, append this session's circumstances."""
        file, before = self.path / "sessions.json", list[dict[str, Any]]()
        if file.exists():
            with files.reading("sessions", file, "Remove this file; nothing else needs it.", CheckpointError):
                content = files.parse_json(files.read_text(file, files.MOST_WEIGHTS))
                before = files.decoded(list[dict[str, Any]], content)
        session = {**circumstances(), "processes": num_processes, "config": config}
        self.write_json(CONFIG_FILE, config)
        self.write_json("sessions.json", [*before, session])

    def write_json(self, name: str, content: Any) -> None:
        files.write_atomically({self.path / name: files.json_text(content)})
