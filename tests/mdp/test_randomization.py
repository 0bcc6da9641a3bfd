"""Draws of an episode: the ranges of the paper's Table I."""

from dataclasses import replace

import pytest
import torch

from pixel2catch.errors import InvalidValueError
from pixel2catch.mdp.randomization import (
    EpisodeParameters,
    GainRanges,
    RandomizationCfg,
    by_joint,
    sample_delay,
    sample_parameters,
)
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

NUM_ARM = 6
OBJECT_IDS = torch.tensor([2, 5, 11])
BIAS = by_joint(UR5E_ALLEGRO, "action_bias", torch.device("cpu"))


def resolved(cfg: RandomizationCfg) -> RandomizationCfg:
    return replace(cfg, gains=cfg.gains.of(UR5E_ALLEGRO))


def drawn(
    cfg: RandomizationCfg | None = None,
    sensing: SensingCfg | None = None,
    num_envs: int = 4000,
    seed: int = 0,
) -> EpisodeParameters:
    generator = torch.Generator().manual_seed(seed)
    return sample_parameters(
        resolved(cfg or RandomizationCfg()), sensing or SensingCfg(), BIAS, OBJECT_IDS, num_envs, generator
    )


@pytest.mark.parametrize(
    ("name", "columns", "low", "high"),
    [
        ("stiffness_scale", slice(0, NUM_ARM), 0.8, 1.2),
        ("stiffness_scale", slice(NUM_ARM, None), 0.7, 1.3),
        ("damping_scale", slice(0, NUM_ARM), 0.8, 1.2),
        ("damping_scale", slice(NUM_ARM, None), 0.7, 1.3),
        ("joint_offset", slice(None), -0.125, 0.125),
        ("mass_scale", None, 0.5, 1.5),
        ("restitution", None, 0.0, 0.5),
        ("friction", None, 0.5, 1.5),
    ],
)
def test_uniform_draws_fill_their_ranges(name, columns, low, high):
    values = getattr(drawn(), name)
    values = values[:, None] if columns is None else values[:, columns]
    width = high - low
    assert (values.amin(dim=0) >= low - 1e-6).all()
    assert (values.amin(dim=0) < low + 0.01 * width).all()
    assert (values.amax(dim=0) <= high + 1e-6).all()
    assert (values.amax(dim=0) > high - 0.01 * width).all()
    assert values.std(dim=0).tolist() == pytest.approx([width / 12**0.5] * values.shape[1], rel=0.05)


def test_relative_damping_follows_the_stiffness_within_its_own_range():
    """The elbow's damping is the stiffness' factor times 0.95 to 1.05; every other draw stays as it was."""
    narrow = ((0.8, 1.2),) * 2 + ((0.95, 1.05),) + ((0.8, 1.2),) * 3 + ((0.7, 1.3),) * 13
    elbow = torch.arange(19) == 2
    plain = drawn(RandomizationCfg(gains=GainRanges(damping_scale=narrow)))
    relative = GainRanges(damping_scale=narrow, is_damping_relative=tuple(elbow.tolist()))
    parameters = drawn(RandomizationCfg(gains=relative))
    ratio = parameters.damping_scale / parameters.stiffness_scale
    torch.testing.assert_close(ratio[:, elbow], plain.damping_scale[:, elbow])
    assert torch.equal(parameters.damping_scale[:, ~elbow], plain.damping_scale[:, ~elbow])
    assert torch.equal(parameters.stiffness_scale, plain.stiffness_scale)
    assert parameters.damping_scale[:, 2].amax() > 1.15


def test_ranges_of_other_joints_are_refused():
    with pytest.raises(InvalidValueError, match="stiffness_scale has 2 entries"):
        GainRanges(stiffness_scale=((0.8, 1.2),) * 2).of(UR5E_ALLEGRO)


@pytest.mark.parametrize(
    ("limits", "grid", "expected"),
    [
        ((0, 0), 1.0, [0.0]),
        ((2, 2), 1.0, [2.0]),
        ((0, 3), 1.0, [0.0, 1.0, 2.0, 3.0]),
        ((1.5, 2.5), 1.0, [1.5, 2.5]),
        ((0.5, 1.5), 0.25, [0.5, 0.75, 1.0, 1.25, 1.5]),
        ((1.25, 1.25), 0.0, [1.25]),
    ],
)
def test_delays_take_every_value_of_their_grid_as_often(limits, grid, expected):
    generator = torch.Generator().manual_seed(0)
    values, counts = sample_delay(limits, grid, 3000, generator).unique(return_counts=True)
    torch.testing.assert_close(values, torch.tensor(expected))
    share = 1.0 / len(expected)
    error = (3000 * share * (1.0 - share)) ** 0.5  # of a count
    assert (counts - 3000 * share).abs().max() <= 4.0 * error


@pytest.mark.parametrize(("steps", "grid"), [((0, 0), 1.0), ((2, 2), 1.0), ((1, 5), 1.0), ((0.6, 4.3), 0.0)])
def test_a_seed_draws_the_same_at_every_latency(steps, grid):
    """What is drawn after it, too, such as throws: levels of latency are compared on the same ones."""
    generators = [torch.Generator().manual_seed(0) for _ in range(2)]
    changed = SensingCfg(latency_steps=steps, latency_grid=grid)
    for sensing, generator in zip((SensingCfg(), changed), generators, strict=True):
        sample_parameters(resolved(RandomizationCfg()), sensing, BIAS, OBJECT_IDS, 40, generator)
    first, second = (torch.rand(3, generator=generator) for generator in generators)
    assert torch.equal(first, second)
