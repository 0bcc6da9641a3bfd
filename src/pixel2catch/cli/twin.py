"""`pixel2catch twin`: the lab on the wire, without a lab."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pixel2catch.envs.cfg import CatchEnvCfg
    from pixel2catch.policy import Policy
    from pixel2catch.twin.lab_node import LabNode
    from pixel2catch.twin.realtime import ClockStats


@dataclass(frozen=True, kw_only=True)
class TaskArgs:
    """What is thrown at which robot.

    Attributes:
        dynamics: Dynamics file of the robot that the twin is. Default: the nominal robot.
        objects: What is thrown: seen, unseen, real, names of objects, or several of them.
    """

    dynamics: Path | None = None
    objects: tuple[str, ...] = ("seen",)

    def make(self, policy: "Policy") -> "CatchEnvCfg":
        """The task in which a policy is to catch."""
        from pixel2catch.evaluation.loading import task_of
        from pixel2catch.scene.objects import select_objects

        return replace(task_of(policy, dynamics=self.dynamics), objects=select_objects(self.objects))


@dataclass(frozen=True, kw_only=True)
class Twin:
    """Be robot, hand, camera and thrower on this machine's DDS network, until interrupted.

    `deploy` cannot tell it from the lab; topics are those of the profile ur5e_allegro_v4. An operator asks
    for throws on /twin/command, and /twin/state says what is true. See docs/deployment.md.

    Attributes:
        policy: Policy whose hand and camera the twin has. Default: catch_alone+fit.
        task: What is thrown at which robot.
        clock: Seconds of the twin in a real second, at most 1; `deploy` must be given the same.
        seed: Seed of the room and of all noise; a throw has a seed of its own.
        web: Port of a page that shows the twin and has buttons to throw. Default: no page.
        domain: DDS domain. Default: ROS_DOMAIN_ID, or 0.
    """

    policy: Path | None = None
    task: TaskArgs = field(default_factory=TaskArgs)
    clock: float = 1.0
    seed: int = 0
    web: int | None = None
    domain: int | None = None

    def run(self) -> None:
        """Serve, and say what happens."""
        import os

        from pixel2catch.cli.console import say
        from pixel2catch.cli.device import prepare
        from pixel2catch.cli.extras import needs_extra
        from pixel2catch.evaluation.loading import load_policy
        from pixel2catch.interruption import StopRequest

        with needs_extra("twin"):
            from pixel2catch.twin.realtime import TwinCfg, serve
        prepare("cpu")
        if self.domain is not None:
            os.environ["ROS_DOMAIN_ID"] = str(self.domain)
        policy, _ = load_policy(self.policy)
        cfg = TwinCfg(task=self.task.make(policy), seed=self.seed, clock=self.clock, web=self.web)
        last = ""

        def report(lab_node: "LabNode", stats: "ClockStats") -> bool:
            nonlocal last
            if (now := lab_node.summary()) != last:
                say(f"{lab_node.time:7.1f} s  {now}")
                last = now
            return not stop.is_set

        say(f"opening the lab; clock {self.clock:g}; Ctrl-C ends it")
        with StopRequest() as stop:
            stats = serve(cfg, report)
        late = f"{stats.num_late:,} of them late, the worst by {1000 * stats.worst:.0f} ms"
        say(f"{stats.num_cycles:,} cycles, {late}")
