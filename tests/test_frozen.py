"""Behaviour that no rebuilding may change: compiled models, observations, and outcomes of throws.

Results record a hash of it, `pixel2catch.behaviour`. `python tests/test_frozen.py` writes files and hashes
anew, after a change of the robot or the task that is meant. Numbers within the tolerance are kept.
"""

import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pixel2catch import behaviour
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.evaluation.protocol import EvaluationCfg, evaluate
from pixel2catch.mdp.control_step import take
from pixel2catch.methods import find_method
from pixel2catch.scene.objects import OBJECTS, SEEN
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.shipped import DEFAULT_POLICY, shipped_policies
from pixel2catch.workcells import workcells

FOLDER = Path(__file__).parent / "frozen"
MODELS, OBSERVATIONS, THROWS = FOLDER / "models.npz", FOLDER / "observations.npz", FOLDER / "throws.json"
PHYSICS_HZ, SEED = 240.0, 7
HOME = "ur5e_allegro"  #: The work cell that is frozen with all objects, others with the first one alone.
DERIVED = ("plugin", "bvh_", "oct_", "mesh_")
"""Fields that follow from the others, or from the meshes of the objects, which are large."""

METHODS = ("proposed", "catch_alone+fit", "catch_teacher+age", "catch_alone+anycamera")
"""Methods whose observations together have every term."""

NUM_ENVS, NUM_STEPS, EVERY = 2, 25, 5
"""Environments, control steps, and steps from one observation to the next."""
MODEL_TOLERANCE = {"rtol": 1e-9, "atol": 1e-12}
OBSERVATION_TOLERANCE = {"rtol": 1e-4, "atol": 1e-4}  #: Of 32-bit numbers, by other processors' rounding.
HASH = 12  #: Characters of a hash.

Arrays = dict[str, np.ndarray]


def model_fields(workcell: str, object_name: str) -> Arrays:
    """All numbers of the compiled model, and the names of everything in it."""
    model = build_model(SceneCfg(workcell=workcell), object_name)
    arrays = {name: getattr(model, name) for name in dir(model) if not name.startswith(("_", *DERIVED))}
    options = {f"opt.{name}": getattr(model.opt, name) for name in dir(model.opt) if not name.startswith("_")}
    fields = {
        n: np.array(v) for n, v in (arrays | options).items() if isinstance(v, int | float | np.ndarray)
    }
    return fields | {"names": np.frombuffer(model.names, dtype=np.uint8)}


def model_arrays(workcell: str) -> Arrays:
    """The fields of the models of a work cell, with one entry for each object where they differ."""
    models = [
        model_fields(workcell, name) for name in (OBJECTS if workcell == HOME else [next(iter(OBJECTS))])
    ]
    stacked = {field: np.stack([model[field] for model in models]) for field in models[0]}
    return {f: v[:1] if all(np.array_equal(each, v[0]) for each in v) else v for f, v in stacked.items()}


def observation_arrays(workcell: str) -> Arrays:
    """Observations of agents, and inputs of value networks, in throws with given actions."""
    arrays: Arrays = {}
    for method in (find_method(name, workcells()[workcell]) for name in METHODS):
        task = CatchEnvCfg(scene=SceneCfg(workcell=workcell, physics_hz=PHYSICS_HZ), objects=SEEN)
        env = CatchEnv(task, method, num_envs=NUM_ENVS, device="cpu", seed=SEED)
        env.reset()
        rows = []
        for step in range(NUM_STEPS):
            action = 0.3 * torch.sin(0.4 * step + torch.arange(env.world.joint_pos.shape[1]))
            actions = {
                agent.name: take(action.expand(NUM_ENVS, -1), agent.joints) for agent in env.method.agents
            }
            observation = env.step(actions).observation
            if step % EVERY == EVERY - 1:
                seen = observation.policy | {"state": observation.state}
                rows.append({name: values.numpy().copy() for name, values in seen.items()})
        env.close()
        arrays |= {f"{method.name}/{name}": np.stack([row[name] for row in rows]) for name in rows[0]}
    return arrays


@cache
def outcomes(policy_name: str) -> dict[str, str]:
    """Which of the throws were tracked, caught and verified, one digit a throw."""
    policy, method = load_policy(Path(policy_name))
    task = task_of(policy, PHYSICS_HZ)
    trials = evaluate(policy, method, EvaluationCfg(objects=SEEN, trials=1, seed=SEED, task=task))
    flags = {
        "tracked": trials.record.is_tracked,
        "caught": trials.record.is_success,
        "verified": trials.is_verified,
    }
    return {name: "".join(str(int(flag)) for flag in values) for name, values in flags.items()}


