"""Errors of the camera in an episode: of its pose, its boxes, its stamps, and missing images.

Source: ours; the defaults of `SensingCfg` have none. A calibrated camera is drawn for each episode within the
uncertainty of its calibration.
"""

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.batches import Boxes, Counts, Flags, Scalars, Vectors
from pixel2catch.camera.boxes import center_and_size
from pixel2catch.camera.pinhole import Projection, nominal_projection
from pixel2catch.camera.region import REGION
from pixel2catch.mdp.sensing import ASSUMED_AGE, SensingCfg
from pixel2catch.mdp.throws import Throw, drawn, random_directions
from pixel2catch.scene.constants import CONTROL_DT


@dataclass(frozen=True, kw_only=True)
class CameraErrors:
    """The draws of one episode in each environment."""

    assumed: Projection  #: The calibrated camera, which trackers and policies assume.
    camera: Projection  #: The true camera.
    box_bias: Float[Tensor, "num_envs 2"]  #: Shift of every box, along u and v [px].
    noise_scale: Scalars  #: Factor on the noise of every edge.
    drop_rate: Scalars  #: Share of the images in which the object is not found.
    blackout_start: Counts  #: Control step of the first missing image.
    blackout_steps: Counts  #: Control steps without images.
    image_period: Scalars  #: Control steps between images that are processed.
    clock_error: Scalars  #: Error of the age of every box, by its stamp [control steps].
    stamp_jitter: Scalars  #: Standard deviation of a further error of each image [control steps].
    is_stamped: Flags  #: Whether images have stamps.

    def is_dark(self, steps: Counts) -> Flags:
        """Return whether an image is missing after this many control steps of the episode."""
        return (steps >= self.blackout_start) & (steps < self.blackout_start + self.blackout_steps)

    def is_looked_at(self, steps: Counts) -> Flags:
        """Return whether the image after this many control steps of the episode is processed."""
        count, before = steps / self.image_period, (steps - 1) / self.image_period
        return count.floor() > before.floor()

    def age_error(self, latency: Scalars, generator: torch.Generator) -> Scalars:
        """Return the error of the age of a box, by the stamp of its image [control steps]."""
        jitter = torch.randn(len(latency), generator=generator, device=latency.device)
        error = self.clock_error + self.stamp_jitter * jitter
        return torch.where(self.is_stamped, error, ASSUMED_AGE - latency)


def is_camera_exact(cfg: SensingCfg) -> bool:
    """Return whether the camera has no errors besides the noise of training."""
    names = "camera_offset camera_turn focal_error box_bias drop_rate blackout_steps clock_error stamp_jitter"
    drawn_per_episode = (*names.split(), "unstamped", "image_period", "noise_scale")
    exact = SensingCfg()
    return (
        cfg.camera.is_exact
        and not cfg.any_camera
        and all(getattr(cfg, n) == getattr(exact, n) for n in drawn_per_episode)
    )


def sample_camera_errors(cfg: SensingCfg, throw: Throw, generator: torch.Generator) -> CameraErrors:
    """Draw the errors of an episode for each environment, on the generator's device."""
    num_envs = len(throw.pos)
    offset, turn = (random_directions(num_envs, generator) for _ in range(2))
    chance = torch.rand(num_envs, 5, generator=generator, device=generator.device)
    amount = partial(drawn, num_envs=num_envs, generator=generator)
    zoom = 1.0 + amount(cfg.focal_error) * _sign(chance[:, 0])
    spec = cfg.camera.camera
    assumed = nominal_projection(spec, offset)
    if cfg.any_camera:
        assumed = REGION.sample(num_envs, generator)
    camera = assumed if cfg.camera.is_exact else cfg.camera.sample(num_envs, generator)
    bias_angle = 2.0 * torch.pi * chance[:, 1]
    flight_steps = throw.flight_time() / CONTROL_DT
    blackout_steps = amount(cfg.blackout_steps).round()
    latest = torch.clamp(flight_steps - blackout_steps, min=0.0)
    direction = torch.stack((torch.cos(bias_angle), torch.sin(bias_angle)), dim=-1)
    turn, offset = amount(cfg.camera_turn)[:, None] * turn, amount(cfg.camera_offset)[:, None] * offset
    return CameraErrors(
        assumed=Projection(
            matrix=assumed.matrix.expand(num_envs, 3, 3), center=assumed.center.expand(num_envs, 3)
        ),
        camera=camera.zoomed(zoom, spec).turned(turn).moved(offset),
        box_bias=amount(cfg.box_bias)[:, None] * direction,
        drop_rate=amount(cfg.drop_rate),
        blackout_start=throw.hover_steps + (chance[:, 2] * latest).round().long(),
        blackout_steps=blackout_steps.long(),
        clock_error=amount(cfg.clock_error) / CONTROL_DT * _sign(chance[:, 3]),
        stamp_jitter=amount(cfg.stamp_jitter) / CONTROL_DT,
        is_stamped=chance[:, 4] >= cfg.unstamped,
        image_period=amount(cfg.image_period),
        noise_scale=amount(cfg.noise_scale),
    )


def _sign(chance: Scalars) -> Scalars:
    return 1.0 - 2.0 * (chance < 0.5).float()


def scaled_box(box: Boxes, factor: float) -> Boxes:
    """Return boxes [px], scaled by a factor about their centres."""
    center, size = center_and_size(box)
    half_size = 0.5 * factor * size
    return torch.cat((center - half_size, center + half_size), dim=-1)


def tracked_position(
    camera: Projection, assumed: Projection, object_pos: Vectors, shift: Float[Tensor, "num_envs 2"]
) -> Vectors:
    """Return the position that a depth camera's tracker reports, world frame [m].

    The true camera sees the object's centre. The tracker's pixel has the error `shift` [px]; it is projected
    back at the true depth by the assumed camera.
    """
    pixels, depth = camera.pixels(object_pos[:, None])
    return assumed.points(pixels[:, 0] + shift, depth[:, 0])
