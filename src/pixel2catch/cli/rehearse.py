"""`pixel2catch rehearse`: throws with the whole deployment against its digital twin."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from pixel2catch.checks import NewFolder, require_used
from pixel2catch.cli.console import prepare, say
from pixel2catch.cli.deploy import summary_lines
from pixel2catch.files import free_folder, held_folder, json_text, write_atomically
from pixel2catch.installation import needs_extra
from pixel2catch.reports import circumstances
from pixel2catch.shipped import PolicyPath
from pixel2catch.twin import RehearsalCfg

if TYPE_CHECKING:
    from pixel2catch.twin.rehearsal import Outcome

REPORT = "report.json"  #: The report's file in the output folder; the output of both processes is beside it.
LOCKSTEP_ONLY = ("perception_ms", "perception_jitter_ms", "clock_error_ms", "plain")


@dataclass(frozen=True, kw_only=True)
class Rehearse:
    """Let `deploy` catch in the twin; report catches and times.

    Both are processes on DDS, on this machine only, in the domain ROS_DOMAIN_ID (default 77). Images are
    rendered; two cores need a slower clock for that, such as --clock 0.5. With --lockstep there is one
    process without network and real time: a seed gives the same throws and times on any machine.
    """

    #: Folder of a policy or of its training run, an ONNX file, or a shipped name. Default: catch_alone+fit.
    policy: Positional[PolicyPath | None] = None
    rehearsal: RehearsalCfg = field(default_factory=RehearsalCfg)  #: What is rehearsed, and in what time.
    #: New or empty folder for report.json and what both processes print.
    out: NewFolder = field(default_factory=partial(free_folder, "rehearsal"))

    def run(self) -> None:
        from pixel2catch.evaluation.loading import load_policy, region_remark
        from pixel2catch.rendering.renderer import find_gl_backend
        from pixel2catch.workcells import find_workcell

        with needs_extra("deployment"):
            from pixel2catch.twin.lab_node import twin_profile
            from pixel2catch.twin.rehearsal import rehearse
        cfg = self.rehearsal
        require_used(cfg, LOCKSTEP_ONLY, cfg.lockstep, "without --lockstep")
        require_used(cfg, ("clock",), not cfg.lockstep, "with --lockstep")
        if not cfg.plain:
            find_gl_backend()

        def show(outcome: "Outcome") -> None:
            say(f"throw {outcome.seed}: {in_words(outcome)}")

        policy, method = load_policy(self.policy)
        task = cfg.task.make(policy, cfg.seed)
        for remark in region_remark(method, task.sensing.camera.camera):
            say(remark)
        with held_folder(self.out):
            if cfg.lockstep:
                from pixel2catch.twin.stepped import rehearse_stepped

                prepare("cpu")
                report = rehearse_stepped(cfg, task, policy, show)
            else:
                say(f"starting twin and deployment; clock {cfg.clock:g}")
                profile = twin_profile(find_workcell(policy.contract.workcell))
                report = rehearse(cfg, self.policy and str(self.policy), profile, self.out, show)
            report |= {"workcell": policy.contract.workcell, "circumstances": circumstances()}
            print("\n".join(_lines(report)), flush=True)
            write_atomically({self.out / REPORT: json_text(report)})
        say(f"wrote {self.out}: {', '.join(sorted(file.name for file in self.out.iterdir()))}")


def in_words(outcome: "Outcome") -> str:
    """Return the outcome of a throw in words."""
    ended = "caught" if outcome.is_success else "reached, not caught" if outcome.is_tracked else "missed"
    words = [f"{outcome.object} {ended}" if outcome.object else "not thrown"]
    words += [f"the robot stopped: {stop}" for stop in outcome.stops]
    return "; ".join([*words, outcome.problem] if outcome.problem else words)


def _lines(report: dict[str, Any]) -> Iterator[str]:
    for name, short in (("tracking_rate", "T.R."), ("success_rate", "S.R.")):
        low, high = report[f"{name}_interval"]
        yield f"{short} {100 * report[name]:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
    if "clock" in report:
        yield f"{report['num_throws']} throws in {report['seconds']:.0f} s at clock {report['clock']:g}"
    else:
        least, jitter = 1e3 * report["perception_time"], 1e3 * report["perception_jitter"]
        times = f"{least:g} to {least + jitter:g} ms, clock error {1e3 * report['clock_error']:g} ms"
        yield f"{report['num_throws']} throws in lockstep, perception {times}"
    yield from (f"stopped without a request: {reason}: {count}" for reason, count in report["stops"].items())
    yield from summary_lines(report["deploy"])
    yield "twin: " + ", ".join(f"{name} {value}" for name, value in report["twin"].items())
