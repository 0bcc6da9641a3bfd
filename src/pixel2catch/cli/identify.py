"""`pixel2catch identify`: from recorded motion to the simulator's joint dynamics."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from pixel2catch.checks import DynamicsPath, OutputFolder, PhysicsRate

if TYPE_CHECKING:
    from collections.abc import Callable

    from pixel2catch.identification.fit import FitCfg
    from pixel2catch.identification.identify import CheckedRecording, Identification
    from pixel2catch.robots.workcell import WorkcellSpec


@dataclass(frozen=True, kw_only=True)
class Identify:
    """Fit the simulator's joints to recorded motion: data checks, dynamics file, report."""

    #: Files or folders: rosbag2 (.mcap, .db3), a folder with rtde.csv and commands.csv, or .npz.
    recordings: Positional[tuple[Path, ...]]
    #: Whose joints to fit: ur5e, allegro, ur5e_allegro; of another work cell, its arms and hands by their
    #: names, or arm, hand, or its own name.
    robot: str
    out: Annotated[
        Path, OutputFolder(is_empty=True)
    ]  #: New or empty folder for dynamics.json, report.html and result.json.
    workcell: str = "ur5e_allegro"  #: The robots: a name, or a Python file that defines WORKCELLS.
    #: The recording that is not fitted, to judge the fit: its name or number (from 1), or none. Default: the
    #: last of several.
    hold_out: str | None = None
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
        from pixel2catch.circumstances import circumstances
        from pixel2catch.cli.console import results_console, say, working
        from pixel2catch.files import json_text, require_free_folder
        from pixel2catch.identification.identify import identify, start_of_fit
        from pixel2catch.identification.report import DYNAMICS, PAGE, write_report
        from pixel2catch.identification.report_tables import check_grid
        from pixel2catch.workcells import find_workcell

        require_free_folder(self.out)
        workcell = find_workcell(self.workcell)
        cfg, start = self._fit_cfg(), start_of_fit(self.robot, self.start, self.filter, workcell)
        with working() as report:
            sources = self._sources(workcell, report)
        for source in () if self.json else sources:
            table = check_grid(source.recording.name, source.checks).for_terminal()
            results_console().print(table)
        with working() as report:
            result = identify(sources, start, cfg, report)
            report("drawing the report")
            now = circumstances()
            command = shlex.join(["pixel2catch", *now["command"][1:]])
            content = write_report(self.out, result, now | {"command": command})
        if self.json:
            print(json_text(content), end="")
        else:
            _print_result(result)
        say(f"wrote {self.out / DYNAMICS}, and the report for people, {self.out / PAGE}")

    def _fit_cfg(self) -> "FitCfg":
        """How to fit; the rate is one that a training can have."""
        from pixel2catch.identification.fit import FILTER_PARAMETERS, SERVO_PARAMETERS, FitCfg
        from pixel2catch.scene.scene import SceneCfg

        default = FILTER_PARAMETERS if self.filter else SERVO_PARAMETERS
        physics_dt = SceneCfg(physics_hz=self.physics_hz).physics_dt
        return FitCfg(free=self.free or default, physics_dt=physics_dt)

    def _sources(self, workcell: "WorkcellSpec", report: "Callable[[str], None]") -> "list[CheckedRecording]":
        """Read and check the recordings."""
        from dataclasses import replace

        from pixel2catch.identification.identify import checked
        from pixel2catch.identification.importers import Names, read_recording

        names = Names.parse(self.command_topic, self.joint_states_topic, self.rename, workcell)
        recordings = []
        for path in self.recordings:
            report(f"reading {path}")
            recording = read_recording(path, self.robot, names, workcell)
            recordings.append(replace(recording, t_cmd=recording.t_cmd + self.shift_commands))
        report("checking the data")
        return checked(recordings, self.hold_out)


def _print_result(result: "Identification") -> None:
    """Print errors and parameters as tables, then what is not known."""
    from rich.text import Text

    from pixel2catch.cli.console import results_console
    from pixel2catch.identification.report import NOTHING_HELD_OUT
    from pixel2catch.identification.report_tables import errors_grid, open_questions, parameters_grid

    console = results_console()
    console.print(errors_grid(result).for_terminal())
    console.print(parameters_grid(result).for_terminal())
    for question in open_questions(result.fit):
        console.print(Text(f"- {question}"))
    if not result.of(is_held_out=True):
        console.print(Text(NOTHING_HELD_OUT, style="bold red"))
