"""How a policy learns, and the presets; imports nothing heavy, as the command line reads it."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pixel2catch.checks import Count, Device, PhysicsRate, Seed, Share, Within, require_used, require_valid
from pixel2catch.errors import InvalidValueError, UnknownNameError

Transitions = Annotated[int, Within(1, 1_000_000_000_000)]  #: Control steps of all environments.
Width = Annotated[int, Within(1, 65_536)]  #: Units of a layer.
PresetName = Literal["fast", "large", "cpu", "paper"]

CONFIG_FILE = "config.json"  #: The resolved configuration in the folder of a run.


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainCfg:
    """How a policy learns; the defaults are the preset `fast`.

    Source: paper, Sec. IV-E, and the release for what the paper leaves open.
    Differs: batch size, learning rate, its schedule and physics rates of `fast`, `large` and `cpu` are ours,
    and the layers of `cpu`: with large batches the KL schedule hardly ever lowers the rate, and training
    stalls (`experiments/LOG.md`).
    """

    #: Environments that are simulated side by side, in all processes of torchrun together.
    num_envs: Count = 8192
    #: Where to simulate and learn: cpu, cuda (each process on its own device), cuda:1, ... Default: cuda
    #: where there is one.
    device: Device = "cuda"
    #: Seed of networks, exploration and environments.
    seed: Seed = 0
    #: Physics steps per second, one rate after the other in equal shares of the training. Coarse first (120:
    #: paper), then finer, so that the policy does not exploit coarse impacts (ours). Empty:
    #: env.scene.physics_hz throughout, as with --env.scene.physics-hz.
    physics_stages: tuple[PhysicsRate, ...] = (120.0, 120.0, 120.0, 120.0, 120.0, 240.0)
    #: Policy to go on from, of the same method: its folder, that of its training run, or the name of a
    #: shipped one. Value networks and exploration begin anew: give an --initial-log-std of about -2. Default:
    #: untrained networks.
    start: Path | None = None
    #: Transitions after such a start in which only the value networks learn; over as many again the learning
    #: rate rises. Source: ours.
    start_transitions: Transitions = 2_000_000
    #: Policy whose actions are imitated at first, in the states that the trained policy reaches; its name is
    #: as that of --start. It may be of another method, such as one that observes the object's position.
    #: Default: none.
    teacher: Path | None = None
    #: Share of the training over which the weight of imitation falls from 1 to its final value, and that of
    #: the rewards rises from 0 to the rest. Source: ours.
    teacher_share: Share = 0.5
    #: Weight of imitation that stays to the end. Source: ours.
    final_teacher_weight: Share = 0.0
    #: Length of the training: control steps, summed over the environments. Source: release.
    transitions: Transitions = 51_200_000
    #: Control steps of every environment between two updates.
    rollout_steps: Count = 8
    #: Passes over a rollout in an update. Source: release.
    epochs: Count = 4
    #: Gradient steps in each pass. Source: release.
    mini_batches: Count = 8
    #: Start the first throws one after the other, so that each rollout holds all parts of an episode from the
    #: start. Source: Bharthulwar et al. 2025.
    staggered: bool = False
    #: How the learning rate changes: linear over the transitions, or adapted to the KL divergence.
    schedule: Literal["linear", "kl"] = "linear"
    #: Learning rate at the start.
    learning_rate: Annotated[float, Within(0.0, 1.0, is_open=True)] = 1e-3
    #: Learning rate at the end (linear), or its lower bound (kl).
    final_learning_rate: Share = 3e-5
    #: Target of the KL divergence with the kl schedule. Source: paper, Sec. IV-E.
    kl_target: Annotated[float, Within(0.0, 10.0, is_open=True)] = 0.016
    #: Discount factor (gamma) of a control step. Source: paper, Sec. IV-E.
    discount: Share = 0.99
    #: Lambda of the generalised advantage estimate. Source: release.
    gae_lambda: Share = 0.95
    #: Clip (epsilon) of the probability ratio. Source: paper, Sec. IV-E.
    ratio_clip: Annotated[float, Within(0.0, 10.0, is_open=True)] = 0.2
    #: Clip of the change of a (standardised) value in an update. Source: release.
    value_clip: Annotated[float, Within(0.0, 1000.0, is_open=True)] = 0.2
    #: Weight of the value loss. Source: release.
    value_loss_scale: Annotated[float, Within(0.0, 1000.0)] = 2.0
    #: Weight of the entropy bonus. Source: release.
    entropy_scale: Annotated[float, Within(0.0, 100.0)] = 0.0
    #: Largest norm of an agent's gradient. Source: release.
    gradient_clip: Annotated[float, Within(0.0, 1e6, is_open=True)] = 1.0
    #: Sizes of the hidden layers of all networks. Source: paper, Sec. IV-E (cpu: ours). With --start: those
    #: of that policy.
    hidden: tuple[Width, ...] = (512, 256, 128)
    #: Logarithm of the standard deviation of the actions at the start. Source: ours (release: 0).
    initial_log_std: Annotated[float, Within(-10.0, 3.0)] = -0.7
    #: Weights of reward terms that differ from the method's, such as arm.success 5 hand.grasp 0.3. Default:
    #: the method's.
    rewards: dict[str, Annotated[float, Within(-1e6, 1e6)]] = dataclasses.field(default_factory=dict)
    #: Project of Weights & Biases that also gets configuration and curves. Its environment variables, such as
    #: WANDB_MODE=offline, hold. Default: none.
    wandb: str | None = None
    #: Fuse the kernels of a control step and of a gradient step by torch.compile. Steps are faster; the start
    #: and each change of the physics rate take up to a minute more. A CPU needs a C++ compiler.
    fuse: bool = False
    #: Time between two checkpoints [s].
    checkpoint_seconds: Annotated[float, Within(0.0, 1e6)] = 60.0
    #: Time between two report lines where there is no terminal [s].
    report_seconds: Annotated[float, Within(0.0, 1e6)] = 10.0

    def __post_init__(self) -> None:
        require_valid(self)
        if self.rollout_transitions % self.mini_batches:
            raise InvalidValueError(
                f"num_envs * rollout_steps = {self.rollout_transitions} transitions cannot be split into "
                f"{self.mini_batches} equal mini-batches; change one of the three."
            )
        has_teacher = self.teacher is not None
        require_used(self, ("start_transitions",), self.start is not None, "without start")
        require_used(self, ("teacher_share", "final_teacher_weight"), has_teacher, "without teacher")
        require_used(self, ("kl_target",), self.schedule == "kl", "without schedule kl")

    def changed(self, options: Mapping[str, Any]) -> "TrainCfg":
        """Return the configuration with other values of fields; raise UnknownNameError for an unknown one."""
        if unknown := [name for name in options if name not in self.__dataclass_fields__]:
            raise UnknownNameError("option", unknown[0], self.__dataclass_fields__)
        return dataclasses.replace(self, **options)

    def rate_at(self, transitions: int) -> float | None:
        """Return the physics rate after that many transitions [1/s]; None means the environment's own."""
        if not self.physics_stages:
            return None
        stage = len(self.physics_stages) * transitions // self.transitions
        return self.physics_stages[min(stage, len(self.physics_stages) - 1)]

    @property
    def rollout_transitions(self) -> int:
        """Transitions between two updates."""
        return self.num_envs * self.rollout_steps


PRESETS: dict[str, TrainCfg] = {
    "fast": TrainCfg(),
    "large": TrainCfg(num_envs=32_768, rollout_steps=4, epochs=3, staggered=True),
    "cpu": TrainCfg(
        device="cpu",
        num_envs=1024,
        transitions=8_000_000,
        epochs=5,
        mini_batches=4,
        learning_rate=5e-4,
        hidden=(256, 128, 64),
    ),
    "paper": TrainCfg(
        num_envs=512,
        rollout_steps=32,
        schedule="kl",
        physics_stages=(),
        mini_batches=4,
        initial_log_std=0.0,
        learning_rate=5e-4,
        final_learning_rate=1e-5,
    ),
}
"""How each preset learns: `fast` on a GPU, `large` on one with much memory or on several, `cpu` without one,
`paper` as the release. `learning.experiment.preset` adds the environments."""
