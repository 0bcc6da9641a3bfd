"""The commands as functions: what is given is used, and what is wrong is named."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import config

import pixel2catch as p2c
from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.errors import CheckpointError, InvalidValueError, PolicyMismatchError, UnknownNameError
from pixel2catch.learning.experiment import read_run
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.robots import ur5e
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.cfg import SceneCfg
from pixel2catch.scene.constants import PEOPLE_CAMERA

SMALL: dict[str, Any] = dict(num_envs=4, rollout_steps=2, mini_batches=2, transitions=8, hidden=(8,))
OWN = p2c.CatchEnvCfg(
    name="own",
    scene=SceneCfg(physics_hz=60.0, cone="elliptic", multiccd=True),
    sensing=SensingCfg(latency_steps=(3, 4)),
)

BEHIND = CameraFile(camera=replace(PEOPLE_CAMERA, pos=(39.0, 0.0, 1.6)))
TWICE: Any = np.array([True, True])
METHOD = p2c.find_method("single_agent")


def agents_named(name: str) -> p2c.Method:
    return replace(METHOD, agents=(replace(METHOD.agents[0], name=name),))


WRONG: tuple[tuple[Callable[[], Any], str], ...] = (
    (lambda: p2c.make(None), "method is None; it must be a text or Method"),  # pyright: ignore[reportArgumentType]
    (lambda: p2c.make(task=replace(OWN, throws=replace(OWN.throws, spin=-1.0))), "task.throws.spin is -1"),
    (lambda: p2c.make(num_envs=0), "num_envs is 0"),
    (
        lambda: p2c.make(task=replace(OWN, sensing=SensingCfg(any_camera=TWICE))),
        r"any_camera is .*; it must be True or False",
    ),
    (lambda: p2c.make(device="gpu"), "device is 'gpu'"),
    (lambda: p2c.find_method(5), "name is 5; it must be a text"),  # pyright: ignore[reportArgumentType]
    (lambda: p2c.evaluate(change=5), "change is 5; it must be a function"),  # pyright: ignore[reportArgumentType]
    (lambda: p2c.CatchParallelEnv(None), "env is None; it must be CatchEnv"),  # pyright: ignore[reportArgumentType]
    (lambda: p2c.Method(name="own", agents=("arm",), pixel_features=()), r"agents\[0\] is 'arm'"),  # pyright: ignore[reportArgumentType]
    (lambda: p2c.make().seed(-1), "seed is -1"),
    (lambda: p2c.load_policy().act({"robot": torch.zeros(99)}), r"'robot' is of shape \(99,\); give"),
    (lambda: p2c.Policy.load(5), "folder is 5; it must be a text or a path"),  # pyright: ignore[reportArgumentType]
    (lambda: p2c.Renderer(None), "model is None; it must be MjModel"),  # pyright: ignore[reportArgumentType]
    (lambda: p2c.make().step({"arm": torch.zeros(1, 6)}), r"action of agent 'hand' is None; .* \(1, 13\)"),
    (
        lambda: p2c.make("catch_alone").step({"robot": torch.zeros(1, 19), "leg": torch.zeros(1, 6)}),
        "there is no agent 'leg'; give an action for robot",
    ),
    (lambda: p2c.Level(label="5", change=None, source="ours"), "change is None; it must be a function"),  # pyright: ignore[reportArgumentType]
    (lambda: WorkcellSpec(name="own", robots=(None,)), r"robots\[0\] is None; it must be Placed"),  # pyright: ignore[reportArgumentType]
    (lambda: p2c.Axis(name="own", unit="", levels=("5",)), r"levels\[0\] is '5'; it must be Level"),  # pyright: ignore[reportArgumentType]
    (lambda: p2c.make(objects=3), "name is 3; it must be a text or"),  # pyright: ignore[reportArgumentType]
    (lambda: p2c.EvaluationCfg(objects=()), "objects is empty; give at least one value"),
    (lambda: p2c.make("catch_alone").step({"robot": torch.zeros(1, 19) * 1j}), r"\(1, 19\) of real numbers"),
    (lambda: p2c.make("catch_alone").step({"robot": torch.zeros(1, 19, device="meta")}), "numbers on cpu"),
    (lambda: p2c.CatchEnvCfg(scene=SceneCfg(object_friction=0.1)), "0.1, which does nothing in a task"),
    (lambda: p2c.make(task=p2c.CatchEnvCfg(scene=SceneCfg(camera=PEOPLE_CAMERA))), "is not sensing.camera"),
    (lambda: p2c.make(task=OWN.with_camera(BEHIND)), r"the camera sees no throw; correct its pos \[m\]"),
    (lambda: p2c.CatchEnvCfg(variants=(1,)), r"variants\[0\] is 1; it must be TaskVariant"),  # pyright: ignore[reportArgumentType]
    (lambda: SensingCfg(camera=None), r"sensing\.camera is None; it must be CameraFile"),  # pyright: ignore[reportArgumentType]
    (lambda: p2c.Experiment(env=None, train=None), "env is None; it must be CatchEnvCfg"),  # pyright: ignore[reportArgumentType]
    (lambda: p2c.RewardTerm(function=partial(max), weight=1.0), "define it by def, which gives it a name"),
    (lambda: replace(METHOD, name="../own"), r"name is '\.\./own'; use up to 100 letters"),
    (lambda: replace(METHOD, num_boxes=0), "num_boxes is 0; it must be from 1 to 99"),
    (lambda: agents_named("a.b"), r"agent 'a\.b' cannot have this name"),
    (lambda: agents_named("training"), "agent 'training' cannot have this name"),
    (
        lambda: replace(METHOD, agents=(replace(METHOD.agents[0], observation=()),)),
        "lacks observations or rewards",
    ),
)


@pytest.mark.parametrize(("call", "words"), WRONG)
def test_a_wrong_argument_is_named(call: Callable[[], Any], words: str):
    config.update("jaxtyping_disable", True)  # as for users
    with pytest.raises(InvalidValueError, match=words):
        call()


OWN_TERMS: tuple[tuple[str, Callable[..., Any], str], ...] = (
    ("observation", lambda frame: frame.now.palm_pos[:, 0, 2], r"the shape \(1,\); it must be \(1, any\)"),
    ("observation", lambda frame: frame.now.colour, r"AttributeError: .*no attribute 'colour'"),
    ("observation", lambda frame: frame.now.joint_pos + torch.inf, "NaN or infinity"),
    ("reward", lambda transition, part: transition.now.object_pos, r"the shape \(4, 3\); it must be \(4\)"),
    ("reward", lambda transition, part: 0.5, "returns 0.5; it must return a tensor"),
    ("reward", lambda transition, part: 1j * transition.now.object_pos[:, 0], "a tensor of real numbers"),
)


@pytest.mark.parametrize(("kind", "term", "words"), OWN_TERMS)
def test_a_wrong_term_of_ones_own_is_named(kind: str, term: Callable[..., Any], words: str, tmp_path: Path):
    """With its file, before anything is written."""
    method = p2c.find_method("single_agent")
    (agent,) = method.agents
    if kind == "reward":
        own = p2c.RewardTerm(function=term, weight=1.0)
        agent = replace(agent, parts=(replace(agent.parts[0], reward=(own,)),))
    else:
        agent = replace(agent, observation=(*agent.observation, term))
    with pytest.raises(InvalidValueError, match=rf"{kind} term '<lambda>' \('.*test_calls.py', .*{words}"):
        p2c.train(replace(method, name="own", agents=(agent,)), tmp_path / "run", **SMALL)
    assert not list(tmp_path.iterdir())


def height(frame: p2c.observations.ObservationInputs) -> torch.Tensor:
    """A user's term that reads what no camera measures."""
    return frame.now.object_pos[:, 2:]


