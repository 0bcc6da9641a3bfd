"""Rays that are left out: nothing would have been in their way."""

from dataclasses import replace

import pytest
import torch

from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.tasks import find_task
from pixel2catch.methods import METHODS
from pixel2catch.scene.scene import SceneCfg

NUM_ENVS = 32


@torch.no_grad()
def test_what_is_left_out_hides_nothing(monkeypatch: pytest.MonkeyPatch):
    task = replace(find_task("sizes"), scene=SceneCfg(physics_hz=30.0))
    env = CatchEnv(task, METHODS["proposed"], num_envs=NUM_ENVS)
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
        env.step({name: 2.0 * torch.rand(NUM_ENVS, size, generator=generator) - 1.0 for name, size in sizes})
    assert num_hidden > 100
    assert sum(shares) / len(shares) < 0.7
