"""Throws: the path really peaks and comes down where it is said to, and the draws fill their ranges."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pixel2catch.mdp.throws import (
    Throw,
    ThrowCfg,
    drawn,
    launch_velocity,
    sample_paths,
    sample_throws,
    uniform,
)
from pixel2catch.scene.constants import GRAVITY

CFG = ThrowCfg()
RELEASE_HEIGHT, AIM_HEIGHT = st.floats(0.75, 0.85), st.floats(0.9, 1.1)


def throws(cfg: ThrowCfg = CFG, num_envs: int = 2000, seed: int = 0) -> Throw:
    return sample_throws(cfg, num_envs, torch.Generator().manual_seed(seed))


def fly(pos: np.ndarray, vel: np.ndarray, dt: float = 5e-4, duration: float = 2.0) -> np.ndarray:
    """Integrate gravity in small steps (trapezoidal rule): positions (time, 3)."""
    path = [pos]
    for _ in range(int(duration / dt)):
        after = vel - np.array((0.0, 0.0, GRAVITY)) * dt
        path.append(path[-1] + (vel + after) / 2 * dt)
        vel = after
    return np.array(path)


def descent(path: np.ndarray, height: float) -> np.ndarray:
    """Where a path first comes down through a height."""
    peak = int(path[:, 2].argmax())
    return path[peak:][path[peak:, 2] <= height][0]


def test_velocity_by_hand():
    """Rise of g/2 m takes 1 s, fall of g/8 m 0.5 s: 3 m in 1.5 s, -0.75 m in 1.5 s, and g m/s upwards."""
    pos = torch.tensor([[0.0, 0.0, 0.0]])
    aim = torch.tensor([[3.0, -0.75, GRAVITY / 2 - GRAVITY / 8]])
    velocity = launch_velocity(pos, aim, torch.tensor([GRAVITY / 2]))
    torch.testing.assert_close(velocity, torch.tensor([[2.0, -0.5, GRAVITY]]))


def test_the_path_peaks_and_comes_down_through_the_aim():
    thrown = throws(num_envs=8)
    for pos, vel, aim in zip(thrown.pos.double(), thrown.lin_vel.double(), thrown.aim.double(), strict=True):
        path = fly(pos.numpy(), vel.numpy())
        np.testing.assert_allclose(descent(path, aim[2].item()), aim.numpy(), atol=5e-3)
        least = CFG.clearance + max(pos[2].item(), aim[2].item())
        assert max(CFG.peak_z[0], least) - 1e-3 < path[:, 2].max() < max(CFG.peak_z[1], least) + 1e-3


@given(RELEASE_HEIGHT, AIM_HEIGHT, st.floats(1.6, 1.9), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_peak_height_and_flight_time_of_any_throw(start, catch, peak, dx, dy):
    pos = torch.tensor([[0.0, 0.0, start]], dtype=torch.float64)
    aim = torch.tensor([[dx, dy, catch]], dtype=torch.float64)
    vx, vy, vz = launch_velocity(pos, aim, torch.tensor([peak], dtype=torch.float64))[0].tolist()
    assert start + vz**2 / (2 * GRAVITY) == pytest.approx(peak)
    duration = (vz + (vz**2 - 2 * GRAVITY * (catch - start)) ** 0.5) / GRAVITY  # the later of two crossings
    assert (vx * duration, vy * duration) == pytest.approx((dx, dy), abs=1e-6)


@pytest.mark.parametrize(
    ("values", "bounds"),
    [("pos", ("release_x", "release_y", "release_z")), ("aim", ("aim_x", "aim_y", "aim_z"))],
)
def test_draws_fill_their_ranges(values, bounds):
    drawn = getattr(throws(), values)
    for column, name in enumerate(bounds):
        low, high = getattr(CFG, name)
        assert low <= drawn[:, column].min() < low + 0.01 * (high - low)
        assert high - 0.01 * (high - low) < drawn[:, column].max() <= high


def test_ranges_are_those_of_the_task():
    assert dataclasses.asdict(CFG) == {
        "release_x": (2.4, 2.9),
        "release_y": (-0.3, 0.3),
        "release_z": (0.75, 0.85),
        "aim_x": (0.65, 0.85),
        "aim_y": (-0.35, 0.35),
        "aim_z": (0.9, 1.1),
        "peak_z": (1.6, 1.9),
        "clearance": 0.2,
        "hover_steps": (5, 19),
        "speed_deviation": 0.0,
        "angle_deviation": 0.0,
        "spin": 0.0,
    }


def test_hover_takes_every_number_of_steps_from_first_to_last():
    assert set(throws().hover_steps.tolist()) == set(range(5, 20))


def test_clearance_lifts_a_low_peak():
    thrown = throws(ThrowCfg(peak_z=(0.5, 0.6), clearance=0.3))
    peak = thrown.pos[:, 2] + thrown.lin_vel[:, 2] ** 2 / (2 * GRAVITY)
    torch.testing.assert_close(peak, torch.maximum(thrown.pos[:, 2], thrown.aim[:, 2]) + 0.3)


def test_orientations_are_rotations_without_a_preferred_direction():
    quat = throws(num_envs=20_000).quat
    torch.testing.assert_close(quat.norm(dim=-1), torch.ones(len(quat)))
    # Uniform on the sphere of quaternions: mean 0 and covariance I / 4.
    torch.testing.assert_close(quat.mean(dim=0), torch.zeros(4), atol=0.02, rtol=0)
    torch.testing.assert_close(quat.T @ quat / len(quat), torch.eye(4) / 4, atol=0.02, rtol=0)


def test_a_seed_gives_its_throws_again():
    assert torch.equal(throws(seed=1).lin_vel, throws(seed=1).lin_vel)
    assert not torch.equal(throws(seed=1).lin_vel, throws(seed=2).lin_vel)


@given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(0.0, 1e3)), min_size=1, max_size=5))
def test_uniform_stays_in_any_range(bounds):
    ranges = tuple((low, low + width) for low, width in bounds)
    drawn = uniform(ranges, 50, torch.Generator().manual_seed(0))
    assert drawn.shape == (50, len(ranges))
    for column, (low, high) in zip(drawn.T, ranges, strict=True):
        slack = 1e-6 * (abs(low) + abs(high))  # float32
        assert column.min() >= low - slack
        assert column.max() <= high + slack


def test_errors_of_the_thrower_have_their_deviations_and_leave_the_rest():
    """2 % of the speed, 0.03 rad in elevation and in azimuth, each on its own."""
    meant, thrown = throws(), throws(dataclasses.replace(CFG, speed_deviation=0.02, angle_deviation=0.03))
    for name in ("pos", "quat", "aim", "hover_steps"):
        assert torch.equal(getattr(meant, name), getattr(thrown, name))

    def polar(vel: torch.Tensor) -> torch.Tensor:
        along = vel[:, :2].norm(dim=-1)
        speed, azimuth = vel.norm(dim=-1), torch.atan2(vel[:, 1], vel[:, 0]).remainder(2 * torch.pi)
        return torch.stack((speed.log(), torch.atan2(vel[:, 2], along), azimuth), dim=-1)

    error = polar(thrown.lin_vel) - polar(meant.lin_vel)
    torch.testing.assert_close(error.std(dim=0), torch.tensor([0.02, 0.03, 0.03]), rtol=0.08, atol=0)
    assert error.mean(dim=0).abs().max() < 0.003
    assert torch.corrcoef(error.T).sub(torch.eye(3)).abs().max() < 0.08


def test_a_throwers_deviation_may_be_each_episodes_own():
    """Uniform from 0 to s, the relative errors of all throws have the deviation s / √3."""
    meant = throws(num_envs=20_000).lin_vel.norm(dim=-1)
    thrown = throws(dataclasses.replace(CFG, speed_deviation=(0.0, 0.06)), num_envs=20_000)
    error = thrown.lin_vel.norm(dim=-1) / meant - 1.0
    assert error.std().item() == pytest.approx(0.06 / 3**0.5, rel=0.04)


def test_amounts_are_numbers_or_ranges():
    generator = torch.Generator().manual_seed(0)
    before = generator.get_state()
    assert drawn(0.25, 3, generator).tolist() == [0.25] * 3
    assert torch.equal(generator.get_state(), before), "a number draws nothing"
    values = drawn((2.0, 4.0), 2000, generator)
    assert 2.0 <= values.min() < 2.02
    assert 3.98 < values.max() <= 4.0
    assert drawn((1.5, 1.5), 2, generator).tolist() == [1.5] * 2


def test_spin_is_uniform_in_size_and_has_no_preferred_axis():
    spin = throws(dataclasses.replace(CFG, spin=10.0)).ang_vel
    speed = spin.norm(dim=-1)
    assert 9.9 < speed.max() <= 10.0
    assert speed.mean() == pytest.approx(5.0, rel=0.05)
    assert spin.mean(dim=0).abs().max() < 0.4
    assert not throws().ang_vel.any()


def test_flight_time_by_hand():
    """Up with g/2 m/s for half a second, down again to the same height: 1 s; to g/8 m above: earlier."""
    still = torch.zeros(1, 3)
    up = torch.tensor([[1.0, 0.0, GRAVITY / 2]])
    cfg = {"pos": still, "quat": torch.zeros(1, 4), "hover_vel": still, "lin_vel": up, "ang_vel": still}
    hover = torch.zeros(1, dtype=torch.long)
    assert Throw(**cfg, aim=still, hover_steps=hover).flight_time().item() == pytest.approx(1.0)
    peak = torch.tensor([[0.0, 0.0, GRAVITY / 8]])
    assert Throw(**cfg, aim=peak, hover_steps=hover).flight_time().item() == pytest.approx(0.5, abs=1e-3)


def test_sampled_paths_lead_from_release_to_aim_in_free_fall():
    cfg = ThrowCfg()
    paths = sample_paths(cfg, 30, seed=1)
    throw = sample_throws(cfg, 30, torch.Generator().manual_seed(1))
    torch.testing.assert_close(paths[:, 0], throw.pos.double())
    torch.testing.assert_close(paths[:, -1], throw.aim.double(), atol=1e-3, rtol=0.0)
    bend = paths.diff(n=2, dim=1)
    torch.testing.assert_close(bend[..., :2], torch.zeros_like(bend[..., :2]), atol=1e-5, rtol=0.0)
    flight = (-bend[:, 0, 2] / GRAVITY).sqrt() * (paths.shape[1] - 1)
    assert ((flight > 0.7) & (flight < 1.2)).all()
