"""What a training run can be told, and the presets."""

import dataclasses
from pathlib import Path
from typing import Literal

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.policy import HIDDEN


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainCfg:
    """Configuration of a training run; the defaults are the preset `fast`.

    Source: paper, Sec. IV-E, and the release for what the paper leaves open.
    Differs: batch size, learning-rate schedule and physics rates of `fast` and `cpu` are ours: with big
    batches the KL rule hardly ever lowers the rate, and training stalls (`experiments/LOG.md`).
    """

    num_envs: int = 4096
    """Number of environments that are simulated side by side, in all processes together."""
    device: str = "cuda"
    """Where to simulate and learn: "cuda" (each process on its own device), "cuda:1", … or "cpu"."""
    seed: int = 0
    """Seed of the networks, the exploration and the environments."""
    physics_hz: tuple[float, ...] = (120.0, 120.0, 240.0)
    """Physics steps in a second, in equal shares of the training: coarse first (120: paper), then finer, so
    that the policy does not live by what coarse steps do to an impact (ours)."""
    dynamics: Path | None = None
    """Dynamics file of the robot that is simulated; the nominal robot if absent."""
    camera: Path | None = None
    """Camera file of the camera that is simulated; the release's if absent."""
    task: str = "nominal"
    """Name of the task: "nominal" (paper), or "wide", with what laboratories do to it as well (ours)."""
    latency_steps: tuple[float, float] = SensingCfg.latency_steps
    """Control steps between image and delivered box, first and last of the draw per episode."""
    start: Path | None = None
    """Policy to go on from, of the same method; value networks begin anew. Without one everything does."""
    start_transitions: int = 2_000_000
    """Transitions after such a start in which the value networks alone learn; in as many again the learning
    rate rises. Source: ours."""
    teacher: Path | None = None
    """Policy whose actions are imitated at first, in the states that the pupil comes to; its observations may
    be of another method, such as that of an oracle."""
    teacher_share: float = 0.5
    """Share of the training over which the weight of imitation falls from 1 to 0, and that of the rewards
    rises from 0 to 1. Source: ours."""
    transitions: int = 51_200_000
    """Length of the training: control steps, summed over the environments. Source: release."""
    rollout_steps: int = 8
    """Control steps of every environment between two updates."""
    epochs: int = 4
    """Passes over a rollout in an update. Source: release."""
    mini_batches: int = 4
    """Gradient steps a pass. Source: release."""
    schedule: Literal["linear", "kl"] = "linear"
    """How the learning rate changes: "linear" from first to last over the transitions, or "kl" adaptive."""
    learning_rate: float = 1e-3
    """Learning rate at the start."""
    final_learning_rate: float = 3e-5
    """Learning rate at the end ("linear"), or its lower bound ("kl")."""
    kl_target: float = 0.016
    """KL divergence that the "kl" schedule aims at. Source: paper, Sec. IV-E."""
    discount: float = 0.99
    """Discount factor (gamma) of a control step. Source: paper, Sec. IV-E."""
    gae_lambda: float = 0.95
    """Lambda of the generalised advantage estimate. Source: release."""
    ratio_clip: float = 0.2
    """Clip (epsilon) of the probability ratio. Source: paper, Sec. IV-E."""
    value_clip: float = 0.2
    """Clip of the change of a (standardised) value in an update. Source: release."""
    value_loss_scale: float = 2.0
    """Weight of the value loss. Source: release."""
    entropy_scale: float = 0.0
    """Weight of the entropy bonus. Source: release."""
    gradient_clip: float = 1.0
    """Largest norm of an agent's gradient. Source: release."""
    hidden: tuple[int, ...] = HIDDEN
    """Sizes of the hidden layers of all networks. Source: paper, Sec. IV-E."""
    initial_log_std: float = -0.7
    """Logarithm of the standard deviation of the actions at the start. Source: ours (release: 0)."""
    checkpoint_seconds: float = 60.0
    """Time between two checkpoints [s]."""
    report_seconds: float = 10.0
    """Time between two report lines where there is no terminal [s]."""

    def __post_init__(self) -> None:
        """Refuse values with which no training is possible."""
        for name in (
            "num_envs",
            "transitions",
            "start_transitions",
            "rollout_steps",
            "epochs",
            "mini_batches",
            "learning_rate",
        ):
            if getattr(self, name) <= 0:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be greater than 0.")
        if not self.physics_hz:
            raise InvalidValueError("physics_hz is empty; it needs a rate, such as 120.")
        if not 0 <= self.latency_steps[0] <= self.latency_steps[1]:
            raise InvalidValueError(
                f"latency_steps is {self.latency_steps}; give 0 or more, then the same or more."
            )
        for name in ("discount", "gae_lambda", "teacher_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be between 0 and 1.")
        if self.rollout_transitions % self.mini_batches:
            raise InvalidValueError(
                f"num_envs * rollout_steps = {self.rollout_transitions} transitions cannot be split into "
                f"{self.mini_batches} equal mini-batches; change one of the three."
            )

    def rate_at(self, transitions: int) -> float:
        """Physics steps in a second after that many transitions."""
        stage = len(self.physics_hz) * transitions // self.transitions
        return self.physics_hz[min(stage, len(self.physics_hz) - 1)]

    @property
    def inputs(self) -> dict[str, Path | None]:
        """The files that the training depends on, by the option that names them."""
        return {"dynamics": self.dynamics, "camera": self.camera}

    @property
    def rollout_transitions(self) -> int:
        """Transitions between two updates."""
        return self.num_envs * self.rollout_steps


PRESETS = {
    "fast": TrainCfg(),
    "cpu": TrainCfg(
        device="cpu",
        num_envs=256,
        rollout_steps=32,
        transitions=5_000_000,
        epochs=3,
    ),
    "paper": TrainCfg(
        num_envs=512,
        rollout_steps=32,
        transitions=51_200_000,
        schedule="kl",
        physics_hz=(120.0,),
        initial_log_std=0.0,
        learning_rate=5e-4,
        final_learning_rate=1e-5,
    ),
}
"""`fast`: one big GPU. `cpu`: two cores. `paper`: paper, Sec. IV-E, with the numbers of the release."""


def preset(name: str) -> TrainCfg:
    """Return a preset by its name.

    Raises:
        UnknownNameError: There is no such preset.
    """
    if name not in PRESETS:
        raise UnknownNameError("preset", name, PRESETS)
    return PRESETS[name]
