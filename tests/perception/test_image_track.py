import numpy as np
import pytest
import torch

from pixel2catch.camera.boxes import box_of_mask
from pixel2catch.perception.image_track import LARGEST_REACH, ImageTrack, find_blobs


def two_blobs() -> np.ndarray:
    mask = np.zeros((48, 64), dtype=bool)
    mask[5:10, 8:14] = True  # 30 pixels
    mask[20:30, 40:44] = True  # 40 pixels
    return mask


def test_blobs_have_the_boxes_that_were_painted():
    large, small = find_blobs(two_blobs())
    assert (large.area, large.width, large.height, large.center) == (40, 4, 10, (42.0, 25.0))
    assert (small.area, small.width, small.height, small.center) == (30, 6, 5, (11.0, 7.5))


def test_the_masks_of_all_blobs_are_the_mask():
    first, second = (blob.mask() for blob in find_blobs(two_blobs()))
    assert not (first & second).any()
    assert np.array_equal(first | second, two_blobs())


def test_boxes_are_those_of_training():
    for blob in find_blobs(two_blobs()):
        box, _ = box_of_mask(torch.from_numpy(blob.mask())[None])
        assert box[0].tolist() == list(blob.box)


@pytest.mark.parametrize("level", [False, True])
def test_a_mask_is_one_blob_or_none(level: bool):
    assert len(find_blobs(np.full((6, 8), level))) == level


def test_a_track_goes_on_as_it_moved():
    track = ImageTrack(center=(10.0, 10.0)).seen((16.0, 12.0))
    assert track.expected == (22.0, 14.0)
    assert track.missed().expected == (28.0, 16.0)
    assert track.missed().seen((34.0, 18.0)).velocity == (9.0, 3.0)


def test_what_stays_away_is_not_expected_ever_further():
    track = ImageTrack(center=(0.0, 0.0), velocity=(10.0, 0.0))
    for _ in range(20):
        track = track.missed()
    assert track.expected == (30.0, 0.0)
    assert track.reach == LARGEST_REACH


def blob_at(u: int, v: int) -> np.ndarray:
    mask = np.zeros((240, 320), dtype=bool)
    mask[v - 5 : v + 5, u - 5 : u + 5] = True
    return mask


@pytest.mark.parametrize(
    ("place", "is_in_reach"),
    [
        ((160, 100), True),  # where it is expected
        ((100, 100), True),  # stopped by a hand
        ((130, 130), True),  # 30 px beside the way
        ((130, 160), False),  # 60 px beside it
        ((220, 100), False),  # 60 px ahead of where it is expected
        ((40, 100), False),  # 60 px back
    ],
)
def test_a_track_goes_on_near_its_way(place: tuple[int, int], is_in_reach: bool):
    track = ImageTrack(center=(100.0, 100.0), velocity=(60.0, 0.0), num_seen=2)
    assert (track.next_blob(find_blobs(blob_at(*place))) is not None) == is_in_reach
    first = ImageTrack(center=(100.0, 100.0), num_seen=1)  # it may go anywhere at any speed of a throw
    assert (first.next_blob(find_blobs(blob_at(*place))) is not None) == (place != (220, 100))


def test_what_flies_goes_on_ahead():
    track = ImageTrack(center=(100.0, 100.0), velocity=(30.0, 0.0), num_seen=2)
    ahead, behind = find_blobs(blob_at(137, 108) | blob_at(100, 100))
    assert sorted(map(track.leads_to, (ahead, behind))) == [False, True]
    assert not ImageTrack(center=(130.0, 100.0)).leads_to(ahead)  # no motion was seen yet


def test_of_two_things_the_nearest_goes_on():
    found = find_blobs(blob_at(150, 100) | blob_at(170, 125))
    blob = ImageTrack(center=(140.0, 100.0), velocity=(12.0, 0.0)).next_blob(found)
    assert blob is not None
    assert blob.center == (150.0, 100.0)


def test_what_was_another_thing_does_not_become_the_object():
    both = find_blobs(blob_at(150, 100) | blob_at(190, 100))
    track = ImageTrack(center=(140.0, 100.0), velocity=(10.0, 0.0))
    track, _ = track.advanced(both, track.next_blob(both))
    assert track.others == ((190.0, 100.0),)
    assert track.next_blob(find_blobs(blob_at(186, 102))) is None
    assert track.next_blob(find_blobs(blob_at(186, 130))) is not None
    assert track.next_blob(find_blobs(blob_at(160, 100))) is not None


def test_the_object_may_pass_where_another_thing_was():
    track = ImageTrack(center=(140.0, 100.0), velocity=(50.0, 0.0), others=((191.0, 100.0),))
    assert track.next_blob(find_blobs(blob_at(192, 101))) is not None


def test_the_object_may_pass_by_a_thing_that_stays():
    """It starts out of nothing, where nobody expects it, towards a thing that is still where it was."""
    track = ImageTrack(center=(140.0, 100.0), others=((160.0, 95.0),))
    blob = track.next_blob(find_blobs(blob_at(156, 110) | blob_at(160, 94)))
    assert blob is not None
    assert blob.center == (156.0, 110.0)


def test_candidates_come_nearest_first():
    track = ImageTrack(center=(140.0, 100.0), velocity=(12.0, 0.0))
    found = track.candidates(find_blobs(blob_at(170, 125) | blob_at(150, 100) | blob_at(300, 100)))
    assert [blob.center for blob in found] == [(150.0, 100.0), (170.0, 125.0)]


def test_things_of_another_size_are_no_object():
    speck, wall = np.zeros((240, 320), dtype=bool), np.zeros((240, 320), dtype=bool)
    speck[100, 100:105] = True
    wall[100:110, 50:151] = True
    for mask in (speck, wall):
        assert ImageTrack(center=(100.0, 105.0)).next_blob(find_blobs(mask)) is None
