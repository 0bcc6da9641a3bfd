"""`pixel2catch doctor`: what works on this machine, and what to install or do where something does not."""

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

STYLES = {"good": "green", "BAD": "bold red", "absent": "dim"}
"""Colour of each state; the word tells without colour, too."""

EXIT_BAD = 1
"""Exit status where something that is needed does not work."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """What a probe found.

    Attributes:
        name: What was looked at.
        state: good, BAD, or absent: optional, and not there.
        found: What there is, or what is wrong and what to do.
        is_needed: Whether `catch` and `evaluate`, or what was asked for by an option, need it.
    """

    name: str
    state: str
    found: str
    is_needed: bool


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Check this machine: versions, policy, physics, rendering, GPU, perception, network.

    The exit status is 0 if `catch` and `evaluate` work, and what an option asks for.

    Attributes:
        checkpoint: Folder of a SAM 2.1 checkpoint to load and time, too.
        camera: Number or device of a camera to watch for three seconds, too.
        json: Print all checks as one JSON object.
    """

    checkpoint: Path | None = None
    camera: str | None = None
    json: bool = False

    def run(self) -> None:
        """Check and print.

        Raises:
            SystemExit: With status 1 if something needed does not work.
        """
        checks = self._checks()
        if self.json:
            print(json.dumps({"checks": [asdict(check) for check in checks]}, indent=2))
        else:
            self._print(checks)
        if any(check.is_needed and check.state == "BAD" for check in checks):
            sys.exit(EXIT_BAD)

    def _checks(self) -> list[Check]:
        """Look at everything."""
        from pixel2catch.cli import doctor_probes as probes

        def optional(module: str, distribution: str, extra: str) -> Callable[[], str]:
            return probes.Optional(module=module, distribution=distribution, extra=extra).probe

        return [
            check("Python", probes.python, is_needed=True),
            check("packages", probes.packages, is_needed=True),
            check("policy, physics", probes.policy_and_physics, is_needed=True),
            check("disk", probes.disk, is_needed=True),
            check("rendering", probes.rendering),
            check("GPU", probes.cuda),
            check("Warp on the GPU", probes.warp),
            check("OpenCV", optional("cv2", "opencv-python-headless", "perception")),
            check("rosbags", optional("rosbags", "rosbags", "identification")),
            check("cyclonedds", optional("cyclonedds", "cyclonedds", "deployment")),
            check("DDS", probes.dds),
            check("viser", optional("viser", "viser", "twin")),
            check("transformers", optional("transformers", "transformers", "sam2")),
            check("torchvision", probes.torchvision),
            check("SAM 2", lambda: probes.sam2(self.checkpoint), is_needed=self.checkpoint is not None),
            check("camera", lambda: probes.camera(self.camera), is_needed=self.camera is not None),
        ]

    def _print(self, checks: list[Check]) -> None:
        """Print a table, and what it means."""
        from pixel2catch.cli.console import results_console

        console = results_console()
        console.print(_table(checks))
        bad = [check.name for check in checks if check.state == "BAD" and check.is_needed]
        console.print(f"To be mended: {', '.join(bad)}." if bad else "`catch` and `evaluate` work here.")


def check(name: str, probe: Callable[[], str], *, is_needed: bool = False) -> Check:
    """Run a probe; whatever it raises becomes the result."""
    from pixel2catch.cli.doctor_probes import Absent, Broken
    from pixel2catch.errors import Pixel2CatchError

    try:
        state, found = "good", probe()
    except Absent as error:
        state, found = "absent", str(error)
    except (Broken, Pixel2CatchError) as error:
        state, found = "BAD", str(error)
    except Exception as error:  # the reason why a doctor is asked may be anything
        state, found = "BAD", f"{type(error).__name__}: {error}: reinstall with make setup"
    return Check(name=name, state=state, found=found, is_needed=is_needed)


def _table(checks: list[Check]) -> "Table":
    """One line a check."""
    from rich.table import Table
    from rich.text import Text

    table = Table()
    for column in ("check", "", "found"):
        table.add_column(column)
    for each in checks:
        style = STYLES[each.state]
        table.add_row(each.name, Text(each.state, style=style), Text(each.found, style=style))
    return table
