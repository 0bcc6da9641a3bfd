"""`pixel2catch excite`: motion that tells the joints' dynamics, and recordings of it by a simulated robot."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pixel2catch.checks import (
    AtMostFull,
    DynamicsPath,
    NewFolder,
    OutputFile,
    PhysicsRate,
    Positive,
    Seed,
    Within,
)
from pixel2catch.cli.console import results_console, say, working
from pixel2catch.files import require_free_file, write_atomically

if TYPE_CHECKING:
    from pixel2catch.identification.recording import Trajectory
    from pixel2catch.identification.rehearsal import Assessment
    from pixel2catch.robots.joint_dynamics import JointDynamics
    from pixel2catch.robots.workcell import WorkcellSpec


@dataclass(frozen=True, kw_only=True)
class Excite:
    """Draw motion that tells the joints' dynamics, try it in simulation, and write it as joint targets.

    It begins and ends at rest in the start pose. Written is only what a simulated robot follows within all
    limits and at a distance from the table and from itself. Nothing is overwritten.
    """

    #: Whose joints move, such as ur5e, allegro, arm or hand; the others hold the start pose. Default: all of
    #: the work cell.
    robot: str | None = None
    workcell: str = "ur5e_allegro"  #: The robots: a name, or a Python file that defines WORKCELLS.
    #: File of the trajectory, such as excitation.npz; of several, excitation-1.npz and so on.
    out: Annotated[Path, OutputFile((".npz",))] | None = None
    picture: Annotated[Path, OutputFile((".png",))] | None = (
        None  #: File of a picture of commands and simulated motion, numbered likewise.
    )
    seconds: Positive = 40.0  #: Duration of a trajectory [s].
    #: Factor on speeds, accelerations and jumps: begin small on a real robot. 1 is full: jumps like a
    #: policy's, which it takes to tell the inertia of the arm's drives.
    speed: AtMostFull = 0.2
    seed: Seed = 0  #: Seed of everything that is drawn; each further recording has the next.
    recordings: Annotated[int, Within(1, 1000)] = (
        1  #: Number of trajectories; a fit needs two at least, one to be held out.
    )
    dynamics: DynamicsPath | None = (
        None  #: Dynamics file of the robot that tries them. Default: the nominal robot.
    )
    #: New folder for what a robot would have recorded, recording-1.npz and so on, and truth.json.
    rehearse: NewFolder | None = None
    #: Dynamics file of that robot. Default: drawn, up to 40 % from the nominal one, 12 ms late.
    truth: DynamicsPath | None = None
    #: Physics steps in a second of a rehearsal; the more, the nearer to a real robot.
    physics_hz: PhysicsRate = 480.0

    def run(self) -> None:
        """Draw, try, print and write."""
        from numpy.random import default_rng

        from pixel2catch.identification.excitation import ExcitationCfg, find_excitation
        from pixel2catch.identification.rehearsal import RecorderCfg, rehearse, unlike_nominal
        from pixel2catch.identification.report import motion_picture
        from pixel2catch.workcells import find_workcell

        outs, pictures = self._numbered(self.out), self._numbered(self.picture)
        for path in (*outs, *pictures):
            require_free_file(path)
        workcell, found = find_workcell(self.workcell), []
        dynamics, truth = (self._dynamics(path, workcell) for path in (self.dynamics, self.truth))
        if self.truth is None:
            truth = unlike_nominal(default_rng(self.seed), self._dynamics(None, workcell))
        with working() as report:
            for i in range(self.recordings):
                report(f"drawing and trying trajectory {i + 1} of {self.recordings}")
                options = {"seconds": self.seconds, "speed": self.speed, "seed": self.seed + i}
                cfg = ExcitationCfg(workcell=workcell, robot=self.robot, **options)
                found.append(find_excitation(cfg, dynamics, report))
            for (trajectory, _), path in zip(found, outs, strict=False):
                trajectory.save(path)
            for pair, path in zip(found, pictures, strict=False):
                write_atomically({path: motion_picture(*pair)})
            if self.rehearse:
                report("recording what a robot would have done")
                trajectories = [trajectory for trajectory, _ in found]
                cfg = RecorderCfg(physics_hz=self.physics_hz)
                rehearse(self.rehearse, trajectories, truth, cfg, self.seed)
        for trajectory, assessment in found:
            _print(trajectory, assessment)
        written = [*outs, *pictures, *([self.rehearse] if self.rehearse else [])]
        say(f"wrote {', '.join(map(str, written)) or 'nothing: no --out, no --rehearse'}")

    def _numbered(self, path: Path | None) -> list[Path]:
        """The names of a file, one for each trajectory; none if it is not wanted."""
        if path is None:
            return []
        numbers = range(1, self.recordings + 1)
        return [path] if self.recordings == 1 else [path.with_stem(f"{path.stem}-{i}") for i in numbers]

    def _dynamics(self, path: Path | None, workcell: "WorkcellSpec") -> "JointDynamics":
        """The dynamics of the robot's joints; what a file does not have is nominal."""
        from pixel2catch.identification.joints import joints_of
        from pixel2catch.mdp.dynamics_file import DynamicsFile
        from pixel2catch.robots.joint_dynamics import JointDynamics

        joints = joints_of(workcell, self.robot)
        nominal = JointDynamics.nominal(specs=workcell.joints)
        return DynamicsFile.load(path, workcell).dynamics.over(nominal).select(joints)


def _print(trajectory: "Trajectory", assessment: "Assessment") -> None:
    """Print what the simulated robot did."""
    from pixel2catch.identification.report_tables import motion_grid

    console = results_console()
    title = f"seed {trajectory.header['seed']}, simulated"
    console.print(motion_grid(title, assessment).for_terminal())
    for clearance in assessment.clearances:
        console.print(clearance.sentence())
    weak = sum(not check.is_good for check in assessment.checks)
    if weak:
        advice = "raise --speed or --seconds"
        console.print(f"{weak} joints are excited too weakly to tell their dynamics: {advice}.")
