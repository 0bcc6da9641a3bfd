"""`pixel2catch bench`: what a training costs on this machine, and which part of it takes how long."""

import contextlib
import io
import itertools
import os
import resource
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Annotated, Any

from pixel2catch.checks import Count, Device, OutputFile
from pixel2catch.cli.console import prepare, results_console, say, working
from pixel2catch.cli.fields import Given, TaskFields, with_given
from pixel2catch.files import json_text
from pixel2catch.reports import circumstances
from pixel2catch.shipped import PolicyPath, policy_folder

if TYPE_CHECKING:
    from rich.table import Table

    from pixel2catch.learning.experiment import Experiment
    from pixel2catch.policy import Policy

Row = dict[str, Any]

RATES = {
    "training, transitions/s": "training_steps_per_second",
    "environment, steps/s": "environment_steps_per_second",
}
STAGES = {"acting": "acting_us", "environment": "environment_us", "update": "update_us"}
"""Parts of a training, which take turns."""

LOG_STD = -1.5  #: Noise of the actions, small enough to keep the policy's throws. Source: ours.
WARM_UPDATES = 2  #: Updates before the measurement, in which libraries initialise and graphs are recorded.


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure a training that goes on from a trained policy, with the policy's throws.

    Rates are summed over the environments. Microseconds are for a control step of one of them.
    """

    device: tuple[Device, ...] = ("cpu",)  #: Where to simulate and learn: cpu, cuda, cuda:1, ..., or several.
    num_envs: tuple[Count, ...] = (512,)  #: Environments that are simulated side by side; or several numbers.
    updates: Count = 5  #: Updates that are measured, after two that are not.
    #: Folder of the policy that acts and goes on to learn, or name of a shipped one.
    policy: PolicyPath = Path("proposed")
    fuse: bool = False  #: Whether torch.compile makes fewer kernels, as in a training.
    #: Any field of the task, such as --env.scene.cone pyramidal. All fields: bench --env.help.
    env: TaskFields = None
    given: Given = ()  #: Which of them are given.
    out: Annotated[Path, OutputFile((".json",))] | None = None  #: File that gets all numbers.

    def run(self) -> None:
        """Measure, print and write."""
        import torch

        from pixel2catch.evaluation.report import write_files
        from pixel2catch.policy import Policy

        threads = torch.get_num_threads()
        folder, devices = policy_folder(self.policy), [*map(prepare, self.device)]
        torch.set_num_threads(threads)  # those of `train`
        load = os.getloadavg()[0]
        rows: list[Row] = []
        result = circumstances() | {"load_average_before": load, "policy": folder.name, "results": rows}
        with working() as report:
            for device, num_envs in itertools.product(devices, sorted(self.num_envs)):
                report(f"{device}, {num_envs:,} environments")
                policy = Policy.load(folder, device)
                rows.append(measure(policy, self._experiment(policy, device, num_envs), self.updates))
                if self.out:  # at once: the next number may take too long
                    write_files(self.out.parent, {self.out.name: json_text(result)})
        results_console().print(_table(rows))
        if load > 0.5 * len(os.sched_getaffinity(0)):
            say(f"this machine had other work (load average {load:.1f}): without it, it is faster")
        if self.out:
            say(f"wrote {self.out}")

    def _experiment(self, policy: "Policy", device: str, num_envs: int) -> "Experiment":
        """Return the training that goes on from a policy, by the preset for the device."""
        from pixel2catch.learning.experiment import preset

        experiment = preset(
            "fast" if device.startswith("cuda") else "cpu",
            policy.contract.task,
            workcell=policy.contract.workcell,
            device=device,
            num_envs=num_envs,
            fuse=self.fuse,
            physics_stages=(),
            hidden=policy.hidden,
            recurrent=policy.recurrent,
            initial_log_std=LOG_STD,
        )
        return replace(experiment, env=with_given(experiment.env, self.env, self.given))


def measure(policy: "Policy", experiment: "Experiment", updates: int) -> Row:
    """Train from a policy, and return the costs of a control step, and the memory that is in use then.

    Returns:
        `*_per_second`: rates, summed over the environments; that of the environment without the networks.
        `*_us`: parts of the training, for a control step of one environment [µs]; `acting` is the rollout
        without the environment.
        `rss_bytes`, `device_bytes`: the most memory that this process had, and what all processes have on
        the device at the end [bytes].
    """
    import torch

    from pixel2catch.devices import DeviceTime
    from pixel2catch.envs.catch_env import CatchEnv
    from pixel2catch.learning.log import METRICS_FILE, read_rows
    from pixel2catch.learning.train import train
    from pixel2catch.policy import method_of

    cfg, calls = experiment.train, list[tuple[DeviceTime, DeviceTime]]()
    method, num_envs = method_of(policy.contract), cfg.num_envs
    env = CatchEnv(experiment.env, method, num_envs=num_envs, device=cfg.device, is_fused=cfg.fuse)

    step = env.step

    def timed(*arguments: Any) -> Any:
        begun = DeviceTime(env.device)
        result = step(*arguments)
        calls.append((begun, DeviceTime(env.device)))
        return result

    setattr(env, "step", timed)  # noqa: B010 (a method)
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
    environment = mean(begun.until(ended) for begun, ended in calls[-updates * cfg.rollout_steps :])
    free, total = torch.cuda.mem_get_info(env.device) if env.device.type == "cuda" else (0, 0)
    return {
        "device": cfg.device,
        "num_envs": num_envs,
        "physics_hz": experiment.env.scene.physics_hz,
        "environment_steps_per_second": num_envs / environment,
        "training_steps_per_second": num_envs / (rollout + update),
        "acting_us": 1e6 * (rollout - environment) / num_envs,
        "environment_us": 1e6 * environment / num_envs,
        "update_us": 1e6 * update / num_envs,
        "rss_bytes": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "device_bytes": total - free,
    }


def _table(rows: Sequence[Row]) -> "Table":
    """Return a table with a column for every device and number of environments."""
    from rich.table import Table

    table = Table("", *(f"{row['device']}, {row['num_envs']:,}" for row in rows))
    for title, name in RATES.items():
        table.add_row(title, *(f"{row[name]:,.0f}" for row in rows))
    table.add_section()
    for title, name in STAGES.items():
        table.add_row(f"{title}, µs a transition", *(f"{row[name]:.1f}" for row in rows))
    table.add_section()
    for title, name in {"memory": "rss_bytes", "memory of the device": "device_bytes"}.items():
        table.add_row(f"{title}, GB", *(f"{row[name] / 1e9:.2f}" if row[name] else "-" for row in rows))
    for column in table.columns[1:]:
        column.justify = "right"
    return table
