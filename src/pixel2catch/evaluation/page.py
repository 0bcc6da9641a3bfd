"""An evaluation as one HTML page: rates, objects, landing points, and stills of each outcome."""

import io
from collections.abc import Mapping
from dataclasses import asdict

from numpy import ndarray
from PIL import Image

from pixel2catch.evaluation.figures import landing_figure, objects_figure
from pixel2catch.evaluation.metrics import Metrics
from pixel2catch.evaluation.protocol import EvaluationCfg
from pixel2catch.evaluation.recorded_throws import OUTCOMES, ThrowCollection
from pixel2catch.evaluation.report import Row, percent, png
from pixel2catch.evaluation.result_tables import objects_rows, quality_rows, results_rows
from pixel2catch.files import json_text
from pixel2catch.reports import box, circumstances, folded, page, picture, plain_table, section, what_was_run
from pixel2catch.scene.objects import OBJECT_GROUPS

RATES_NOTE = (
    "T.R.: a palm is once within 8 cm of the object's middle, or 3.5 cm of a larger object's surface. S.R.: "
    "it is for 20 control steps in a row. Verified hold: then the policy stops, two parts of the hand touch "
    "the object for 1 s, and the hold survives half a second of shaking. In brackets: 95 % Wilson intervals."
)
LANDING_NOTE = (
    "Where each throw would pass through the middle of the catch heights without a robot. Seen from above, "
    "the robot at 0 and the thrower at the top. Box: where the paper's throws are aimed."
)
NO_STRIPS = "Nothing can be drawn on this machine; 'pixel2catch doctor' says what to install."
STRIPS_NOTE = "The first throw of each outcome: the flight, the catch in the middle, the end."


def evaluation_page(
    name: str,
    result: Metrics,
    cfg: EvaluationCfg,
    throws: ThrowCollection,
    strips: Mapping[str, ndarray],
) -> str:
    """Return the page of one evaluation.

    Args:
        name: The thrown objects.
        result: The metrics.
        cfg: The configuration.
        throws: The throws.
        strips: Stills of the example of each outcome, in the order of the page; empty without graphics.
    """
    low_to_high = percent(result["success_rate"], result["success_rate_interval"], digits=1)
    caught = f"Of {result['trials']:,} throws, {low_to_high} % were caught (S.R., 95 % interval)."
    rows = {name: result}
    stills = [picture(_webp(image), "webp", _caption(outcome, throws)) for outcome, image in strips.items()]
    objects = picture(png(objects_figure(_object_rows(result))), "png", "S.R. with 95 % intervals")
    landings = picture(png(landing_figure(throws)), "png", "Throws by outcome")
    return page(
        f"Evaluation of {result['method']}: {name}",
        [
            box(caught, "good"),
            section("Rates [% of throws]", RATES_NOTE, plain_table(results_rows(rows, result["method"]))),
            section("By object", "", objects, plain_table(objects_rows(result))),
            section("Where throws come down", LANDING_NOTE, landings),
            section("Failures and contact", "", plain_table(quality_rows(rows))),
            section("Stills", STRIPS_NOTE if strips else NO_STRIPS, *stills),
            what_was_run(circumstances(), f"policy {result.get('policy_sha256', 'unknown')}"),
            folded("Configuration", json_text(asdict(cfg))),
        ],
    )


def _object_rows(result: Metrics) -> list[Row]:
    groups = {name: group for group in ("seen", "unseen") for name in OBJECT_GROUPS[group]}
    rows = [
        {"method": result["method"], "objects": groups.get(name, "other"), "object": name, **rates}
        for name, rates in result["objects"].items()
    ]
    return sorted(rows, key=lambda row: row["objects"])


def _caption(outcome: str, throws: ThrowCollection) -> str:
    number = len(throws.landings[outcome])
    return f"{OUTCOMES[outcome]}: {number:,} throw{'' if number == 1 else 's'}"


def _webp(image: ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "webp", quality=75)
    return buffer.getvalue()