def frozen(file: Path, workcell: str) -> Arrays:
    """The arrays of a work cell in a frozen file; none if it has none."""
    with np.load(file) as found:
        if workcell not in found:
            return {}
        values, shapes = found[workcell], json.loads(str(found[f"{workcell}/shapes"]))
    sizes = np.cumsum([int(np.prod(shape)) for shape in shapes.values()])
    pieces = np.split(values, sizes[:-1])
    return {name: piece.reshape(shapes[name]) for name, piece in zip(shapes, pieces, strict=True)}


def packed(workcell: str, arrays: Arrays) -> Arrays:
    """Arrays as one, which takes a tenth of the space, and their shapes."""
    shapes = json.dumps({name: array.shape for name, array in arrays.items()})
    values = np.concatenate([array.astype(np.float64).ravel() for array in arrays.values()])
    return {workcell: values, f"{workcell}/shapes": np.array(shapes)}


def frozen_outcomes(workcell: str) -> dict[str, dict[str, str]]:
    """The frozen outcomes of the first policy for a work cell: a further policy changes no behaviour."""
    name = DEFAULT_POLICY if workcell == HOME else workcell
    found = json.loads(THROWS.read_text())
    return {name: found[name]} if name in found else {}


def frozen_hash(workcell: str) -> str:
    """The hash of everything that is frozen of a work cell."""
    digest = hashlib.sha256(json.dumps(frozen_outcomes(workcell), sort_keys=True).encode())
    for file in (MODELS, OBSERVATIONS):
        for name, array in sorted(frozen(file, workcell).items()):
            digest.update(f"{name} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()[:HASH]


def require_equal(now: Arrays, then: Arrays, tolerance: dict[str, Any]) -> None:
    assert sorted(now) == sorted(then)
    for name, value in then.items():
        np.testing.assert_allclose(now[name], value, **tolerance, err_msg=name)


@pytest.mark.parametrize("workcell", sorted(workcells()))
def test_models_and_observations_are_what_they_were(workcell: str):
    require_equal(model_arrays(workcell), frozen(MODELS, workcell), MODEL_TOLERANCE)
    require_equal(observation_arrays(workcell), frozen(OBSERVATIONS, workcell), OBSERVATION_TOLERANCE)


def test_results_record_the_frozen_behaviour():
    assert {name: frozen_hash(name) for name in behaviour.HASHES} == behaviour.HASHES


SLOW = {name: [pytest.mark.slow] * (name != DEFAULT_POLICY) for name in sorted(shipped_policies())}


@pytest.mark.parametrize("policy_name", [pytest.param(name, marks=marks) for name, marks in SLOW.items()])
def test_shipped_policies_catch_the_same_throws(policy_name: str):
    now, then = outcomes(policy_name), json.loads(THROWS.read_text())[policy_name]
    for name, flags in then.items():
        differences = sum(a != b for a, b in zip(flags, now[name], strict=True))
        assert differences <= 3, f"{name}: another processor's rounding changes a throw or two"


def kept(now: Arrays, then: Arrays, tolerance: dict[str, Any]) -> Arrays:
    """New arrays, with the old one in place of each that agrees with it."""
    same = {n for n in now.keys() & then.keys() if now[n].shape == then[n].shape}
    return now | {n: then[n] for n in same if np.allclose(now[n], then[n], **tolerance)}


def write() -> None:
    for file, make, tolerance in (
        (MODELS, model_arrays, MODEL_TOLERANCE),
        (OBSERVATIONS, observation_arrays, OBSERVATION_TOLERANCE),
    ):
        arrays: Arrays = {}
        for workcell in workcells():
            arrays |= packed(workcell, kept(make(workcell), frozen(file, workcell), tolerance))
        np.savez_compressed(file, allow_pickle=False, **arrays)
    THROWS.write_text(json.dumps({name: outcomes(name) for name in shipped_policies()}, indent=1) + "\n")
    write_hashes()


def write_hashes() -> None:
    hashes = "".join(f'    "{name}": "{frozen_hash(name)}",\n' for name in sorted(workcells()))
    file = Path(behaviour.__file__)
    text = file.read_text().partition("HASHES")[0]
    file.write_text(text + "HASHES: dict[str, str] = {\n" + hashes + "}\n")


if __name__ == "__main__":
    write()
