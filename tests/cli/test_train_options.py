"""Fields of the task as options of train, what a run writes down of them, and what it goes on with."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pixel2catch.cli.fields import with_fields
from pixel2catch.cli.main import main, parse
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.tasks import TASKS
from pixel2catch.learning.config import TrainCfg
from pixel2catch.methods import METHODS, find_method

SIZE = ("--num-envs", "4", "--rollout-steps", "2", "--mini-batches", "2", "--transitions", "16")
TRAIN = ("train", "only_center", "--device", "cpu", *SIZE, "--hidden", "8", "--env.scene.physics-hz", "30")
LATE = ("--env.sensing.latency-steps", "1", "3", "--env.throws.hover-steps", "7", "7")

COVARIANCE = tuple(tuple(0.5 if i == j else 0.0 for j in range(6)) for i in range(6))
OTHER = {
    "engine": "physx",
    "cone": "pyramidal",
    "robot_model": ("maker.urdf",),
    "robot_surface": "visual",
    "workcell": "ur5e_leap",
    "physics_hz": 240.0,
    "object_scale": 1.1,
    "objects": ("cube_s", "cone_l"),
    "quat": (1.0, 0.0, 0.0, 0.0),
    "width": 640,  # policies know no other size
    "height": 480,
    "distortion": (0.1, 0.2, 0.3, 0.4),
    "pose_covariance": COVARIANCE,
    "focal_std": 0.1,
    "stiffness_scale": ((0.9, 1.1), (0.8, 1.2)),
    "damping_scale": ((0.9, 1.1),),
    "is_damping_relative": (True, False),
    "share": 0.2,
    "corner_noise": 4.0,  # in the variants as in the task
    "least_visible": 0.1,
    "joint_noise": 0.01,
    "action_noise": 2.0,
}


def other(name: str, value: Any) -> Any:
    """Another value that is allowed."""
    if name in OTHER:
        return OTHER[name]
    if isinstance(value, bool):
        return not value
    return tuple(entry + 1 for entry in value) if isinstance(value, tuple) else value + 1


def changed(cfg: Any) -> Any:
    """Every field of a configuration with another value, but the dynamics: they have a file of their own."""
    values = {field.name: getattr(cfg, field.name) for field in dataclasses.fields(cfg)}
    return dataclasses.replace(
        cfg,
        **{
            name: changed(value)
            if dataclasses.is_dataclass(value)
            else tuple(map(changed, value))
            if name == "variants"
            else other(name, value)
            for name, value in values.items()
            if name != "dynamics"
        },
    )


def options(value: Any, name: str = "") -> Iterator[tuple[str, ...]]:
    """Every leaf of a configuration as an option."""
    prefix = f"{name}." if name else ""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if field.name != "dynamics":
                yield from options(getattr(value, field.name), prefix + field.name)
    elif name.endswith(("variants", "pose_covariance")):
        for number, entry in enumerate(value):
            yield from options(entry, f"{prefix}{number}")
    else:
        entries = value if isinstance(value, tuple) else (value,)
        flat = (part for entry in entries for part in (entry if isinstance(entry, tuple) else (entry,)))
        yield name, *map(str, flat)


@pytest.mark.parametrize("name", ["nominal", "wide"])
def test_every_field_of_a_task_can_be_set(name: str):
    task = TASKS[name]
    expected = changed(task)
    assert expected != task
    assert with_fields(task, tuple(options(expected))) == expected


def test_what_is_set_reaches_the_environment():
    train = parse([*TRAIN, "--task", "wide", "--env.variants.0.share=0.5", *LATE])
    cfg = train.with_task(train.resolve())
    assert [variant.share for variant in cfg.env.variants] == [0.5, 0.2, 0.2, 0.1]
    env = CatchEnv(dataclasses.replace(cfg.env, variants=()), METHODS["only_center"], num_envs=64)
    try:
        assert env.cfg.sensing.latency_steps == cfg.latency_steps == (1.0, 3.0)
        assert set(env._episode.parameters.latency.tolist()) == {1.0, 2.0, 3.0}
        assert set(env._episode.throw.hover_steps.tolist()) == {7}
    finally:
        env.close()


def test_short_options_and_fields_of_the_task_are_one():
    train = parse([*TRAIN, "--env.sensing.latency-steps", "0", "2", "--env.scene.physics-hz", "60"])
    cfg = train.with_task(train.resolve())
    assert (cfg.physics_hz, cfg.env.scene.physics_hz) == ((60.0,), 60.0)
    assert cfg.env.sensing.latency_steps == cfg.latency_steps == (0.0, 2.0)
    objects = parse([*TRAIN, "--env.objects", "unseen", "cube_s"])
    assert "cross" in objects.with_task(objects.resolve()).env.objects


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (("--env.sensing.latency-stps", "1", "3"), ("--env.sensing.latency-steps",)),
        (("--env.sensing.latency-steps", "1"), ("--env.sensing.latency-steps", "Expected 2 values")),
        (("--env.sensing.edge-noise", "much"), ("--env.sensing.edge-noise", "much")),
        (("--env.scene.object-scale", "9"), ("object_scale is 9",)),
    ],
)
def test_a_wrong_field_or_value_says_what_is_right(
    option: tuple[str, ...], words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit) as stopped:
        main([*TRAIN, *option, "--out", str(tmp_path / "run")])
    assert stopped.value.code == 2
    output = "".join(capsys.readouterr())
    assert all(word in output for word in words)
    assert not list(tmp_path.iterdir())


def test_help_tells_all_fields(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stopped:
        main(["train", "--device", "cpu", "--env.help"])
    assert stopped.value.code == 0
    assert "--env.sensing.latency-steps" in capsys.readouterr().out


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a teacher and an own latency."""
    out = tmp_path_factory.mktemp("own") / "run"
    teacher = ("--teacher", "object_position-seed0")
    assert main([*TRAIN, *LATE, *teacher, "--task", "wide", "--out", str(out)]) == 0
    return out


