"""A static page in which one throws with the mouse and a policy catches, in MuJoCo's WebAssembly build.

The folder holds the page, the policy as training writes it, one MJCF file an object, and `task.json`: every
number that the page's code reads, from where it is declared here. The page's JavaScript is the same path of
observations and actions as the Python code's; `tests/evaluation/test_web_demo.py` compares them step by step.
It reads the policy's own file: a perceptron is twenty lines, a runtime for networks many megabytes.
"""

import dataclasses
import json
import shutil
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import Any

import torch

from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.envs import actuators
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.world import MASS_POWER, NUM_SURFACE_POINTS, OCCLUDER_GROUPS
from pixel2catch.errors import PolicyMismatchError
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.files import as_json, read_json_object, require_free_folder
from pixel2catch.mdp import observations, terminations
from pixel2catch.policy import Policy
from pixel2catch.policy.policy import INPUT_CLIP
from pixel2catch.robots.geometry import chain_of
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.cfg import PUSH_OUT
from pixel2catch.scene.constants import CONTROL_DT, GRAVITY, RGB_CAMERA, SPEED_MARGIN
from pixel2catch.scene.objects import OBJECTS, SEEN, UNSEEN, surface_points
from pixel2catch.scene.scene import build_spec
from pixel2catch.workcells import find_workcell

LIBRARIES = {
    "@mujoco/mujoco": ("mujoco.js", "mujoco.wasm"),
    "three": ("build/three.module.js", "build/three.core.js", "examples/jsm/controls/OrbitControls.js"),
}
"""Files of npm packages that the page loads; `page/package.json` has the versions."""

LIBRARY_FOLDER = "lib"  #: Where the page finds them.
NPM_FOLDER = "node_modules"  #: Where npm puts packages.

TERMS = ("pixels", "palm_pose", "joint_pos", "last_action", "joint_pos_target", "box_age", "box_fit")
"""Observation terms that the page computes (`page/observations.js`)."""


def write_web_demo(policy_folder: Path | None, out: Path) -> tuple[str, ...]:
    """Write the page into a folder: an empty one, or one with npm's packages or an earlier page.

    Args:
        policy_folder: See `load_policy`.
        out: The folder; what npm has put there is bundled.

    Returns:
        The npm packages that are missing there, with their versions; without them the page does not run.

    Raises:
        PolicyMismatchError: If there is no such policy, or the page cannot run it.
        InvalidValueError: If the folder holds something else, or cannot be made.
    """
    policy, _ = load_policy(policy_folder)
    if not isinstance(policy, Policy):
        raise PolicyMismatchError(
            f"'{policy_folder}' is an ONNX file, which the page cannot read; name a folder."
        )
    workcell = find_workcell(policy.contract.workcell)
    _require_runnable(policy, workcell)
    page = _page_files()
    _require_own_folder(out, page)
    task = task_of(policy)
    (out / "scenes").mkdir(parents=True, exist_ok=True)
    for name in (*SEEN, *UNSEEN):
        (out / "scenes" / f"{name}.xml").write_text(_scene_xml(task, name), encoding="utf-8")
    policy.save(out / "policy")
    content = json.dumps(as_json(_task_content(task, workcell)), separators=(",", ":"), allow_nan=False)
    (out / "task.json").write_text(content, encoding="utf-8")
    for name, text in page.items():
        (out / name).write_text(text, encoding="utf-8")
    return _bundle_libraries(out, json.loads(page["package.json"])["dependencies"])


def _require_own_folder(out: Path, page: Iterable[str]) -> None:
    """Refuse a folder with anything but an earlier page and what npm writes."""
    known = {*page, "task.json", "scenes", "policy", LIBRARY_FOLDER, NPM_FOLDER, "package-lock.json"}
    if not (out.is_dir() and known.issuperset(path.name for path in out.iterdir())):
        require_free_folder(out, "--web-demo")


def _require_runnable(policy: Policy, workcell: WorkcellSpec) -> None:
    """Refuse what the page's code has no counterpart of."""
    contract = policy.contract
    if policy.recurrent:
        raise PolicyMismatchError(
            f"the policy has a GRU of {policy.recurrent}, and the page runs networks without memory only; "
            "export one that was trained without --recurrent."
        )
    if len(workcell.palms) != 1:
        raise PolicyMismatchError(
            f"the policy is of the work cell '{workcell.name}' with {len(workcell.palms)} palms, and the "
            "page runs robots with one; export a policy of a single robot."
        )
    full = {"box_fit": len(observations.BOX_FIT_FEATURES)}
    for agent in contract.agents.values():
        for term, size in agent.observation:
            name = term.partition("[")[0]
            if name not in TERMS or size != full.get(name, size):
                raise PolicyMismatchError(
                    f"the policy of method '{contract.method}' observes '{term}' of {size} numbers, which "
                    f"the page does not compute; export a policy that observes only {', '.join(TERMS)}."
                )


def _page_files() -> dict[str, str]:
    """The page's own files by name."""
    folder = resources.files("pixel2catch.evaluation.web_demo") / "page"
    return {file.name: file.read_text(encoding="utf-8") for file in folder.iterdir() if file.is_file()}


