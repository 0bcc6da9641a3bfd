"""Write a static page in which a policy catches in a browser, in MuJoCo's WebAssembly build.

The folder holds the page, the policy's own file, one MJCF file per object, and `task.json`: every number that
the JavaScript reads, taken from where the Python code declares it.
"""

import argparse
import dataclasses
import json
import math
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

import pixel2catch as p2c

PAGE = Path(__file__).parent / "page"
LIBRARIES = {
    "@mujoco/mujoco": ("mujoco.js", "mujoco.wasm"),
    "three": ("build/three.module.js", "build/three.core.js", "examples/jsm/controls/OrbitControls.js"),
}
"""Files of npm packages that the page loads; `page/package.json` has the versions."""

LIBRARY_FOLDER = "lib"  #: Folder of these files in the page.
NPM_FOLDER = "node_modules"  #: Folder of npm's packages.

TERMS = ("pixels", "palm_pose", "joint_pos", "last_action", "joint_pos_target", "box_age", "box_fit")
"""Observation terms that the page computes (`page/observations.js`)."""


def write_web_demo(policy_name: str | None, out: Path) -> tuple[str, ...]:
    """Write the page into a folder.

    Args:
        policy_name: A policy as for `p2c.load_policy`.
        out: A new or empty folder, or one with npm's packages or an earlier page.

    Returns:
        The npm packages, with versions, that the folder lacks and the page needs.

    Raises:
        ValueError: If the page cannot run the policy, or the folder holds other files.
    """
    policy = p2c.load_policy(policy_name)
    workcell = p2c.find_workcell(policy.contract.workcell)
    _require_runnable(policy, workcell)
    page = [file for file in sorted(PAGE.iterdir()) if file.is_file()]
    _require_own_folder(out, [file.name for file in page])
    task = p2c.task_of(policy)
    (out / "scenes").mkdir(parents=True, exist_ok=True)
    for name in (*p2c.SEEN, *p2c.UNSEEN):
        (out / "scenes" / f"{name}.xml").write_text(_scene_xml(task, name), encoding="utf-8")
    policy.save(out / "policy")
    content = json.dumps(
        _task_content(task, workcell), default=lambda v: v.tolist(), separators=(",", ":"), allow_nan=False
    )
    (out / "task.json").write_text(content, encoding="utf-8")
    for file in page:
        shutil.copyfile(file, out / file.name)
    return _bundle_libraries(out, _read(PAGE / "package.json")["dependencies"])


def _require_own_folder(out: Path, page: Iterable[str]) -> None:
    known = {*page, "task.json", "scenes", "policy", LIBRARY_FOLDER, NPM_FOLDER, "package-lock.json"}
    if out.exists() and not (out.is_dir() and known.issuperset(path.name for path in out.iterdir())):
        raise ValueError(f"'{out}' holds files that are not of the page; name a new or empty folder.")


def _require_runnable(policy: p2c.Policy, workcell: p2c.WorkcellSpec) -> None:
    contract = policy.contract
    if len(workcell.palms) != 1:
        raise ValueError(
            f"the work cell '{workcell.name}' has {len(workcell.palms)} palms, and the page runs robots with "
            "one; export a policy of a single robot."
        )
    if any(math.isfinite(joint.acceleration_limit) for joint in workcell.joints):
        raise ValueError(
            f"the joints of '{workcell.name}' have limits of acceleration, which the page does not keep; "
            "export a policy of another robot."
        )
    full = {"box_fit": len(p2c.observations.BOX_FIT_FEATURES)}
    for agent in contract.agents.values():
        for term, size in agent.observation:
            name = term.partition("[")[0]
            if name not in TERMS or size != full.get(name, size):
                raise ValueError(
                    f"the policy of method '{contract.method}' observes '{term}' of {size} numbers, which "
                    f"the page does not compute; export a policy that observes only {', '.join(TERMS)}."
                )


def _bundle_libraries(out: Path, versions: dict[str, str]) -> tuple[str, ...]:
    """Copy what the page needs of npm's packages; return those that are missing or of another version."""
    missing = []
    for package, files in LIBRARIES.items():
        folder, description = out / NPM_FOLDER / package, out / NPM_FOLDER / package / "package.json"
        found = _read(description).get("version") if description.is_file() else None
        if found != versions[package]:
            missing.append(f"{package}@{versions[package]}")
            continue
        (out / LIBRARY_FOLDER).mkdir(exist_ok=True)
        for file in files:
            shutil.copyfile(folder / file, out / LIBRARY_FOLDER / Path(file).name)
    return tuple(missing)


def _read(file: Path) -> dict[str, Any]:
    return json.loads(file.read_text(encoding="utf-8"))


