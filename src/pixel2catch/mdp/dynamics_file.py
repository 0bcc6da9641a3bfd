"""The dynamics file: what an identification writes, and training, evaluation and videos take."""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pixel2catch.checks import Range, Within, require_valid
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.files import decoded, json_text, read_json_object, reading, take_version, write_atomically
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

FORMAT_VERSION = 1  #: Version of the files. Raised when an older one can no longer be read.

Factors = tuple[Annotated[Range, Within(0.01, 100.0)], ...]  #: Ranges of factors on a gain.


@dataclass(frozen=True, kw_only=True)
class GainRanges:
    """Ranges of the factors on the gains of every joint, in joint order."""

    #: Factor on a joint's stiffness; one range is every joint's, none those of the robot's joint groups
    #: (Source: paper, Table I).
    stiffness_scale: Factors = ()
    damping_scale: Factors = ()  #: Factor on its damping, drawn apart; likewise.
    #: Whether the damping is also multiplied by the factor on the stiffness, where the fit determines their
    #: ratio better than each of them. Empty: for no joint.
    is_damping_relative: tuple[bool, ...] = ()

    def of(self, workcell: WorkcellSpec) -> "GainRanges":
        """Return the ranges with an entry for each joint of a work cell: of none, one, or as many."""
        own = tuple(group.gain_range for group in workcell.groups for _ in group.joints)
        every = {"stiffness_scale": own, "damping_scale": own, "is_damping_relative": (False,) * len(own)}
        return GainRanges(**{key: _for_each(getattr(self, key), each, key) for key, each in every.items()})


Entry = TypeVar("Entry")


def _for_each(values: tuple[Entry, ...], default: tuple[Entry, ...], name: str) -> tuple[Entry, ...]:
    if len(values) not in (0, 1, len(default)):
        raise InvalidValueError(f"{name} has {len(values)} entries; it needs {len(default)}, one a joint")
    return values * len(default) if len(values) == 1 else values or default


@dataclass(frozen=True, kw_only=True)
class DynamicsFile:
    """Content of a dynamics file; the defaults are the simulator's robot and the paper's ranges."""

    dynamics: JointDynamics = field(default_factory=JointDynamics.of)  #: Of some joints or of all.
    gains: GainRanges = GainRanges()  #: How the gains are randomised; the file has those of its joints.
    workcell: WorkcellSpec = UR5E_ALLEGRO  #: Whose joints they are.
    #: Joints whose motion, held out from the fit, their command alone predicts better than these dynamics.
    worse_than_command: tuple[str, ...] = ()

    def save(self, path: Path) -> None:
        """Write the file, all of it or nothing. Its folder must exist."""
        full = dataclasses.asdict(self.gains.of(self.workcell))
        names = [joint.name for joint in self.workcell.joints if joint.name in self.dynamics.joints]
        dynamics = self.dynamics.select(names)
        rows = _rows(dynamics, self.workcell)
        ranges = {name: [values[row] for row in rows] for name, values in full.items()}
        content = {"format_version": FORMAT_VERSION, **dataclasses.asdict(dynamics), "gain_ranges": ranges}
        if self.worse_than_command:
            content["worse_than_command"] = self.worse_than_command
        write_atomically({path: json_text(content)})

    @classmethod
    def load(cls, path: Path, workcell: WorkcellSpec = UR5E_ALLEGRO) -> "DynamicsFile":
        """Read a file of a work cell's joints.

        Without ranges in it, the gains keep the paper's. Warns of joints that are worse than their command.
        """
        with reading("dynamics file", path, "Identify again, or correct that entry."):
            content = read_json_object(path)
            take_version(content, FORMAT_VERSION)
            ranges = content.pop("gain_ranges", {})
            worse = tuple(content.pop("worse_than_command", ()))
            dynamics = decoded(JointDynamics, content)
            dynamics.require(workcell.joints)
            if unknown := [name for name in worse if name not in dynamics.joints]:
                raise UnknownNameError("joint in worse_than_command", unknown[0], dynamics.joints)
            gains = _gains(ranges, _rows(dynamics, workcell), workcell)
        if worse:
            warnings.warn(
                f"{path}: of {', '.join(worse)}, the command alone predicts motion better than these "
                "dynamics. Record the commands that are sent, not the controller's target; identify again.",
                stacklevel=2,
            )
        return cls(dynamics=dynamics, gains=gains, workcell=workcell, worse_than_command=worse)


def _rows(dynamics: JointDynamics, workcell: WorkcellSpec) -> list[int]:
    return [workcell.joint_names.index(name) for name in dynamics.joints]


def _gains(content: Mapping[str, Any], rows: Sequence[int], workcell: WorkcellSpec) -> GainRanges:
    gains = decoded(GainRanges, dict(content), "gain_ranges")
    require_valid(gains, "gain_ranges")
    whole = GainRanges().of(workcell)
    for name in content:
        if len(values := getattr(gains, name)) != len(rows):
            raise InvalidValueError(f"{name} has {len(values)} entries; it needs {len(rows)}")
        columns = dict(enumerate(getattr(whole, name))) | dict(zip(rows, values, strict=True))
        whole = dataclasses.replace(whole, **{name: tuple(columns.values())})
    return whole
