"""`pixel2catch twin`: the digital twin of the laboratory on this machine's network."""

from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pixel2catch.checks import Fraction, Seed, require_used
from pixel2catch.cli.console import prepare, say, saying_changes
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest
from pixel2catch.shipped import PolicyPath
from pixel2catch.twin import TaskArgs
from pixel2catch.viewer import PageCfg

if TYPE_CHECKING:
    from pixel2catch.twin.lab_node import LabNode


@dataclass(frozen=True, kw_only=True)
class Twin:
    """Simulate robot, camera and thrower on this machine's network.

    For `deploy` it is like the laboratory; its topics are those of the robot's profile, ur5e_allegro_v4 or
    fr3_allegro, in the domain ROS_DOMAIN_ID. Requests for throws go to /twin/command, the true state comes
    on /twin/state. See docs/deployment.md.
    """

    #: Policy with the robot and camera to simulate. Default: catch_alone+fit.
    policy: PolicyPath | None = None
    task: TaskArgs = field(default_factory=TaskArgs)  #: What is thrown at which robot.
    clock: Fraction = 1.0  #: Seconds of the twin in a real second, at most 1; `deploy` must have the same.
    seed: Seed = 0  #: Seed of the room and of all noise; each throw has a seed of its own.
    web: bool = False  #: Serve a page that shows the twin and has buttons to throw.
    page: PageCfg = field(default_factory=PageCfg)  #: Where that page is served.

    def run(self) -> None:
        from pixel2catch.evaluation.loading import load_policy
        from pixel2catch.workcells import find_workcell

        with needs_extra("twin"):
            from pixel2catch.twin.lab_node import serve, twin_profile
        require_used(self.page, ("address",), self.web, "without --web")
        prepare("cpu")
        policy, _ = load_policy(self.policy)
        task = self.task.make(policy, self.seed)
        say_change = saying_changes()

        def on_cycle(node: "LabNode") -> bool:
            say_change(node.summary(), node.time)
            return not stop.is_set

        say(f"opening the lab; clock {self.clock:g}; Ctrl-C ends it")
        with ExitStack() as stack:
            stop = stack.enter_context(StopRequest())
            if self.web:
                with needs_extra("viewer"):
                    from pixel2catch.viewer.twin import twin_page
                profile = twin_profile(find_workcell(task.scene.workcell))
                stack.enter_context(twin_page(self.page, profile, self.clock))
            say(serve(task, self.seed, self.clock, on_cycle))
