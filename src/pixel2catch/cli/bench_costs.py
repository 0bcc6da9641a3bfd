"""Measure physics, the environment and a training with the throws of a trained policy."""

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

LOG_STD = -1.5  #: Noise of the actions in the training, small enough to keep the policy's throws (ours).
STATE = ("qpos", "qvel", "ctrl", "qacc_warmstart")  #: State that physics steps change.
STEPS_AT_ONCE = 10  #: Control steps between two reads of the clock, which wait for the device.
WARM_UPDATES = 2  #: Updates before the measurement, in which libraries initialise and graphs are recorded.
LEAST_UPDATES = 3  #: Least number of updates that are measured.
TRAIN_THREADS = torch.get_num_threads()  #: Threads of `train`, not of `prepare`.


Calls = list[tuple[DeviceTime, DeviceTime]]  #: Begin and end of each call, by the clock of the device.


def timed(function: Callable[..., Any], device: torch.device, calls: Calls) -> Callable[..., Any]:
    """Return the function; each of its calls on the device is appended to `calls`."""

    def call(*arguments: Any) -> Any:
        begun = DeviceTime(device)
        result = function(*arguments)
        calls.append((begun, DeviceTime(device)))
        return result

    return call


def seconds_of(calls: Calls) -> list[float]:
    """Return the time of every call [s]; wait for the device."""
    return [begun.until(ended) for begun, ended in calls]


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
    """Measure the costs of a control step of one environment, and the memory that is in use then.

    Args:
        policy: The policy that acts and learns.
        change: The function that changes its task.
        device: Device of simulation and training.
        num_envs: Number of environments.
        seconds: Least time of each measurement [s].
        fuse: Whether kernels are fused.
        report: Gets the name of each part before it is measured.

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
    """Return the time of a control step of all environments, and of its physics steps alone [s].

    The clock starts when the environments are at different times of their episodes. The physics steps start
    from the state after every control step, which is then restored.
    """
    simulation = env.world.simulation
    state = [simulation.bind(name) for name in STATE]
    steps, physics = Calls(), Calls()
    step, advance = timed(env.step, env.device, steps), timed(lambda: _advance(env), env.device, physics)
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
    return mean(seconds_of(steps)), mean(seconds_of(physics))


def _advance(env: CatchEnv) -> None:
    for _ in range(env.cfg.scene.decimation):
        env.world.simulation.step()


def _training(cfg: TrainCfg, env: CatchEnv, policy: Policy, num_steps: int) -> tuple[float, float, float]:
    """Return the times of acting, environment and update for a control step of all environments [s].

    They are those of a training that starts from the policy and has at least this number of steps.
    """
    updates, calls = max(LEAST_UPDATES, num_steps // cfg.rollout_steps), Calls()
    setattr(env, "step", timed(env.step, env.device, calls))  # noqa: B010 (a method)
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
    environment = mean(seconds_of(calls)[-updates * cfg.rollout_steps :])
    return rollout - environment, environment, update


def _forget_peak() -> None:
    """Reset the kernel's largest memory of this process, where that is allowed."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak_bytes() -> int:
    """Return the largest memory of this process since `_forget_peak` [bytes]."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])
