"""`pixel2catch train`: learn a policy."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

if TYPE_CHECKING:
    from pixel2catch.rl import TrainCfg


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train:
    """Train a policy. What is not given comes from the preset.

    Attributes:
        method: What to train: proposed, without_pf, only_wh, only_center, single_agent, object_position,
            shared_reward, journal, catch, catch_alone or catch_teacher; with a memory METHOD+age, +boxes
            or +fit.
        task: What it is trained for: nominal, the paper's task; wide, with what laboratories do to it; or
            wide_sharp, the same with boxes to 2 px. Default: nominal.
        preset: Starting values: fast (a big GPU), cpu (two cores) or paper. Default: fast on CUDA, else cpu.
        device: Where to simulate and learn: cpu, cuda, cuda:1, ... Default: cuda where there is one.
        physics_hz: Physics steps in a second, multiples of 30; several: one after the other, in equal shares.
        dynamics: Dynamics file of the robot that is simulated, as `identify` writes it; the run keeps a copy.
            Evaluations take it by their own --dynamics only. Default: the nominal robot.
        camera: Camera file of the camera that is simulated, as `calibrate` writes it; the run keeps a copy.
            Every episode draws pose and focal length within what the file leaves open. Its images must be
            rectified, and the policy is for this camera. Default: the release's camera, known exactly.
        latency_steps: Control steps between image and delivered box in nominal episodes: least and most.
            Default: 1 2, as the release.
        out: Folder of the run. Default: runs/METHOD-seedSEED.
        resume: Go on from the last checkpoint in that folder.
        start: Policy to go on from, of the same method: its folder, that of its training run, or the name of
            a shipped one. Value networks begin anew, and so does exploration: give an --initial-log-std of
            about -2. Default: untrained networks.
        start_transitions: Transitions after such a start in which the value networks alone learn.
        teacher: Policy that is imitated at first, named likewise; it may be of another method, such as one
            that is told where the object is.
        teacher_share: Share of the training over which imitation gives way to the rewards.
        seed: Seed of networks, exploration and environments.
        num_envs: Environments that are simulated side by side, in all processes of torchrun together.
        transitions: Length of the training: control steps, summed over the environments.
        rollout_steps: Control steps of every environment between two updates.
        epochs: Passes over a rollout in an update.
        mini_batches: Gradient steps a pass.
        schedule: How the learning rate changes: linear over the transitions, or kl adaptive.
        learning_rate: Learning rate at the start.
        final_learning_rate: Learning rate at the end (linear), or its lower bound (kl).
        kl_target: KL divergence that the kl schedule aims at.
        discount: Discount factor of a control step.
        gae_lambda: Lambda of the generalised advantage estimate.
        ratio_clip: Clip of the probability ratio.
        value_clip: Clip of the change of a value in an update.
        value_loss_scale: Weight of the value loss.
        entropy_scale: Weight of the entropy bonus.
        gradient_clip: Largest norm of an agent's gradient.
        hidden: Sizes of the hidden layers.
        initial_log_std: Logarithm of the standard deviation of the actions at the start.
        checkpoint_seconds: Time between two checkpoints [s].
        report_seconds: Time between two report lines where there is no terminal [s].
    """

    method: Positional[str] = "proposed"
    workcell: str = "ur5e_allegro"
    task: str | None = None
    preset: Literal["fast", "cpu", "paper"] | None = None
    device: str | None = None
    physics_hz: tuple[float, ...] | None = None
    dynamics: Path | None = None
    camera: Path | None = None
    latency_steps: tuple[float, float] | None = None
    out: Path | None = None
    resume: bool = False
    seed: int | None = None
    num_envs: int | None = None
    start: Path | None = None
    start_transitions: int | None = None
    teacher: Path | None = None
    teacher_share: float | None = None
    transitions: int | None = None
    rollout_steps: int | None = None
    epochs: int | None = None
    mini_batches: int | None = None
    schedule: Literal["linear", "kl"] | None = None
    learning_rate: float | None = None
    final_learning_rate: float | None = None
    kl_target: float | None = None
    discount: float | None = None
    gae_lambda: float | None = None
    ratio_clip: float | None = None
    value_clip: float | None = None
    value_loss_scale: float | None = None
    entropy_scale: float | None = None
    gradient_clip: float | None = None
    hidden: tuple[int, ...] | None = None
    initial_log_std: float | None = None
    checkpoint_seconds: float | None = None
    report_seconds: float | None = None

    def run(self) -> None:
        """Train to the end."""
        from pixel2catch.envs.catch_env import CatchEnv
        from pixel2catch.envs.tasks import find_task
        from pixel2catch.evaluation.loading import load_policy
        from pixel2catch.methods import find_method
        from pixel2catch.workcells import find_workcell
        from pixel2catch.policy import contract_of
        from pixel2catch.rl import train

        workcell = find_workcell(self.workcell)
        method, cfg = find_method(self.method, workcell), self.resolve()
        task = find_task(cfg.task)
        task = dataclasses.replace(
            task, scene=dataclasses.replace(task.scene, workcell=workcell.name)
        ).with_files(cfg.dynamics, cfg.camera)
        scenes = {rate: dataclasses.replace(task.scene, physics_hz=rate) for rate in cfg.physics_hz}
        sensing = dataclasses.replace(task.sensing, latency_steps=cfg.latency_steps)
        contract = contract_of(method, workcell, sensing.camera.camera)
        contract = dataclasses.replace(contract, task=cfg.task)
        teacher = load_policy(cfg.teacher)[1] if cfg.teacher else None

        def make_env(cfg: "TrainCfg") -> CatchEnv:
            stage = dataclasses.replace(task, scene=scenes[cfg.physics_hz[0]], sensing=sensing)
            return CatchEnv(
                stage, method, num_envs=cfg.num_envs, device=cfg.device, seed=cfg.seed, teacher=teacher
            )

        out = self.out or Path("runs") / f"{method.name}-seed{cfg.seed}"
        train(cfg, make_env, contract, out, resume=self.resume)

    def resolve(self) -> "TrainCfg":
        """Return the preset with what was given on the command line.

        Raises:
            DeviceUnavailableError: If CUDA was asked for and is absent.
            InvalidValueError: If no training is possible with the values.
            PolicyMismatchError: If there is no policy to start from, or to imitate.
        """
        import torch

        from pixel2catch.evaluation.loading import policy_folder
        from pixel2catch.rl import TrainCfg, preset
        from pixel2catch.sim.devices import require_cuda

        device = self.device or ("cuda" if torch.cuda.is_available() else "cpu")
        if device.startswith("cuda"):
            require_cuda(device)
        cfg = preset(self.preset or ("fast" if device.startswith("cuda") else "cpu"))
        names = {field.name for field in dataclasses.fields(TrainCfg)}
        given: dict[str, Any] = {n: v for n, v in vars(self).items() if n in names and v is not None}
        for name in ("start", "teacher"):
            if name in given:
                given[name] = policy_folder(given[name])
        return dataclasses.replace(cfg, **given | {"device": device})
