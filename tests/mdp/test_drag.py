"""Throws through air: they arrive, by a finer integration than the one that aimed them."""

import pytest
import torch

from pixel2catch.mdp.throws import ThrowCfg, flight_time, sample_throws, velocity_through_air
from pixel2catch.scene.constants import GRAVITY


def fly(pos: torch.Tensor, vel: torch.Tensor, drag: float, duration: torch.Tensor) -> torch.Tensor:
    """Where an object is after its flight, in 2,000 steps [m]."""
    pos, vel, step = pos.double(), vel.double(), duration.double()[:, None] / 2000
    down = torch.tensor([0.0, 0.0, -GRAVITY], dtype=torch.float64)
    for _ in range(2000):
        after = vel + step * (down - drag * vel.norm(dim=-1, keepdim=True) * vel)
        pos, vel = pos + step * (vel + after) / 2, after
    return pos


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


def test_without_drag_nothing_changes():
    meant = sample_throws(ThrowCfg(), 20, torch.Generator().manual_seed(0))
    vel = velocity_through_air(meant.pos, meant.aim, meant.lin_vel, torch.zeros(20))
    torch.testing.assert_close(vel, meant.lin_vel, atol=1e-4, rtol=0)


def test_flight_time_by_hand():
    """Up with g m/s: back at the start after 2 s, at g/2 m, the peak, after 1 s."""
    up = torch.tensor([[0.0, 0.0, GRAVITY]]).expand(2, 3)
    times = flight_time(up, torch.tensor([0.0, GRAVITY / 2]))
    torch.testing.assert_close(times, torch.tensor([2.0, 1.0]), atol=1e-3, rtol=0)


def test_the_same_throws_are_drawn_with_and_without_air():
    plain = sample_throws(ThrowCfg(), 5, torch.Generator().manual_seed(3))
    aired = sample_throws(ThrowCfg(), 5, torch.Generator().manual_seed(3), torch.full((5,), 0.05))
    for name in ("pos", "quat", "aim", "hover_steps"):
        assert torch.equal(getattr(plain, name), getattr(aired, name))
    assert (aired.lin_vel.norm(dim=-1) > plain.lin_vel.norm(dim=-1)).all()
