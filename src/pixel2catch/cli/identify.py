"""`pixel2catch identify`: from recordings of a robot to a dynamics file and a report."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.text import Text
from tyro.conf import Positional

from pixel2catch.checks import NOT_EMPTY, DynamicsPath, NewFolder, require_used
from pixel2catch.cli.console import results_console, say, suggest, working
from pixel2catch.errors import InvalidValueError
from pixel2catch.files import held_folder
from pixel2catch.reports import circumstances, terminal_table

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pixel2catch.identification.checks import DataCheck
    from pixel2catch.identification.recording import Recording
    from pixel2catch.robots.workcell import WorkcellSpec

EXIT_UNFIT = 1  #: Exit status of --check if a recording cannot be fitted.


@dataclass(frozen=True, kw_only=True)
class Identify:
    """Fit the simulated joints to recorded motion.

    A recording is a rosbag2 (its folder, .mcap or .db3 file) with the joint states and the topics of the
    commands, an .npz file with the arrays joints (names), t_cmd, q_cmd (a row per command), t_meas and q (a
    row per measurement), or a folder with commands.csv (columns t, q_0, ...) and another .csv file with the
    measurements (columns timestamp, actual_q_0, ...). Times are in s, positions in rad; commands and
    measurements may have different clocks. The last of several recordings judges the fit.
    """

    #: Files or folders: rosbag2 (.mcap, .db3), .npz or tables (.csv).
    recordings: Positional[Annotated[tuple[Path, ...], NOT_EMPTY]]
    #: Part whose joints are fitted: ur5e, allegro, ur5e_allegro; of another work cell, an arm or a hand by
    #: its name, or arm, hand, or the work cell's name. Optional with --check: all recorded joints are
    #: checked.
    robot: str | None = None
    #: New or empty folder for dynamics.json, report.md and result.json.
    out: NewFolder | None = None
    #: Only check the data of one joint or more, without a fit; the exit status is 1 if they cannot be fitted.
    check: bool = False
    workcell: str = "ur5e_allegro"  #: Name of the robots.
    #: Robot profile, shipped or a .yaml, with the topics and joint names of a bag.
    profile: str | None = None
    #: Topic of the commands in a bag, without --profile. Default: the only one that can have commands.
    command_topic: str | None = None
    #: Parameters to fit; filter_gain filter_lookahead latency are those of the UR's servoJ filter, in front
    #: of a stiff servo, or of the servo of --start.
    free: tuple[str, ...] = ("stiffness", "damping", "frictionloss", "armature", "latency")
    #: Dynamics file to start from; parameters that are not fitted keep its values.
    start: DynamicsPath | None = None

    def run(self) -> None:
        from pixel2catch.identification import report as reports
        from pixel2catch.identification.fit import FILTER_PARAMETERS, FitCfg
        from pixel2catch.identification.identify import checked, identify, open_questions, start_of_fit
        from pixel2catch.workcells import find_workcell

        workcell, cfg, start = find_workcell(self.workcell), FitCfg(free=self.free), None
        if self.check:
            require_used(self, ("out", "start", "free"), False, "with --check")
        else:
            if self.robot is None or self.out is None:
                raise InvalidValueError("--robot and --out are needed for a fit; --check needs neither.")
            has_filter = not {*FILTER_PARAMETERS[:2]}.isdisjoint(cfg.free)
            start = start_of_fit(self.robot, self.start, has_filter, workcell)
        with working() as report:
            recordings = self._read(workcell, report)
            report("checking the data")
            sources = checked(recordings)
        for source in sources:
            print_checks(source.recording.name, source.checks)
        if start is None or self.out is None:
            if any(check.forbids_fit for source in sources for check in source.checks):
                raise SystemExit(EXIT_UNFIT)
            return
        with held_folder(self.out), working() as report:
            result = identify(sources, start, cfg, report)
            report("drawing the report")
            reports.write_report(self.out, result, circumstances())
        console = results_console()
        console.print(terminal_table("Tracking error, RMS [mrad]", reports.error_rows(result)))
        console.print(terminal_table("Parameters with 95 % intervals", reports.parameter_rows(result)))
        for question in open_questions(result.fit):
            console.print(Text(f"- {question}"))
        for warning in reports.warnings(result):
            console.print(Text(warning, style="bold yellow"))
        dynamics = self.out / reports.DYNAMICS
        say(f"wrote {dynamics} and the report {self.out / reports.REPORT}")
        suggest("evaluate", "--dynamics", dynamics)

    def _read(self, workcell: "WorkcellSpec", report: "Callable[[str], None]") -> "list[Recording]":
        from pixel2catch.identification.recording import Recording, joints_of

        joints, found = joints_of(workcell, self.robot), []
        if self.profile and self.command_topic:
            raise InvalidValueError("--profile has the topics of the commands; leave out --command-topic.")
        names = None
        if self.profile or self.command_topic:
            from pixel2catch.identification.importers import RecordedNames
            from pixel2catch.ros2.profile import Profile

            names = RecordedNames(command_topics={self.command_topic or "": ()})
            if self.profile:
                names = RecordedNames.of(Profile.load(self.profile), joints)
        for path in self.recordings:
            report(f"reading {path}")
            if path.suffix == ".npz":
                whole = Recording.load(path, workcell, names.joints if names else {})
            else:
                from pixel2catch.identification.importers import COMMAND_TABLE, read_rosbag, read_tables

                read = read_tables if (path / COMMAND_TABLE).is_file() else read_rosbag
                whole = read(path, joints, names, workcell)
            found.append(whole if self.check and self.robot is None else whole.select(joints))
        return found


def print_checks(name: str, checks: "Sequence[DataCheck]") -> None:
    """Print the data checks of a recording as a table."""
    from pixel2catch.identification.report import check_table

    results_console().print(terminal_table(*check_table(name, checks)))
