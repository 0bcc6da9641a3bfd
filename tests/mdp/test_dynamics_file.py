"""The dynamics file: what it keeps, what it leaves out, and how it is refused."""

import json
from dataclasses import asdict

import numpy as np
import pytest

from pixel2catch.errors import InvalidValueError
from pixel2catch.files import json_text
from pixel2catch.mdp.dynamics_file import DynamicsFile, GainRanges
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

ELBOW = 2
ELBOW_AND_INDEX = ("elbow_joint", "index_joint_1")
DYNAMICS = JointDynamics.of().select(ELBOW_AND_INDEX)
DYNAMICS = DYNAMICS.with_values(
    latency=0.0123456789, filter_gain=[300.0, np.inf], filter_lookahead=[0.1, 0.0]
)


def with_elbow(columns: tuple, value: object) -> tuple:
    return (*columns[:ELBOW], value, *columns[ELBOW + 1 :])


PAPER = GainRanges().of(UR5E_ALLEGRO)
GAINS = GainRanges(
    damping_scale=with_elbow(PAPER.damping_scale, (0.95, 1.05)),
    is_damping_relative=with_elbow((False,) * 19, True),
).of(UR5E_ALLEGRO)


def test_file_keeps_every_value(tmp_path):
    file = DynamicsFile(dynamics=DYNAMICS, gains=GAINS)
    file.save(tmp_path / "dynamics.json")
    assert DynamicsFile.load(tmp_path / "dynamics.json") == file
    content = json.loads((tmp_path / "dynamics.json").read_text())
    assert content["filter_gain"] == [300.0, None]
    assert content["gain_ranges"]["damping_scale"] == [[0.95, 1.05], [0.7, 1.3]]


def test_loading_warns_of_joints_that_are_worse_than_their_command(tmp_path):
    file = DynamicsFile(dynamics=DYNAMICS, gains=GAINS, worse_than_command=("elbow_joint",))
    file.save(tmp_path / "dynamics.json")
    with pytest.warns(UserWarning, match="dynamics.json: of elbow_joint, the command alone predicts motion"):
        assert DynamicsFile.load(tmp_path / "dynamics.json") == file


def test_file_without_ranges_keeps_the_papers(tmp_path):
    path = tmp_path / "dynamics.json"
    path.write_text(json_text({"format_version": 1, **asdict(DYNAMICS)}))
    assert DynamicsFile.load(path) == DynamicsFile(dynamics=DYNAMICS, gains=PAPER)


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("format_version", 9, "format_version is 9"),
        ("worse_than_command", ["wrist_9_joint"], "unknown joint in worse_than_command"),
        ("joints", ["elbow_joint", "index_joint_9"], "Did you mean"),
        ("joints", ["index_joint_1", "elbow_joint"], "in the order"),
        ("stiffness", [1.0, -2.0], "stiffness of index_joint_1 is -2; give 1e-09"),
        ("latency", [float("nan"), 0.0], "'latency' has the number nan"),
        ("damping", [1.0], "damping"),
        ("weight", [1.0, 1.0], "unknown field 'weight'"),
        ("gain_ranges", {"stiffness": [[1, 1], [1, 1]]}, "stiffness"),
        ("gain_ranges", {"stiffness_scale": [[0.9, 1.1]]}, "stiffness_scale has 1 entries; it needs 2"),
        ("gain_ranges", {"stiffness_scale": [[1.1, 0.9], [1, 1]]}, "stiffness_scale is 1.1 0.9"),
        ("gain_ranges", {"damping_scale": [[1, 1], [0, 1]]}, "damping_scale is 0; it must be from 0.01"),
        ("gain_ranges", {"is_damping_relative": [True, 1]}, "is_damping_relative"),
    ],
)
def test_bad_file_names_its_fault(tmp_path, entry, value, message):
    path = tmp_path / "dynamics.json"
    DynamicsFile(dynamics=DYNAMICS, gains=GAINS).save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {entry: value}))
    with pytest.raises(InvalidValueError, match=message) as error:
        DynamicsFile.load(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("content", ["", '{"format_version": 1, "joints": 3}'])
def test_damaged_file_is_refused(tmp_path, content):
    path = tmp_path / "dynamics.json"
    path.write_text(content)
    with pytest.raises(InvalidValueError, match="cannot read the dynamics file"):
        DynamicsFile.load(path)
    with pytest.raises(InvalidValueError, match="No such file"):
        DynamicsFile.load(tmp_path / "missing.json")
