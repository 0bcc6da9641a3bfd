"""An evaluation as one page: rates, objects, where throws come down, what each kind of miss looks like."""

import io
from collections.abc import Mapping
from dataclasses import asdict

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy import ndarray
from PIL import Image

from pixel2catch.circumstances import circumstances
from pixel2catch.evaluation.comparison.figures import STYLE, objects_figure
from pixel2catch.evaluation.metrics import Metrics
from pixel2catch.evaluation.protocol import EvaluationCfg
from pixel2catch.evaluation.recorded_throws import CAUGHT, OUTCOMES, ThrowCollection
from pixel2catch.evaluation.report import objects_rows, percent, png, quality_rows, results_rows
from pixel2catch.files import json_text
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.offline_page import box, folded, page, picture, plain_table, section, what_was_run
from pixel2catch.scene.objects import OBJECT_GROUPS

COLORS = dict(zip(OUTCOMES, ("#0072B2", "#56B4E9", "#D55E00", "#E69F00", "#CC79A7", "#3C3C3C"), strict=True))
"""Colours of outcomes that people with any kind of colour vision tell apart. Source: Okabe and Ito 2008."""

RATES_NOTE = (
    "T.R.: a palm within 8 cm of the object's middle, or 3.5 cm of a larger one's surface, once; S.R.: for "
    "20 control steps in a row. Verified hold: then the policy stops, two parts of the hand touch the object "
    "for 1 s, and it survives half a second of shaking. In brackets: 95 % Wilson intervals."
)
LANDING_NOTE = (
    "Where each throw would come down through the middle of the catch heights if nothing stopped it. "
    "Seen from above, the robot at 0 and the thrower at the top. Box: where the paper's throws are aimed."
)
NO_STRIPS = "Nothing can be drawn on this machine; 'pixel2catch doctor' says what to install."
STRIPS_NOTE = "The first throw of each kind: the flight, the catch in the middle, the end."


def evaluation_page(
    name: str,
    result: Metrics,
    cfg: EvaluationCfg,
    throws: ThrowCollection,
    strips: Mapping[str, ndarray],
) -> str:
    """The page of one evaluation.

    Args:
        name: What was thrown.
        result: Its metrics.
        cfg: How it was done.
        throws: Its throws.
        strips: Stills of the example of each outcome, in the order of the page; empty without graphics.
    """
    low_to_high = percent(result["success_rate"], result["success_rate_interval"], digits=1)
    caught = f"Of {result['trials']:,} throws, {low_to_high} % were caught (S.R., 95 % interval)."
    settings = json_text(asdict(cfg))
    rows = {name: result}
    shown = (picture(_webp(image), "webp", _kind(outcome, throws)) for outcome, image in strips.items())
    return page(
        f"Evaluation of {result['method']}: {name}",
        [
            box(caught, "good"),
            section("Rates [% of throws]", RATES_NOTE, plain_table(results_rows(rows, result["method"]))),
            section(
                "By object",
                "",
                picture(png(_objects_figure(result)), "png", "S.R. with 95 % intervals"),
                plain_table(objects_rows(result)),
            ),
            section(
                "Where throws come down",
                LANDING_NOTE,
                picture(png(landing_figure(throws)), "png", "Throws by outcome"),
            ),
            section("Failures and contact", "", plain_table(quality_rows(rows))),
            section("What they look like", STRIPS_NOTE if strips else NO_STRIPS, *shown),
            what_was_run(circumstances(), f"policy {result.get('policy_sha256', 'unknown')}"),
            folded("Configuration", settings),
        ],
    )


def landing_figure(throws: ThrowCollection) -> Figure:
    """Draw where throws come down, misses over catches."""
    paper = ThrowCfg()
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 4.6), layout="constrained")
        axes = figure.subplots()
        corner = (paper.aim_y[0], paper.aim_x[0])
        size = (paper.aim_y[1] - paper.aim_y[0], paper.aim_x[1] - paper.aim_x[0])
        axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor="#8A8A8A", linestyle="--"))
        for outcome, text in OUTCOMES.items():
            if points := throws.landings.get(outcome):
                is_caught = outcome == CAUGHT
                axes.scatter(
                    *np.array(points).T[::-1],
                    s=14 if is_caught else 42,
                    marker="o" if is_caught else "X",
                    color=COLORS[outcome],
                    alpha=0.45 if is_caught else 1.0,
                    zorder=2 if is_caught else 3,
                    linewidth=0.0,
                    label=f"{text} ({len(points):,})",
                )
        axes.set(xlabel="y [m]", ylabel="x [m], from the robot to the thrower", aspect="equal")
        axes.invert_xaxis()
        axes.grid(visible=True)
        figure.legend(loc="outside lower center", ncols=2)
        return figure


def _objects_figure(result: Metrics) -> Figure:
    groups = {name: group for group in ("seen", "unseen") for name in OBJECT_GROUPS[group]}
    rows = [
        {
            "method": result["method"],
            "objects": groups.get(name, "other"),
            "object": name,
            "success_rate": {"pooled": each["success_rate"], "interval": each["success_rate_interval"]},
        }
        for name, each in result["objects"].items()
    ]
    return objects_figure(sorted(rows, key=lambda row: row["objects"]))


def _kind(outcome: str, throws: ThrowCollection) -> str:
    number = len(throws.landings[outcome])
    return f"{OUTCOMES[outcome]}: {number:,} throw{'' if number == 1 else 's'}"


def _webp(image: ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "webp", quality=75)
    return buffer.getvalue()
