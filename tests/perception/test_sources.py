"""Images of videos and bags in every encoding that is read, on the control clock; and what is no source."""

from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from filmed import compressed, jpeg, raw, save_video, stamp_of, throw
from rosbags.rosbag2 import StoragePlugin

from pixel2catch.camera.image import Image
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.sources import (
    LONGEST_PAUSE,
    camera_images,
    images_of,
    on_control_clock,
    video_images,
)
from pixel2catch.rendering.video import write_video
from pixel2catch.scene.constants import CONTROL_DT
from ros_bags import Message, joint_state, save_bag

PICTURE = next(throw())


def test_video_keeps_pixels_and_stamps(tmp_path: Path):
    pictures = list(islice(throw(), 5))
    frames = list(video_images(save_video(tmp_path / "v.mp4", pictures, fps=24), []))
    assert [frame.stamp for frame in frames] == pytest.approx([i / 24 for i in range(5)], abs=1e-4)
    difference = np.array([frame.pixels for frame in frames], dtype=float) - pictures
    assert np.abs(difference).mean() < 4.0


def test_what_is_no_source_is_refused(tmp_path: Path):
    (tmp_path / "notes.txt").write_text("no video")
    (tmp_path / "folder").mkdir()
    for name, words in (
        ("nothing.mp4", "/dev/videoN"),
        ("notes.txt", "cannot be read as a video"),
        ("folder", r"folder has no images \(\.png, .*\) and is no rosbag2 \(metadata\.yaml\)"),
        ("/dev/video99", "gives no image: plug it in"),
    ):
        with pytest.raises(PerceptionError, match=words):
            next(images_of(str(tmp_path / name), []))


def test_a_camera_gives_images_until_it_fails(tmp_path: Path):
    """A video file stands for a camera: OpenCV reads both alike."""
    pictures, notes = list(islice(throw(), 12)), list[str]()
    frames = list(camera_images(str(save_video(tmp_path / "v.mp4", pictures)), notes))
    difference = np.array([frame.pixels for frame in frames], dtype=float) - pictures
    assert np.abs(difference).mean() < 4.0
    assert (np.diff([frame.stamp for frame in frames]) > 0.0).all()
    assert notes == ["the camera gives no more images. Is it unplugged?"]


def test_a_damaged_video_ends_where_the_damage_begins(tmp_path: Path):
    file = save_video(tmp_path / "v.mp4", islice(throw(), 30))
    content = bytearray(file.read_bytes())
    middle, length = len(content) // 2, len(content) // 5
    content[middle : middle + length] = bytes(length)
    file.write_bytes(content)
    notes: list[str] = []
    frames = list(video_images(file, notes))
    assert 3 < len(frames) < 30
    assert notes[0].startswith(f"the video is damaged after {len(frames)} images: Invalid data")


def test_strong_compression_is_said_with_its_remedy(tmp_path: Path):
    pictures, notes = list(islice(throw(), 30)), list[str]()
    list(video_images(save_video(tmp_path / "usual.mp4", pictures), notes))
    assert not notes
    write_video(tmp_path / "strong.mp4", pictures, fps=30, crf=48)
    list(video_images(tmp_path / "strong.mp4", notes))
    assert len(notes) == 1
    assert "record with -crf 18" in notes[0]


def images_got(stamps: list[float], notes: list[str] | None = None) -> list[int]:
    """Number of the image that each control step gets; ticks are whole control steps apart."""
    frames = [Image(pixels=PICTURE, stamp=stamp) for stamp in stamps]
    ticks = list(on_control_clock(frames, [] if notes is None else notes))
    assert all(tick.image.stamp < tick.now for tick in ticks)
    steps = np.array([(tick.now - stamps[0]) / CONTROL_DT for tick in ticks])
    np.testing.assert_allclose(steps % 1.0, 0.5, atol=1e-4)
    assert (np.diff(steps) > 0.5).all()
    return [next(i for i, frame in enumerate(frames) if frame is tick.image) for tick in ticks]


