"""How far the box of projected surface points is from the box of the rendered object.

Training never renders: it takes the box of those surface points that no ray finds hidden
(`mdp.sensing.detect`). Here that box is compared with the one of the rendered mask, in flights and holds of
the default policy; by number of points and least visible share. `--frames` is the number for each object.

python benchmarks/box_error.py --frames 90
"""

from dataclasses import dataclass, replace

import mujoco
import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pixel2catch.camera.pinhole import is_in_view, is_unoccluded, nominal_projection
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.evaluation.protocol import EvaluationCfg, recorded_throws
from pixel2catch.mdp.sensing import detect
from pixel2catch.perception.regions import window_of
from pixel2catch.rendering.renderer import RGB_VIEW, Renderer, Viewpoint
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.scene.objects import OBJECTS, SEEN, surface_points
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.sim.factory import make_simulation

POINT_COUNTS = (64, 96, 128, 256)
SHARES = (0.001, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3)
LEAST_PIXELS = (1, 20, 40)

OCCLUDER_GROUPS = (0, 3)

FLIGHT_STEPS = 28  #: Control steps of a flight.


@dataclass(frozen=True, kw_only=True)
class BoxErrors:
    """One row per frame."""

    error: Float[Tensor, "num_frames 4"]  #: Computed minus rendered box [px]; 0 where one sees nothing.
    num_pixels: Int[Tensor, " num_frames"]  #: Rendered pixels of the object.
    visible_fraction: Float[Tensor, " num_frames"]  #: Share of the points on the image and not hidden.
    is_hit: Bool[Tensor, " num_frames"]  #: Whether a ray to any point is stopped.
    is_cut: Bool[Tensor, " num_frames"]  #: Whether any point lies off the image.

    @property
    def worst_edge(self) -> Float[Tensor, " num_frames"]:
        """Largest error of the four edges [px]."""
        return self.error.abs().amax(-1)

    def select(self, rows: Bool[Tensor, " num_frames"]) -> "BoxErrors":
        """The frames where `rows` is true."""
        return BoxErrors(**{name: values[rows] for name, values in vars(self).items()})

    @staticmethod
    def concatenate(several: list["BoxErrors"]) -> "BoxErrors":
        """All frames of several comparisons."""
        names = vars(several[0])
        return BoxErrors(**{name: torch.cat([getattr(errors, name) for errors in several]) for name in names})


