"""The protocol of an evaluation: which objects, how many throws, all noise and randomisation on.

Source: paper, Sec. V: 100 environments and 10 trials in each, deterministic policy.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg
from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.metrics import Metrics, metrics
from pixel2catch.evaluation.rounds import ROUND_STEPS, Actor, Trials, run_round
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.methods import Method
from pixel2catch.robot.objects import OBJECTS


@dataclass(frozen=True, kw_only=True)
class EvaluationCfg:
    """What is thrown at a policy.

    Attributes:
        objects: Names of the objects; each throw draws one.
        num_envs: Throws in a round. Source: paper.
        trials: Rounds. Source: paper.
        seed: Seed of everything that is drawn.
        device: "cpu" or a CUDA device.
        task: The task, with all its noise; objects and endings are set here.
    """

    objects: tuple[str, ...]
    num_envs: int = 100
    trials: int = 10
    seed: int = 0
    device: str = "cpu"
    task: CatchEnvCfg = field(default_factory=CatchEnvCfg)

    def __post_init__(self) -> None:
        """Refuse an evaluation of nothing."""
        for name in ("num_envs", "trials"):
            if getattr(self, name) < 1:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be at least 1.")

    def make_env(self, method: Method) -> CatchEnv:
        """The environments: like those of training, but only the loss of the object ends an episode."""
        endings = EpisodeCfg(max_steps=ROUND_STEPS + 1, ends_on_success=False)
        task = replace(self.task, objects=self.objects, episode=endings)
        return CatchEnv(task, method, num_envs=self.num_envs, device=self.device, seed=self.seed)


def evaluate(
    actor: Actor, method: Method, cfg: EvaluationCfg, on_round: Callable[[Trials], None] = lambda _: None
) -> Trials:
    """Evaluate a policy.

    Args:
        actor: The policy.
        method: The method that it was trained with.
        cfg: What is thrown.
        on_round: Called with the trials of every round.
    """
    env = cfg.make_env(method)
    rounds = []
    try:
        for _ in range(cfg.trials):
            rounds.append(run_round(env, actor))
            on_round(rounds[-1])
    finally:
        env.close()
    return Trials.concatenate(rounds)


def assess(
    actor: Actor, method: Method, cfg: EvaluationCfg, on_round: Callable[[Trials], None] = lambda _: None
) -> Metrics:
    """Evaluate a policy and return its metrics, with how they were obtained.

    Args:
        actor: The policy.
        method: The method that it was trained with.
        cfg: What is thrown.
        on_round: Called with the trials of every round.
    """
    started = time.perf_counter()
    trials = evaluate(actor, method, cfg, on_round)
    return {
        "method": method.name,
        "objects_thrown": list(cfg.objects),
        "num_envs": cfg.num_envs,
        "rounds": cfg.trials,
        "seed": cfg.seed,
        "device": cfg.device,
        "physics_hz": cfg.task.scene.physics_hz,
        **metrics(trials, tuple(OBJECTS)),
        "seconds": time.perf_counter() - started,
    }