def test_no_jitter_of_a_camera_makes_a_tick_miss_its_image():
    jitter = np.random.default_rng(0).uniform(-0.4, 0.4, 300)
    jitter[0] = 0.0
    stamps = ((np.arange(300) + jitter) * CONTROL_DT + 1.79e9).tolist()
    assert images_got(stamps) == list(range(300))


@pytest.mark.parametrize(
    ("rate", "expected"),
    [(60, [0, 2, 4, 5]), (15, [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5]), (30, [0, 1, 2, 3, 4, 5])],
)
def test_other_rates_skip_or_repeat_images(rate: int, expected: list[int]):
    assert images_got([i / rate for i in range(6)]) == expected


def test_a_long_pause_is_cut_and_said():
    notes: list[str] = []
    got = images_got([0.0, 1 / 30, 3600.0], notes)
    assert got == [0] + [1] * LONGEST_PAUSE + [2]
    assert notes == ["3600.0 s without an image after 0.0 s."]


def test_stamps_that_go_back_are_passed_over_and_said():
    notes: list[str] = []
    assert images_got([0.0, 1 / 30, 1 / 30, 0.01, 2 / 30], notes) == [0, 1, 4]
    assert notes == ["images no newer than those before them, passed over: 2."]


def read(path: Path, topic: str | None = None, notes: list[str] | None = None) -> list[Image]:
    return list(images_of(str(path), [] if notes is None else notes, topic))


@pytest.mark.parametrize(
    ("storage", "encoding", "padding"),
    [(StoragePlugin.MCAP, "rgb8", 24), (StoragePlugin.SQLITE3, "bgr8", 0)],
)
def test_raw_images_come_out_as_they_were(
    storage: StoragePlugin, encoding: str, padding: int, tmp_path: Path
):
    pixels = PICTURE if encoding == "rgb8" else PICTURE[..., ::-1]
    path = save_bag(tmp_path / "bag", [raw(step, pixels, encoding, padding) for step in range(3)], storage)
    for source in (path, *path.glob("*.mcap")):
        frames = read(source)
        assert [frame.stamp for frame in frames] == pytest.approx([stamp_of(step) / 1e9 for step in range(3)])
        for frame in frames:
            np.testing.assert_array_equal(frame.pixels, PICTURE)


@pytest.mark.parametrize("sec", [0, 7])
def test_the_times_of_recording_count_where_stamps_are_missing_or_stand_still(sec: int, tmp_path: Path):
    notes, sent = list[str](), [raw(step, PICTURE) for step in range(3)]
    for *_, message in sent:
        message.header.stamp.sec, message.header.stamp.nanosec = sec, 0
    frames = read(save_bag(tmp_path / "bag", sent), notes=notes)
    times = [received / 1e9 for _, received, _ in sent]
    assert [frame.stamp for frame in frames] == pytest.approx(times)
    assert notes == ["the images have no stamps that increase: their times of recording are used."]


def test_compressed_images_are_decoded_and_damaged_ones_passed_over(tmp_path: Path):
    good = jpeg(PICTURE)
    messages = [compressed(0, good, "jpeg"), compressed(1, good), compressed(2, good[:9]), compressed(3, b"")]
    notes: list[str] = []
    frames = read(save_bag(tmp_path / "bag", messages), notes=notes)
    assert len(frames) == 2
    assert np.abs(frames[1].pixels.astype(float) - PICTURE).mean() < 6.0
    assert len(notes) == 1
    assert notes[0].startswith("damaged images, passed over: 2; the last of 0 bytes at")


ONLY = "is not read; record jpeg or png of rgb8 or bgr8"


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (compressed(0, jpeg(PICTURE), "16UC1; compressedDepth png"), ONLY),
        (compressed(0, jpeg(PICTURE), "bayer_rggb8; jpeg compressed bayer_rggb8"), ONLY),
        (raw(0, PICTURE[..., :1], "16UC1"), "image_raw: the encoding is '16UC1'; set the camera"),
        (("/joint_states", 0, joint_state(0, ["elbow_joint"], [0.0])), "is on no topic; record the camera"),
    ],
)
def test_a_bag_without_colours_of_8_bits_is_refused(message: Message, words: str, tmp_path: Path):
    with pytest.raises(PerceptionError, match=words):
        read(save_bag(tmp_path / "bag", [message]))


