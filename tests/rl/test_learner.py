"""The learner against numbers worked out by hand, and its traps."""

import copy
import dataclasses
from collections.abc import Callable, Iterator
from functools import partial

import pytest
import torch
from reaching import CONTRACT, SMALL, Observation, ReachingEnv, Step, roll_out
from skrl.multi_agents.torch.mappo import MAPPO
from skrl.resources.schedulers.torch import KLAdaptiveLR

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.rl import gradient_step
from pixel2catch.rl.config import PRESETS, TrainCfg, preset
from pixel2catch.rl.learner import Learner
from pixel2catch.rl.memory import RolloutMemory


@pytest.fixture
def learner() -> Learner:
    torch.manual_seed(0)
    return Learner(SMALL, ReachingEnv(SMALL))


def test_advantages_by_hand_and_no_leak_over_a_time_out() -> None:
    """Discount 1/2, lambda 1, values 0: returns are discounted sums to the end of the episode.

    Environment 0 is cut off after step 2, environment 1 terminates there, environment 2 goes on.
    Rewards 1, 1, 4 in each: returns 1.5, 1, 4 for the first two, 1 + (1 + 4/2)/2 = 2.5, 3, 4 for the third.
    """
    cfg = dataclasses.replace(
        SMALL, num_envs=3, rollout_steps=3, discount=0.5, gae_lambda=1.0, mini_batches=1, epochs=1
    )
    learner = Learner(cfg, ReachingEnv(cfg))
    for model in learner.models.values():
        for parameter in list(model["value"].network.parameters())[-2:]:
            torch.nn.init.zeros_(parameter)
    observation = Observation({"arm": torch.randn(3, 4), "hand": torch.randn(3, 2)}, torch.randn(3, 3))
    for index, reward in enumerate((1.0, 1.0, 4.0)):
        rewards = {"arm": torch.full((3,), reward), "hand": torch.full((3,), reward)}
        terminated = torch.tensor([False, index == 1, False])
        truncated = torch.tensor([index == 1, False, False])
        actions = learner.act(observation)
        learner.record(
            observation.policy, observation.state, actions, Step(observation, rewards, terminated, truncated)
        )
    learner.update(0.0)
    for agent in learner.agents:
        returns = learner.memories[agent].get_tensor_by_name("returns")[..., 0]
        scaler = learner.mappo._value_preprocessor[agent]
        expected = torch.tensor([[1.5, 1.5, 2.5], [1.0, 1.0, 3.0], [4.0, 4.0, 4.0]])
        torch.testing.assert_close(scaler(returns, inverse=True), expected, atol=1e-5, rtol=0)


def test_mini_batches_hold_every_transition_once() -> None:
    memory = RolloutMemory(memory_size=4, num_envs=6, device="cpu")
    memory.create_tensor(name="observations", size=1, dtype=torch.float32)
    for index in range(4):
        values = (torch.arange(6.0) + 6 * index)[:, None]
        memory.add_samples(observations=values)  # pyright: ignore[reportArgumentType] (wrong in skrl)
    batches = [batch[0] for batch in memory.sample(["observations"], batch_size=24, mini_batches=3)]
    assert [len(batch) for batch in batches] == [8, 8, 8]
    drawn = torch.cat(batches)[:, 0]
    assert drawn.tolist() != sorted(drawn.tolist())
    assert sorted(drawn.tolist()) == list(range(24))


class OrderedMemory(RolloutMemory):
    """Draws mini-batches from a generator of its own, so that two learners see the same ones."""

    def sample(
        self, names: list[str], *, batch_size: int, mini_batches: int = 1, sequence_length: int = 1
    ) -> Iterator[list[torch.Tensor]]:
        with torch.random.fork_rng():
            torch.manual_seed(self.memory_index)
            yield from super().sample(names, batch_size=batch_size, mini_batches=mini_batches)


