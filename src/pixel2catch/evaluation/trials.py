"""A series of real throws: its order, the rows of its throws, and its report in the paper's form.

A row has a throw's `number`, `block`, `object` and `policy`. Once it has ended, it has what was measured, the
outcome that this `proposed`, and its `outcome`: caught (held), reached (touched, not held), or dropped.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from pixel2catch.evaluation.grid import Json, read_row
from pixel2catch.evaluation.metrics import paired_difference, rate
from pixel2catch.evaluation.report import Row, difference_cells, percent, table, write_report
from pixel2catch.files import json_text, write_atomically
from pixel2catch.reports import Section, as_markdown, circumstances

REPEAT = "repeat"  #: Outcome of a throw that does not count.
EVENTS = {"T.R.": ("caught", "reached"), "S.R.": ("caught",)}  #: Outcomes that each rate counts.
RATES = "T.R.: throws [%] that were caught or reached; S.R.: caught; with Wilson's 95 % interval."
PAIRS = "Differences from the first policy over throws of one object in one block, and p of McNemar's test."


def draw_plan(objects: Sequence[str], policies: Sequence[str], blocks: int, seed: int) -> Iterator[Row]:
    """Yield the throws of a series in random order.

    A block has its objects in random order, each with all policies in a row. For each object each policy is
    first, second, and so on equally often, or once more where the number of blocks is no multiple.
    """
    rng, number = np.random.default_rng(seed), 0
    turns = {name: rng.permutation(blocks) % len(policies) for name in objects}
    for block in range(blocks):
        for name in rng.permutation(objects).tolist():
            for policy in np.roll(policies, turns[name][block]).tolist():
                number += 1
                yield {"number": number, "block": block + 1, "object": name, "policy": policy}


def folder_of(out: Path, throw: Row) -> Path:
    """Return the folder of a throw, with its `row.json`, `strip.png` and `recording/`."""
    return out / "throws" / f"{throw['number']:04d}"


def read_throw(out: Path, throw: Row) -> Row:
    """Return the row of a throw of the plan; raise StudyError if it is damaged."""
    return {**throw, **(read_row(folder_of(out, throw) / "row.json") or {})}


def write_throw(out: Path, throw: Row) -> None:
    """Write the row of a throw; set one that is repeated aside, with its recording."""
    folder = folder_of(out, throw)
    write_atomically({folder / "row.json": json_text(throw)})
    if throw["outcome"] == REPEAT:
        number = len([*folder.parent.glob(f"{folder.name}-*")]) + 1
        folder.rename(folder.with_name(f"{folder.name}-repeated-{number}"))


def rate_rows(throws: Sequence[Row]) -> Iterator[Row]:
    """Yield the rates of each policy for each object, and all, with Wilson intervals."""
    policies, objects = (dict.fromkeys(each[name] for each in throws) for name in ("policy", "object"))
    for event, policy, name in product(EVENTS, sorted(policies), (*sorted(objects), "all")):
        own = [each for each in throws if each["policy"] == policy and name in (each["object"], "all")]
        if own:
            count = sum(each["outcome"] in EVENTS[event] for each in own)
            names = {"policy": policy, "event": event, "rate": f"{event} {policy}", "object": name}
            yield names | rate("share", count, len(own))


def paired_rows(throws: Sequence[Row], home: str) -> Iterator[Row]:
    """Yield the differences of the other policies from one."""
    found = {(each["policy"], each["object"], each["block"]): each["outcome"] for each in throws}
    for policy, event in product(sorted({name for name, *_ in found} - {home}), EVENTS):
        keys = [key for name, *key in found if name == policy and (home, *key) in found]
        sides = ["".join("01"[found[name, *key] in EVENTS[event]] for key in keys) for name in (home, policy)]
        if keys:
            yield {"policy": policy, "event": event, "pairs": len(keys), **paired_difference(*sides)}


def write_trials(out: Path, throws: Sequence[Row], plan: Json) -> str:
    """Write the report of finished throws, at least one; return its tables in Markdown."""
    rates, pairs = [*rate_rows(throws)], [*paired_rows(throws, next(iter(plan["configuration"]["policies"])))]
    counts = Counter((each["proposed"], each["outcome"]) for each in throws)
    right = sum(count for (proposed, outcome), count in counts.items() if proposed == outcome)
    share = percent(rate("share", right, len(throws)), "share")
    num_repeated = len([*out.glob("throws/*-repeated-*")])
    cells = [{"proposed": one, "outcome": two, "count": n} for (one, two), n in sorted(counts.items())]
    pair_lines = [
        {**{name: f"{row[name]}" for name in ("policy", "event", "pairs")}, **difference_cells(row)}
        for row in pairs
    ]
    tables = [
        Section(
            title="Rates", text=RATES, rows=table(rates, "rate", "object", lambda row: percent(row, "share"))
        ),
        Section(title="Pairs", text=PAIRS, rows=pair_lines),
        Section(
            title="Proposals",
            text=f"{share} % of {len(throws)} outcomes were proposed (down); {num_repeated} throws repeated.",
            rows=table(cells, "proposed", "outcome", lambda row: f"{row['count']}"),
        ),
    ]
    pages = [
        Section(
            title=f"Throw {each['number']}: {each['object']}, {each['policy']}, {each['outcome']}",
            text=f"![{each['outcome']}]({folder_of(Path(), each)}/strip.png)",
        )
        for each in throws
    ]
    data = {"results": rates, "pairs": pairs, "throws": throws, "plan": plan["configuration"]}
    write_report(out, "Trials", tables + pages, data | {"circumstances": circumstances()})
    return as_markdown("Trials", tables)
