"""The boxes that a policy gets of a stream of images, and which thing the prompter points out."""

from collections import Counter
from collections.abc import Sequence
from itertools import islice
from math import inf

import filmed
import numpy as np
import pytest
from filmed import NUM_EMPTY, RED, Disc

from pixel2catch.camera.image import Box, Edges, Image, Pixels, Verdict
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.foreground import LEARNING_IMAGES, Foreground
from pixel2catch.perception.regions import Blob, RobotMask
from pixel2catch.perception.segmenter import BoxPrompt, ColorRange, ColorThreshold, ImageMotion, Segmentation
from pixel2catch.perception.tracker import MOST_CANDIDATES, PATIENCE, ObjectTracker, Prompter
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

REDS = ColorRange(hue=(340.0, 20.0))
HOME = np.array([joint.home for joint in UR5E_ALLEGRO.joints])
START: Edges = (300.0, 150.0, 330.0, 180.0)


def picture(*boxes: Edges) -> np.ndarray:
    image = np.zeros((RGB_CAMERA.height, RGB_CAMERA.width, 3), dtype=np.uint8)
    for box in boxes:
        xmin, ymin, xmax, ymax = map(int, box)
        image[ymin:ymax, xmin:xmax] = RED
    return image


def color_tracker(robot: RobotMask | None = None) -> ObjectTracker:
    return ObjectTracker(ColorThreshold(REDS), Prompter(colors=REDS), robot=robot)


def play(images: Sequence[np.ndarray | None], subject: ObjectTracker) -> list[Box]:
    return [
        subject.step(None if image is None else Image(pixels=image, stamp=i * CONTROL_DT), i * CONTROL_DT)
        for i, image in enumerate(images)
    ]


def moved(box: Edges, right: float, down: float) -> Edges:
    return box[0] + right, box[1] + down, box[2] + right, box[3] + down


def test_without_a_detection_the_box_is_held():
    seen = play([None, picture(), picture(START), picture(), picture()], color_tracker())
    verdicts = ["no image", "no prompt", "seen", "not found", "not found"]
    assert [each.verdict for each in seen] == verdicts
    assert [each.is_valid for each in seen] == [False, False, True, True, True]
    assert [each.edges for each in seen[2:]] == [START] * 3
    assert [round(each.age / CONTROL_DT) for each in seen[2:]] == [0, 1, 2]
    assert (seen[0].stamp, seen[1].age, seen[4].stamp) == (-inf, inf, pytest.approx(4 * CONTROL_DT))


def test_repeated_and_older_images_hold_the_box():
    subject, image = color_tracker(), Image(pixels=picture(START), stamp=5.0)
    boxes = [subject.step(each, 5.0 + i * CONTROL_DT) for i, each in enumerate((None, image, image, None))]
    assert [each.verdict for each in boxes] == ["no image", "seen", "repeated image", "no image"]
    older = subject.step(Image(pixels=picture(moved(START, 9, 9)), stamp=4.9), 5.2)
    assert (older.verdict, older.edges) == (Verdict.REPEATED, START)


class EverythingRed(ColorThreshold):
    def find(self, image: Pixels, *_: object, **__: object) -> Segmentation:
        return Segmentation(mask=REDS.mask(image), score=1.0)


def everything_red() -> ObjectTracker:
    return ObjectTracker(EverythingRed(REDS), Prompter(BoxPrompt(box=START)))


@pytest.mark.parametrize(
    ("box", "verdict"),
    [
        ((0, 0, 640, 480), Verdict.TOO_LARGE),
        ((300, 150, 400, 212), Verdict.TOO_LARGE),  # 6,200 px of 6,144 allowed
        ((300, 150, 304, 151), Verdict.TOO_SMALL),
        (moved(START, 0, 125), Verdict.JUMP),
        ((0, 0, 20, 20), Verdict.BORDER),  # a corner of the image
    ],
)
def test_an_implausible_mask_holds_the_box(box: Edges, verdict: Verdict):
    """But an object may leave the image at one side."""
    before, now = play([picture(START), picture(box)], everything_red())
    assert now.verdict is verdict
    assert (now.edges, now.mask) == (before.edges, None)
    (leaving,) = play([picture((10, 10, 20, 20), (330, 0, 360, 60))], everything_red())
    assert (leaving.verdict, leaving.edges) == (Verdict.SEEN, (330, 0, 360, 60))  # the larger of the two


