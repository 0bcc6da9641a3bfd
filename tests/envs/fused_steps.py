"""Compares fused control steps with plain ones: `python fused_steps.py cpu|cuda`.

A program of its own, since the compiler cannot trace the checks of shapes that tests put into the code.
"""

import sys

import torch

from pixel2catch.devices import keeping
from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg
from pixel2catch.methods import METHODS
from pixel2catch.sim.graphs import fused


def require_equal_steps(plain: CatchEnv, compiled: CatchEnv, num_steps: int) -> None:
    generator = torch.Generator().manual_seed(1)
    for _ in range(num_steps):
        actions = {
            name: (2.0 * torch.rand(plain.num_envs, size, generator=generator) - 1.0).to(plain.device)
            for name, size in plain.action_sizes.items()
        }
        expected, found = plain.step(actions), compiled.step(actions)
        torch.testing.assert_close(found.observation.policy, expected.observation.policy)
        torch.testing.assert_close(found.observation.state, expected.observation.state)
        torch.testing.assert_close(found.rewards, expected.rewards)
        assert torch.equal(found.terminated, expected.terminated)


def main(device: str) -> None:
    """On a GPU by what it is trained with; on the CPU traced, without the code that would be generated."""
    is_cuda = device == "cuda"
    plain, compiled = (
        CatchEnv(CatchEnvCfg(), METHODS["proposed"], num_envs=4, device=device, seed=3, is_fused=is_fused)
        for is_fused in (False, is_cuda)
    )
    if not is_cuda:
        compiled._advance = fused(compiled._control_step, compiled.world.simulation, backend="aot_eager")
    with keeping({}):
        require_equal_steps(plain, compiled, 2)
        with torch.compiler.set_stance("fail_on_recompile"):
            require_equal_steps(plain, compiled, 10 if is_cuda else 95)  # through the ends of episodes


if __name__ == "__main__":
    main(sys.argv[1])
