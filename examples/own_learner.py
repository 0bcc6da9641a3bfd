"""A network and a learner of your own, with the Gymnasium view: policy gradients by hand.

python examples/own_learner.py
"""

import torch
import tyro
from torch import nn

import pixel2catch as p2c


def main(num_envs: int = 256, updates: int = 200, steps: int = 32, discount: float = 0.97) -> None:
    """Train a small network to bring the palm to the object; print the mean reward of a step."""
    env = p2c.CatchVectorEnv(p2c.make("single_agent", num_envs=num_envs))
    observation, _ = env.reset(seed=0)
    num_inputs, num_actions = observation.shape[1], env.action_space.sample().shape[1]
    network = nn.Sequential(nn.Linear(num_inputs, 64), nn.ELU(), nn.Linear(64, num_actions))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    for update in range(updates):
        log_probs, rewards, ends = [], torch.zeros(steps, num_envs), torch.zeros(steps, num_envs)
        for step in range(steps):
            actions = torch.distributions.Normal(network(torch.from_numpy(observation)), 0.3)
            action = actions.sample()
            observation, reward, terminated, _, _ = env.step(action.numpy())
            log_probs.append(actions.log_prob(action).sum(dim=-1))
            rewards[step], ends[step] = torch.from_numpy(reward), torch.from_numpy(terminated)
        gain = rewards.clone()
        for step in reversed(range(steps - 1)):
            gain[step] += discount * (1.0 - ends[step]) * gain[step + 1]
        optimizer.zero_grad()
        (-torch.stack(log_probs) * (gain - gain.mean()) / (gain.std() + 1e-6)).mean().backward()
        optimizer.step()
        print(f"update {update}: mean reward {rewards.mean():+.4f}")
    env.close()


if __name__ == "__main__":
    tyro.cli(main)
