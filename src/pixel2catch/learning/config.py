"""What a training run can be told, and the presets; imports nothing heavy, as the command line reads it."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

from pixel2catch.checks import (
    CameraPath,
    Count,
    Device,
    DynamicsPath,
    NotNegative,
    PhysicsRate,
    Positive,
    Seed,
    Share,
    Within,
    require_valid,
)
from pixel2catch.errors import CheckpointError, InvalidValueError, UnknownNameError
from pixel2catch.files import decoded, read_json_object
from pixel2catch.shipped import policy_folder

Width = Annotated[int, Within(1, 65_536)]  #: Units of a layer.

CONFIG_FILE = "config.json"  #: The resolved configuration in the folder of a run.


def _released_latency() -> tuple[float, float]:
    from pixel2catch.mdp.sensing import SensingCfg

    return SensingCfg.latency_steps


def _paper_layers() -> tuple[int, ...]:
    from pixel2catch.policy import HIDDEN

    return HIDDEN


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainCfg:
    """Configuration of a training run; the defaults are the preset `fast`.

    Source: paper, Sec. IV-E, and the release for what the paper leaves open.
    Differs: batch size, learning rate, its schedule and physics rates of `fast`, `large` and `cpu` are ours,
    and the layers of `cpu`: with big batches the KL rule hardly ever lowers the rate, and training stalls
    (`experiments/LOG.md`).
    """

    method: str = "proposed"
    """Name of the method."""
    env: Any = None
    """The environments: a `CatchEnvCfg` with the task's values and what is given."""
    num_envs: Count = 8192
    """Environments that are simulated side by side, in all processes of torchrun together."""
    device: Device = "cuda"
    """Where to simulate and learn: cpu, cuda (each process on its own device), cuda:1, ... Default: cuda
    where there is one."""
    seed: Seed = 0
    """Seed of networks, exploration and environments."""
    physics_hz: tuple[PhysicsRate, ...] = (120.0, 120.0, 120.0, 120.0, 120.0, 240.0)
    """Physics steps in a second, multiples of 30; several: one after the other, in equal shares of the
    training, coarse first (120: paper), then finer, so that the policy does not live by what coarse steps do
    to an impact (ours)."""
    cone: Literal["elliptic", "pyramidal"] = "pyramidal"
    """Friction cones of the contacts in training: elliptic, as in evaluations, or pyramidal, which are
    computed faster and teach as much (ours)."""
    multiccd: bool = False
    """Whether faces and edges touch in several points, as in evaluations, or in one, likewise."""
    dynamics: DynamicsPath | None = None
    """Dynamics file of the robot that is simulated, as `identify` writes it; the run keeps a copy.
    Evaluations take it by their own --dynamics only. Default: the nominal robot."""
    camera: CameraPath | None = None
    """Camera file of the camera that is simulated, as `calibrate` writes it; the run keeps a copy. Every
    episode draws pose and focal length within what the file leaves open. Its images must be rectified, and
    the policy is for this camera. Default: the release's camera, known exactly."""
    task: str = "nominal"
    """What it is trained for: nominal, the paper's task; wide, with what laboratories do to it (ours);
    wide_sharp, the same with boxes to 2 px; or sizes, balls and boxes of 6 to 28 cm (ours)."""
    latency_steps: tuple[NotNegative, NotNegative] = dataclasses.field(default_factory=_released_latency)
    """Control steps between image and delivered box in nominal episodes: least and most. Default: 1 2, as the
    release."""
    start: Path | None = None
    """Policy to go on from, of the same method: its folder, that of its training run, or the name of a
    shipped one. Value networks begin anew, and so does exploration: give an --initial-log-std of about -2.
    Default: untrained networks."""
    start_transitions: Annotated[int, Within(1)] = 2_000_000
    """Transitions after such a start in which the value networks alone learn; in as many again the learning
    rate rises. Source: ours."""
    teacher: Path | None = None
    """Policy whose actions are imitated at first, in the states that the pupil comes to, named likewise; it
    may be of another method, such as one that is told where the object is."""
    teacher_share: Share = 0.5
    """Share of the training over which the weight of imitation falls from 1 to its final one, and that of the
    rewards rises from 0 to the rest. Source: ours."""
    final_teacher_weight: Share = 0.0
    """Weight of imitation that stays to the end, for a policy that goes on from an imitation and would else
    lose by chance what rewards alone do not teach. Source: ours."""
    transitions: Annotated[int, Within(1)] = 51_200_000
    """Length of the training: control steps, summed over the environments. Source: release."""
    rollout_steps: Count = 8
    """Control steps of every environment between two updates."""
    epochs: Count = 4
    """Passes over a rollout in an update. Source: release."""
    mini_batches: Count = 8
    """Gradient steps a pass. Source: release."""
    staggered: bool = False
    """Whether the first throws begin one after the other, so that a rollout has all parts of an episode from
    the start. With `large`, 30 % of the throws are reached after 10 million transitions instead of 16 (means
    of fourteen and three trainings).
    Source: Bharthulwar et al. 2025."""
    schedule: Literal["linear", "kl"] = "linear"
    """How the learning rate changes: linear over the transitions, or kl adaptive."""
    learning_rate: Positive = 1e-3
    """Learning rate at the start."""
    final_learning_rate: NotNegative = 3e-5
    """Learning rate at the end (linear), or its lower bound (kl)."""
    kl_target: Positive = 0.016
    """KL divergence that the kl schedule aims at. Source: paper, Sec. IV-E."""
    discount: Share = 0.99
    """Discount factor (gamma) of a control step. Source: paper, Sec. IV-E."""
    gae_lambda: Share = 0.95
    """Lambda of the generalised advantage estimate. Source: release."""
    ratio_clip: Positive = 0.2
    """Clip (epsilon) of the probability ratio. Source: paper, Sec. IV-E."""
    value_clip: Positive = 0.2
    """Clip of the change of a (standardised) value in an update. Source: release."""
    value_loss: Literal["clipped", "maximum"] = "clipped"
    """Error of a value: clipped, after the clip (release), or maximum, the larger of that and the error
    without the clip, whose gradient does not vanish beyond the clip."""
    value_loss_scale: NotNegative = 2.0
    """Weight of the value loss. Source: release."""
    entropy_scale: NotNegative = 0.0
    """Weight of the entropy bonus. Source: release."""
    gradient_clip: Positive = 1.0
    """Largest norm of an agent's gradient. Source: release."""
    hidden: tuple[Width, ...] = dataclasses.field(default_factory=_paper_layers)
    """Sizes of the hidden layers of all networks. Default: those of the policy to start from; else 512 256
    128, as in the paper, Sec. IV-E; cpu: 256 128 64 (ours)."""
    recurrent: Annotated[int, Within(0, 65_536)] = 0
    """Size of a recurrent unit (GRU) before the hidden layers of all networks, learnt over whole rollouts; 0
    for none. Source: ours."""
    initial_log_std: float = -0.7
    """Logarithm of the standard deviation of the actions at the start. Source: ours (release: 0)."""
    rewards: dict[str, float] = dataclasses.field(default_factory=dict)
    """Weights of reward terms that differ from the method's, such as arm.success 5 hand.grasp 0.3."""
    wandb: str | None = None
    """Project of Weights & Biases that gets configuration and curves, too; its environment variables, such as
    WANDB_MODE=offline, hold. Default: none."""
    fuse: bool = False
    """Whether torch.compile makes fewer kernels of a control step and of a gradient step: a minute more at
    the start, and where the physics rate changes. On a CPU it needs a C++ compiler."""
    checkpoint_seconds: NotNegative = 60.0
    """Time between two checkpoints [s]."""
    report_seconds: NotNegative = 10.0
    """Time between two report lines where there is no terminal [s]."""

    def __post_init__(self) -> None:
        """Refuse values with which no training is possible."""
        require_valid(self)
        is_wrong = {
            "physics_hz is empty; it needs a rate, such as 120.": not self.physics_hz,
            f"latency_steps is {self.latency_steps}; give 0 or more, then the same or more.": not (
                self.latency_steps[0] <= self.latency_steps[1]
            ),
            f"num_envs * rollout_steps = {self.rollout_transitions} transitions cannot be split into "
            f"{self.mini_batches} equal mini-batches; change one of the three.": (
                self.rollout_transitions % self.mini_batches
            ),
            f"num_envs = {self.num_envs} cannot be split into {self.mini_batches} equal mini-batches of "
            "whole rollouts, which recurrent networks need; change one of the two.": (
                self.recurrent and self.num_envs % self.mini_batches
            ),
        }
        for message, applies in is_wrong.items():
            if applies:
                raise InvalidValueError(message)

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

    def to_dict(self) -> dict[str, Any]:
        """Plain values by name, but for the environments."""
        return {name: value for name, value in dataclasses.asdict(self).items() if name != "env"}

    @classmethod
    def of_run(cls, folder: Path) -> "TrainCfg":
        """The configuration of the run in a folder, with the files that it keeps.

        Raises:
            CheckpointError: It does not fit this code.
            OSError: It cannot be read.
        """
        from pixel2catch.envs.cfg import CatchEnvCfg

        file = folder / CONFIG_FILE
        try:
            content = read_json_object(file)
            values = content["train"] | {"method": content["policy"]["method"]}
            kept = {name: str(folder / f"{name}.json") for name in ("dynamics", "camera") if values[name]}
            return dataclasses.replace(decoded(cls, values | kept), env=decoded(CatchEnvCfg, content["env"]))
        except (ValueError, LookupError, TypeError) as error:
            raise CheckpointError(
                f"'{file}' is no configuration that this code reads ({error}); resume with the version that "
                "wrote it, or begin another run."
            ) from error