def test_a_task_of_ones_own_is_trained_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file, out = tmp_path / "dynamics.json", tmp_path / "run"
    arm = JointDynamics.of(ur5e.ARM.joints).with_values(latency=0.02)
    DynamicsFile(dynamics=arm).save(file)
    p2c.train("only_center", out, task=OWN, dynamics=file, **SMALL)
    run = read_run(out)
    assert run.experiment.train.physics_stages == ()
    assert (run.experiment.env.scene, run.experiment.env.sensing) == (OWN.scene, OWN.sensing)
    assert run.experiment.env.dynamics == arm
    assert read_run(out).experiment.env.with_files(file, None) == run.experiment.env
    assert p2c.load_policy(out).contract.task == "own"
    assert "in 3D" not in capsys.readouterr().out
    with pytest.raises(CheckpointError, match="'own', and 'nominal' is given"):
        p2c.train("only_center", out, task="nominal", resume=True)
    with pytest.raises(CheckpointError, match="began with another hidden; leave it out"):
        p2c.train("only_center", out, resume=True, hidden=(16,))
    p2c.train("only_center", out, resume=True, transitions=16)
    assert read_run(out).experiment.env == run.experiment.env


def test_an_observation_in_3d_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    method = p2c.find_method("single_agent")
    agent = replace(method.agents[0], observation=(*method.agents[0].observation, height))
    p2c.train(replace(method, name="own", agents=(agent,)), tmp_path / "run", **SMALL)
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first == "training own on 1 x cpu, 4 environments, preset: cpu"
    assert "in 3D, by height: for comparisons, 'deploy' refuses it" in second


