"""Where robot or table may stand between the camera and the object: what needs rays, and what does not."""

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

MARGIN = 1e-3  #: By which everything counts as larger [m]. Source: ours; float32 errs by less.


class Occluders:
    """Balls about the geoms of the robot and about the objects, and all that is under the table's top."""

    def __init__(
        self,
        model: mujoco.MjModel,
        groups: tuple[int, ...],
        surface: Float[Tensor, "num_objects num_points 3"],
    ) -> None:
        """Take over geoms of some groups from a model, and points on every object about its centre [m]."""
        surroundings = [model.geom(name).id for name in ("floor", "table")]
        is_ball = np.isin(model.geom_group, groups)
        is_ball[surroundings] = False
        radius = np.where(is_ball, model.geom_rbound + MARGIN, -np.inf)
        self._radius = torch.tensor(radius).to(surface)
        self._object_radius = torch.linalg.vector_norm(surface, dim=-1).amax(dim=-1)
        table = model.geom("table")
        self._top = float(table.pos[2] + table.size[2]) + MARGIN

    def may_hide(
        self,
        origin: Float[Tensor, "3"],
        center: Float[Tensor, "num_envs 3"],
        object_id: Int[Tensor, " num_envs"],
        geom_pos: Float[Tensor, "num_envs num_geoms 3"],
    ) -> Bool[Tensor, " num_envs"]:
        """Whether anything may hide a part of an object from a camera; where not, nothing does.

        No way from the camera to a point of its ball is anywhere further from that to its centre than by the
        ball's radius. Camera, centre and geoms are in the world frame [m].
        """
        radius = self._object_radius[object_id]
        way, offset = (center - origin).T[..., None], (geom_pos - origin).movedim(-1, 0).contiguous()
        share = (offset * way).sum(dim=0) / way.square().sum(dim=0)
        apart = (offset - share.clamp(0.0, 1.0) * way).square().sum(dim=0).sqrt()
        is_near = apart < self._radius + radius[:, None]
        is_low = torch.minimum(center[:, 2] - radius, origin[2]) < self._top
        return is_near.any(dim=-1) | is_low
