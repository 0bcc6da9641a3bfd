"""Observations: sizes, layout, memories, and that every difference comes from (before, now)."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from pixel2catch.agents import AgentSpec, agents_of
from pixel2catch.errors import UnknownNameError
from pixel2catch.mdp import observations
from pixel2catch.mdp.control_step import BoxHistory, History
from pixel2catch.mdp.observations import (
    ObservationInputs,
    box_age,
    pixel_columns,
)
from pixel2catch.methods import MEMORIES, METHODS, Method, find_method, remembering
from pixel2catch.policy import contract_of, method_of
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO
from snapshots import measurement

PROPOSED = METHODS["proposed"]
ARM = agents_of(UR5E_ALLEGRO)[0]
OLDEST, BEFORE, NOW = (measurement(2, start) for start in (0.0, 0.25, 0.75))
HISTORY = History(OLDEST, BEFORE, NOW)

SIZES = {
    "without_pf": {"arm": 2 * (3 + 7 + 12), "hand": 2 * (3 + 7 + 26)},
    "object_extent": {"arm": 54, "hand": 82},
    "proposed": {"arm": 50, "hand": 78},
    "journal": {"arm": 2 * (25 + 3 + 6), "hand": 2 * (39 + 3 + 13)},
    "only_wh": {"arm": 46, "hand": 74},
    "single_agent": {"robot": 2 * (6 + 7 + 19 + 19)},
    "analytic": {"robot": 2 * (6 + 19 + 19)},
}


def observation(agent: AgentSpec, method: Method, history: History = HISTORY) -> torch.Tensor:
    return method.observe(history)[agent.name]


def seeing(box: list[list[float]], age: list[float]) -> ObservationInputs:
    """A frame of a robot that remembers these boxes, newest first."""
    boxes = BoxHistory(box=torch.tensor([box]), age=torch.tensor([age]))
    now = replace(measurement(), boxes=boxes)
    return ObservationInputs(
        before=measurement(), now=now, joints=ARM.joints, palms=ARM.palms, pixel_columns=()
    )


@pytest.mark.parametrize("name", SIZES)
def test_sizes(name: str):
    """Twice 25 for the arm and twice 39 for the hand, as the paper counts; the others follow."""
    agents = METHODS[name].agents
    assert {agent.name: observation(agent, METHODS[name]).shape[1] for agent in agents} == SIZES[name]


def test_journal_adds_palm_displacement_and_targets():
    arm = METHODS["journal"].agents[0]
    older, newer = observation(arm, METHODS["journal"])[:, :68].split(34, dim=-1)
    for row, before, now in ((older, OLDEST, BEFORE), (newer, BEFORE, NOW)):
        torch.testing.assert_close(row[:, 25:28], (now.palm_pos - before.palm_pos)[:, 0])
        assert torch.equal(row[:, 28:], now.joint_pos_target[:, :6])
        assert row[:, 25:28].abs().min() > 0  # the release's palm displacement is always zero


def test_the_oracle_sees_position_and_change_in_place_of_pixels():
    oracle = METHODS["object_position"]
    for agent, pixel_agent in zip(oracle.agents, PROPOSED.agents, strict=True):
        older, newer = observation(agent, oracle).chunk(2, dim=-1)
        for row, before, now in ((older, OLDEST, BEFORE), (newer, BEFORE, NOW)):
            assert torch.equal(row[:, :3], now.object_pos)
            assert torch.equal(row[:, 3:6], now.object_pos - before.object_pos)
        pixels = observation(pixel_agent, PROPOSED)
        assert torch.equal(newer[:, 6:], pixels[:, pixels.shape[1] // 2 + 6 :])


def test_the_extent_is_the_box_at_the_objects_distance():
    """2 m along the optical axis, 618.163 px wide and half of 618.468 px high: 2 m and 1 m."""
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, np.array(RGB_CAMERA.quat))
    place = torch.tensor([[*(np.array(RGB_CAMERA.pos) + 2.0 * turn.reshape(3, 3)[:, 2])]]).float()
    box = torch.tensor([[100.0, 100.0, 100.0 + RGB_CAMERA.fx, 100.0 + RGB_CAMERA.fy / 2]])
    boxes = replace(NOW.boxes, box=box.expand_as(NOW.boxes.box[:, 0])[:, None])
    now = replace(NOW, boxes=boxes, object_pos=place.expand_as(NOW.object_pos))
    method = METHODS["object_extent"]
    for agent in method.agents:
        newer = observation(agent, method, History(NOW, NOW, now)).chunk(2, dim=-1)[1]
        torch.testing.assert_close(newer[:, :2], torch.tensor([[2.0, 1.0]]).expand(len(newer), -1))


def test_without_pixel_features_the_object_is_seen_at_the_beginning_only():
    method = METHODS["without_pf"]
    boxes = replace(NOW.boxes, box=NOW.boxes.box + 50.0, age=NOW.boxes.age + 1.0)
    later = replace(NOW, boxes=boxes, object_pos=NOW.object_pos + 1.0)
    for agent in method.agents:
        seen = observation(agent, method)
        assert torch.equal(seen, observation(agent, method, History(OLDEST, BEFORE, later)))
        assert torch.equal(seen[:, :3], BEFORE.initial_object_pos)


def test_box_track_by_hand():
    """Centre (320, 240) after (310, 244), size (20, 30) after (16, 32), 2 steps apart; as still before.

    In a step the centre moved by (5, -2) px, the size grew by (2, -1).
    """
    newest, older = [310.0, 225.0, 330.0, 255.0], [302.0, 228.0, 318.0, 260.0]
    track = observations.box_track(seeing([newest, older, older], [1.5, 3.5, 4.0]))
    now, speeds, ages = [3.2, 2.4, 0.2, 0.3], [5.0, -2.0, 2.0, -1.0, 0.0, 0.0, 0.0, 0.0], [1.5, 3.5, 4.0]
    torch.testing.assert_close(track, torch.tensor([now + speeds + ages]))


def test_boxes_with_nearly_the_same_stamp_have_no_speed_without_bounds():
    """Half a control step is the least that they are taken to be apart."""
    track = observations.box_track(seeing([[12.0, 0.0, 12.0, 0.0], [10.0, 0.0, 10.0, 0.0]], [1.0, 1.1]))
    assert track[0, 4].item() == pytest.approx(2.0 / 0.5)


@pytest.mark.parametrize("memory", MEMORIES)
def test_a_memory_comes_after_the_frames(memory: str):
    """And is of the newest measurement alone."""
    plain, method = METHODS["catch"], remembering(METHODS["catch"], memory)
    history = History(*(measurement(2, start, method.num_boxes) for start in (0.0, 0.25, 0.75)))
    for agent, forgetful in zip(method.agents, plain.agents, strict=True):
        frame = method.inputs(agent, history.before, history.now)
        remembered = [term(frame) for term in agent.memory]
        expected = torch.cat((observation(forgetful, plain, history), *remembered), dim=-1)
        assert torch.equal(observation(agent, method, history), expected)
        other = History(measurement(2, 7.0, method.num_boxes), history.before, history.now)
        size = sum(value.shape[1] for value in remembered)
        assert torch.equal(observation(agent, method, other)[:, -size:], expected[:, -size:])


@pytest.mark.parametrize("name", ["only_wh", "only_center"])
def test_a_fit_tells_no_more_than_a_method_sees(name: str):
    """Of boxes that differ in what it does not see, in their centres or in their sizes, it sees the same."""
    method, generator = find_method(f"{name}+fit"), torch.Generator().manual_seed(0)
    center, size = 100.0 + 200.0 * torch.rand(2, method.num_boxes, 2, generator=generator)
    other = (center.flip(0), size) if name == "only_wh" else (center, size.flip(0))
    ages, fits = [1.5 + number for number in range(method.num_boxes)], []
    for middle, extent in ((center, size), other):
        seen = seeing(torch.cat((middle - extent / 2, middle + extent / 2), dim=-1).tolist(), ages)
        frame = replace(seen, pixel_columns=pixel_columns(method.pixel_features))
        fits.append(torch.cat([term(frame) for term in method.agents[0].memory], dim=-1))
    torch.testing.assert_close(*fits, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", ["without_pf", "object_position"])
def test_without_pixel_features_a_memory_is_the_age(name: str):
    method = find_method(f"{name}+fit")
    assert (method.name, method.num_boxes) == (f"{name}+fit", 1)
    assert all(agent.memory == (box_age,) for agent in method.agents)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("propsed", r"'propsed'.*proposed"),
        ("+fit", r"unknown method ''"),
        ("catch+nonsense", r"'nonsense'.*age, boxes, fit"),
        ("catch+age+fit", r"'age\+fit'"),
        ("catch+boxes0", r"'boxes0'.*boxes5"),
    ],
)
def test_an_unknown_name_is_refused_with_the_valid_ones(name: str, message: str):
    with pytest.raises(UnknownNameError, match=message):
        find_method(name)


def test_a_number_behind_a_memory_is_that_of_its_boxes():
    """Of five boxes: the newest's centre and size, four speeds of both, five ages."""
    method = find_method("proposed+boxes5")
    assert (method.name, method.num_boxes) == ("proposed+boxes5", 5)
    assert contract_of(method).agents["arm"].observation[-1] == ("box_track[t]", 4 + 4 * 4 + 5)
    assert method_of(replace(contract_of(method), method="mine+boxes5")).num_boxes == 5
    assert find_method("without_pf+boxes5").num_boxes == 1
