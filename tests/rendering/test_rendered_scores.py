import pytest

from pixel2catch.camera.image import Box, Verdict
from pixel2catch.evaluation.box_scores import reacquisition, score_box, summary
from pixel2catch.perception.labels import Truth

BOX = (100.0, 100.0, 120.0, 110.0)
TRUTHS = [
    *[Truth(phase="held", box=BOX)] * 2,
    *[Truth(phase="flight", box=box) for box in (BOX, BOX, None)],
    *[Truth(phase="near the hand", box=BOX)] * 2,
]


def seen(error: float, verdict: Verdict = Verdict.SEEN) -> Box:
    """A box of which the right edge is wrong by so much."""
    xmin, ymin, xmax, ymax = BOX
    return Box(edges=(xmin, ymin, xmax + error, ymax), verdict=verdict, is_valid=True, age=0.0)


SEEN = [*map(seen, (1.0, 3.0, -5.0)), seen(9.0, Verdict.NOT_FOUND), *map(seen, (2.0, 6.0, 4.0))]
SCORES = [
    score_box(truth, box.edges, is_seen=box.verdict is Verdict.SEEN)
    for truth, box in zip(TRUTHS, SEEN, strict=True)
]


def test_a_new_box_of_at_most_five_pixels_error_is_good_in_its_phase():
    assert [each.phase for each in SCORES] == ["held"] * 2 + ["flight"] * 3 + ["near the hand"] * 2
    assert [each.is_good for each in SCORES] == [True, True, True, False, False, False, True]


def test_rates_are_of_the_images_in_which_the_object_is_visible():
    report = summary(SCORES)
    assert report["held"]["error_p50"] == pytest.approx(2.0)
    flight = report["flight"]
    assert (flight["images"], flight["hidden"], flight["seen_though_hidden"]) == (2, 1, 1)
    assert (flight["detected"], flight["within_5px"]) == (0.5, 0.5)
    assert flight["error_p50"] == pytest.approx(5.0)
    assert flight["delivered_error_p50"] == pytest.approx(7.0)
    low, high = flight["within_5px_interval"]  # of 1 in 2, by hand: (1 + z²/2 ± z √(1/2 + z²/4)) / (2 + z²)
    assert (low, high) == (pytest.approx(0.0945, abs=1e-4), pytest.approx(0.9055, abs=1e-4))
    assert (flight["false_boxes"], flight["losses"], flight["reacquisitions"]) == (1, 1, 0)
    assert report["near the hand"]["within_5px"] == 0.5
    assert (report["near the hand"]["losses"], report["near the hand"]["false_boxes"]) == (0, 0)


def test_a_box_is_false_where_nothing_is_visible_or_it_has_none_of_the_object():
    here, nothing = Truth(phase="flight", box=BOX), Truth(phase="flight", box=None)
    beside = (120.0, 100.0, 140.0, 110.0)
    boxes = [(here, BOX, True), (here, beside, True), (here, beside, False), (nothing, BOX, True)]
    rows = [score_box(truth, box, is_seen=is_seen) for truth, box, is_seen in boxes]
    assert [row.is_seen and row.is_apart for row in rows] == [False, True, False, True]
    assert [row.error for row in rows[:2]] == [0.0, 20.0]


def test_the_object_is_lost_and_found_again():
    truth = Truth(phase="flight", box=BOX)
    rows = [score_box(truth, BOX, is_seen=is_seen) for is_seen in (False, True, False, False, True, False)]
    report = summary(rows)["flight"]
    assert (report["losses"], report["reacquisitions"], report["reacquisition_images_p50"]) == (2, 1, 2)


def test_the_wait_after_a_gap_ends_with_the_first_good_box():
    assert reacquisition(SCORES, 2) == 0
    assert reacquisition(SCORES, 3) == 3
    assert reacquisition(SCORES[:6], 3) is None
