"""What a policy was trained on: ranges, grids and variants, worked out by hand."""

from dataclasses import replace
from operator import methodcaller
from typing import Any

import pytest

from paper_robot import JOINTS
from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.envs.cfg import CatchEnvCfg, TaskVariant
from pixel2catch.envs.tasks import TASKS
from pixel2catch.evaluation.stress import Change, is_trained_on, part, select_settings, together
from pixel2catch.mdp.dynamics_file import GainRanges
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.robots.spec import Vec3
from pixel2catch.scene.constants import RGB_CAMERA

NOMINAL = CatchEnvCfg()


def task(name: str, **values: Any) -> CatchEnvCfg:
    """The nominal task with other fields of one part."""
    return part(name, **values)(NOMINAL)


def with_variants(*changes: Change) -> CatchEnvCfg:
    """The nominal task, with a variant for each change."""
    variants = []
    for change in changes:
        each = change(NOMINAL)
        variants.append(
            TaskVariant(share=0.2, throws=each.throws, randomization=each.randomization, sensing=each.sensing)
        )
    return replace(NOMINAL, variants=tuple(variants))


@pytest.mark.parametrize(
    ("name", "trained", "met", "expected"),
    [
        ("restitution", (0.0, 0.6), (0.5, 0.5), True),
        ("restitution", (0.0, 0.6), (0.0, 0.7), False),
        ("restitution", (0.3, 0.6), (0.25, 0.25), False),
        ("camera_offset", (0.0, 0.02), (0.01, 0.02), True),
        ("camera_offset", 0.02, 0.01, False),  # never drawn
        ("camera_offset", 0.02, (0.01, 0.02), False),
        ("camera_offset", 0.0, 0.01, False),
        ("spin", 14.0, 10.0, True),  # less than the largest is nothing new
        ("spin", 14.0, 25.0, False),
        ("unstamped", 0.05, 1.0, True),  # what happens in some episodes may happen in all
        ("unstamped", 0.0, 1.0, False),
        ("unstamped", 1.0, 0.5, False),
        ("object_scale", 1.0, 0.8, False),  # what no range describes must be the same
        ("object_scale", 0.8, 0.8, True),
    ],
)
def test_a_range_lies_within_a_range_and_a_number_is_itself(name, trained, met, expected):
    place = {"restitution": "randomization", "spin": "throws", "object_scale": "scene"}.get(name, "sensing")
    assert is_trained_on(task(place, **{name: trained}), part(place, **{name: met})) == expected


@pytest.mark.parametrize(
    ("trained", "grid", "met", "expected"),
    [
        ((1, 2), 1.0, (1, 1), True),
        ((1, 2), 1.0, (1.5, 1.5), False),
        ((1, 2), 0.5, (1.5, 1.5), True),
        ((1, 2), 0.0, (1.5, 1.5), True),
        ((1, 3), 1.0, (1, 2), True),  # the same steps
        ((1, 3), 2.0, (2, 2), False),  # 1 and 3 only
        ((0.6, 4.3), 0.0, (2, 4), True),
        ((0.5, 4.5), 1.0, (3, 3), False),  # 0.5, 1.5, 2.5, 3.5, 4.5
    ],
)
def test_a_delay_on_a_grid_is_one_of_its_values(trained, grid, met, expected):
    seen = task("sensing", latency_steps=trained, latency_grid=grid)
    slow = task("randomization", command_delay=trained, command_delay_grid=grid)
    if met != (1, 2):  # the nominal latency is always trained on
        assert is_trained_on(seen, part("sensing", latency_steps=met)) == expected
    assert is_trained_on(slow, part("randomization", command_delay=met)) == expected


def test_any_delay_between_is_more_than_its_grid():
    between = part("sensing", latency_steps=(1, 3), latency_grid=0.0)
    assert not is_trained_on(task("sensing", latency_steps=(1, 4)), between)
    assert is_trained_on(task("sensing", latency_steps=(1, 4), latency_grid=0.0), between)


def test_gains_lie_within_joint_by_joint():
    def gains(low: float, high: float) -> Change:
        scale = ((low, high),) * len(JOINTS)
        return part("randomization", gains=GainRanges(stiffness_scale=scale, damping_scale=scale))

    assert is_trained_on(gains(0.7, 1.3)(NOMINAL), gains(0.8, 1.2))
    assert is_trained_on(NOMINAL, gains(0.8, 1.2))
    assert not is_trained_on(NOMINAL, gains(0.7, 1.3))  # the arm had 0.8 to 1.2


@pytest.mark.parametrize(
    ("pos", "std", "expected"),
    [
        (RGB_CAMERA.pos, 0.0, {"any", "release"}),
        ((-0.4, 0.1, 2.1), 0.002, {"any"}),
        ((-0.4, 0.1, 2.1), 0.003, set()),
        ((-0.4, 0.1, 2.4), 0.0, set()),  # above the region
    ],
)
def test_a_camera_is_that_of_the_training_or_of_its_region(pos: Vec3, std: float, expected: set[str]):
    """Errors of a calibration count up to three standard deviations; the training drew up to 8 mm."""
    covariance = tuple(tuple(std**2 * (row == column == 0) for column in range(6)) for row in range(6))
    file = CameraFile(camera=replace(RGB_CAMERA, pos=pos), pose_covariance=covariance)
    tasks = {"any": task("sensing", any_camera=True, camera_offset=(0.0, 0.008)), "release": NOMINAL}
    change = methodcaller("with_camera", file)
    assert {name for name, trained in tasks.items() if is_trained_on(trained, change)} == expected
    assert is_trained_on(NOMINAL.with_camera(CameraFile(camera=file.camera)), change) == (std == 0.0)


def test_everything_must_be_in_one_variant():
    late, heavy = part("sensing", latency_steps=(1, 4)), part("randomization", mass_scale=(1.0, 2.0))
    both = together(part("sensing", latency_steps=(4, 4)), part("randomization", mass_scale=(2.0, 2.0)))
    assert not is_trained_on(with_variants(late, heavy), both)
    assert is_trained_on(with_variants(late, together(late, heavy)), both)
    assert is_trained_on(with_variants(late, heavy), part("randomization", mass_scale=(2.0, 2.0)))
    assert is_trained_on(with_variants(late), together())
    assert is_trained_on(NOMINAL, part("scene", physics_hz=240.0))  # the accuracy of the simulation
    assert not is_trained_on(NOMINAL, lambda cfg: replace(cfg, dynamics=JointDynamics.of()))


def test_the_suite_holds_something_out_of_the_nominal_and_the_wide_task():
    trained = {
        name: {each.name for each in select_settings(()) if is_trained_on(TASKS[name], each.level.change)}
        for name in ("nominal", "wide")
    }
    nominal = {"nominal", "latency-1", "latency-2", "mass-15"}
    assert trained["nominal"] == nominal | {"restitution-0", "restitution-0.25", "restitution-0.5"}
    assert trained["nominal"] < trained["wide"]
    held_out = {"latency-0", "latency-5", "camera_position-4", "drops-30", "throws-far", "restitution-0.75"}
    assert not held_out & trained["wide"]