def _scene_xml(task: p2c.CatchEnvCfg, object_name: str) -> str:
    """The scene with visible parts, as MJCF that the WebAssembly build, one version older, can read."""
    spec = p2c.build_spec(dataclasses.replace(task.scene, visuals=True), object_name)
    spec.geom("floor").castshadow = True  # the default is not written; the attribute is new
    for sensor in [*spec.sensors]:
        spec.delete(sensor)
    spec.compile()
    return spec.to_xml()


def _task_content(task: p2c.CatchEnvCfg, workcell: p2c.WorkcellSpec) -> dict[str, Any]:
    """Every number that the page needs beside the policy's contract, by the names of the Python code."""
    task = task.for_workcell(workcell)
    world, names = p2c.world, (*p2c.SEEN, *p2c.UNSEEN)
    points = {n: p2c.surface_points(p2c.OBJECTS[n], world.NUM_SURFACE_POINTS).round(7) for n in names}
    return {
        "joints": _joints(task, workcell),
        "palm": _palm(workcell),
        "objects": {"seen": p2c.SEEN, "unseen": p2c.UNSEEN, "points": points},
        "physics": {
            "control_dt": p2c.constants.CONTROL_DT,
            "decimation": task.scene.decimation,
            "gravity": p2c.constants.GRAVITY,
            "speed_margin": p2c.constants.SPEED_MARGIN,
            "effort_margin": p2c.actuators.EFFORT_MARGIN,
            "friction_speed": p2c.actuators.FRICTION_SPEED,
            "push_out": p2c.PUSH_OUT,
            "mass_power": world.MASS_POWER,
            "occluder_groups": world.OCCLUDER_GROUPS,
        },
        "camera": _cameras(task),
        "input_clip": p2c.INPUT_CLIP,
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
            **{
                name.lower(): getattr(p2c.terminations, name)
                for name in ("REACH", "HOLD_STEPS", "DROP_HEIGHT", "DROP_X")
            },
        },
        "box_fit": {
            name.lower(): getattr(p2c.observations, name)
            for name in (
                *("NUM_BOXES", "TIME_CONSTANTS", "STEPS_PER_SECOND", "TYPICAL_SIZE", "LEAST_SIZE"),
                *("PIXEL_NOISE", "LONGEST_EXTRAPOLATION", "BOUND", "MOST_FAR", "SPREAD_FLOOR"),
            )
        },
    }


def _joints(task: p2c.CatchEnvCfg, workcell: p2c.WorkcellSpec) -> list[dict[str, Any]]:
    """Each joint with the ranges of its gains and the noise of its actions, in joint order."""
    gains = task.randomization.gains
    groups = [group for group in workcell.groups for _ in group.joints]
    ranges = zip(gains.stiffness_scale, gains.damping_scale, strict=True)
    return [
        {name: value for name, value in vars(joint).items() if name not in ("acceleration_limit", "travel")}
        | {"stiffness_scale": stiffness, "damping_scale": damping}
        | {"action_noise": task.randomization.action_noise * group.action_noise}
        | {"action_bias": task.randomization.action_bias * group.action_bias}
        for joint, group, (stiffness, damping) in zip(workcell.joints, groups, ranges, strict=True)
    ]


def _palm(workcell: p2c.WorkcellSpec) -> dict[str, Any]:
    """The palm's site, and the chain of joints that carries it as the matrices of `robots.chain`."""
    (palm,) = workcell.palms
    chain = p2c.chain_of(workcell, palm, dtype=torch.float64)
    matrices = chain.matrices.permute(1, 0, 2, 3)  # of each joint K, C and S
    return {
        "site": palm.spec.site,
        "first": palm.carriers.start,
        "matrices": matrices.tolist(),
        "side": chain.side,
    }


def _cameras(task: p2c.CatchEnvCfg) -> dict[str, Any]:
    """The true camera as a projection, and the camera whose numbers turn pixels into features."""
    camera = task.sensing.camera.camera
    projection = p2c.nominal_projection(camera, torch.zeros(1, dtype=torch.float64))
    return {
        "matrix": projection.matrix,
        "center": projection.center,
        "true": dataclasses.asdict(camera),
        "assumed": dataclasses.asdict(p2c.constants.RGB_CAMERA),
    }


def main() -> None:
    """Write the page, and print the next command."""
    parser = argparse.ArgumentParser(
        description="Write a static page in which a policy catches in a browser."
    )
    parser.add_argument("out", type=Path, help="folder of the page: new, empty, or with npm's packages")
    parser.add_argument("--policy", help="name of a shipped policy, or a folder (default: catch_alone+fit)")
    args = parser.parse_args()
    try:
        missing = write_web_demo(args.policy, args.out)
    except (p2c.Pixel2CatchError, ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    if missing:
        packages = " ".join(missing)
        print(f"the page needs {packages}: install them, then export again", file=sys.stderr)
        print(f"  npm install --prefix {args.out} {packages}", file=sys.stderr)
    print(f"wrote {args.out}; to look at it: python -m http.server --directory {args.out}")


if __name__ == "__main__":
    main()
