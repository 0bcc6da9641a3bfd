"""The camera and what finds the object in its images: from the true state to a `Detection`."""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Bool
from torch import Tensor

from pixel2catch.camera.boxes import perturb_box
from pixel2catch.camera.pinhole import Projection, nominal_projection
from pixel2catch.envs.draws import Episode
from pixel2catch.envs.world import CatchWorld
from pixel2catch.mdp.sensing import Detection, SensingCfg, detect
from pixel2catch.mdp.sight import scaled_box, tracked_position
from pixel2catch.mdp.snapshot import Privileged
from pixel2catch.robot.constants import CONTROL_DT, RGB_CAMERA


class Eye(ABC):
    """Looks at the object of every environment, once in every control step."""

    @abstractmethod
    def look(self, truth: Privileged, episode: Episode) -> tuple[Detection, Bool[Tensor, " num_envs"]]:
        """What the present image shows of the object, and whether it was found at all.

        Args:
            truth: What there is to see.
            episode: The present episodes; one that has just begun has made no step.
        """


class ProjectingEye(Eye):
    """Projects surface points instead of taking images, and adds the errors of the sensors."""

    def __init__(self, cfg: SensingCfg, world: CatchWorld, generator: torch.Generator) -> None:
        """Look into a world.

        Args:
            cfg: The errors.
            world: What is looked at.
            generator: Source of the errors that are drawn for every image.
        """
        self._cfg, self._world, self._generator = cfg, world, generator

    def look(self, truth: Privileged, episode: Episode) -> tuple[Detection, Bool[Tensor, " num_envs"]]:
        """See `Eye.look`.

        Rays to hidden points start where the camera was calibrated: the rest changes little of what it hides.
        """
        cfg, camera = self._cfg, self._camera(episode)
        points, is_visible = self._world.surface_points(cfg.camera.camera)
        box, is_seen = detect(points, is_visible, cfg.least_visible, camera)
        if cfg.box_scale != 1.0:
            box = scaled_box(box, cfg.box_scale)
        noise = 2.0 * torch.rand(box.shape, generator=self._generator, device=box.device) - 1.0
        error = (cfg.corner_noise + cfg.edge_noise) * noise
        shift = 0.5 * cfg.edge_noise * (noise[:, :2] + noise[:, 2:])
        if episode.sight is not None:
            error = error + episode.sight.box_bias.repeat(1, 2)
            shift = shift + episode.sight.box_bias
        object_pos = truth.object_pos
        if episode.sight is not None or episode.shake is not None or cfg.edge_noise:
            object_pos = tracked_position(camera, cfg.camera.camera, object_pos, shift)
        detection = Detection(box=perturb_box(box, error, RGB_CAMERA), object_pos=object_pos)
        return detection, is_seen & self._has_image(episode)

    def _camera(self, episode: Episode) -> Projection:
        """The true camera, in the frame of the robot's base."""
        nominal = nominal_projection(self._cfg.camera.camera, episode.throw.pos)
        camera = nominal if episode.sight is None else episode.sight.camera
        if episode.shake is None:
            return camera
        return camera.moved(-episode.shake.displacement(CONTROL_DT * episode.record.steps))

    def _has_image(self, episode: Episode) -> Bool[Tensor, " num_envs"] | bool:
        """Whether an image arrived, in which the object may be found."""
        has_image = True
        if self._cfg.drop_rate:
            chance = torch.rand(len(episode.throw.pos), generator=self._generator, device=self._world.device)
            has_image = chance >= self._cfg.drop_rate
        if episode.sight is not None and self._cfg.blackout_steps:
            has_image = ~episode.sight.is_dark(episode.record.steps, self._cfg.blackout_steps) & has_image
        return has_image
