"""From the true state to what sensors measure, in simulation: occlusion, noise, latency, camera errors."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.batches import Boxes, Counts, Flags, PointFlags, Points, Scalars, Vectors
from pixel2catch.camera import region
from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.camera.pinhole import Projection, box_of_points, is_in_view, nominal_projection, project
from pixel2catch.checks import Amount, Range, Share, Within, require
from pixel2catch.errors import InvalidValueError
from pixel2catch.mdp.tensors import select
from pixel2catch.mdp.throws import Throw, drawn, random_directions
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA

RELEASE_CAMERA = CameraFile(camera=RGB_CAMERA)  #: The camera of the release, without errors.

Pixels = Annotated[float, Within(0.0, 100.0)]  #: Largest error of an edge of a box [px].


@dataclass(frozen=True, kw_only=True)
class SensingCfg:
    """Noise and delay of the sensors."""

    corner_noise: Pixels = 5.0  #: Largest error of each edge of the box, uniform [px] (Source: paper).
    #: Control steps between image and delivered box, drawn for each episode (Source: release).
    latency_steps: Annotated[Range, Within(0.0, 60.0)] = (1, 2)
    #: Difference of neighbouring latencies [control steps] (Source: release, whole steps); 0 draws any.
    latency_grid: Annotated[float, Within(0.0, 60.0)] = 1.0
    #: Standard deviation of the encoders' noise [rad] (Source: paper, Table I, observation noise).
    #: Differs: the release adds it to the whole observation, pixels included.
    joint_noise: Annotated[float, Within(0.0, 0.5)] = 0.005
    #: Standard deviation of their error in an episode [rad] (Source: release).
    joint_bias: Annotated[float, Within(0.0, 0.5)] = 0.001
    #: Share of the object's surface points that must be visible for a detection (Source: ours, see
    #: `benchmarks/box_error.py`).
    least_visible: Share = 0.05
    #: The camera and its uncertainty: the true camera of each episode is drawn within that. Default: the
    #: release's, without errors.
    camera: CameraFile = RELEASE_CAMERA
    #: Draw the calibrated camera of each episode from `camera.region` instead.
    any_camera: bool = False
    #: Distance of the true camera from the calibrated one, in a random direction [m]. The training of the
    #: paper has neither this error nor those below (ours; values: `envs.tasks`, `evaluation.stress`).
    camera_offset: Annotated[Amount, Within(0.0, 1.0)] = 0.0
    #: Angle between the two, about a random axis [rad].
    camera_turn: Annotated[Amount, Within(0.0, 0.8)] = 0.0
    #: Relative error of the focal length, of random sign.
    focal_error: Annotated[Amount, Within(0.0, 0.5)] = 0.0
    #: Shift of every box of an episode in a random direction [px].
    box_bias: Annotated[Amount, Within(0.0, 300.0)] = 0.0
    #: Factor on `corner_noise` in all images of an episode.
    noise_scale: Annotated[Amount, Within(0.0, 20.0)] = 1.0
    box_scale: Annotated[float, Within(0.1, 10.0)] = 1.0  #: Factor on the size of every box about its centre.
    edge_noise: Pixels = 0.0  #: Largest error of each edge on top of `corner_noise` [px].
    #: Share of the images in which the object is not found.
    drop_rate: Annotated[Amount, Within(0.0, 1.0)] = 0.0
    #: Consecutive control steps of each flight without images, from a random time on.
    blackout_steps: Annotated[Amount, Within(0.0, 300.0)] = 0
    #: Control steps between images that are processed: 2 if perception takes 60 ms.
    image_period: Annotated[Amount, Within(1.0, 100.0)] = 1.0
    #: Error of the stamps of all images of an episode, early or late [s].
    clock_error: Annotated[Amount, Within(0.0, 1.0)] = 0.0
    #: Standard deviation of the error of each stamp [s].
    stamp_jitter: Annotated[Amount, Within(0.0, 1.0)] = 0.0
    unstamped: Share = 0.0  #: Share of the episodes whose images have no stamps; `ASSUMED_AGE` is then used.

    def __post_init__(self) -> None:
        """Refuse a camera of another resolution than that of policies, and one that would not be used."""
        require(CameraFile, "sensing.camera", self.camera)
        if self.any_camera is True and self.camera != RELEASE_CAMERA:
            raise InvalidValueError("any_camera draws the camera, but sensing.camera is given: drop one.")
        camera = self.camera.camera
        if (camera.width, camera.height) != (RGB_CAMERA.width, RGB_CAMERA.height):
            raise InvalidValueError(
                f"the camera has {camera.width} x {camera.height} pixels; policies need "
                f"{RGB_CAMERA.width} x {RGB_CAMERA.height}: set that resolution and calibrate again."
            )

    def require_sight(self, points: Points) -> None:
        """Refuse a camera in whose image none of these points [m] is."""
        camera = self.camera.camera
        if not self.any_camera and not is_in_view(camera, *project(camera, points)).any():
            raise InvalidValueError(
                "the camera sees no throw; correct its pos [m], quat (w, x, y, z) and fx [px], or the throws."
            )


ASSUMED_AGE = 1.5  #: Age of a box without a stamp [control steps]. Source: release, mean of its latencies.


@dataclass(frozen=True, kw_only=True)
class Detection:
    """The object in one image."""

    box: Boxes  #: Its bounding box [px].
    object_pos: Vectors  #: Its position by a tracker, world frame [m].
    is_seen: Flags  #: Whether it was found; else box and position are those of the last detection.
    stale: Scalars  #: Control steps since that detection.
    age_error: Scalars  #: Error of its age by the stamp [control steps].

    def held(self, is_seen: Flags, previous: "Detection") -> "Detection":
        """Return this detection where the object is seen, else the previous one, a control step older."""
        later = replace(previous, is_seen=torch.zeros_like(is_seen), stale=previous.stale + 1.0)
        return select(is_seen, self, later)

    def exposed_before(self, previous: "Detection", time: Scalars) -> "Detection":
        """Return the detection some time before this one, 0 to 1 [control steps], by linear interpolation.

        The previous detection is one control step older.
        """
        share = time[:, None]
        return replace(
            self,
            box=torch.lerp(self.box, previous.box, share),
            object_pos=torch.lerp(self.object_pos, previous.object_pos, share),
            is_seen=self.is_seen & (previous.is_seen | (time == 0.0)),
        )


def detect(
    points: Points, is_visible: PointFlags, least_visible: float, camera: Projection
) -> tuple[Boxes, Flags]:
    """Return the box of the visible surface points, clipped to the image [px], and whether enough are seen.

    `least_visible` is the share that must be visible and in the image.
    """
    pixels, depth = camera.pixels(points)
    in_view = is_in_view(RGB_CAMERA, pixels, depth)
    is_seen = (is_visible & in_view).to(points.dtype).mean(dim=-1) >= least_visible
    return box_of_points(pixels, is_visible, RGB_CAMERA), is_seen


@dataclass(frozen=True, kw_only=True)
class CameraErrors:
    """Errors of the camera in an episode: of its pose, its boxes, its stamps, and missing images (ours)."""

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
    names = "camera corner_noise latency_steps latency_grid joint_noise joint_bias least_visible box_scale"
    exact = SensingCfg(**{name: getattr(cfg, name) for name in (*names.split(), "edge_noise")})
    return cfg.camera.is_exact and cfg == exact


def sample_camera_errors(cfg: SensingCfg, throw: Throw, generator: torch.Generator) -> CameraErrors:
    """Draw the errors of an episode for each environment, on the generator's device."""
    num_envs = len(throw.pos)
    offset, turn = (random_directions(num_envs, generator) for _ in range(2))
    chance = torch.rand(num_envs, 5, generator=generator, device=generator.device)
    amount = partial(drawn, num_envs=num_envs, generator=generator)
    sign = 1.0 - 2.0 * (chance < 0.5).float()
    zoom = 1.0 + amount(cfg.focal_error) * sign[:, 0]
    spec = cfg.camera.camera
    assumed = nominal_projection(spec, offset)
    if cfg.any_camera:
        assumed = region.sample(num_envs, generator)
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
        clock_error=amount(cfg.clock_error) / CONTROL_DT * sign[:, 3],
        stamp_jitter=amount(cfg.stamp_jitter) / CONTROL_DT,
        is_stamped=chance[:, 4] >= cfg.unstamped,
        image_period=amount(cfg.image_period),
        noise_scale=amount(cfg.noise_scale),
    )


def tracked_position(
    camera: Projection, assumed: Projection, object_pos: Vectors, shift: Float[Tensor, "num_envs 2"]
) -> Vectors:
    """Return the position that a depth camera's tracker reports, world frame [m].

    The true camera sees the object's centre. The tracker's pixel has the error `shift` [px]; it is projected
    back at the true depth by the assumed camera.
    """
    pixels, depth = camera.pixels(object_pos[:, None])
    return assumed.points(pixels[:, 0] + shift, depth[:, 0])
