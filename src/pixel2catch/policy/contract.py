"""The contract of a policy: everything outside its networks that must be the same wherever it acts.

A policy is a function of numbers. Which numbers, in which order and unit, seen by which camera, and what
becomes of its outputs is written here, saved beside the networks and compared on loading: a policy that does
not fit fails with the name of the field instead of moving a robot in a wrong way.
"""

import dataclasses
import json
from collections.abc import Iterator, Mapping
from typing import Any

from pixel2catch.errors import InvalidValueError, PolicyMismatchError
from pixel2catch.files import decoded
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

FORMAT_VERSION = 2
"""Version of the files that `Policy.save` writes. Raised when an older file can no longer be read."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AgentContract:
    """Inputs and outputs of one agent's network."""

    #: Name and size of every observation term, in the order of the input vector.
    observation: tuple[tuple[str, int], ...]
    joints: tuple[str, ...]  #: Names of the joints, in the order of the output vector.

    @property
    def num_inputs(self) -> int:
        """Length of the observation vector."""
        return sum(size for _, size in self.observation)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyContract:
    """What the policy of a method expects of the world and promises to it."""

    method: str  #: Name of the method.
    pixel_features: tuple[str, ...]  #: Names of the pixel features, in their order within a frame.
    agents: dict[str, AgentContract]  #: The agents by name.
    #: How an action becomes a joint target, by joint: the fields of its `JointCommand` [rad].
    commands: dict[str, dict[str, float]]
    control_dt: float  #: Time between two actions [s].
    #: The fields of its `CameraSpec`: size and intrinsics [px], position [m], orientation.
    camera: dict[str, int | float | tuple[float, ...]]
    workcell: str  #: Name of the work cell.
    task: str = "nominal"  #: Name of the task that it was trained for; it may act in others.
    format_version: int = FORMAT_VERSION  #: Version of the file format.

    def to_dict(self) -> dict[str, Any]:
        """Return plain dictionaries, lists and numbers, ready for JSON."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "PolicyContract":
        """Read what `to_dict` returned.

        Raises:
            PolicyMismatchError: A field is missing or unknown, or the file has another format version.
        """
        data = _of_version_1(data) if data.get("format_version") == 1 else data
        version = data.get("format_version")
        if version != FORMAT_VERSION:
            raise PolicyMismatchError(
                f"policy field 'format_version' is {version}, this code reads {FORMAT_VERSION}; "
                "train again or use the version of this package that wrote the policy."
            )
        try:
            return decoded(cls, dict(data))
        except InvalidValueError as error:
            raise PolicyMismatchError(f"policy {error}; train again.") from error

    def require(self, expected: "PolicyContract") -> None:
        """Compare with the contract of the place where the policy is to act.

        Raises:
            PolicyMismatchError: They differ; the message names every field that does, with both values.
        """
        same_task = dataclasses.replace(expected, task=self.task)
        ours, theirs = dict(leaves(self.to_dict())), dict(leaves(same_task.to_dict()))
        fields = [name for name in ours | theirs if ours.get(name) != theirs.get(name)]
        if fields:
            lines = [f"  {name}: policy {ours.get(name)!r}, here {theirs.get(name)!r}" for name in fields]
            raise PolicyMismatchError("the policy does not fit:\n" + "\n".join(lines))


def _of_version_1(data: Mapping[str, Any]) -> dict[str, Any]:
    """What files say that knew one robot only, with a left or a right hand."""
    content = {**data, "format_version": FORMAT_VERSION}
    hand = content.pop("handedness", "left")
    name = UR5E_ALLEGRO.name
    return content | {"workcell": name if hand == "left" else f"{name}_{hand}"}


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of nested mappings: what two of them are compared by."""
    if isinstance(value, Mapping) and value:
        for key, entry in value.items():
            yield from leaves(entry, f"{name}.{key}" if name else str(key))
    else:
        yield name, value