def test_contradictions_and_options_that_are_gone_are_refused(tmp_path: Path):
    task = replace(OWN, dynamics=JointDynamics.of())
    DynamicsFile().save(file := tmp_path / "dynamics.json")
    wrong: tuple[tuple[type[Exception], str, dict[str, Any]], ...] = (
        (InvalidValueError, "already; leave out one", {"task": task, "dynamics": file}),
        (InvalidValueError, "leave out task", {"preset": p2c.preset("cpu", **SMALL), "task": "wide"}),
        (UnknownNameError, "Did you mean 'num_envs'", {"num_env": 3}),
        (PolicyMismatchError, "single_agent", {"start": "single_agent"}),  # a name, as for `load_policy`
    )
    with pytest.raises(PolicyMismatchError, match="policy 'only_wh', here 'only_center'"):
        p2c.evaluate("only_wh", p2c.find_method("only_center"))
    for error, words, given in wrong:
        with pytest.raises(error, match=words):
            p2c.train("proposed", tmp_path / "run", **given)
    assert [path.name for path in tmp_path.iterdir()] == ["dynamics.json"]


def test_evaluate_warns_of_another_camera():
    with pytest.warns(UserWarning, match="trained for another camera"):
        p2c.evaluate("proposed", num_envs=1, trials=1, change=lambda task: task.with_sensing(any_camera=True))


def test_a_back_end_with_which_mujoco_cannot_be_imported_is_named():
    command = [sys.executable, "-c", "import pixel2catch; pixel2catch.find_method"]
    environment = os.environ | {"MUJOCO_GL": "nonsense"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert "MUJOCO_GL is 'nonsense', with which MuJoCo cannot be imported: unset it" in done.stderr


IDLE = """
import time
import torch
import pixel2catch
from pixel2catch.api.threads import let_torch_sleep

def idle_time():
    start = time.process_time() - time.thread_time()
    for _ in range(100):
        torch.ones(2**18).exp()
        time.sleep(0.003)
    return time.process_time() - time.thread_time() - start

before = idle_time()
let_torch_sleep()
print(before, idle_time())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="GNU OpenMP")
def test_idle_threads_of_torch_take_no_time(monkeypatch: pytest.MonkeyPatch):
    """Also where torch was imported first: without the remedy, a second thread waits in a loop."""
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    done = subprocess.run([sys.executable, "-c", IDLE], capture_output=True, check=True, text=True)
    before, after = map(float, done.stdout.split())
    assert after < 0.5 * before
