"""Rays that are left out: nothing would have been in their way."""

import pytest
import torch

from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.tasks import find_task
from pixel2catch.methods import METHODS


@torch.no_grad()
def test_what_is_left_out_hides_nothing(monkeypatch: pytest.MonkeyPatch):
    env = CatchEnv(find_task("sizes"), METHODS["proposed"], num_envs=64)
    ray, shares, num_hidden = env.world.simulation.ray, [], 0

    def checked(origin, directions, groups, mask):
        nonlocal num_hidden
        everywhere = ray(origin, directions, groups)
        hidden = ((everywhere >= 0.0) & (everywhere < 1.0)).any(dim=-1)
        assert not (hidden & ~mask).any()
        chosen = ray(origin, directions, groups, mask)
        assert torch.equal(chosen, torch.where(mask[:, None], everywhere, -1.0))
        num_hidden += int(hidden.sum())
        shares.append(float(mask.float().mean()))
        return chosen

    monkeypatch.setattr(env.world.simulation, "ray", checked)
    generator = torch.Generator().manual_seed(0)
    for _ in range(80):
        sizes = env.action_sizes.items()
        env.step({name: 2.0 * torch.rand(64, size, generator=generator) - 1.0 for name, size in sizes})
    assert num_hidden > 100
    assert sum(shares) / len(shares) < 0.7
