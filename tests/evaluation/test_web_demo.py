"""The page's folder, and its JavaScript against the Python code, step by step in node."""

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from pixel2catch.cli.main import main
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.episode import Episode
from pixel2catch.errors import InvalidValueError, PolicyMismatchError
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.evaluation.web_demo import write_web_demo
from pixel2catch.evaluation.web_demo.export import LIBRARIES
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.methods import PROPOSED, METHODS, find_method
from pixel2catch.policy import Policy, contract_of
from pixel2catch.scene.objects import SEEN
from pixel2catch.workcells import find_workcell

PACKAGES = os.environ.get("PIXEL2CATCH_NODE_MODULES")
"""Folder `node_modules` with the packages of the page's package.json, for the tests that run it."""

needs_packages = pytest.mark.skipif(
    not (PACKAGES and shutil.which("node")), reason="needs node, and PIXEL2CATCH_NODE_MODULES"
)
NUM_THROWS, NUM_STEPS = 3, 50


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the shipped policy, with npm's packages where there are any."""
    folder = tmp_path_factory.mktemp("demo")
    if PACKAGES:
        (folder / "node_modules").symlink_to(Path(PACKAGES).resolve())
    write_web_demo(None, folder)
    return folder


def node(script: str, *args: str | Path) -> Any:
    command = ["node", str(Path(__file__).with_name(script)), *map(str, args)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_the_command_writes_the_page_and_names_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["export", "proposed", "--web-demo", str(tmp_path / "web")]) == 0
    printed = capsys.readouterr()
    assert "npm install --prefix" in printed.err
    assert "@mujoco/mujoco@3.14.0 three@0.187.0" in printed.err
    files = {path.relative_to(tmp_path / "web").as_posix() for path in (tmp_path / "web").rglob("*.*")}
    assert {"index.html", "main.js", "task.json", "policy/policy.json", "scenes/cube_s.xml"} <= files
    assert Policy.load(tmp_path / "web" / "policy").contract.method == "proposed"
    assert main(["export", "proposed", "--web-demo", str(tmp_path / "web")]) == 0, "over an earlier page"


def test_a_folder_with_anything_else_is_refused(tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(InvalidValueError, match="--web-demo"):
        write_web_demo(None, tmp_path)


def test_only_packages_of_the_pinned_versions_are_bundled(tmp_path: Path):
    for package, version in (("@mujoco/mujoco", "3.14.0"), ("three", "0.1.0")):
        folder = tmp_path / "node_modules" / package
        for file in LIBRARIES[package]:
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_text("")
        (folder / "package.json").write_text(json.dumps({"version": version}))
    assert write_web_demo(None, tmp_path) == ("three@0.187.0",)
    assert {path.name for path in (tmp_path / "lib").iterdir()} == {"mujoco.js", "mujoco.wasm"}


@pytest.mark.parametrize(
    ("method", "workcell", "recurrent", "message"),
    [
        ("proposed", "ur5e_allegro", 8, "GRU of 8"),
        ("proposed", "two_ur5e_allegro", 0, "2 palms"),
        ("catch_teacher+age", "ur5e_allegro", 0, "object_position"),
        ("only_center+fit", "ur5e_allegro", 0, "box_fit"),
    ],
)
def test_what_the_page_cannot_run_is_refused(
    tmp_path: Path, method: str, workcell: str, recurrent: int, message: str
):
    cell = find_workcell(workcell)
    policy = Policy(contract_of(find_method(method, cell), cell), hidden=(8,), recurrent=recurrent)
    policy.save(tmp_path / "policy")
    with pytest.raises(PolicyMismatchError, match=message):
        write_web_demo(tmp_path / "policy", tmp_path / "web")
    assert not (tmp_path / "web").exists()


def quiet_throws(policy_name: str | None) -> dict[str, Any]:
    """Throws without noise by the Python code: what was drawn, and every step."""
    policy, method = load_policy(policy_name and Path(policy_name))
    task = task_of(policy)
    quiet = replace(
        task,
        objects=SEEN,
        episode=EpisodeCfg(max_steps=NUM_STEPS + 1, ends_on_success=False),
        randomization=replace(task.randomization, action_noise=0.0, action_bias=0.0),
        sensing=replace(task.sensing, corner_noise=0.0, joint_noise=0.0, joint_bias=0.0),
    )
    env = CatchEnv(quiet, method, num_envs=NUM_THROWS, seed=3)
    observation = env.reset()
    episodes = drawn(env._episode, env.world.objects.names)
    steps = []
    for _ in range(NUM_STEPS):
        actions = policy.act(observation.policy)
        inputs = {name: value.tolist() for name, value in observation.policy.items()}
        step = env.step(actions)
        observation = step.observation
        steps.append(
            {
                "observations": inputs,
                "actions": {name: value.tolist() for name, value in actions.items()},
                "target": step.joint_pos_target.tolist(),
                "qpos": env.world.simulation.bind("qpos").tolist(),
                "is_touched": step.record.is_hand_contact.tolist(),
                "is_success": step.record.is_success.tolist(),
            }
        )
    return {"episodes": episodes, "steps": steps}


def drawn(episode: Episode, names: tuple[str, ...]) -> list[dict[str, Any]]:
    """What was drawn for each throw, by the page's names."""
    parameters, throw = episode.parameters, episode.throw
    values = {
        "latency": parameters.latency.long(),
        "massScale": parameters.mass_scale,
        "restitution": parameters.restitution,
        "friction": parameters.friction,
        "stiffnessScale": parameters.stiffness_scale,
        "dampingScale": parameters.damping_scale,
        "actionBias": parameters.action_bias,
        "jointBias": parameters.joint_bias,
        "jointOffset": parameters.joint_offset,
    }
    thrown = {"pos": throw.pos, "quat": throw.quat, "linVel": throw.lin_vel, "hoverSteps": throw.hover_steps}
    return [
        {name: value[i].tolist() for name, value in values.items()}
        | {"object": names[int(parameters.object_id[i])]}
        | {"throw": {name: value[i].tolist() for name, value in thrown.items()}}
        for i in range(NUM_THROWS)
    ]


@needs_packages
@pytest.mark.parametrize("policy", [None, "proposed"])
def test_javascript_and_python_agree(demo: Path, tmp_path: Path, policy: str | None):
    """On the states of the Python code to float32, and freely until the hand touches the object."""
    folder = demo
    if policy:
        folder = tmp_path / "web"
        folder.mkdir()
        (folder / "node_modules").symlink_to(Path(str(PACKAGES)).resolve())
        write_web_demo(Path(policy), folder)
    (tmp_path / "throws.json").write_text(json.dumps(quiet_throws(policy)))
    result = node("web_demo_agreement.mjs", folder, tmp_path / "throws.json")
    print(json.dumps(result))
    assert max(result["forced"].values()) < 1e-4
    assert max(result["free"].values()) < 1e-3
    assert result["num_steps_free"] > 20 * NUM_THROWS