@pytest.mark.parametrize("schedule", ["linear", "kl"])
def test_update_is_that_of_skrl(schedule: str) -> None:
    """Three updates by skrl's own method and by ours give the same networks, statistics and losses."""
    cfg = dataclasses.replace(
        SMALL, schedule=schedule, entropy_scale=0.01, kl_target=0.004, gradient_clip=0.5
    )
    outcomes = []
    for is_ours in (True, False):
        torch.manual_seed(0)
        learner = Learner(cfg, ReachingEnv(cfg))
        for memory in learner.memories.values():
            memory.__class__ = OrderedMemory
        update = learner.mappo.update if is_ours else skrl_update(learner)
        env = ReachingEnv(cfg)
        losses = []
        for seed in range(3):
            torch.manual_seed(seed)
            roll_out(learner, env)
            for agent in learner.agents:
                update(timestep=0, timesteps=0, uid=agent)
            tracked = {name.lower(): values[-1] for name, values in learner.mappo.tracking_data.items()}
            names = (
                ("policy_loss/{}", "value_loss/{}")
                if is_ours
                else ("loss / policy loss ({})", "loss / value loss ({})")
            )
            losses += [tracked[name.format(agent)] for name in names for agent in learner.agents]
        weights = [
            tensor
            for agent in learner.state_dict().values()
            for name in ("policy", "value", "value_preprocessor")
            for tensor in agent[name].values()
        ]
        outcomes.append((losses, weights))
    assert outcomes[0][0] == pytest.approx(outcomes[1][0], rel=1e-3, abs=1e-5)
    for ours, theirs in zip(outcomes[0][1], outcomes[1][1], strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-5)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_captured_steps_equal_eager_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = dataclasses.replace(SMALL, device="cuda")
    outcomes = []
    for num_eager_steps in (3, 10**9):
        monkeypatch.setattr(gradient_step, "NUM_EAGER_STEPS", num_eager_steps)
        torch.manual_seed(0)
        learner, env = Learner(cfg, ReachingEnv(cfg)), ReachingEnv(cfg)
        for progress in (0.0, 0.5):
            roll_out(learner, env)
            metrics = learner.update(progress)
        outcomes.append((metrics, learner.export(CONTRACT).state_dict()))
    assert outcomes[0][0] == pytest.approx(outcomes[1][0], rel=1e-4)
    for name, tensor in outcomes[0][1].items():
        torch.testing.assert_close(tensor, outcomes[1][1][name])


def skrl_update(learner: Learner) -> Callable[..., None]:
    """Give a learner the optimisers and schedules of skrl, and return skrl's update."""
    cfg, mappo = learner.cfg, learner.mappo
    settings = {
        "learning_epochs": cfg.epochs,
        "mini_batches": cfg.mini_batches,
        "discount_factor": cfg.discount,
        "gae_lambda": cfg.gae_lambda,
        "ratio_clip": cfg.ratio_clip,
        "value_clip": cfg.value_clip,
        "value_loss_scale": cfg.value_loss_scale,
        "entropy_loss_scale": cfg.entropy_scale,
        "grad_norm_clip": cfg.gradient_clip,
    }
    for name, value in settings.items():
        setattr(mappo.cfg, name, dict.fromkeys(learner.agents, value))
    for agent, models in learner.models.items():
        parameters = [*models["policy"].parameters(), *models["value"].parameters()]
        optimizer = torch.optim.Adam(parameters, lr=cfg.learning_rate)
        mappo.optimizers[agent] = mappo.checkpoint_modules[agent]["optimizer"] = optimizer
        if cfg.schedule == "kl":
            mappo.schedulers[agent] = KLAdaptiveLR(
                optimizer, kl_threshold=cfg.kl_target, min_lr=cfg.final_learning_rate
            )
    return partial(MAPPO.update, mappo)


def test_exploration_is_recorded_unclipped(learner: Learner) -> None:
    roll_out(learner, ReachingEnv(SMALL))
    actions = learner.memories["arm"].get_tensor_by_name("actions")
    assert actions.abs().max() > 1.0
    means = actions.mean((0, 1))
    normal = torch.distributions.Normal(0.0, 1.0)
    recorded = learner.memories["arm"].get_tensor_by_name("log_prob")[..., 0]
    assert (recorded - normal.log_prob(actions - means).sum(-1)).abs().mean() < 0.3


