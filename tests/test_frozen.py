"""Behaviour that no rebuilding may change: the compiled model, and the outcome of throws by shipped policies.

`python tests/test_frozen.py` writes the files anew, after a change of the robot or the task that is meant.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.evaluation.protocol import EvaluationCfg, evaluate
from pixel2catch.scene.objects import OBJECTS, SEEN
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.shipped import DEFAULT_POLICY, shipped_policies

FOLDER = Path(__file__).parent / "frozen"
MODELS, THROWS = FOLDER / "models.npz", FOLDER / "throws.json"
PHYSICS_HZ, SEED = 240.0, 7
WORKCELLS = ("ur5e_allegro", "ur5e_allegro_right")
FIRST = next(iter(OBJECTS))
DERIVED = ("plugin", "bvh_", "oct_", "mesh_")
"""Fields that follow from the others, or from the meshes of the objects, which are large."""


def model_fields(workcell: str, object_name: str) -> dict[str, np.ndarray]:
    """All numbers of the compiled model, and the names of everything in it."""
    model = build_model(SceneCfg(workcell=workcell), object_name)
    arrays = {name: getattr(model, name) for name in dir(model) if not name.startswith(("_", *DERIVED))}
    options = {f"opt.{name}": getattr(model.opt, name) for name in dir(model.opt) if not name.startswith("_")}
    fields = {
        n: np.array(v) for n, v in (arrays | options).items() if isinstance(v, int | float | np.ndarray)
    }
    return fields | {"names": np.frombuffer(model.names, dtype=np.uint8)}


def frozen_models() -> dict[str, np.ndarray]:
    """The model with each hand, and of each other object what differs from that of the first."""
    arrays = {}
    for workcell in WORKCELLS:
        whole = model_fields(workcell, FIRST)
        arrays |= {f"{workcell}/{FIRST}/{field}": value for field, value in whole.items()}
        for name in OBJECTS:
            fields = model_fields(workcell, name)
            changed = {field: v for field, v in fields.items() if not np.array_equal(v, whole[field])}
            arrays |= {f"{workcell}/{name}/{field}": v for field, v in changed.items()}
    return arrays


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


@pytest.mark.parametrize("workcell", WORKCELLS)
def test_the_compiled_model_is_what_it_was(workcell: str):
    with np.load(MODELS) as file:
        frozen = {tuple(key.split("/")): file[key] for key in file if key.startswith(workcell + "/")}
    whole = {field: value for (_, name, field), value in frozen.items() if name == FIRST}
    for name in OBJECTS:
        now = model_fields(workcell, name)
        then = whole | {field: value for (_, other, field), value in frozen.items() if other == name}
        for field, value in then.items():
            np.testing.assert_allclose(now[field], value, rtol=1e-9, atol=1e-12, err_msg=f"{name}: {field}")


SLOW = {name: [pytest.mark.slow] * (name != DEFAULT_POLICY) for name in sorted(shipped_policies())}


@pytest.mark.parametrize("policy_name", [pytest.param(name, marks=marks) for name, marks in SLOW.items()])
def test_shipped_policies_catch_the_same_throws(policy_name: str):
    now, then = outcomes(policy_name), json.loads(THROWS.read_text())[policy_name]
    for name, flags in then.items():
        differences = sum(a != b for a, b in zip(flags, now[name], strict=True))
        assert differences <= 3, (
            f"{name}: another processor's rounding changes a throw or two, not {differences}"
        )


if __name__ == "__main__":
    np.savez_compressed(MODELS, allow_pickle=False, **frozen_models())
    THROWS.write_text(json.dumps({name: outcomes(name) for name in shipped_policies()}, indent=1) + "\n")
