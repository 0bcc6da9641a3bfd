"""Print how well surface points replace a renderer: errors of the box, number of points, least visible share.

python benchmarks/box_error.py --frames 90
"""

import argparse

import torch

from pixel2catch.evaluation.box_error import BoxErrors, compare, sample_frames
from pixel2catch.robot.objects import OBJECTS

NUM_POINTS = 64
POINT_COUNTS = (64, 96, 128, 256)
SHARES = (0.001, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3)
LEAST_PIXELS = (1, 20, 40)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=90, help="frames per object")
    frames = parser.parse_args().frames
    print_errors({name: compare_one(name, frames, NUM_POINTS) for name in OBJECTS})
    print_point_counts(frames)


def compare_one(name: str, frames: int, num_points: int) -> BoxErrors:
    """The same frames at every number of points."""
    return compare(name, sample_frames(frames, seed=list(OBJECTS).index(name)), num_points)


def print_errors(errors: dict[str, BoxErrors]) -> None:
    print(f"Worst edge [px], computed ({NUM_POINTS} points) against rendered box")
    print(f"{'object':<18}{'unoccluded':>36}{'occluded':>36}")
    for name, each in [*errors.items(), ("all", BoxErrors.concatenate(list(errors.values())))]:
        print(f"{name:<18}{summary(free(each)):>36}{summary(hidden(each)):>36}")
    everything = BoxErrors.concatenate(list(errors.values()))
    cut = everything.select(~everything.is_hit & everything.is_cut & (everything.num_pixels > 0))
    print(f"cut by the image edge, not occluded: {summary(cut)}")
    print_shares(everything.select(everything.is_hit))


def print_shares(hit: BoxErrors) -> None:
    """Print how often a threshold on the share disagrees with a detector that needs so many pixels."""
    print(f"\nLeast visible share of the points, {len(hit.error)} frames in which a ray is stopped")
    print(f"{'share':>6}" + "".join(f"{f'>= {pixels} px: missed, ghosts':>28}" for pixels in LEAST_PIXELS))
    for share in SHARES:
        is_seen = hit.visible_fraction >= share
        columns = []
        for pixels in LEAST_PIXELS:
            is_rendered = hit.num_pixels >= pixels
            missed, ghosts = (is_rendered & ~is_seen).float().mean(), (~is_rendered & is_seen).float().mean()
            columns.append(f"{f'{missed:.1%}, {ghosts:.1%}':>28}")
        print(f"{share:>6}" + "".join(columns))


def print_point_counts(frames: int) -> None:
    names = ("cube_l", "sphere_s", "cone_l", "capsule_l", "cross")
    print(f"\nNumber of points, objects {', '.join(names)}")
    for count in POINT_COUNTS:
        errors = BoxErrors.concatenate([compare_one(name, frames, count) for name in names])
        print(f"{count:>6}   unoccluded {summary(free(errors))}   occluded {summary(hidden(errors))}")


def free(errors: BoxErrors) -> BoxErrors:
    return errors.select(~errors.is_hit & ~errors.is_cut)


def hidden(errors: BoxErrors) -> BoxErrors:
    return errors.select(errors.is_hit & (errors.num_pixels > 0) & (errors.visible_fraction > 0))


def summary(errors: BoxErrors) -> str:
    if not len(errors.error):
        return "none"
    worst = errors.worst_edge
    quantiles = torch.quantile(worst, torch.tensor([0.5, 0.9], dtype=worst.dtype))
    return f"n {len(worst):>4}  {quantiles[0]:.2f}  p90 {quantiles[1]:.2f}  max {worst.max():.2f}"


if __name__ == "__main__":
    main()
