"""`pixel2catch trials`: the paper's table of real throws, from a randomised and blinded series."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pixel2catch.checks import NOT_EMPTY, ResultsFolder, Seed, Within
from pixel2catch.errors import StudyError
from pixel2catch.files import json_text, write_atomically
from pixel2catch.installation import needs_extra
from pixel2catch.shipped import PolicyPath


@dataclass(frozen=True, kw_only=True)
class Trials:
    """Lead through a randomised, blinded series of real throws.

    Each throw is one run of `deploy --after-catch`; no output names its policy. From what the robot measured,
    an outcome is proposed: caught; reached, if the hand touched the object; or dropped. Enter confirms it; a
    key, or a button of `operate --web`, corrects it. The same command continues an interrupted series.
    """

    #: Policies; the others are compared with the first.
    policies: Annotated[tuple[PolicyPath, ...], NOT_EMPTY]
    #: What is thrown, by names or groups; cube, l_block and triangle are the paper's.
    objects: tuple[str, ...] = ("cube", "l_block", "triangle")
    throws: Annotated[int, Within(1, 1000)] = 30  #: Throws of each object with each policy.
    seed: Seed = 0  #: Seed of the order, and of the first throw of a rehearsal.
    out: ResultsFolder = Path("trials")  #: Folder of the series: plan, throws and, at the end, the report.
    deploy: str = ""  #: Options of `deploy`: --deploy="--network eth0 --profile my_lab.yaml".
    #: Options of `rehearse`: by --rehearse="--lockstep --plain" the twin throws, and its truth decides.
    rehearse: str = ""

    def run(self) -> None:
        with needs_extra("deployment"):
            from pixel2catch.cli.trial_series import TrialSeries, new_plan
        from pixel2catch.evaluation.grid import differences, held, read_row
        from pixel2catch.evaluation.trials import read_throw, write_trials

        series = TrialSeries(vars(self))
        plan, file = new_plan(vars(self)), self.out / "plan.json"
        before = read_row(file) or plan
        if changes := differences(before["configuration"], plan["configuration"], "in the series"):
            raise StudyError(f"'{self.out}' is another series ({changes}): give its options or a new --out.")
        self.out.mkdir(parents=True, exist_ok=True)
        with held(self.out):
            write_atomically({file: json_text(before)})
            for throw in before["throws"]:
                while "outcome" not in read_throw(self.out, throw):
                    series.take(throw)
        throws = [read_throw(self.out, throw) for throw in before["throws"]]
        print(write_trials(self.out, throws, before), end="")
