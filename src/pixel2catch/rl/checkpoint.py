"""Checkpoints: the full state of learning, so that a training goes on as if it had not been interrupted.

The environments are not part of it: a resumed training begins with new episodes.
"""

import dataclasses
import io
import json
import pickle
from pathlib import Path
from typing import Any

import torch

from pixel2catch.errors import CheckpointError
from pixel2catch.files import write_atomically
from pixel2catch.policy import PolicyContract
from pixel2catch.rl.learner import Learner

FORMAT_VERSION = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a training is.

    Attributes:
        transitions: Transitions learnt from.
        seconds: Wall-clock time spent, over all sessions [s].
    """

    transitions: int = 0
    seconds: float = 0.0


def save_checkpoint(path: Path, learner: Learner, contract: PolicyContract, progress: Progress) -> None:
    """Write the state of learning, all or nothing.

    Raises:
        OSError: It could not be written; the checkpoint that was there before is still there.
    """
    state = {
        "format_version": FORMAT_VERSION,
        "contract": json.dumps(contract.to_dict()),
        "progress": dataclasses.asdict(progress),
        "learner": learner.state_dict(),
        "random": _random_state(learner.cfg.device),
    }
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomically({path: buffer.getvalue()})


def load_checkpoint(path: Path, learner: Learner, contract: PolicyContract) -> Progress:
    """Put a learner and the random generators into the saved state.

    Raises:
        CheckpointError: The file is missing or damaged, or does not fit this learner.
        PolicyMismatchError: It was trained under another contract; the message names the fields.
    """
    state = _read(path, learner.cfg.device)
    saved = PolicyContract.from_dict(json.loads(state["contract"]))
    saved.require(contract)
    if saved.task != contract.task:
        raise CheckpointError(
            f"checkpoint '{path}' is of a training for the task '{saved.task}'; train with --task "
            f"{saved.task}, or name another folder."
        )
    try:
        learner.load_state_dict(state["learner"])
    except (KeyError, RuntimeError, ValueError) as error:
        raise CheckpointError(f"checkpoint '{path}' does not fit this configuration: {error}") from error
    torch.set_rng_state(state["random"]["cpu"].cpu())
    if "cuda" in state["random"] and learner.cfg.device.startswith("cuda"):
        torch.cuda.set_rng_state(state["random"]["cuda"].cpu(), learner.cfg.device)
    return Progress(**state["progress"])


def _read(path: Path, device: str) -> dict[str, Any]:
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except FileNotFoundError as error:
        raise CheckpointError(f"no checkpoint '{path}'; start without --resume.") from error
    except (RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise CheckpointError(f"checkpoint '{path}' is damaged ({error}); start without --resume.") from error
    version = state.get("format_version") if isinstance(state, dict) else None
    if version != FORMAT_VERSION:
        raise CheckpointError(f"checkpoint '{path}' has format {version}, this code reads {FORMAT_VERSION}.")
    return state


def _random_state(device: str) -> dict[str, torch.Tensor]:
    state = {"cpu": torch.get_rng_state()}
    return state | ({"cuda": torch.cuda.get_rng_state(device)} if device.startswith("cuda") else {})
