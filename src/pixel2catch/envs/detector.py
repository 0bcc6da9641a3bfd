"""From the true state to a `Detection`: the camera and the detector of the object in its images."""

from dataclasses import replace

import torch

from pixel2catch.camera.pinhole import Projection, nominal_projection, perturb_box, scaled_box
from pixel2catch.envs.episode import Episode
from pixel2catch.envs.world import CatchWorld
from pixel2catch.mdp.control_step import Privileged
from pixel2catch.mdp.sensing import Detection, SensingCfg, detect, tracked_position
from pixel2catch.scene.constants import RGB_CAMERA


class Detector:
    """Detects objects once in every control step: projects surface points instead of taking images."""

    def __init__(self, cfg: SensingCfg, world: CatchWorld, generator: torch.Generator) -> None:
        self._cfg, self._world, self._generator = cfg, world, generator

    def look(self, truth: Privileged, episode: Episode) -> Detection:
        """Return the detection in an image of this moment, without errors of the sensors."""
        cfg, errors = self._cfg, episode.camera_errors
        assumed = self.assumed(episode)
        points, is_visible = self._world.surface_points(assumed.center)
        box, is_seen = detect(points, is_visible, cfg.least_visible, errors.camera if errors else assumed)
        if cfg.box_scale != 1.0:
            box = scaled_box(box, cfg.box_scale)
        exact = torch.zeros_like(box[:, 0])
        return Detection(
            box=box, object_pos=truth.object_pos, is_seen=is_seen, stale=exact, age_error=exact.clone()
        )

    def disturbed(self, detection: Detection, episode: Episode) -> Detection:
        """Return the detection with noise and the camera errors of the episode."""
        cfg, wrong, box = self._cfg, episode.camera_errors, detection.box
        noise = 2.0 * torch.rand(box.shape, generator=self._generator, device=box.device) - 1.0
        scale = 1.0 if wrong is None else wrong.noise_scale[:, None]
        error = (scale * cfg.corner_noise + cfg.edge_noise) * noise
        shift = 0.5 * cfg.edge_noise * (noise[:, :2] + noise[:, 2:])
        is_seen, age_error = detection.is_seen, detection.age_error
        if wrong is not None:
            error = error + wrong.box_bias.repeat(1, 2)
            shift = shift + wrong.box_bias
            chance = torch.rand(len(box), generator=self._generator, device=box.device)
            steps = episode.record.steps
            is_seen = (
                is_seen & (chance >= wrong.drop_rate) & ~wrong.is_dark(steps) & wrong.is_looked_at(steps)
            )
            age_error = wrong.age_error(episode.parameters.latency, self._generator)
        object_pos = detection.object_pos
        if wrong is not None or cfg.edge_noise:
            assumed = self.assumed(episode)
            camera = wrong.camera if wrong else assumed
            object_pos = tracked_position(camera, assumed, object_pos, shift)
        return replace(
            detection,
            box=perturb_box(box, error, RGB_CAMERA),
            object_pos=object_pos,
            is_seen=is_seen,
            age_error=age_error,
        )

    def assumed(self, episode: Episode) -> Projection:
        """Return the calibrated camera: one for all environments, or one for each."""
        nominal = nominal_projection(self._cfg.camera.camera, episode.throw.pos)
        return nominal if episode.camera_errors is None else episode.camera_errors.assumed