def test_one_of_several_topics_is_chosen_by_name(tmp_path: Path):
    path = save_bag(tmp_path / "bag", [raw(0, PICTURE), compressed(0, jpeg(PICTURE))])
    for topic in (None, "/wrist"):
        with pytest.raises(PerceptionError, match="is on /camera/image_raw, /camera/image_raw/compressed; "):
            read(path, topic)
    assert len(read(path, "/camera/image_raw")) == 1


def bayer(red: tuple[int, int], blue: tuple[int, int]) -> np.ndarray:
    """A mosaic of one colour, with red and blue at these rows and columns of each four pixels."""
    mosaic = np.full((48, 64, 1), COLOR[1], np.uint8)
    mosaic[red[0] :: 2, red[1] :: 2], mosaic[blue[0] :: 2, blue[1] :: 2] = COLOR[0], COLOR[2]
    return mosaic


COLOR = np.array((200, 60, 30), np.uint8)
ONE = np.broadcast_to(COLOR, (48, 64, 3))
UYVY = cv2.cvtColor(np.ascontiguousarray(ONE), cv2.COLOR_RGB2YUV_UYVY)
ENCODED = {
    "8UC3": ONE[..., ::-1],
    "rgba8": np.insert(ONE, 3, 9, axis=-1),
    "bgra8": np.insert(ONE[..., ::-1], 3, 9, axis=-1),
    "yuv422": UYVY,
    "yuv422_yuy2": UYVY[..., ::-1],
    "bayer_rggb8": bayer((0, 0), (1, 1)),
    "bayer_bggr8": bayer((1, 1), (0, 0)),
    "bayer_gbrg8": bayer((1, 0), (0, 1)),
    "bayer_grbg8": bayer((0, 1), (1, 0)),
}


@pytest.mark.parametrize("encoding", ENCODED)
def test_usual_encodings_are_converted(encoding: str, tmp_path: Path):
    (frame,) = read(save_bag(tmp_path / "bag", [raw(0, ENCODED[encoding], encoding, padding=6)]))
    assert np.abs(frame.pixels.astype(int) - ONE).max() <= 4


def test_grey_images_and_compressed_ones_without_a_format_are_read(tmp_path: Path):
    (grey,) = read(save_bag(tmp_path / "grey", [raw(0, PICTURE[..., :1], "mono8")]))
    np.testing.assert_array_equal(grey.pixels, PICTURE[..., :1].repeat(3, axis=-1))
    assert len(read(save_bag(tmp_path / "unnamed", [compressed(0, jpeg(PICTURE), "")]))) == 1


def test_a_folder_of_images_is_a_video_in_the_order_of_their_numbers(tmp_path: Path):
    notes: list[str] = []
    for number in (10, 9, 100):
        cv2.imwrite(str(tmp_path / f"frame{number}.png"), np.full((48, 64, 3), number, np.uint8))
    frames = read(tmp_path, notes=notes)
    assert [frame.pixels[0, 0, 0] for frame in frames] == [9, 10, 100]
    assert [frame.stamp for frame in frames] == pytest.approx([0.0, CONTROL_DT, 2 * CONTROL_DT])
    assert notes == ["files of images have no times: 30 images a second are assumed."]
    with pytest.raises(PerceptionError, match="a single image; give the folder"):
        read(tmp_path / "frame9.png")
    cv2.imwrite(str(tmp_path / "frame11.png"), np.full((48, 64), 30_000, np.uint16))
    with pytest.raises(PerceptionError, match=r"frame11\.png': not a readable image of 8 bits"):
        read(tmp_path)