def test_a_wrong_image_is_refused_at_the_start_and_skipped_later():
    image = np.zeros((240, 320, 3), dtype=np.uint8)
    with pytest.raises(PerceptionError, match=r"must be \(480, 640, 3\) and uint8"):
        play([image], color_tracker())
    _, wrong, after = play([picture(START), image, picture(moved(START, 3, 0))], color_tracker())
    assert (wrong.verdict, wrong.edges, after.verdict) == (Verdict.BAD_IMAGE, START, Verdict.SEEN)
    assert "rgb8" in wrong.message


def test_joint_positions_that_are_not_finite_skip_the_image():
    subject = color_tracker(RobotMask(UR5E_ALLEGRO))
    joints = HOME, HOME * np.nan, HOME
    images = [Image(pixels=picture(START), stamp=0.1 * i, joint_pos=each) for i, each in enumerate(joints)]
    seen = [subject.step(image, image.stamp) for image in images]
    assert [each.verdict for each in seen] == [Verdict.SEEN, Verdict.FAILED, Verdict.SEEN]
    assert "must be finite" in seen[1].message
    assert set(subject.durations) == {"robot", "segment", "box", "total"}
    assert subject.durations["total"] > subject.durations["segment"] > 0.0


def test_a_lost_object_is_pointed_out_again():
    far = moved(START, 280, 280)  # 396 px
    seen = play([picture(START), *[picture(far)] * (PATIENCE + 3)], color_tracker())
    verdicts = [each.verdict for each in seen]
    assert verdicts == [Verdict.SEEN, *[Verdict.NOT_FOUND] * PATIENCE, *[Verdict.SEEN] * 3]
    assert seen[-1].edges == far


def test_no_other_object_is_searched_after_one_vanished_at_the_robot():
    robot = RobotMask(UR5E_ALLEGRO)
    rows, columns = np.nonzero(robot.at(HOME))
    u, v = int(np.median(columns)), int(np.median(rows))
    subject, far = color_tracker(robot), (600, 10, 630, 40)
    pictures = [picture((u - 9, v - 9, u + 9, v + 9)), *[picture(far)] * (PATIENCE + 3)]
    images = [Image(pixels=each, stamp=i / 30, joint_pos=HOME) for i, each in enumerate(pictures)]
    verdicts = [subject.step(image, image.stamp).verdict for image in images]
    assert verdicts == [Verdict.SEEN, *[Verdict.NOT_FOUND] * (PATIENCE + 3)]


def test_a_new_throw_starts_without_the_old_box_and_its_stamps():
    subject = color_tracker()
    play([picture(START)] * 3, subject)
    subject.reset()
    first, second = play([picture(), picture(moved(START, 200, 200))], subject)
    assert (first.is_valid, first.verdict) == (False, Verdict.NO_PROMPT)
    assert (second.verdict, second.is_elsewhere) == (Verdict.SEEN, False)


BALL = Disc(path=filmed.thrown(0, 20), radius=9.0)


def first_prompt(
    prompter: Prompter, discs: tuple[Disc, ...], ignored: Disc | None = None, first: int = 0
) -> tuple[int, BoxPrompt] | None:
    """Step and prompt of the first prompt in a stream from a first step on."""
    foreground, num_steps = Foreground(), len(discs[0].path)
    for step, image in islice(enumerate(filmed.images(discs, num_steps)), first, None):
        motion = foreground.step(image, None if ignored is None else ignored.mask(step))
        prompt = prompter.look(image, motion)
        if prompt is not None:
            return step, prompt
    return None


def test_a_persons_prompt_is_used_once_and_comes_before_the_colour():
    click, later = BoxPrompt(box=(3.0, 4.0, 9.0, 9.0)), BoxPrompt(box=(5.0, 6.0, 9.0, 9.0))
    prompter, red = Prompter(click, colors=REDS), picture((30, 10, 50, 20))
    box = BoxPrompt(box=(30.0, 10.0, 50.0, 20.0))
    assert [prompter.look(red), prompter.look(red), prompter.look(picture())] == [click, box, None]
    prompter.give(later)
    assert [prompter.look(picture()), prompter.look(picture())] == [later, None]
    prompter.give(later)
    prompter.reset()  # a new throw: only the place that is known for all throws counts
    assert prompter.look(picture()) == click


