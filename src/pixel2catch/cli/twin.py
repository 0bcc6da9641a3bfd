"""`pixel2catch twin`: the lab on the wire, without a lab."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pixel2catch.checks import Domain, OutputFile
from pixel2catch.cli.console import say, saying_changes
from pixel2catch.cli.device import prepare
from pixel2catch.errors import InvalidValueError
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest
from pixel2catch.shipped import PolicyPath
from pixel2catch.twin.config import TwinCfg
from pixel2catch.viewer.config import PageCfg

if TYPE_CHECKING:
    from pixel2catch.envs.cfg import CatchEnvCfg
    from pixel2catch.twin.lab_node import LabNode
    from pixel2catch.twin.realtime import ClockStats


@dataclass(frozen=True, kw_only=True)
class Twin:
    """Be robot, hand, camera and thrower on this machine's DDS network, until interrupted.

    `deploy` cannot tell it from the lab; topics are those of the profile ur5e_allegro_v4. An operator asks
    for throws on /twin/command, and /twin/state says what is true. See docs/deployment.md.
    """

    policy: PolicyPath | None = None  #: Policy whose hand and camera the twin has. Default: catch_alone+fit.
    twin: TwinCfg = field(default_factory=TwinCfg)  #: How the twin runs.
    #: New file: be a robot up to 40 % off the nominal one and 12 ms late, drawn by --seed, and write there
    #: what it is; `identify` can then be judged by it.
    draw_dynamics: Annotated[Path, OutputFile((".json",), is_new=True)] | None = None
    web: bool = False  #: Whether to serve a page that shows the twin and has buttons to throw.
    page: PageCfg = field(default_factory=PageCfg)  #: Where that page is served.
    domain: Domain | None = None  #: DDS domain. Default: ROS_DOMAIN_ID, or 0.

    def run(self) -> None:
        """Serve, and say what happens."""
        import os
        from contextlib import nullcontext

        from pixel2catch.evaluation.loading import load_policy
        from pixel2catch.workcells import find_workcell

        with needs_extra("twin"):
            from pixel2catch.twin.lab_node import twin_profile
            from pixel2catch.twin.realtime import serve
        prepare("cpu")
        if self.domain is not None:
            os.environ["ROS_DOMAIN_ID"] = str(self.domain)
        policy, _ = load_policy(self.policy)
        task = self._drawn(self.twin.task.make(policy))
        hear = saying_changes()

        def report(lab_node: "LabNode", stats: "ClockStats") -> bool:
            hear(lab_node.summary(), lab_node.time)
            return not stop.is_set

        say(f"opening the lab; clock {self.twin.clock:g}; Ctrl-C ends it")
        page = nullcontext()
        if self.web:
            with needs_extra("viewer"):
                from pixel2catch.viewer.process import page_process
                from pixel2catch.viewer.twin import serve_page
            profile = twin_profile(find_workcell(task.scene.workcell))
            scene, clock = task.scene, self.twin.clock
            page = page_process(serve_page, self.page, scene, profile, clock, niceness=0)  # has a switch
        with StopRequest() as stop, page:
            stats = serve(self.twin, task, report)
        late = f"{stats.num_late:,} of them late, the worst by {1000 * stats.worst:.0f} ms"
        say(f"{stats.num_cycles:,} cycles, {late}")

    def _drawn(self, task: "CatchEnvCfg") -> "CatchEnvCfg":
        """The task with a robot that is drawn, if one is to be."""
        if self.draw_dynamics is None:
            return task
        import numpy as np

        from pixel2catch.identification.rehearsal import exact_file, unlike_nominal
        from pixel2catch.robots.joint_dynamics import JointDynamics
        from pixel2catch.workcells import find_workcell

        if self.twin.task.dynamics:
            raise InvalidValueError("--dynamics says what the robot is, --draw-dynamics draws it: give one.")
        workcell = find_workcell(task.scene.workcell)
        nominal = JointDynamics.nominal(specs=workcell.joints)
        file = exact_file(unlike_nominal(np.random.default_rng(self.twin.seed), nominal), workcell)
        self.draw_dynamics.parent.mkdir(parents=True, exist_ok=True)
        file.save(self.draw_dynamics)
        say(f"wrote {self.draw_dynamics}: the robot that this twin is")
        return task.with_dynamics(file)
