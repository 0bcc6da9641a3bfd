"""What is wrong with the sight of an episode: the camera, the boxes, the images that are missing.

Source: ours; with the defaults of `SensingCfg` nothing is. A calibrated camera differs from episode to
episode, in training too, as far as its calibration leaves it open; the rest is for tests of policies.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pixel2catch.camera.pinhole import Projection, back_project, nominal_projection
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.throws import Throw, random_directions
from pixel2catch.robot.constants import CONTROL_DT, CameraSpec


@dataclass(frozen=True, kw_only=True)
class Sight:
    """The draws of one episode in each environment.

    Attributes:
        camera: The true camera; a tracker assumes the one that it was drawn about.
        box_bias: Shift of every box, along u and v [px].
        blackout_start: Control step of the episode at which the images fail.
    """

    camera: Projection
    box_bias: Float[Tensor, "num_envs 2"]
    blackout_start: Int[Tensor, " num_envs"]

    def is_dark(self, steps: Int[Tensor, " num_envs"], blackout_steps: int) -> Bool[Tensor, " num_envs"]:
        """Whether there is no image after so many control steps of the episode."""
        return (steps >= self.blackout_start) & (steps < self.blackout_start + blackout_steps)


def sample_sight(cfg: SensingCfg, throw: Throw, generator: torch.Generator) -> Sight | None:
    """Draw what is wrong, on the generator's device; nothing is drawn where nothing can be."""
    errors = (cfg.camera_offset, cfg.camera_turn, cfg.focal_error, cfg.box_bias, cfg.blackout_steps)
    is_uncertain = any((*cfg.camera.pos_std, *cfg.camera.turn_std, cfg.camera.focal_std))
    if not (any(errors) or is_uncertain):
        return None
    num_envs = len(throw.pos)
    offset, turn = (random_directions(num_envs, generator) for _ in range(2))
    chance = torch.rand(num_envs, 3, generator=generator, device=generator.device)
    zoom = 1.0 + cfg.focal_error * (1.0 - 2.0 * (chance[:, 0] < 0.5).float())
    spec = cfg.camera.camera
    camera = cfg.camera.sample(num_envs, generator) if is_uncertain else nominal_projection(spec, offset)
    bias_angle = 2.0 * torch.pi * chance[:, 1]
    flight_steps = throw.flight_time() / CONTROL_DT
    latest = torch.clamp(flight_steps - cfg.blackout_steps, min=0.0)
    return Sight(
        camera=camera.zoomed(zoom, spec).turned(cfg.camera_turn * turn).moved(cfg.camera_offset * offset),
        box_bias=cfg.box_bias * torch.stack((torch.cos(bias_angle), torch.sin(bias_angle)), dim=-1),
        blackout_start=throw.hover_steps + (chance[:, 2] * latest).round().long(),
    )


def scaled_box(box: Float[Tensor, "num_envs 4"], factor: float) -> Float[Tensor, "num_envs 4"]:
    """Boxes [px], larger by a factor about their centres."""
    center = 0.5 * (box[:, :2] + box[:, 2:])
    half_size = 0.5 * factor * (box[:, 2:] - box[:, :2])
    return torch.cat((center - half_size, center + half_size), dim=-1)


def tracked_position(
    camera: Projection,
    assumed: CameraSpec,
    object_pos: Float[Tensor, "num_envs 3"],
    shift: Float[Tensor, "num_envs 2"],
) -> Float[Tensor, "num_envs 3"]:
    """Where a depth camera's tracker takes the object to be, world frame [m].

    The true camera sees the object's centre; the tracker's pixel is off by `shift`; what it reports is that
    pixel at the true depth, seen by the camera that it assumes.

    Args:
        camera: The true camera.
        assumed: The camera that the tracker knows.
        object_pos: The object's centre, world frame [m].
        shift: Error of the pixel [px].
    """
    pixels, depth = camera.pixels(object_pos[:, None])
    return back_project(assumed, pixels[:, 0] + shift, depth[:, 0])
