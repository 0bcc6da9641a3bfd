"""What a policy gets of a stream of images, step by step."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np
import pytest
import torch

from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import PerceptionError
from pixel2catch.mdp.observations import ObservationInputs, pixels
from pixel2catch.mdp.snapshot import BoxHistory
from pixel2catch.mdp.tensors import clone
from pixel2catch.methods import find_method
from pixel2catch.perception.color import ColorRange, ColorThreshold
from pixel2catch.perception.extractor import CameraFrame, Extraction, ExtractorCfg, PixelFeatureExtractor
from pixel2catch.perception.plausibility import PlausibilityCfg, Verdict
from pixel2catch.perception.prompt import Prompter
from pixel2catch.perception.robot_mask import RobotMask
from pixel2catch.perception.segmenter import Image, Motion, PointPrompt, Prompt, Segmentation, Segmenter
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

RED = (220, 20, 20)
REDS = ColorRange(hue=(350.0, 10.0))
ANYTHING = PlausibilityCfg(least_area=1, largest_share=1.0, largest_jump=1e4, largest_sides=4)
HOME = np.array([joint.home for joint in UR5E_ALLEGRO.joints])

Box = tuple[int, int, int, int]


def picture(*boxes: Box) -> np.ndarray:
    """Red boxes on black."""
    image = np.zeros((RGB_CAMERA.height, RGB_CAMERA.width, 3), dtype=np.uint8)
    for xmin, ymin, xmax, ymax in boxes:
        image[ymin:ymax, xmin:xmax] = RED
    return image


def painted_box(box: torch.Tensor) -> np.ndarray:
    xmin, ymin, xmax, ymax = box[0].tolist()
    return picture((xmin, ymin, xmax, ymax))


def extractor(cfg: ExtractorCfg | None = None, robot: RobotMask | None = None) -> PixelFeatureExtractor:
    """Follows red, pointed out by its colour."""
    return PixelFeatureExtractor(ColorThreshold(REDS), Prompter(colors=REDS), robot=robot, cfg=cfg)


def play(images: Sequence[np.ndarray | None], subject: PixelFeatureExtractor) -> list[Extraction]:
    """One image in every control step."""
    return [
        subject.step(
            None if image is None else CameraFrame(image=image, stamp=i * CONTROL_DT), i * CONTROL_DT
        )
        for i, image in enumerate(images)
    ]


def moved(box: Box, right: int, down: int) -> Box:
    return box[0] + right, box[1] + down, box[2] + right, box[3] + down


START: Box = (300, 150, 330, 180)


def test_features_are_those_of_training():
    """The boxes of an episode, painted, seen again, and turned into features by the observation term."""
    env = CatchEnv(CatchEnvCfg(), find_method("proposed"), num_envs=1, seed=3)
    stay = {name: torch.zeros(1, size) for name, size in env.action_sizes.items()}
    measurements = [clone(env.step(stay).measurement) for _ in range(30)]
    boxes = [measurement.box.round().int() for measurement in measurements]
    env.close()
    assert len({tuple(box[0].tolist()) for box in boxes}) > 20
    seen = play([painted_box(box) for box in boxes], extractor(ExtractorCfg(plausibility=ANYTHING)))
    for now, box in zip(seen, boxes, strict=True):
        assert now.verdict is Verdict.SEEN
        assert torch.equal(now.box, box.to(now.box))
    for before, now, measurement in zip(seen, seen[1:], measurements, strict=False):
        frames = [
            replace(measurement, boxes=BoxHistory.begun(each.box, torch.zeros(1), 1))
            for each in (before, now)
        ]
        frame = ObservationInputs(
            before=frames[0], now=frames[1], joints=(), palms=(), pixel_columns=tuple(range(8))
        )
        assert torch.equal(now.features, pixels(frame))


def test_the_first_box_stands_for_its_predecessor():
    first, second = play([picture(START), picture(moved(START, 4, -6))], extractor())
    assert first.features[0].tolist() == pytest.approx([315 / 640, 165 / 480, 30 / 640, 30 / 480, 0, 0, 0, 0])
    assert second.features[0, 4:].tolist() == [4.0, -6.0, 0.0, 0.0]


def test_without_a_detection_the_box_is_held_and_nothing_changes():
    seen = play([picture(START), picture(), picture()], extractor())
    for step in (1, 2):
        assert seen[step].verdict is Verdict.NOT_FOUND
        assert torch.equal(seen[step].box, seen[0].box)
        assert not seen[step].features[0, 4:].any()
    assert [round(each.age / CONTROL_DT) for each in seen] == [0, 1, 2]
    assert all(each.is_valid and each.is_fresh for each in seen)


def test_an_old_box_is_not_fresh():
    seen = play([picture(START), *[picture()] * 3], extractor())
    assert [each.is_fresh for each in seen] == [True, True, True, False]


def test_before_the_first_detection_nothing_is_valid():
    for each in play([None, picture(), picture()], extractor()):
        assert not each.is_valid
        assert not each.is_fresh
        assert each.age == inf
        assert not each.box.any()


def test_no_image_and_the_same_image_again_hold_the_box():
    subject, frame = extractor(), CameraFrame(image=picture(START), stamp=5.0)
    verdicts = [subject.step(each, 5.0 + i * CONTROL_DT) for i, each in enumerate((None, frame, frame, None))]
    assert [each.verdict for each in verdicts] == ["no image", "seen", "repeated image", "no image"]
    older = subject.step(CameraFrame(image=picture(moved(START, 9, 9)), stamp=4.9), 5.2)
    assert older.verdict is Verdict.REPEATED
    assert torch.equal(older.box, verdicts[1].box)


def test_a_skipped_image_is_marked_because_it_doubles_the_differences():
    subject = extractor()
    for stamp, right, num_skipped in ((0, 0, 0), (1, 5, 0), (3, 15, 1), (4, 20, 0), (8, 40, 3)):
        time = stamp * CONTROL_DT + 0.1 * CONTROL_DT * (stamp % 2)  # a camera is never quite on time
        frame = CameraFrame(image=picture(moved(START, right, 0)), stamp=time)
        assert subject.step(frame, time).num_skipped == num_skipped


class EverythingRed(Segmenter):
    """Returns all that is red, in one piece or several."""

    def start(self, image: Image, prompt: Prompt, motion: Motion | None = None) -> Segmentation:
        return self.track(image, motion)

    def track(self, image: Image, motion: Motion | None = None) -> Segmentation:
        return Segmentation(mask=REDS.mask(image), score=1.0)

    def reset(self) -> None:
        pass


def everything_red() -> PixelFeatureExtractor:
    return PixelFeatureExtractor(EverythingRed(), Prompter(PointPrompt(center=(315.0, 165.0))))


def test_of_two_regions_the_box_is_that_of_the_largest():
    (seen,) = play([picture((10, 10, 20, 20), START)], everything_red())
    assert seen.box[0].tolist() == list(START)
    assert seen.mask is not None
    assert seen.mask.sum() == 30 * 30 - 4  # a range of colours leaves single corners out


@pytest.mark.parametrize(
    ("box", "verdict"),
    [
        ((0, 0, 640, 480), Verdict.TOO_LARGE),
        ((300, 150, 304, 151), Verdict.TOO_SMALL),
        (moved(START, 0, 100), Verdict.JUMP),
        ((620, 150, 640, 480), Verdict.TOO_LARGE),
        ((0, 0, 20, 20), Verdict.BORDER),
    ],
)
def test_an_implausible_mask_holds_the_box(box: Box, verdict: Verdict):
    before, now = play([picture(START), picture(box)], everything_red())
    assert now.verdict is verdict
    assert torch.equal(now.box, before.box)
    assert not now.features[0, 4:].any()
    assert now.mask is None


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((240, 320, 3), dtype=np.uint8),
        np.zeros((480, 640), dtype=np.uint8),
        np.zeros((480, 640, 4), dtype=np.uint8),
        np.zeros((480, 640, 3), dtype=np.float32),
        np.zeros((0, 0, 3), dtype=np.uint8),
    ],
)
def test_a_wrong_image_is_refused_at_the_start_and_passed_over_later(image: np.ndarray):
    with pytest.raises(PerceptionError, match=r"must be \(480, 640, 3\) and uint8"):
        play([image], extractor())
    before, wrong, after = play([picture(START), image, picture(moved(START, 3, 0))], extractor())
    assert wrong.verdict is Verdict.BAD_IMAGE
    assert "rgb8" in wrong.message
    assert torch.equal(wrong.box, before.box)
    assert after.verdict is Verdict.SEEN


def test_joint_states_that_are_no_numbers_do_not_stop_the_loop():
    subject = extractor(robot=RobotMask(UR5E_ALLEGRO))
    frames = [
        CameraFrame(image=picture(START), stamp=stamp, joint_pos=joints)
        for stamp, joints in ((0.0, HOME), (0.1, HOME * np.nan), (0.2, HOME))
    ]
    seen = [subject.step(frame, frame.stamp) for frame in frames]
    assert [each.verdict for each in seen] == [Verdict.SEEN, Verdict.FAILED, Verdict.SEEN]
    assert "must be finite" in seen[1].message


def test_a_lost_object_is_pointed_out_again():
    far = moved(START, 250, 200)
    images = [picture(START), *[picture(far)] * 6]
    seen = play(images, extractor(ExtractorCfg(patience=3, plausibility=PlausibilityCfg(largest_jump=10.0))))
    verdicts = [each.verdict for each in seen]
    assert verdicts == [Verdict.SEEN, *[Verdict.NOT_FOUND] * 3, *[Verdict.SEEN] * 3]
    assert seen[-1].box[0].tolist() == list(far)


def test_what_vanished_at_the_robot_is_in_the_hand_and_nothing_else_is_looked_for():
    robot = RobotMask(UR5E_ALLEGRO)
    rows, columns = np.nonzero(robot.at(HOME))
    u, v = int(np.median(columns)), int(np.median(rows))
    subject, far = extractor(ExtractorCfg(patience=2), robot), (600, 10, 630, 40)
    images = [picture((u - 9, v - 9, u + 9, v + 9)), *[picture(far)] * 8]
    frames = [CameraFrame(image=image, stamp=i / 30, joint_pos=HOME) for i, image in enumerate(images)]
    verdicts = [subject.step(frame, frame.stamp).verdict for frame in frames]
    assert verdicts == [Verdict.SEEN, *[Verdict.NOT_FOUND] * 8]


def test_a_new_throw_begins_without_the_old_box_and_its_stamps():
    subject = extractor()
    play([picture(START)] * 3, subject)
    subject.reset()
    first, second = play([picture(), picture(moved(START, 200, 200))], subject)
    assert not first.is_valid
    assert first.verdict is Verdict.NO_PROMPT
    assert second.verdict is Verdict.SEEN
    assert not second.features[0, 4:].any()


def test_every_stage_is_measured():
    subject = extractor(robot=RobotMask(UR5E_ALLEGRO))
    for i in range(3):
        subject.step(CameraFrame(image=picture(START), stamp=i / 30, joint_pos=HOME), i / 30)
    report = subject.clock.percentiles()
    assert set(report) == {"robot", "segment", "box", "total"}
    assert {each.count for each in report.values()} == {3}
    assert report["total"].p50 > report["segment"].p50