def test_the_largest_thing_of_a_colour_in_the_region_of_interest_is_pointed_out():
    image = picture((30, 10, 50, 20), (200, 100, 205, 105))
    assert Prompter(colors=REDS).look(image) == BoxPrompt(box=(30.0, 10.0, 50.0, 20.0))
    region = (190.0, 90.0, 220.0, 120.0)
    assert Prompter(colors=REDS, region=region).look(image) == BoxPrompt(box=(200.0, 100.0, 205.0, 105.0))
    assert Prompter(colors=REDS, region=(0.0, 150.0, 300.0, 240.0)).look(image) is None
    assert Prompter(colors=REDS).look(np.full_like(image, RED)) is None  # a wall


def test_a_flight_is_found_once_chance_does_not_explain_it():
    """After a second of background; the robot's own motion is not."""
    late = NUM_EMPTY + 10 - LEARNING_IMAGES
    for first, expected in ((0, NUM_EMPTY + 3), (late, late + LEARNING_IMAGES - 1)):
        step, prompt = first_prompt(Prompter(), (BALL,), first=first) or (0, BoxPrompt(box=START))
        assert step == expected
        assert np.abs(np.array(prompt.box) - filmed.box_of(BALL.mask(step))).max() <= 2
    assert first_prompt(Prompter(), (BALL,), ignored=BALL) is None


@pytest.mark.parametrize("is_told", [False, True])
def test_what_stands_still_is_dropped_unless_it_was_pointed_out(is_told: bool):
    path, verdicts = np.concatenate((BALL.path[:-8], np.tile(BALL.path[-8], (14, 1)))), list[Verdict]()
    prompter, ball = Prompter(), Disc(path=path, radius=9.0)
    subject = ObjectTracker(BackgroundSubtraction(), prompter, camera=filmed.CAMERA)
    for step, image in enumerate(filmed.images((ball,), len(path))):
        if is_told and step == NUM_EMPTY + 2:
            prompter.give(BoxPrompt(box=tuple(filmed.box_of(ball.mask(step)).tolist())))
        seen = subject.step(Image(pixels=image, stamp=step * CONTROL_DT), step * CONTROL_DT)
        verdicts.append(seen.verdict)
    assert set(verdicts[NUM_EMPTY + 4 : -5]) == {Verdict.SEEN}
    assert set(verdicts[-3:]) == {Verdict.SEEN if is_told else Verdict.NO_PROMPT}


@pytest.mark.parametrize(
    ("amplitude", "radius"),
    [(60.0, 55.0), (5.0, 9.0), (30.0, 10.0)],
    ids=["an arm", "something slow", "something that turns back"],
)
def test_other_motion_is_no_flight(amplitude: float, radius: float):
    path = (160.0, 120.0) + amplitude * np.sin(np.arange(NUM_EMPTY + 20)[:, None] * (0.9, 1.1))
    path[:NUM_EMPTY] = -100.0
    assert first_prompt(Prompter(), (Disc(path=path, radius=radius),)) is None


def specks(number: int, generator: np.random.Generator) -> ImageMotion:
    image = picture()
    unknown = np.zeros(image.shape[:2], dtype=bool)
    moving = unknown.copy()
    for place in zip(*(generator.integers(0, size - 3, number) for size in moving.shape), strict=True):
        moving[tuple(slice(start, start + 3) for start in place)] = True
    difference = image[..., 0]
    return ImageMotion(image=image, background=image, difference=difference, moving=moving, unknown=unknown)


@pytest.mark.parametrize("number", [3, 20, 400])
def test_specks_are_no_flight_and_cost_little(number: int, monkeypatch: pytest.MonkeyPatch):
    calls = Counter[str]()
    distance = Blob.distance
    monkeypatch.setattr(Blob, "distance", lambda *of: (calls.update(["distance"]), distance(*of))[1])
    generator, prompter = np.random.default_rng(number), Prompter()
    for _ in range(60):
        motion = specks(number, generator)
        assert prompter.look(motion.image, motion) is None
    assert calls["distance"] <= 60 * 3 * MOST_CANDIDATES**2