def test_a_run_goes_on_with_its_own_configuration(run: Path):
    before = json.loads((run / "config.json").read_text())
    assert main(["train", "--resume", "--transitions", "32", "--out", str(run)]) == 0
    after = json.loads((run / "config.json").read_text())
    assert after["train"].pop("transitions") == 32
    assert before["train"].pop("transitions") == 16
    assert after == before
    assert after["train"]["teacher"].endswith("object_position-seed0")
    assert json.loads((run / "summary.json").read_text())["transitions"] == 32


def test_a_configuration_that_was_read_is_the_one_that_was_written(run: Path):
    cfg = TrainCfg.of_run(run)
    assert isinstance(cfg.env, CatchEnvCfg)
    assert cfg.env == with_fields(cfg.env, ())
    assert cfg.env.sensing.latency_steps == (1.0, 3.0)
    assert cfg.env.variants[0].sensing == TASKS["wide"].variants[0].sensing
    assert (cfg.method, cfg.task, cfg.hidden) == ("only_center", "wide", (8,))


def test_a_run_tells_terms_and_weights_of_its_agents(run: Path):
    agents = json.loads((run / "config.json").read_text())["agents"]
    method = find_method("only_center")
    assert list(agents) == [agent.name for agent in method.agents]
    assert agents["arm"]["observation"] == ["pixels", "palm_pose", "joint_pos", "last_action"]
    assert agents["arm"]["rewards"] == {
        "arm.elapsed_time": -0.01,
        "arm.palm_approach": 1.0,
        "arm.success": 10.0,
        "arm.nearness": 0.1,
        "arm.drop": -5.0,
        "arm.table_contact": -5.0,
        "arm.action_square": -0.01,
    }


@pytest.mark.parametrize(
    "content", ["{", "{}", '{"train": {"wings": 2}, "policy": {"method": "x"}, "env": {}}']
)
def test_a_damaged_configuration_is_refused(content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "config.json").write_text(content)
    assert main(["train", "--resume", "--out", str(tmp_path)]) == 2
    assert "is no configuration that this code reads" in capsys.readouterr().err
