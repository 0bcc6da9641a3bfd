"""The results of the stress suite: every policy under every setting.

OUT/cells/POLICY/SETTING.json    metrics of a policy under a setting, and how they were obtained
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pixel2catch.errors import InvalidValueError, StudyError
from pixel2catch.evaluation.loading import load_policy, shipped_policies
from pixel2catch.evaluation.stress.axes import Setting
from pixel2catch.methods import METHODS

Json = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class StressCfg:
    """How each result is obtained.

    Attributes:
        objects: Names of the objects; each throw draws one.
        num_envs: Throws in a round.
        trials: Rounds.
        seed: Seed of the first round; the next round has the next one.
        device: "cpu" or a CUDA device.
        physics_hz: Physics steps in a second.
    """

    objects: tuple[str, ...]
    num_envs: int = 100
    trials: int = 2
    seed: int = 0
    device: str = "cpu"
    physics_hz: float = 600.0


@dataclass(frozen=True, kw_only=True)
class PolicyEntry:
    """A policy of the suite.

    Attributes:
        name: Its name in tables and folders.
        folder: Where it is.
        method: Name of the method that it was trained with.
        task: Name of the task that it was trained for.
    """

    name: str
    folder: Path
    method: str
    task: str = "nominal"


@dataclass(frozen=True, kw_only=True)
class Result:
    """A policy under a setting, and the file of its metrics."""

    policy: PolicyEntry
    setting: Setting
    file: Path

    def read(self) -> Json | None:
        """Its metrics, if they are there.

        Raises:
            StudyError: If the file is damaged.
        """
        try:
            return json.loads(self.file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise StudyError(f"'{self.file}' is damaged ({error}); delete it.") from error


def find_policies(folders: Sequence[Path]) -> tuple[PolicyEntry, ...]:
    """The policies in these folders, or all that are shipped if there are none.

    Raises:
        PolicyMismatchError: If a policy does not fit this code, or none is shipped.
        InvalidValueError: If two have the same name.
    """
    found = [_entry(folder) for folder in folders or shipped_policies().values()]
    if not folders:
        found.sort(key=lambda each: (list(METHODS).index(each.method.partition("+")[0]), each.name))
    names = [each.name for each in found]
    for name in names:
        if names.count(name) > 1:
            raise InvalidValueError(f"two policies are called '{name}'; rename one of their folders.")
    return tuple(found)


def plan_results(
    policies: Sequence[PolicyEntry], settings: Sequence[Setting], out: Path
) -> tuple[Result, ...]:
    """All results, setting by setting."""
    return tuple(
        Result(policy=policy, setting=setting, file=out / "cells" / policy.name / f"{setting.name}.json")
        for setting in settings
        for policy in policies
    )


def _entry(folder: Path) -> PolicyEntry:
    """The policy in a folder or in the run folder around it; it is called as the folder of the run."""
    policy, method = load_policy(folder)
    resolved = folder.resolve()
    name = resolved.parent.name if resolved.name == "policy" else resolved.name
    return PolicyEntry(name=name, folder=folder, method=method.name, task=policy.contract.task)
