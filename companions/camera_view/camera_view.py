"""Which throws a camera sees, and how well: shares of flights in view, sizes, and times."""

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib
import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor
from torch.autograd.functional import jacobian

import pixel2catch as p2c
from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.camera.pinhole import is_in_view, project
from pixel2catch.checks import CAMERA_NAMES, InputFile, OutputFile
from pixel2catch.envs.tasks import PEOPLE_THROWS
from pixel2catch.evaluation.figures import STYLE, png
from pixel2catch.mdp.throws import ThrowCfg, flight_time, sample_paths, sample_throws
from pixel2catch.scene.constants import CONTROL_DT, GRAVITY, CameraSpec

NUM_THROWS = 500  #: Drawn throws of a row of the table. Source: ours.
SEEN_FOR = 0.4  #: Time after the release at which an estimate is judged [s]. Source: ours, half a flight.
NUM_HELD = 10  #: Images before the release that count. Source: ours.
NUM_JUDGED = 100  #: Throws over which uncertainties are averaged. Source: ours.
BOX_ERRORS = (5.0, 1.0)  #: Largest errors of a box's edges [px]. Source: paper; tracked boxes.
DISTANCES = np.linspace(1.0, 5.0, 17)  #: Distances of the release from the hand in the chart [m].
PEAKS = np.linspace(1.3, 3.1, 19)  #: Peak heights in the chart [m].
RELEASE_HEIGHT = 1.2  #: Release height in the chart [m]. Source: ours, of people between hip and chest.


@dataclass(frozen=True, kw_only=True)
class Sight:
    """How a camera sees throws without air; means over throws."""

    share: float  #: Share of the flight in view.
    whole: float  #: Share of the throws of which the whole flight is in view.
    catch: float  #: Share of the throws whose aim is in view, and so the hand.
    time: float  #: Time from the first sight in flight to the aim [s].
    release_size: float  #: Pixels per centimetre at the release [px/cm].
    catch_size: float  #: The same at the aim.


def sight(camera: CameraSpec, throws: ThrowCfg) -> Sight:
    """Return how a camera sees drawn throws; occlusion by the robot is left out."""
    paths = sample_paths(throws, NUM_THROWS)
    duration = sample_throws(throws, NUM_THROWS, torch.Generator().manual_seed(0)).flight_time()
    is_seen, depth = _seen(camera, paths)
    first = is_seen.float().argmax(dim=1) / (paths.shape[1] - 1)
    is_any = is_seen.any(dim=1)
    size = 0.01 * camera.fx / depth
    return Sight(
        share=float(is_seen.float().mean()),
        whole=float(is_seen.all(dim=1).float().mean()),
        catch=float(is_seen[:, -1].float().mean()),
        time=float(torch.where(is_any, (1.0 - first) * duration, 0.0).mean()),
        release_size=float(size[:, 0].mean()),
        catch_size=float(size[:, -1].mean()),
    )


def uncertainty(camera: CameraSpec, throws: ThrowCfg, error: float) -> tuple[float, float]:
    """Return how uncertain the place of the fall through the catch height is, along and across the view [m].

    These are deviations, after `SEEN_FOR`, of the best estimate from the centres of boxes at 30 Hz, whose
    edges have uniform errors up to `error` [px]. The estimate has the covariance of drawn throws as its prior
    and is linear about each throw. Air and sizes of boxes do not count.
    """
    drawn = sample_throws(throws, NUM_THROWS, torch.Generator().manual_seed(0))
    start = torch.cat((drawn.pos, drawn.lin_vel), dim=1).double()
    time = torch.arange(-NUM_HELD, round(SEEN_FOR / CONTROL_DT) + 1).clamp(min=0)[:, None] * CONTROL_DT
    fall = torch.tensor((0.0, 0.0, -0.5 * GRAVITY))

    def centers(throw: Tensor) -> Tensor:
        return project(camera, (throw[:3] + throw[3:] * time + fall * time**2)[None])[0][0].flatten()

    def place(throw: Tensor, height: Tensor) -> Tensor:
        return throw[:2] + throw[3:5] * flight_time(throw[None, 3:], (height - throw[2])[None])

    weight = 6.0 / error**2  # the centre is the mean of two edges, each with a variance of error² / 3
    prior, total = torch.linalg.inv(torch.cov(start.T)), torch.zeros(2).double()
    for throw, aim in zip(start[:NUM_JUDGED], drawn.aim, strict=False):
        views, lands = jacobian(centers, throw), jacobian(lambda each, h=aim[2]: place(each, h), throw)
        left = lands @ torch.linalg.inv(prior + weight * views.T @ views) @ lands.T
        along = torch.nn.functional.normalize(place(throw, aim[2]) - torch.tensor(camera.pos[:2]), dim=0)
        axes = torch.stack((along, along.flip(0) * torch.tensor((-1.0, 1.0))))
        total += (axes @ left @ axes.T).diagonal() / NUM_JUDGED
    along, across = total.sqrt().tolist()
    return along, across


