"""`pixel2catch bench`: what physics, the environment and a training cost on this machine."""

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pixel2catch.checks import Count, Device, OutputFile, Positive
from pixel2catch.cli.console import results_console, say, working
from pixel2catch.cli.device import prepare
from pixel2catch.cli.fields import Given, TaskFields, with_given
from pixel2catch.files import json_text
from pixel2catch.reports import circumstances
from pixel2catch.shipped import PolicyPath, policy_folder

if TYPE_CHECKING:
    from rich.table import Table

Row = dict[str, Any]

RATES = {
    "physics steps/s": "physics_steps_per_second",
    "environment, random actions, steps/s": "random_steps_per_second",
    "environment, policy's actions, steps/s": "trained_steps_per_second",
    "training, transitions/s": "training_steps_per_second",
}

STAGES = {"acting": "acting_us", "physics": "physics_us", "sensing, MDP": "sensing_us", "update": "update_us"}
"""Parts of a training, which take turns."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure what physics, the environment and a training cost, with the throws of a trained policy.

    Rates are summed over the environments. Microseconds of a training are for a control step of one of them.
    """

    device: tuple[Device, ...] = ("cpu",)  #: Where to simulate and learn: cpu, cuda, cuda:1, ..., or several.
    num_envs: tuple[Count, ...] = (512,)  #: Environments that are simulated side by side; or several numbers.
    seconds: Positive = 5.0  #: How long each part is measured [s].
    #: Folder of the policy that acts and goes on to learn, or name of a shipped one.
    policy: PolicyPath = Path("proposed")
    fuse: bool = False  #: Whether torch.compile makes fewer kernels, as in a training.
    #: Any field of the task, such as --env.scene.cone pyramidal. All fields: bench --env.help.
    env: TaskFields = None
    given: Given = ()  #: Which of them are given.
    out: Annotated[Path, OutputFile((".json",))] | None = None  #: File that gets all numbers.

    def run(self) -> None:
        """Measure, print and write."""
        from pixel2catch.cli.bench_costs import measure
        from pixel2catch.evaluation.report import write_files
        from pixel2catch.policy import Policy

        folder, devices = policy_folder(self.policy), [*map(prepare, self.device)]
        load = os.getloadavg()[0]
        rows: list[Row] = []
        result = circumstances() | {"load_average_before": load, "policy": folder.name, "results": rows}
        with working() as report:
            for device, num_envs in itertools.product(devices, sorted(self.num_envs)):
                costs = measure(
                    Policy.load(folder, prepare(device)),
                    lambda task: with_given(task, self.env, self.given),
                    device=device,
                    num_envs=num_envs,
                    seconds=self.seconds,
                    fuse=self.fuse,
                    report=report,
                )
                rows.append(costs)
                if self.out:  # at once: the next number may take too long
                    write_files(self.out.parent, {self.out.name: json_text(result)})
        results_console().print(_table(rows))
        if load > 0.5 * len(os.sched_getaffinity(0)):
            say(f"this machine had other work (load average {load:.1f}): without it, it is faster")
        if self.out:
            say(f"wrote {self.out}")


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