def _bundle_libraries(out: Path, versions: dict[str, str]) -> tuple[str, ...]:
    """Copy what the page needs of npm's packages; return those that are missing or of another version."""
    missing = []
    for package, files in LIBRARIES.items():
        folder, description = out / NPM_FOLDER / package, out / NPM_FOLDER / package / "package.json"
        found = read_json_object(description).get("version") if description.is_file() else None
        if found != versions[package]:
            missing.append(f"{package}@{versions[package]}")
            continue
        (out / LIBRARY_FOLDER).mkdir(exist_ok=True)
        for file in files:
            shutil.copyfile(folder / file, out / LIBRARY_FOLDER / Path(file).name)
    return tuple(missing)


def _scene_xml(task: CatchEnvCfg, object_name: str) -> str:
    """The scene with what is seen, in the MJCF of the WebAssembly build, which is a version older."""
    spec = build_spec(dataclasses.replace(task.scene, visuals=True), object_name)
    spec.geom("floor").castshadow = True  # the default, which is not written: the attribute is new
    for sensor in [*spec.sensors]:
        spec.delete(sensor)
    spec.compile()
    return spec.to_xml()


def _task_content(task: CatchEnvCfg, workcell: WorkcellSpec) -> dict[str, Any]:
    """Every number that the page needs besides the policy's contract, by the names of this code."""
    task = task.for_workcell(workcell)
    return {
        "joints": _joints(task, workcell),
        "palm": _palm(workcell),
        "objects": {
            "seen": SEEN,
            "unseen": UNSEEN,
            "points": {
                name: surface_points(OBJECTS[name], NUM_SURFACE_POINTS).round(7) for name in (*SEEN, *UNSEEN)
            },
        },
        "physics": {
            "control_dt": CONTROL_DT,
            "decimation": task.scene.decimation,
            "gravity": GRAVITY,
            "speed_margin": SPEED_MARGIN,
            "effort_margin": actuators.EFFORT_MARGIN,
            "friction_speed": actuators.FRICTION_SPEED,
            "push_out": PUSH_OUT,
            "mass_power": MASS_POWER,
            "occluder_groups": OCCLUDER_GROUPS,
        },
        "camera": _cameras(task),
        "input_clip": INPUT_CLIP,
        "throws": dataclasses.asdict(task.throws),
        "randomization": {
            name: getattr(task.randomization, name)
            for name in ("initial_joint_noise", "mass_scale", "restitution", "friction")
        },
        "sensing": {
            name: getattr(task.sensing, name)
            for name in ("corner_noise", "latency_steps", "joint_noise", "joint_bias", "least_visible")
        },
        "episode": {
            "max_steps": task.episode.max_steps,
            "reach": terminations.REACH,
            "hold_steps": terminations.HOLD_STEPS,
            "drop_height": terminations.DROP_HEIGHT,
            "drop_x": terminations.DROP_X,
        },
        "box_fit": {
            name.lower(): getattr(observations, name)
            for name in (
                *("NUM_BOXES", "TIME_CONSTANTS", "STEPS_PER_SECOND", "TYPICAL_SIZE", "LEAST_SIZE"),
                *("PIXEL_NOISE", "LONGEST_EXTRAPOLATION", "BOUND", "MOST_FAR", "SPREAD_FLOOR"),
            )
        },
    }


def _joints(task: CatchEnvCfg, workcell: WorkcellSpec) -> list[dict[str, Any]]:
    """What a joint is, what its gains may be, and the noise of its actions; in joint order."""
    gains = task.randomization.gains
    groups = [group for group in workcell.groups for _ in group.joints]
    ranges = zip(gains.stiffness_scale, gains.damping_scale, strict=True)
    return [
        dataclasses.asdict(joint)
        | {"stiffness_scale": stiffness, "damping_scale": damping}
        | {"action_noise": task.randomization.action_noise * group.action_noise}
        | {"action_bias": task.randomization.action_bias * group.action_bias}
        for joint, group, (stiffness, damping) in zip(workcell.joints, groups, ranges, strict=True)
    ]


def _palm(workcell: WorkcellSpec) -> dict[str, Any]:
    """The palm's site, and the chain of joints that carries it as the matrices of `robots.chain`."""
    (palm,) = workcell.palms
    chain = chain_of(workcell, palm, dtype=torch.float64)
    matrices = chain.matrices.permute(1, 0, 2, 3)  # of each joint K, C and S
    return {"site": palm.spec.site, "first": palm.first, "matrices": matrices.tolist(), "side": chain.side}


def _cameras(task: CatchEnvCfg) -> dict[str, Any]:
    """The true camera as a projection, and the one whose numbers make pixels into features."""
    camera = task.sensing.camera.camera
    projection = nominal_projection(camera, torch.zeros(1, dtype=torch.float64))
    return {
        "matrix": projection.matrix,
        "center": projection.center,
        "true": dataclasses.asdict(camera),
        "assumed": dataclasses.asdict(RGB_CAMERA),
    }
