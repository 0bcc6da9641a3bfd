"""`pixel2catch excite`: motion that shows the joints' dynamics, and recordings of it by a simulated robot."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pixel2catch.checks import DynamicsPath, Fraction, NewFolder, OutputFile, Positive, Seed, Within
from pixel2catch.cli.console import results_console, say, suggest, working
from pixel2catch.cli.identify import print_checks

if TYPE_CHECKING:
    from pixel2catch.identification.recording import Trajectory
    from pixel2catch.identification.rehearsal import Assessment


@dataclass(frozen=True, kw_only=True)
class Excite:
    """Write a trajectory that shows the dynamics of the joints.

    It begins and ends at rest in the start pose. It is only written if a simulated robot follows it within
    all limits and keeps its distance from the table and from itself. Nothing is overwritten.
    """

    #: Part whose joints move, such as ur5e, allegro, arm or hand; the others hold the start pose. Default:
    #: all.
    robot: str | None = None
    workcell: str = "ur5e_allegro"  #: Name of the robots.
    #: File of the trajectory, such as excitation.npz; of several, excitation-1.npz and so on.
    out: Annotated[Path, OutputFile((".npz",))] | None = None
    seconds: Positive = 40.0  #: Duration of a trajectory [s]: at the default speed 20 or more, at most 600.
    #: Factor on speeds, accelerations and jumps: begin small on a real robot. Full speed, 1, has jumps like a
    #: policy's, which show the inertia of the arm's drives.
    speed: Fraction = 0.2
    seed: Seed = 0  #: Seed of the first trajectory; each further one has the next.
    #: Number of trajectories; a fit needs two at least, one to be held out.
    recordings: Annotated[int, Within(1, 1000)] = 1
    #: Dynamics file of the simulated robot. Default: nominal; for --rehearse up to 40 % off, 12 ms late.
    dynamics: DynamicsPath | None = None
    #: New folder for recordings of a simulated robot, recording-1.npz and so on, and its dynamics,
    #: truth.json.
    rehearse: NewFolder | None = None

    def run(self) -> None:
        from numpy.random import default_rng

        from pixel2catch.identification.excitation import ExcitationCfg, find_excitation
        from pixel2catch.identification.recording import joints_of
        from pixel2catch.identification.rehearsal import rehearse, unlike_nominal
        from pixel2catch.mdp.dynamics_file import DynamicsFile
        from pixel2catch.robots.joint_dynamics import JointDynamics
        from pixel2catch.workcells import find_workcell

        numbers = range(1, self.recordings + 1)
        outs = [self.out.with_stem(f"{self.out.stem}-{i}") for i in numbers] if self.out else []
        outs = [self.out] if self.out and self.recordings == 1 else outs
        for path in outs:
            OutputFile(is_new=True).require("out", path)
        workcell, found = find_workcell(self.workcell), []
        known = DynamicsFile.load(self.dynamics, workcell).dynamics if self.dynamics else None
        dynamics = JointDynamics.of(workcell.joints, known).select(joints_of(workcell, self.robot))
        with working() as report:
            for i in range(self.recordings):
                report(f"drawing and trying trajectory {i + 1} of {self.recordings}")
                options = {"seconds": self.seconds, "speed": self.speed, "seed": self.seed + i}
                cfg = ExcitationCfg(workcell=workcell, robot=self.robot, **options)
                found.append(find_excitation(cfg, dynamics, report))
            for (trajectory, _), path in zip(found, outs, strict=False):
                trajectory.save(path)
            if self.rehearse:
                report("simulating the recordings")
                truth = dynamics if self.dynamics else unlike_nominal(default_rng(self.seed), dynamics)
                rehearse(self.rehearse, [trajectory for trajectory, _ in found], truth, self.seed)
        for trajectory, assessment in found:
            _print(trajectory, assessment)
        written = [*outs, *([self.rehearse] if self.rehearse else [])]
        say(f"wrote {', '.join(map(str, written)) or 'nothing: no --out, no --rehearse'}")
        if outs:
            suggest("record", outs[0], "--out", "recording")


def _print(trajectory: "Trajectory", assessment: "Assessment") -> None:
    """Print the checks of the simulated robot's motion, and its distances."""
    console = results_console()
    print_checks(f"seed {trajectory.header['seed']}, simulated", assessment.checks)
    for clearance in assessment.clearances:
        console.print(clearance.sentence())
    if limited := [f"{name} {100 * share:.1f} %" for name, share in assessment.at_torque_limit.items()]:
        console.print(
            f"Time at the torque limit of the drives: {', '.join(limited)}. A policy does so, too, and the "
            "inertia shows then; if your robot stops by itself, lower --speed."
        )
    if weak := sum(not check.is_good for check in assessment.checks):
        advice = "raise --speed or --seconds"
        console.print(f"{weak} joints are excited too weakly to show their dynamics: {advice}.")