def _seen(camera: CameraSpec, paths: Float[Tensor, "num_throws num_points 3"]) -> tuple[Tensor, Tensor]:
    pixels, depth = project(camera, paths)
    return is_in_view(camera, pixels, depth), depth


def chart(camera: CameraSpec) -> bytes:
    """Draw the share of the flight in view by distance and peak height, as a PNG file."""
    middle = ThrowCfg()
    aim = (sum(middle.aim_x) / 2.0, sum(middle.aim_z) / 2.0)
    paths = torch.cat([sample_paths(_throw(d, p, aim), 1) for p in PEAKS for d in DISTANCES])
    share = _seen(camera, paths)[0].float().mean(dim=1).view(len(PEAKS), len(DISTANCES))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 4.4), layout="constrained")
        axes = figure.subplots()
        shown = axes.contourf(
            DISTANCES, PEAKS, 100.0 * share.numpy(), levels=np.arange(0, 101, 10), cmap="viridis"
        )
        figure.colorbar(shown, label="share of the flight in view [%]")
        axes.set(xlabel="distance of the thrower from the hand [m]", ylabel="highest point of the throw [m]")
        return png(figure)


def _throw(distance: float, peak: float, aim: tuple[float, float]) -> ThrowCfg:
    """Return one throw, to the middle of the catch volume."""
    x, z = aim
    fixed = {"release_x": x + distance, "release_y": 0.0, "release_z": RELEASE_HEIGHT}
    fixed |= {"aim_x": x, "aim_y": 0.0, "aim_z": z, "peak_z": peak}
    return replace(ThrowCfg(), clearance=0.05, **{name: (value, value) for name, value in fixed.items()})


def main(words: list[str] | None = None) -> None:
    """Print how a camera sees the paper's throws and those of people, and draw the chart."""
    parser = argparse.ArgumentParser(description="Show which throws a camera sees.")
    parser.add_argument("camera", type=Path, help="file of `calibrate`, or release, or people")
    parser.add_argument("file", type=Path, help="picture to write, FILE.png")
    args = parser.parse_args(words)
    try:
        InputFile(CAMERA_NAMES).require("camera", args.camera)
        OutputFile((".png",)).require("file", args.file)
        camera = CameraFile.load(args.camera).camera
    except p2c.Pixel2CatchError as error:
        sys.exit(f"error: {error}")
    for name, throws in (("the paper's throws", ThrowCfg()), ("throws of people", PEOPLE_THROWS)):
        found = sight(camera, throws)
        print(
            f"{name}: {found.share:.0%} of a flight is in view, all of it in {found.whole:.0%} of the "
            f"throws, the catch in {found.catch:.0%}; {found.time:.2f} s from first sight to catch; "
            f"{found.release_size:.1f} px/cm at the release, {found.catch_size:.1f} at the catch"
        )
        for error in BOX_ERRORS:
            along, across = uncertainty(camera, throws, error)
            print(
                f"  boxes {error:g} px off, {SEEN_FOR} s after the release: the place of the fall is known "
                f"to {100 * along:.0f} cm along the view, {100 * across:.0f} cm across"
            )
    args.file.write_bytes(chart(camera))
    print(f"wrote {args.file}")


if __name__ == "__main__":
    main()
