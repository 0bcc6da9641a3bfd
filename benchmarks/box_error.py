"""How far the box of projected surface points is from the box of the rendered object.

Training never renders: it takes the box of those surface points that no ray finds hidden
(`mdp.sensing.detect`). Here that box is compared with the one of the rendered mask, on frames of throws at
robots that wait, reach or hold; by number of points and least visible share.

python benchmarks/box_error.py --frames 90
"""

import argparse
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pixel2catch.camera.boxes import box_of_mask
from pixel2catch.camera.pinhole import camera_center, is_in_view, is_unoccluded, project
from pixel2catch.mdp.sensing import detect
from pixel2catch.mdp.throws import Throw, ThrowCfg, sample_throws
from pixel2catch.rendering.renderer import RGB_VIEW, Renderer, Viewpoint
from pixel2catch.robots.allegro import HAND
from pixel2catch.robots.geometry import first_chain
from pixel2catch.robots.spec import JointSpec
from pixel2catch.robots.ur5e import ARM
from pixel2catch.scene.constants import GRAVITY, RGB_CAMERA
from pixel2catch.scene.objects import OBJECTS, surface_points
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.sim.factory import make_simulation
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

POINT_COUNTS = (64, 96, 128, 256)
SHARES = (0.001, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3)
LEAST_PIXELS = (1, 20, 40)

OCCLUDER_GROUPS = (0, 3)

RESET_NOISE = 0.125
"""How far a joint of the waiting robot is from its start position, at most [rad]. Source: paper, Table I."""

REACH = (0.4, 0.6, 0.6, 0.6, 0.3, 0.3)
"""How far an arm joint of the reaching robot is from its start position, at most [rad]."""

NUM_REACHES = 200  #: Arm positions drawn per throw; the one whose palm is nearest to the path is taken.
NUM_INSTANTS = 60  #: Instants of the path that are tried with each of them.
HELD_DISTANCE = 0.04  #: From the palm's surface to the centre of a held object [m].
CURL = 1.0  #: How far the hand closes around a held object, at most [rad].


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


def sample_frames(num_frames: int, seed: int) -> Float[Tensor, "num_frames nq"]:
    """Draw positions of robot and object: a third each flying to a waiting or a reaching robot, and held.

    Flights are the task's throws at random instants; half of those to a reaching robot lie in the last 0.1 s.
    The object's orientation is random.
    """
    generator = torch.Generator().manual_seed(seed)
    is_waiting, is_reaching, is_holding = (torch.arange(num_frames)[:, None] % 3 == kind for kind in range(3))
    throw = sample_throws(ThrowCfg(), num_frames, generator)
    flight_time = (throw.aim[:, :1] - throw.pos[:, :1]) / throw.lin_vel[:, :1]
    reach, reach_time = _reach(throw, flight_time, generator)
    end = torch.where(is_waiting, flight_time, reach_time)
    chance = torch.rand(num_frames, 2, generator=generator)
    is_late = is_reaching & (chance[:, :1] < 0.5)
    time = torch.where(is_late, end - 0.1 * chance[:, 1:], end * chance[:, 1:])
    arm = torch.where(is_waiting, _near_home(ARM.joints, RESET_NOISE, num_frames, generator), reach)
    hand = _near_home(HAND.joints, RESET_NOISE, num_frames, generator)
    hand = hand + CURL * is_holding * torch.rand(num_frames, 1, generator=generator)
    object_pos = torch.where(is_holding, _palm_target(arm), _path(throw, time[:, :, None])[:, 0])
    return torch.cat([arm, hand, object_pos, throw.quat], dim=-1)


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
    box, _ = detect(points, is_visible, least_visible=0.0)
    in_view = is_in_view(RGB_CAMERA, *project(RGB_CAMERA, points))
    mask = _masks(model, qpos, view)
    rendered, is_rendered = box_of_mask(mask)
    is_comparable = is_rendered & (is_visible & in_view).any(-1)
    return BoxErrors(
        error=torch.where(is_comparable[:, None], box - rendered / magnification, 0.0),
        num_pixels=mask.count_nonzero((-2, -1)) // magnification**2,
        visible_fraction=(is_visible & in_view).float().mean(-1),
        is_hit=~is_visible.all(-1),
        is_cut=~in_view.all(-1),
    )


def _near_home(
    joints: tuple[JointSpec, ...],
    spread: float | tuple[float, ...],
    num_frames: int,
    generator: torch.Generator,
) -> Float[Tensor, "num_frames num_joints"]:
    """Joint positions within the limits and within `spread` of the start position, uniform [rad]."""
    home, lower, upper = (
        torch.tensor([getattr(j, name) for j in joints]) for name in ("home", "lower", "upper")
    )
    offset = (2.0 * torch.rand(num_frames, len(joints), generator=generator) - 1.0) * torch.tensor(spread)
    return torch.minimum(torch.maximum(home + offset, lower), upper)


def _path(
    throw: Throw, time: Float[Tensor, "num_frames num_times 1"]
) -> Float[Tensor, "num_frames num_times 3"]:
    """Positions [m] on the ballistic path at these times after the release [s]."""
    fall = torch.tensor([0.0, 0.0, -0.5 * GRAVITY]) * time**2
    return throw.pos[:, None] + throw.lin_vel[:, None] * time + fall


def _palm_target(arm: Float[Tensor, "num_frames 6"]) -> Float[Tensor, "num_frames 3"]:
    """Where a held object's centre is, in front of the palm [m]."""
    pos, quat = first_chain(UR5E_ALLEGRO, torch.float32).pose(arm)
    w, x, y, z = quat.unbind(-1)
    normal = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], dim=-1)
    return pos + HELD_DISTANCE * normal


def _reach(
    throw: Throw, flight_time: Float[Tensor, "num_frames 1"], generator: torch.Generator
) -> tuple[Float[Tensor, "num_frames 6"], Float[Tensor, "num_frames 1"]]:
    """Choose the arm position nearest to the path [rad], and when the object is there [s]."""
    num_frames = len(flight_time)
    arms = _near_home(ARM.joints, REACH, num_frames * NUM_REACHES, generator)
    targets = _palm_target(arms).view(num_frames, NUM_REACHES, 3)
    times = flight_time * torch.linspace(0.7, 1.2, NUM_INSTANTS)
    distance = torch.cdist(targets, _path(throw, times[:, :, None]))
    best = distance.flatten(1).argmin(-1)
    rows = torch.arange(num_frames)
    arm = arms.view(num_frames, NUM_REACHES, 6)[rows, best // NUM_INSTANTS]
    return arm, times[rows, best % NUM_INSTANTS][:, None]


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
    directions = points - camera_center(RGB_CAMERA, points)
    hit = simulation.ray(camera_center(RGB_CAMERA, points), directions, OCCLUDER_GROUPS)
    simulation.close()
    return points, is_unoccluded(hit)


def _masks(
    model: mujoco.MjModel, qpos: Float[Tensor, "num_frames nq"], view: Viewpoint
) -> Bool[Tensor, "num_frames height width"]:
    """Render the object's masks."""
    with Renderer(model, view, shadows=False) as renderer:
        return torch.from_numpy(np.stack([renderer.object_mask(row) for row in qpos.double().numpy()]))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=90, help="frames per object")
    frames = {name: sample_frames(parser.parse_args().frames, i) for i, name in enumerate(OBJECTS)}
    print("worst edge [px], computed against rendered box")
    for num_points in POINT_COUNTS:
        every = BoxErrors.concatenate([compare(name, qpos, num_points) for name, qpos in frames.items()])
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
    main()
