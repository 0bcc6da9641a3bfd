"""`pixel2catch bench`: what a training costs on this machine, and which part of it takes how long."""

import contextlib
import io
import itertools
import os
import resource
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Annotated, Any

from pixel2catch.checks import Count, Device, OutputFile
from pixel2catch.cli.console import prepare, results_console, say, working
from pixel2catch.cli.fields import TaskOptions, with_given
from pixel2catch.files import json_text
from pixel2catch.reports import Cells, circumstances, terminal_table
from pixel2catch.shipped import PolicyPath, policy_folder

if TYPE_CHECKING:
    from pixel2catch.learning.experiment import Experiment
    from pixel2catch.policy import Policy

Row = dict[str, Any]

LOG_STD = -1.5  #: Noise of the actions, small enough to keep the policy's throws. Source: ours.
WARM_UPDATES = 2  #: Updates before the measurement, in which libraries initialise and graphs are recorded.


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure what a training costs on this machine.

    It goes on from a trained policy, with the policy's throws. Rates are summed over the environments.
    Microseconds are for a control step of one of them.
    """

    device: tuple[Device, ...] = ("cpu",)  #: Where to simulate and learn: cpu, cuda, cuda:1, ..., or several.
    num_envs: tuple[Count, ...] = (512,)  #: Environments that are simulated side by side; or several numbers.
    updates: Count = 5  #: Updates that are measured, after two that are not.
    #: Folder of the policy that acts and goes on to learn, or name of a shipped one.
    policy: PolicyPath = Path("proposed")
    fuse: bool = False  #: Whether torch.compile makes fewer kernels, as in a training.
    task: TaskOptions = field(default_factory=TaskOptions)  #: Changes of the task.
    out: Annotated[Path, OutputFile((".json",))] | None = None  #: File that gets all numbers.

    def run(self) -> None:
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
        results_console().print(terminal_table("costs of a training", [*map(_cells, rows)]))
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
            initial_log_std=LOG_STD,
        )
        return replace(experiment, env=with_given(experiment.env, self.task.env, self.task.given))


def measure(policy: "Policy", experiment: "Experiment", updates: int) -> Row:
    """Train from a policy, and return the costs of a control step, and the memory that is in use then.

    Returns:
        `training_steps_per_second`: the rate, summed over the environments.
        `*_us`: parts of the training, for a control step of one environment [µs].
        `rss_bytes`, `device_bytes`: the most memory that this process had, and what all processes have on
        the device at the end [bytes].
    """
    import torch

    from pixel2catch.envs.catch_env import CatchEnv
    from pixel2catch.learning.log import METRICS_FILE, read_rows
    from pixel2catch.learning.train import train
    from pixel2catch.policy import method_of

    cfg = experiment.train
    method, num_envs = method_of(policy.contract), cfg.num_envs
    env = CatchEnv(experiment.env, method, num_envs=num_envs, device=cfg.device, is_fused=cfg.fuse)
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
    is_cuda = cfg.device.startswith("cuda")
    free, total = torch.cuda.mem_get_info(cfg.device) if is_cuda else (0, 0)
    return {
        "device": cfg.device,
        "num_envs": num_envs,
        "physics_hz": experiment.env.scene.physics_hz,
        "training_steps_per_second": num_envs / (rollout + update),
        "rollout_us": 1e6 * rollout / num_envs,
        "update_us": 1e6 * update / num_envs,
        "rss_bytes": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "device_bytes": total - free,
    }


def _cells(row: Row) -> Cells:
    """Return a line of the table."""
    return {
        "device": row["device"],
        "environments": f"{row['num_envs']:,}",
        "transitions/s": f"{row['training_steps_per_second']:,.0f}",
        "rollout [µs]": f"{row['rollout_us']:.1f}",
        "update [µs]": f"{row['update_us']:.1f}",
        "memory [GB]": f"{1e-9 * row['rss_bytes']:.2f}",
        "memory of the device [GB]": f"{1e-9 * row['device_bytes']:.2f}",
    }
