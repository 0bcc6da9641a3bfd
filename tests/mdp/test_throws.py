"""Throws: paths with and without air, and ranges of the draws."""

from dataclasses import replace

import pytest
import torch

from pixel2catch.mdp.throws import Throw, ThrowCfg, drawn, flight_time, sample_throws, velocity_through_air
from pixel2catch.scene.constants import GRAVITY

CFG = ThrowCfg()


def throws(cfg: ThrowCfg = CFG, num_envs: int = 2000, seed: int = 0) -> Throw:
    return sample_throws(cfg, num_envs, torch.Generator().manual_seed(seed))


def test_clearance_lifts_a_low_peak():
    thrown = throws(ThrowCfg(peak_z=(0.5, 1.2), clearance=0.3))
    peak = thrown.pos[:, 2] + thrown.lin_vel[:, 2] ** 2 / (2 * GRAVITY)
    torch.testing.assert_close(peak, torch.maximum(thrown.pos[:, 2], thrown.aim[:, 2]) + 0.3)


def test_errors_of_the_thrower_have_their_deviations_and_leave_the_rest():
    """2 % of the speed, 0.03 rad in elevation and in azimuth, each on its own."""
    meant, thrown = throws(), throws(replace(CFG, speed_deviation=0.02, angle_deviation=0.03))
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
    spin = throws(replace(CFG, spin=10.0)).ang_vel
    speed = spin.norm(dim=-1)
    assert 9.9 < speed.max() <= 10.0
    assert speed.mean() == pytest.approx(5.0, rel=0.05)
    assert spin.mean(dim=0).abs().max() < 0.4
    assert not throws().ang_vel.any()


def fly(pos: torch.Tensor, vel: torch.Tensor, drag: float, duration: torch.Tensor) -> torch.Tensor:
    """Where an object is after its flight, in 2,000 steps [m]."""
    pos, vel, step = pos.double(), vel.double(), duration.double()[:, None] / 2000
    down = torch.tensor([0.0, 0.0, -GRAVITY], dtype=torch.float64)
    for _ in range(2000):
        after = vel + step * (down - drag * vel.norm(dim=-1, keepdim=True) * vel)
        pos, vel = pos + step * (vel + after) / 2, after
    return pos


def test_a_least_elevation_raises_the_peak():
    """Throws begin at the elevation or above it, and still fall through their aim."""
    cfg = replace(ThrowCfg(), peak_z=(1.0, 1.2), clearance=0.05, least_elevation=0.6)
    thrown, flat = throws(cfg), throws(replace(cfg, least_elevation=0.0))
    angle, lower = (
        torch.atan2(each.lin_vel[:, 2], each.lin_vel[:, :2].norm(dim=-1)) for each in (thrown, flat)
    )
    torch.testing.assert_close(angle, lower.clamp(min=0.6), atol=1e-5, rtol=0)
    end = thrown.pos + thrown.lin_vel * thrown.flight_time()[:, None]
    torch.testing.assert_close(end[:, :2], thrown.aim[:, :2], atol=1e-5, rtol=0)


@pytest.mark.parametrize("drag", [0.0, 0.03, 0.1])
def test_a_compensated_throw_arrives(drag: float):
    """0.1 /m is a cube of 6 cm that weighs 15 g; without compensation it falls short by 20 to 35 cm."""
    meant = sample_throws(ThrowCfg(), 20, torch.Generator().manual_seed(0))
    vel = velocity_through_air(meant.pos, meant.aim, meant.lin_vel, torch.full((20,), drag))
    arrival = fly(meant.pos, vel, drag, meant.flight_time())
    assert (arrival - meant.aim).norm(dim=-1).max() < 0.01
    if drag == 0.1:
        uncorrected = fly(meant.pos, meant.lin_vel, drag, meant.flight_time()) - meant.aim
        assert 0.2 < uncorrected.norm(dim=-1).min() < uncorrected.norm(dim=-1).max() < 0.35


def test_flight_time_by_hand():
    """Up with g m/s: back at the start after 2 s, at g/2 m, the peak, after 1 s."""
    up = torch.tensor([[0.0, 0.0, GRAVITY]]).expand(2, 3)
    times = flight_time(up, torch.tensor([0.0, GRAVITY / 2]))
    torch.testing.assert_close(times, torch.tensor([2.0, 1.0]), atol=1e-3, rtol=0)
