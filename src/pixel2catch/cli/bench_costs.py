"""What physics, the environment and a training cost, measured with the throws of a trained policy."""

import contextlib
import io
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from torch import Tensor

from pixel2catch.device_time import DeviceTime
from pixel2catch.envs.catch_env import CatchEnv, Observation
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.experiment import Experiment, preset
from pixel2catch.learning.log import METRICS_FILE, read_rows
from pixel2catch.learning.train import train
from pixel2catch.policy import Policy, method_of

LOG_STD = -1.5  #: Of the actions in the training: the throws stay those of the policy. Source: ours.
STATE = ("qpos", "qvel", "ctrl", "qacc_warmstart")  #: What physics steps change and is put back.
STEPS_AT_ONCE = 10  #: Control steps between two looks at the clock, which wait for the device.

WARM_UPDATES = 2
"""Updates of the training before it is measured: libraries set themselves up, graphs are recorded."""

TRAIN_THREADS = torch.get_num_threads()  #: PyTorch's own number, as `train` has it, not that of `prepare`.
LEAST_UPDATES = 3  #: Updates that are measured at least.


class Stopwatch:
    """Times of calls by the clock of the device that computes them; nothing waits until they are read."""

    def __init__(self, device: torch.device) -> None:
        """Measure on a device."""
        self._device = device
        self._calls: list[tuple[DeviceTime, DeviceTime]] = []

    def timed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, whose calls are measured."""

        def call(*arguments: Any) -> Any:
            begun = DeviceTime(self._device)
            result = function(*arguments)
            self._calls.append((begun, DeviceTime(self._device)))
            return result

        return call

    def seconds(self) -> list[float]:
        """Time of every call [s]."""
        return [begun.until(ended) for begun, ended in self._calls]


def measure(
    policy: Policy,
    change: Callable[[CatchEnvCfg], CatchEnvCfg],
    *,
    device: str,
    num_envs: int,
    seconds: float,
    fuse: bool,
    report: Callable[[str], None],
) -> dict[str, Any]:
    """What a control step of one environment costs in all parts, and the memory that is in use then.

    Args:
        policy: What acts and learns.
        change: What is different of its task.
        device: Device of simulation and training.
        num_envs: Number of environments.
        seconds: How long each part is measured, at least [s].
        fuse: Whether kernels are fused.
        report: Is told each part before it is measured.

    Returns:
        `*_per_second`: rates, summed over the environments; those of the environment without the networks.
        `*_us`: parts of the training, for a control step of one environment [µs]; `sensing` is all of the
        environment but physics, `acting` the rest of the rollout.
        `rss_bytes`, `device_bytes`: the most memory that this process had, and what all processes have on
        the device at the end [bytes].
    """
    torch.set_num_threads(TRAIN_THREADS)
    _forget_peak()
    experiment = _experiment(policy, device=device, num_envs=num_envs, fuse=fuse)
    task = change(experiment.env)
    env = CatchEnv(task, method_of(policy.contract), num_envs=num_envs, device=device, is_fused=fuse)
    where = f"{device}, {num_envs:,} environments"
    with contextlib.closing(env):
        report(f"{where}: random actions")
        random, _ = _environment(env, _random_actions(env), seconds)
        report(f"{where}: the policy's actions")
        trained, physics = _environment(env, lambda observation: policy.act(observation.policy), seconds)
        report(f"{where}: training")
        acting, stepping, update = _training(experiment.train, env, policy, max(3, int(seconds / trained)))
    free, total = torch.cuda.mem_get_info(env.device) if env.device.type == "cuda" else (0, 0)
    per_env = 1e6 / num_envs
    return {
        "device": device,
        "num_envs": num_envs,
        "physics_hz": task.scene.physics_hz,
        "physics_steps_per_second": num_envs * task.scene.decimation / physics,
        "random_steps_per_second": num_envs / random,
        "trained_steps_per_second": num_envs / trained,
        "training_steps_per_second": num_envs / (acting + stepping + update),
        "acting_us": per_env * acting,
        "physics_us": per_env * stepping * physics / trained,
        "sensing_us": per_env * stepping * (1.0 - physics / trained),
        "update_us": per_env * update,
        "rss_bytes": _peak_bytes(),
        "device_bytes": total - free,
    }


def _experiment(policy: Policy, *, device: str, num_envs: int, fuse: bool) -> Experiment:
    """Return the training that goes on from a policy, by the preset for the device."""
    return preset(
        "fast" if device.startswith("cuda") else "cpu",
        policy.contract.task,
        workcell=policy.contract.workcell,
        device=device,
        num_envs=num_envs,
        fuse=fuse,
        physics_stages=(),
        hidden=policy.hidden,
        recurrent=policy.recurrent,
        initial_log_std=LOG_STD,
    )


def _random_actions(env: CatchEnv) -> Callable[[Observation], dict[str, Tensor]]:
    generator = torch.Generator(env.device).manual_seed(0)
    actions = {
        name: 2.0 * torch.rand(env.num_envs, size, generator=generator, device=env.device) - 1.0
        for name, size in env.action_sizes.items()
    }
    return lambda _: actions


def _environment(
    env: CatchEnv, act: Callable[[Observation], dict[str, Tensor]], seconds: float
) -> tuple[float, float]:
    """Time of a control step of all environments, and of its physics steps alone [s].

    The clock starts when the environments are at different times of their episodes. The physics steps are
    made from the state after every control step, which is put back.
    """
    simulation = env.world.simulation
    state = [simulation.bind(name) for name in STATE]
    steps, physics = Stopwatch(env.device), Stopwatch(env.device)
    step, advance = steps.timed(env.step), physics.timed(lambda: _advance(env))
    observation = env.reset()
    for _ in range(env.cfg.episode.max_steps):
        observation = env.step(act(observation)).observation
    _advance(env)
    deadline = time.perf_counter() + seconds
    while time.perf_counter() < deadline:
        for _ in range(STEPS_AT_ONCE):
            observation = step(act(observation)).observation
            before = [field.clone() for field in state]
            advance()
            for field, value in zip(state, before, strict=True):
                field.copy_(value)
            simulation.forward()
        env.check()
    return mean(steps.seconds()), mean(physics.seconds())


def _advance(env: CatchEnv) -> None:
    for _ in range(env.cfg.scene.decimation):
        env.world.simulation.step()


def _training(cfg: TrainCfg, env: CatchEnv, policy: Policy, num_steps: int) -> tuple[float, float, float]:
    """Times of acting, the environment and the update for a control step of all environments [s].

    It is a training as `pixel2catch train` does it, from the policy on, of so many steps at least; what its
    networks do not take of a rollout is the environment's.
    """
    updates = max(LEAST_UPDATES, num_steps // cfg.rollout_steps)
    watch, step = Stopwatch(env.device), env.step
    setattr(env, "step", watch.timed(step))  # noqa: B010 (a method)
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        policy.save(start := Path(folder, "start"))
        transitions = (WARM_UPDATES + updates) * cfg.rollout_transitions
        cfg = replace(cfg, start=start, transitions=transitions)
        result = train(cfg, lambda *_: env, policy.contract, Path(folder, "run"))
        rows = read_rows(Path(folder, "run", METRICS_FILE))[-updates:]
    if result.status == "interrupted":
        raise KeyboardInterrupt
    rollout, update = (
        mean(float(row[f"{name}_seconds"]) for row in rows) / cfg.rollout_steps
        for name in ("rollout", "update")
    )
    environment = mean(watch.seconds()[-updates * cfg.rollout_steps :])
    return rollout - environment, environment, update


def _forget_peak() -> None:
    """Let the kernel count this process's largest memory anew, where that is allowed."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak_bytes() -> int:
    """The most memory that this process had since then [bytes]."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])
