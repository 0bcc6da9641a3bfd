"""The checks of recordings as a table for people."""

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from pixel2catch.identification.checks import Check

STYLES = {"good": "green", "BAD": "bold red", "weak": "yellow", "unknown": "dim"}
"""Colour of each verdict; the word tells without colour, too."""


def verdict(check: Check) -> str:
    """The answer in a word: BAD forbids a fit, weak means that it tells less."""
    if check.is_good is None:
        return "unknown"
    return "good" if check.is_good else "BAD" if check.forbids_fit else "weak"


def check_table(name: str, checks: Sequence[Check]) -> Table:
    """One line a check that failed or is of the whole recording, one for all joints that passed one.

    Args:
        name: What the recording is called.
        checks: Its checks.
    """
    num_bad = sum(check.is_good is False for check in checks)
    table = Table(title=Text(f"{name}: {num_bad} of {len(checks)} checks failed"))
    for column in ("check", "joint", "", "found"):
        table.add_column(column)
    for group in _groups(checks):
        first, word = group[0], verdict(group[0])
        joint = first.joint or "" if len(group) == 1 else f"{len(group)} joints"
        detail = first.detail if len({check.detail for check in group}) == 1 else ""
        table.add_row(first.name, joint, Text(word, style=STYLES[word]), Text(detail))
    return table


def _groups(checks: Sequence[Check]) -> list[list[Check]]:
    """The checks in lines: alone if it failed, else with those of the other joints that say the same."""
    groups: dict[tuple[str, str, str | None], list[Check]] = {}
    for check in checks:
        alone = check.joint if check.is_good is False else None
        groups.setdefault((check.name, verdict(check), alone), []).append(check)
    return list(groups.values())
