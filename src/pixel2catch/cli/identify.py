"""`pixel2catch identify`: from recorded motion to the simulator's joint dynamics."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from pixel2catch.checks import DynamicsPath, NewFolder, PhysicsRate
from pixel2catch.circumstances import circumstances
from pixel2catch.cli.console import results_console, say, working
from pixel2catch.errors import InvalidValueError
from pixel2catch.files import json_text

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pixel2catch.identification.checks import Check
    from pixel2catch.identification.fit import FitCfg
    from pixel2catch.identification.identify import Identification
    from pixel2catch.identification.importers import Names
    from pixel2catch.identification.recording import Recording
    from pixel2catch.robots.workcell import WorkcellSpec

EXIT_UNFIT = 1  #: Exit status of --check if data cannot be fitted.


@dataclass(frozen=True, kw_only=True)
class Identify:
    """Fit the simulator's joints to recorded motion: data checks, dynamics file, report.

    A recording is a rosbag2 (its folder, .mcap or .db3 file) with the joint states and the topics of the
    commands; or a folder with rtde.csv (columns timestamp, actual_q_0 to actual_q_5, if recorded actual_qd_0
    to actual_qd_5) and commands.csv (t, q_0 to q_5); or an .npz file with the arrays joints (names), t_cmd,
    q_cmd (a row a command), t_meas, q (a row a measurement), if recorded qd and effort. Times are in s,
    positions in rad, speeds in rad/s, efforts in N·m; each of the two times has a clock of its own.
    """

    #: Files or folders: rosbag2 (.mcap, .db3), a folder with rtde.csv and commands.csv, or .npz.
    recordings: Positional[tuple[Path, ...]]
    #: Whose joints to fit: ur5e, allegro, ur5e_allegro; of another work cell, its arms and hands by their
    #: names, or arm, hand, or its own name. With --check it may be left out: what was recorded is checked.
    robot: str | None = None
    #: New or empty folder for dynamics.json, report.html and result.json.
    out: NewFolder | None = None
    #: Only check the data, of one joint or more, and fit nothing; the exit status is 1 if they cannot be
    #: fitted.
    check: bool = False
    workcell: str = "ur5e_allegro"  #: The robots: a name, or a Python file that defines WORKCELLS.
    #: The recording that is not fitted, to judge the fit: its name or number (from 1), or none. Default: the
    #: last of several.
    hold_out: str | None = None
    #: Robot profile, shipped or a .yaml, whose topics and joint names a bag has, as `record` writes it; in
    #: place of --command-topic, --joint-states-topic and --rename.
    profile: str | None = None
    #: Topics of the commands in a bag, each TOPIC, TOPIC=ROBOT or TOPIC=JOINT,JOINT,... where messages name
    #: no joints. Default: the only one that can be it.
    command_topic: tuple[str, ...] = ()
    joint_states_topic: str = "/joint_states"  #: Topic of the measurements in a bag.
    shift_commands: float = 0.0  #: Added to the times of the commands [s], where their clock is another.
    rename: tuple[str, ...] = ()  #: Joints that have another name in the recordings, each OURS=THEIRS.
    #: Parameters to fit. Default: stiffness damping frictionloss armature latency; with --filter: filter_gain
    #: filter_lookahead latency.
    free: tuple[str, ...] = ()
    filter: bool = False  #: Fit the UR's servoJ filter in front of a stiff servo, or of that of --start.
    start: DynamicsPath | None = None  #: Dynamics file to start from: what is not fitted stays as it says.
    physics_hz: PhysicsRate = (
        480.0  #: Physics steps in a second of the fit; more are more exact, and take longer.
    )
    json: bool = False  #: Print the numbers of the report as one JSON object.

    def run(self) -> None:
        """Check, fit, and write the report."""
        from pixel2catch.identification.identify import checked, identify, start_of_fit
        from pixel2catch.identification.report import DYNAMICS, PAGE, write_report
        from pixel2catch.workcells import find_workcell

        workcell = find_workcell(self.workcell)
        if self.check:
            self._check(workcell)
            return
        if self.robot is None or self.out is None:
            raise InvalidValueError(
                "say whose joints to fit, --robot, and where to write, --out; or --check to look at the data."
            )
        cfg, start = self._fit_cfg(), start_of_fit(self.robot, self.start, self.filter, workcell)
        with working() as report:
            recordings = self._read(workcell, report)
            report("checking the data")
            sources = checked(recordings, self.hold_out)
        if not self.json:
            _print_checks([(source.recording, source.checks) for source in sources])
        with working() as report:
            result = identify(sources, start, cfg, report)
            report("drawing the report")
            content = write_report(self.out, result, circumstances())
        if self.json:
            print(json_text(content), end="")
        else:
            _print_result(result)
        say(f"wrote {self.out / DYNAMICS}, and the report for people, {self.out / PAGE}")

    def _check(self, workcell: "WorkcellSpec") -> None:
        """Print what the checks of the data say; the exit status is 1 if one forbids a fit."""
        from pixel2catch.identification.checks import check_recording

        with working() as report:
            found = [(each, check_recording(each)) for each in self._read(workcell, report)]
        if self.json:
            content = {each.name: [asdict(check) for check in checks] for each, checks in found}
            print(json_text(content), end="")
        else:
            _print_checks(found)
        if any(check.forbids_fit for _, checks in found for check in checks):
            raise SystemExit(EXIT_UNFIT)

    def _fit_cfg(self) -> "FitCfg":
        """How to fit; the rate is one that a training can have."""
        from pixel2catch.identification.fit import FILTER_PARAMETERS, SERVO_PARAMETERS, FitCfg
        from pixel2catch.scene.scene import SceneCfg

        default = FILTER_PARAMETERS if self.filter else SERVO_PARAMETERS
        physics_dt = SceneCfg(physics_hz=self.physics_hz).physics_dt
        return FitCfg(free=self.free or default, physics_dt=physics_dt)

    def _read(self, workcell: "WorkcellSpec", report: "Callable[[str], None]") -> "list[Recording]":
        from pixel2catch.identification.importers import read_recording

        if not self.recordings:
            raise InvalidValueError("there is no recording; give at least one.")
        names, found = self._names(workcell), []
        for path in self.recordings:
            report(f"reading {path}")
            recording = read_recording(path, self.robot, names, workcell, is_partial=self.check)
            found.append(replace(recording, t_cmd=recording.t_cmd + self.shift_commands))
        return found

    def _names(self, workcell: "WorkcellSpec") -> "Names":
        """What the recordings call topics and joints."""
        from pixel2catch.identification.importers import Names
        from pixel2catch.identification.joints import joints_of

        if self.profile is None:
            return Names.parse(self.command_topic, self.joint_states_topic, self.rename, workcell)
        from pixel2catch.ros2.profile import Profile

        if self.command_topic or self.rename:
            raise InvalidValueError("--profile says what --command-topic and --rename do; leave them out.")
        return Names.of(Profile.load(self.profile), joints_of(workcell, self.robot))


def _print_checks(found: "Sequence[tuple[Recording, Sequence[Check]]]") -> None:
    from pixel2catch.identification.report_tables import check_grid

    for recording, checks in found:
        results_console().print(check_grid(recording.name, checks).for_terminal())


def _print_result(result: "Identification") -> None:
    """Print errors and parameters as tables, then what is not known."""
    from rich.text import Text

    from pixel2catch.identification.report import NOTHING_HELD_OUT
    from pixel2catch.identification.report_tables import errors_grid, open_questions, parameters_grid

    console = results_console()
    console.print(errors_grid(result).for_terminal())
    console.print(parameters_grid(result).for_terminal())
    for question in open_questions(result.fit):
        console.print(Text(f"- {question}"))
    if not result.of(is_held_out=True):
        console.print(Text(NOTHING_HELD_OUT, style="bold red"))