PRESETS: dict[str, dict[str, Any]] = {
    "fast": {},
    "large": {"num_envs": 32_768, "rollout_steps": 4, "mini_batches": 8, "epochs": 3, "staggered": True},
    "cpu": {
        "device": "cpu",
        "num_envs": 1024,
        "transitions": 8_000_000,
        "epochs": 5,
        "mini_batches": 4,
        "learning_rate": 5e-4,
        "hidden": (256, 128, 64),
    },
    "paper": {
        "num_envs": 512,
        "rollout_steps": 32,
        "transitions": 51_200_000,
        "schedule": "kl",
        "physics_hz": (120.0,),
        "cone": "elliptic",
        "multiccd": True,
        "mini_batches": 4,
        "initial_log_std": 0.0,
        "learning_rate": 5e-4,
        "final_learning_rate": 1e-5,
    },
}
"""Starting values: `fast` for a GPU, `large` for one with much memory or several, `cpu` where there is none,
`paper` the release's."""


def preset(name: str, **given: Any) -> TrainCfg:
    """Return a preset by its name, with what is given instead of its values.

    Networks have the sizes of the policy to start from, if there is one and they are not given.

    Raises:
        UnknownNameError: There is no such preset, or no policy of that name to start from.
        InvalidValueError: No training is possible with the values.
        PolicyMismatchError: The policy to start from cannot be read.
    """
    if name not in PRESETS:
        raise UnknownNameError("preset", name, PRESETS)
    values = PRESETS[name]
    if given.get("start"):
        from pixel2catch.policy import Policy

        start = Policy.load(policy_folder(Path(given["start"])))
        values = values | {"hidden": start.hidden, "recurrent": start.recurrent}
    return TrainCfg(**values | given)