def test_exported_policy_is_the_mean_of_the_learner(learner: Learner) -> None:
    roll_out(learner, ReachingEnv(SMALL))
    learner.update(0.0)
    policy = learner.export(CONTRACT)
    generator = torch.Generator().manual_seed(1)
    for agent, num_inputs in ReachingEnv.observation_sizes.items():
        observations = {agent: 300 * torch.randn(100, num_inputs, generator=generator)}
        scaled = learner.mappo._observation_preprocessor[agent](observations[agent])
        _, outputs = learner.models[agent]["policy"].act({"observations": scaled}, role="policy")
        exported = policy.network(agent)(observations[agent])
        assert torch.equal(exported, outputs["mean_actions"])
        assert scaled.abs().max() == 5.0


def test_linear_learning_rate(learner: Learner) -> None:
    rates = []
    for progress in (0.0, 0.5, 1.0, 1.1):
        roll_out(learner, ReachingEnv(SMALL))
        metrics = learner.update(progress)
        assert metrics["learning_rate/arm"] == metrics["learning_rate/hand"]
        rates.append(metrics["learning_rate/arm"])
    assert rates == pytest.approx([1e-3, 5.5e-4, 1e-4, 1e-4])


@pytest.mark.parametrize(("target", "changes"), [(100.0, 1.5**4), (1e-9, 1 / 1.5**4)])
def test_adaptive_learning_rate(target: float, changes: float) -> None:
    """Four epochs, each of which multiplies or divides the rate by 1.5; never below the lower bound."""
    cfg = dataclasses.replace(
        SMALL, schedule="kl", kl_target=target, learning_rate=1e-3, final_learning_rate=1e-5
    )
    learner = Learner(cfg, ReachingEnv(cfg))
    roll_out(learner, ReachingEnv(cfg))
    assert learner.update(0.0)["learning_rate/hand"] == pytest.approx(1e-3 * changes)
    if target < 1.0:
        for _ in range(3):
            roll_out(learner, ReachingEnv(cfg))
            learner.update(0.0)
        assert learner.mappo.optimizers["hand"].param_groups[0]["lr"] == pytest.approx(1e-5)


def test_state_round_trip_is_exact(learner: Learner) -> None:
    roll_out(learner, ReachingEnv(SMALL))
    learner.update(0.0)
    other = Learner(SMALL, ReachingEnv(SMALL))
    other.load_state_dict(copy.deepcopy(learner.state_dict()))
    outcomes = []
    for each in (learner, other):
        torch.manual_seed(7)
        roll_out(each, ReachingEnv(SMALL))
        each.update(0.5)
        outcomes.append(each.export(CONTRACT).state_dict())
    assert all(torch.equal(outcomes[0][name], outcomes[1][name]) for name in outcomes[0])


def test_discarded_rollout_leaves_room_for_a_whole_one(learner: Learner) -> None:
    env = ReachingEnv(SMALL)
    observation = env.reset()
    actions = learner.act(observation)
    learner.record(observation.policy, observation.state, actions, env.step(actions))
    learner.discard_rollout()
    roll_out(learner, env)
    assert learner.memories["arm"].filled
    assert learner.memories["arm"].memory_index == 0


def test_presets() -> None:
    assert preset("paper").rollout_transitions == 512 * 32
    assert all(
        cfg.transitions % cfg.rollout_transitions < cfg.rollout_transitions for cfg in PRESETS.values()
    )
    with pytest.raises(UnknownNameError, match=r"'papper'.*paper"):
        preset("papper")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"num_envs": 0}, "num_envs is 0"),
        ({"discount": 1.5}, "discount is 1.5"),
        ({"num_envs": 3, "rollout_steps": 3}, "9 transitions cannot be split into 4"),
    ],
)
def test_impossible_configurations(values: dict[str, float], message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        TrainCfg(**values)  # pyright: ignore[reportArgumentType]