def sample_frames(num_frames: int) -> Float[Tensor, "num_frames nq"]:
    """Return positions of robot and object in throws at the default policy: two in flight, one held."""
    policy, method = load_policy(None)
    cfg = EvaluationCfg(objects=SEEN, num_envs=num_frames // 3, trials=1, task=task_of(policy, 120.0))
    rng, frames = np.random.default_rng(0), []
    for throw in recorded_throws(cfg, policy, method):
        flight = throw.release + rng.integers(FLIGHT_STEPS, size=2)
        frames.append(throw.qpos[np.append(np.minimum(flight, len(throw.qpos) - 1), -1)])
    return torch.tensor(rng.permutation(np.concatenate(frames)), dtype=torch.float32)


def compare(
    object_name: str, qpos: Float[Tensor, "num_frames nq"], num_points: int, magnification: int = 1
) -> BoxErrors:
    """Compute and render the box of one object in every frame.

    Args:
        object_name: Which object.
        qpos: Joint positions of robot and object, as `sample_frames` draws them.
        num_points: Surface points of the object, at least its vertices.
        magnification: Rendered pixels per pixel of the camera, in each direction. With 1 the rendered box is
            that of the camera; with more it is closer to the true outline, because a pixel shows the object
            only if its middle does.
    """
    model = build_model(SceneCfg(), object_name)
    width, height = magnification * RGB_VIEW.width, magnification * RGB_VIEW.height
    view = replace(RGB_VIEW, width=width, height=height)
    points, is_visible = _surface(model, object_name, qpos, num_points)
    camera = nominal_projection(RGB_CAMERA, points)
    box, _ = detect(points, is_visible, 0.0, camera)
    in_view = is_in_view(RGB_CAMERA, *camera.pixels(points))
    mask = _masks(model, qpos, view)
    windows = [window_of(each) for each in mask.numpy()]
    edges = [(across.start, down.start, across.stop, down.stop) for down, across in windows]
    rendered = torch.tensor(edges, dtype=torch.float32)
    is_rendered = mask.any(-1).any(-1)
    is_comparable = is_rendered & (is_visible & in_view).any(-1)
    return BoxErrors(
        error=torch.where(is_comparable[:, None], box - rendered / magnification, 0.0),
        num_pixels=mask.count_nonzero((-2, -1)) // magnification**2,
        visible_fraction=(is_visible & in_view).float().mean(-1),
        is_hit=~is_visible.all(-1),
        is_cut=~in_view.all(-1),
    )


def _surface(
    model: mujoco.MjModel, object_name: str, qpos: Float[Tensor, "num_frames nq"], num_points: int
) -> tuple[Float[Tensor, "num_frames num_points 3"], Bool[Tensor, "num_frames num_points"]]:
    """Surface points in the world frame [m], and which of them nothing hides."""
    simulation = make_simulation(model, len(qpos), "cpu")
    simulation.bind("qpos")[:] = qpos
    xpos, xmat = simulation.bind("xpos"), simulation.bind("xmat")
    simulation.forward()
    body = model.body("object").id
    local = torch.from_numpy(surface_points(OBJECTS[object_name], num_points))
    points = local @ xmat[:, body].view(-1, 3, 3).mT + xpos[:, body, None]
    origin = nominal_projection(RGB_CAMERA, points).center
    hit = simulation.ray(origin, points - origin, OCCLUDER_GROUPS)
    simulation.close()
    return points, is_unoccluded(hit)


def _masks(
    model: mujoco.MjModel, qpos: Float[Tensor, "num_frames nq"], view: Viewpoint
) -> Bool[Tensor, "num_frames height width"]:
    """Render the object's masks."""
    with Renderer(model, view, shadows=False) as renderer:
        return torch.from_numpy(np.stack([renderer.object_mask(row) for row in qpos.double().numpy()]))


def main(frames: int = 90) -> None:
    drawn = sample_frames(frames * len(OBJECTS)).chunk(len(OBJECTS))
    of_object = dict(zip(OBJECTS, drawn, strict=True))
    print("worst edge [px], computed against rendered box")
    for num_points in POINT_COUNTS:
        every = BoxErrors.concatenate([compare(name, qpos, num_points) for name, qpos in of_object.items()])
        is_seen = (every.num_pixels > 0) & (every.visible_fraction > 0)
        free, hidden = every.select(~every.is_hit & ~every.is_cut), every.select(every.is_hit & is_seen)
        print(f"{num_points:>6} points   unoccluded {summary(free)}   occluded {summary(hidden)}")
        if num_points == POINT_COUNTS[0]:
            print_shares(every.select(every.is_hit))


def print_shares(hit: BoxErrors) -> None:
    """Print how often a threshold on the share disagrees with a detector that needs so many pixels."""
    print(f"least visible share of the points, {len(hit.error)} frames in which a ray is stopped")
    for share in SHARES:
        is_seen = hit.visible_fraction >= share
        for pixels in LEAST_PIXELS:
            is_rendered = hit.num_pixels >= pixels
            missed, ghosts = (is_rendered & ~is_seen).float().mean(), (~is_rendered & is_seen).float().mean()
            print(f"{share:>6}, at least {pixels} px: missed {missed:.1%}, ghosts {ghosts:.1%}")


def summary(errors: BoxErrors) -> str:
    worst = errors.worst_edge
    quantiles = torch.quantile(worst, torch.tensor([0.5, 0.9], dtype=worst.dtype))
    return f"n {len(worst):>4}  {quantiles[0]:.2f}  p90 {quantiles[1]:.2f}  max {worst.max():.2f}"


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
