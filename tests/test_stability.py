"""What docs/stability.md promises is what `stable.json` lists; `python tests/test_stability.py` writes it."""

import argparse
import inspect
import json
import warnings
from dataclasses import fields
from pathlib import Path
from typing import Any

import tyro

import pixel2catch as p2c
from pixel2catch.camera import camera_file
from pixel2catch.cli.fields import PREFIX, default_of, option_rules
from pixel2catch.cli.main import COMMANDS, load_command
from pixel2catch.identification import recording
from pixel2catch.mdp import dynamics_file
from pixel2catch.mdp.randomization import GainRanges
from pixel2catch.policy import contract
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.constants import CameraSpec

STARS = {inspect.Parameter.VAR_POSITIONAL: "*", inspect.Parameter.VAR_KEYWORD: "**"}
FILE = Path(__file__).with_name("stable.json")


def options_of(name: str) -> list[str]:
    command = load_command(name)
    with warnings.catch_warnings(action="ignore"):  # tyro has no other way to list options
        parser = tyro.extras.get_parser(command, default=default_of(command, []), registry=option_rules())
    shown = [action for action in parser._actions if action.help != argparse.SUPPRESS]
    names = [action.option_strings[0] if action.option_strings else action.dest for action in shown]
    return sorted(option for option in names if option != "-h" and not option.startswith(PREFIX))


def signature_of(name: str) -> str:
    value = getattr(p2c, name)
    kind = "class" if inspect.isclass(value) else "function" if inspect.isroutine(value) else "value"
    if kind == "value" or value is p2c.Pixel2CatchError:
        return kind
    names = [
        f"{STARS.get(each.kind, '')}{each.name}" + ("" if each.default is each.empty else "=")
        for each in inspect.signature(value).parameters.values()
    ]
    return f"{kind} ({', '.join(names)})"


def names_of(kind: Any) -> list[str]:
    return sorted(field.name for field in fields(kind))


def listing() -> dict[str, Any]:
    """Return commands and options, the Python API, and the fields of files with their versions."""
    versions = {
        "policy": contract.FORMAT_VERSION,
        "dynamics": dynamics_file.FORMAT_VERSION,
        "camera": camera_file.FORMAT_VERSION,
        "trajectory": recording.FORMAT_VERSION,
    }
    kinds = {
        "policy": contract.PolicyContract,
        "policy.agents": contract.AgentContract,
        "dynamics": JointDynamics,
        "dynamics.gain_ranges": GainRanges,
        "camera": camera_file.CameraFile,
        "camera.camera": CameraSpec,
        "profile": Profile,
    }
    return {
        "commands": {name: options_of(name) for name in COMMANDS},
        "python": {name: signature_of(name) for name in sorted(p2c.__all__)},
        "format_versions": versions,
        "fields": {name: names_of(kind) for name, kind in kinds.items()},
    }


def test_stable_interfaces_are_those_that_are_listed():
    """A change is deliberate: write the list anew, and follow docs/stability.md."""
    assert listing() == json.loads(FILE.read_text("utf-8"))


if __name__ == "__main__":
    FILE.write_text(json.dumps(listing(), indent=1, sort_keys=True) + "\n", "utf-8")
