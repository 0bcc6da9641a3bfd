"""The checks of recordings as a table for people: green passed, red failed, yellow cannot be told."""

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from pixel2catch.identification.checks import Check

VERDICTS = {True: ("good", "green"), False: ("BAD", "bold red"), None: ("unknown", "yellow")}
"""Word and colour of each answer; the word tells without colour, too."""


def check_table(name: str, checks: Sequence[Check]) -> Table:
    """One line a check, those of the whole recording first.

    Args:
        name: What the recording is called.
        checks: Its checks.
    """
    num_bad = sum(check.is_good is False for check in checks)
    table = Table(title=Text(f"{name}: {num_bad} of {len(checks)} checks failed"))
    for column in ("check", "joint", "", "found"):
        table.add_column(column)
    for check in checks:
        word, style = VERDICTS[check.is_good]
        table.add_row(check.name, check.joint or "", Text(word, style=style), Text(check.detail))
    return table
