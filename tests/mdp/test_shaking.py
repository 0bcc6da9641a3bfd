"""A table that shakes: kinematics of its base, and a throw as seen from it."""

from math import pi

import torch

from pixel2catch.mdp.shaking import Shake, ShakeCfg, sample_shake
from pixel2catch.mdp.throws import ThrowCfg, sample_throws
from pixel2catch.scene.constants import CONTROL_DT

CFG = ShakeCfg(amplitude=0.005, frequency=3.0)


def draw(cfg: ShakeCfg = CFG, num_envs: int = 1000) -> Shake:
    shake = sample_shake(cfg, num_envs, torch.Generator().manual_seed(0))
    assert shake is not None
    return shake


def test_a_table_that_stands_still_draws_nothing():
    for cfg in (ShakeCfg(), ShakeCfg(amplitude=0.01), ShakeCfg(frequency=2.0)):
        assert sample_shake(cfg, 3, torch.Generator()) is None


def test_the_base_swings_along_a_line_with_its_amplitude_and_frequency():
    shake = draw()
    times = torch.arange(0, 200)[:, None] / (200 * 3.0)  # one period
    path = shake.displacement(times.expand(200, 1000))
    torch.testing.assert_close(path.norm(dim=-1).amax(dim=0), torch.full((1000,), 0.005), rtol=1e-3, atol=0)
    torch.testing.assert_close(path[100], -path[0], atol=1e-6, rtol=0)  # half a period later
    flatness = torch.linalg.svdvals(path[:, :5].transpose(0, 1))
    assert (flatness[:, 1] < 1e-4 * flatness[:, 0]).all()


def test_velocity_and_acceleration_are_derivatives():
    shake, step = draw(num_envs=7), 1e-3
    double = Shake(sine=shake.sine.double(), cosine=shake.cosine.double(), rate=shake.rate.double())
    time = torch.linspace(0.0, 1.0, 7, dtype=torch.float64)
    for function, derivative in (
        (double.displacement, double.velocity),
        (double.velocity, double.acceleration),
    ):
        difference = (function(time + step) - function(time - step)) / (2 * step)
        torch.testing.assert_close(difference, derivative(time), rtol=1e-3, atol=1e-4)


def test_the_largest_acceleration_by_hand():
    """(2 pi 3 Hz)² 5 mm = 1.78 m/s²."""
    times = torch.linspace(0.0, 1.0, 500)[:, None].expand(500, 20)
    largest = draw(num_envs=20).acceleration(times).norm(dim=-1).amax(dim=0)
    torch.testing.assert_close(largest, torch.full((20,), (6 * pi) ** 2 * 0.005), rtol=1e-3, atol=0)


def test_a_throw_seen_from_the_base():
    """Minus the base's place at the start, minus its velocity at start and release; the aim stays."""
    shake, throw = draw(num_envs=4), sample_throws(ThrowCfg(), 4, torch.Generator().manual_seed(0))
    seen = shake.seen_from_base(throw)
    start, release = torch.zeros(4), throw.hover_steps * CONTROL_DT
    torch.testing.assert_close(seen.pos + shake.displacement(start), throw.pos)
    torch.testing.assert_close(seen.hover_vel, -shake.velocity(start))
    torch.testing.assert_close(seen.lin_vel + shake.velocity(release), throw.lin_vel)
    assert torch.equal(seen.aim, throw.aim)
