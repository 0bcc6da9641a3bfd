"""Print how well a network can tell from the last boxes where a thrown object will come down.

python benchmarks/sight_information.py --features frames fit_boxes --steps 300 1200

No physics engine: a ball of 6 cm on its path, seen late, with noise, bias, missing boxes and wrong stamps by
a camera that is a little off. Every set of features feeds the same network; root mean squares of the error of
the crossing point with z = 1 m [cm], at four times before the crossing, for three distributions of throws.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from math import radians, tau

import torch
from torch import Tensor

from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.evaluation.stress.suite import HUMAN
from pixel2catch.mdp.observations import fit_boxes
from pixel2catch.mdp.throws import ThrowCfg, random_directions, sample_throws
from pixel2catch.scene.constants import GRAVITY, RGB_CAMERA

STEP, FINE, GRID = 1 / 30, 1 / 60, 100  # the paths are integrated with FINE s, then interpolated
NUM_IMAGES, NUM_BOXES = 34, 24
MOMENTS = (0.35, 0.25, 0.15, 0.08)
WIDE = ThrowCfg(
    release_x=(1.9, 3.1),
    release_y=(-0.45, 0.45),
    release_z=(0.75, 1.35),
    aim_x=(0.6, 0.9),
    aim_y=(-0.4, 0.4),
    peak_z=(1.45, 2.05),
)
PRACTISED = HUMAN(CatchEnvCfg()).throws
DISTRIBUTIONS: dict[str, Callable[[torch.Generator], tuple[ThrowCfg, ...]]] = {
    "nominal": lambda generator: (ThrowCfg(),),
    "wide": lambda generator: tuple(
        replace(WIDE, speed_deviation=0.06 * speed, angle_deviation=radians(3.0) * angle)
        for speed, angle in torch.rand(8, 2, generator=generator).tolist()
    ),
    "practised": lambda generator: (PRACTISED,),
}
Samples = tuple[Tensor, Tensor, Tensor, Tensor]
"""Boxes and ages, newest first; the last three delivered boxes; crossing point [m] and time to it [s]."""


def fly(name: str, number: int, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Paths: positions and velocities on a grid of time, steps of hovering, time and place of crossing."""
    cfgs = DISTRIBUTIONS[name](generator)
    throws = [sample_throws(cfg, number // len(cfgs), generator) for cfg in cfgs]
    pos, vel = torch.cat([t.pos for t in throws]), torch.cat([t.lin_vel for t in throws])
    hover = torch.cat([t.hover_steps for t in throws]).float()
    drag = torch.zeros(len(pos), 1)
    if name == "wide":
        light = torch.rand(len(pos), 1, generator=generator) < 0.5
        mass = 0.013 + 0.047 * torch.rand(len(pos), 1, generator=generator)
        drag = light * 0.5 * 1.2 * 0.0016 / mass
    gravity = torch.tensor([0.0, 0.0, -GRAVITY])
    places, speeds = [pos], [vel]
    for _ in range(GRID - 1):
        middle = vel + 0.5 * FINE * (gravity - drag * vel.norm(dim=-1, keepdim=True) * vel)
        pos = pos + FINE * middle
        vel = vel + FINE * (gravity - drag * middle.norm(dim=-1, keepdim=True) * middle)
        places.append(pos)
        speeds.append(vel)
    path, speed = torch.stack(places, 1), torch.stack(speeds, 1)
    falls = (path[:, :-1, 2] >= 1.0) & (path[:, 1:, 2] < 1.0)
    index, rows = falls.float().argmax(1), torch.arange(len(path))
    above, below = path[rows, index], path[rows, index + 1]
    share = (above[:, 2] - 1.0) / (above[:, 2] - below[:, 2])
    time, cross = (index + share) * FINE, (above + share[:, None] * (below - above))[:, :2]
    is_throw = falls.any(1) & (path[..., 2].amax(1) > 1.15) & (time > 0.45)
    is_throw &= (cross[:, 0] - 0.7).abs() < 0.9
    return tuple(value[is_throw] for value in (path, speed, hover, time, cross))


def interpolate(path: Tensor, speed: Tensor, time: Tensor) -> Tensor:
    """Positions at these times [s]; at the release before it."""
    place = (time / FINE).clamp(0.0, GRID - 2.0)
    index = place.floor().long()[..., None].expand(-1, -1, 3)
    s = (place - place.floor())[..., None]
    a, b = path.gather(1, index), path.gather(1, index + 1)
    va, vb = FINE * speed.gather(1, index), FINE * speed.gather(1, index + 1)
    return a + (b - a) * s * s * (3 - 2 * s) + va * s * (1 - s) ** 2 - vb * s * s * (1 - s)


def see(
    flight: tuple[Tensor, ...], now: Tensor, noise: float, radius: list[float], generator: torch.Generator
) -> Samples:
    """What is known of each flight at a time since its release [s]."""
    path, speed, hover, end, cross = flight
    number, rows = len(path), torch.arange(len(path))

    def draw(*shape: int) -> Tensor:
        return torch.rand(number, *shape, generator=generator)

    age = 1.0 + 3.0 * draw(1) + torch.arange(float(NUM_IMAGES))  # latency of 1 to 4 steps
    exposed = now[:, None] - STEP * age
    is_before = exposed < -STEP * hover[:, None]
    points = interpolate(path, speed, exposed)
    camera = nominal_projection(RGB_CAMERA, points)
    camera = camera.turned(radians(0.5) * random_directions(number, generator))
    pixels, depth = camera.moved(0.01 * random_directions(number, generator)).pixels(points)
    size = torch.tensor([RGB_CAMERA.width, RGB_CAMERA.height], dtype=torch.float32)
    is_seen = ((pixels > 0) & (pixels < size)).all(-1) & (draw(NUM_IMAGES) >= 0.2 * draw(1))
    angle, length = tau * draw(1), 5.0 * draw(1)
    pixels = pixels + (length * torch.cat((angle.cos(), angle.sin()), -1))[:, None]
    half = (RGB_CAMERA.fx * (radius[0] + (radius[1] - radius[0]) * draw(1)) / depth)[..., None]
    edges = torch.cat((pixels - half, pixels + half), -1).clamp(min=0.0).minimum(size.repeat(2))
    edges = (edges + noise * (2.0 * draw(NUM_IMAGES, 4) - 1.0)).clamp(min=0.0).minimum(size.repeat(2))
    # An episode begins with copies of its first box.
    first = (~is_before).sum(1).clamp(min=1) - 1
    edges = torch.where(is_before[..., None], edges[rows, first][:, None], edges)
    is_seen = is_seen | is_before
    is_seen[rows, first] = True
    order = torch.sort((~is_seen).float(), dim=1, stable=True).indices[:, :NUM_BOXES]
    rank, last = torch.arange(NUM_BOXES), is_seen.sum(1)[:, None] - 1
    order = torch.where(rank <= last, order, order.gather(1, last.clamp(max=NUM_BOXES - 1)))
    stamp = 0.3 * (2.0 * draw(1) - 1.0) * (draw(1) < 1 / 3)
    boxes = edges.gather(1, order[..., None].expand(-1, -1, 4))
    ages = age.gather(1, order) + (rank - last).clamp(min=0) + stamp
    held = [(is_seen & (torch.arange(NUM_IMAGES) >= back)).float().argmax(1) for back in range(3)]
    delivered = torch.stack([edges[rows, index] for index in held], 1)
    return boxes, ages, delivered, torch.cat((cross, (end - now)[:, None]), -1)


def center_and_size(box: Tensor) -> Tensor:
    return torch.cat(((box[..., :2] + box[..., 2:]) / 2, box[..., 2:] - box[..., :2]), -1)


def frames(box: Tensor, age: Tensor, delivered: Tensor) -> Tensor:
    z = center_and_size(delivered)
    change = z[:, :-1] - z[:, 1:]
    return torch.cat((z[:, 0, :2], change[:, 0], z[:, 1, :2], change[:, 1]), -1)


def differences(box: Tensor, age: Tensor, delivered: Tensor) -> Tensor:
    z = center_and_size(box[:, :8])
    speed = (z[:, :1] - z[:, 1:]) / (age[:, 1:8] - age[:, :1])[..., None]
    return torch.cat((z[:, 0], speed.flatten(1), age[:, :8]), -1)


def window_fit(box: Tensor, age: Tensor, length: int) -> tuple[Tensor, Tensor]:
    """Least squares in the newest boxes with equal weights, at age 0; and the residual of the centre."""
    z, time = center_and_size(box[:, :length]), -age[:, :length] / 10
    center, size = z[..., :2] / 100, torch.log(z[..., 2:].sum(-1, keepdim=True).clamp(min=4.0))
    ahead = -time.mean(1)[:, None]
    basis = torch.stack([(time + ahead) ** power for power in range(3)], -1)
    normal = basis.mT @ basis + 1e-4 * torch.eye(3)
    curve = torch.linalg.solve(normal, basis.mT @ center)
    line = torch.linalg.solve(normal[:, :2, :2], basis[..., :2].mT @ size)
    zero, one = torch.zeros_like(ahead), torch.ones_like(ahead)
    now, speed = torch.stack((one, ahead, ahead**2), -1), torch.stack((zero, one, 2 * ahead), -1)
    center_now = torch.cat((now @ curve, speed @ curve), -1)[:, 0]
    size_now = torch.cat((now[..., :2] @ line, line[:, 1:]), -1)[:, 0]
    rest = (basis @ curve - center).square().sum((1, 2)).sqrt()
    return torch.cat((center_now, curve[:, 2], size_now), -1), rest[:, None]


FEATURES: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "frames": frames,
    "frames+age": lambda box, age, last: torch.cat((frames(box, age, last), age[:, :1]), -1),
    "raw8": lambda box, age, last: torch.cat((center_and_size(box[:, :8]).flatten(1), age[:, :8]), -1),
    "differences8": differences,
    **{f"fit{n}": lambda box, age, last, n=n: window_fit(box, age, n)[0] for n in (5, 8, 12)},
    "fit5+fit12": lambda box, age, last: torch.cat([window_fit(box, age, n)[0] for n in (5, 12)], -1),
    "fit8+age+rest": lambda box, age, last: torch.cat((*window_fit(box, age, 8), age[:, :1]), -1),
    "fit_boxes unscaled": lambda box, age, last: fit_boxes(box[:, :16], age[:, :16], RGB_CAMERA)[
        :, [*range(18), -1]
    ],
    "fit_boxes": lambda box, age, last: fit_boxes(box[:, :16], age[:, :16], RGB_CAMERA),
}


def learn(name: str, seen: Samples, tests: dict[tuple[str, float], Samples], steps: list[int]) -> None:
    """Train a network on all moments of flight, and print its errors after these numbers of steps."""
    torch.manual_seed(0)
    inputs = FEATURES[name](*seen[:3])
    mean, deviation = inputs.mean(0), inputs.std(0) + 1e-6
    middle, scale = seen[3].mean(0), seen[3].std(0)

    def read(samples: Samples) -> Tensor:
        return ((FEATURES[name](*samples[:3]) - mean) / deviation).clamp(-5.0, 5.0)

    inputs, targets = read(seen), (seen[3] - middle) / scale
    held_out = {key: (read(samples), samples[3]) for key, samples in tests.items()}

    def report(label: str, predict: Callable[[Tensor], Tensor]) -> None:
        with torch.no_grad():
            misses = [(predict(x) * scale + middle - y)[:, :2] for x, y in held_out.values()]
        errors = [100.0 * miss.square().sum(1).mean().sqrt().item() for miss in misses]
        groups = [errors[i : i + len(MOMENTS)] for i in range(0, len(errors), len(MOMENTS))]
        texts = [" ".join(f"{error:5.1f}" for error in group) for group in groups]
        print(f"| {name} | {label} | {' | '.join(texts)} | {sum(errors) / len(errors):.2f} |", flush=True)

    bias = torch.nn.functional.pad(inputs, (0, 1), value=1.0).double()
    ridge = torch.linalg.solve(bias.mT @ bias + 10 * torch.eye(bias.shape[1]), bias.mT @ targets.double())
    report("linear", lambda x: torch.nn.functional.pad(x, (0, 1), value=1.0) @ ridge.float())
    widths = (inputs.shape[1], 512, 256, 128)
    layers = [(torch.nn.Linear(a, b), torch.nn.ELU()) for a, b in pairwise(widths)]
    network = torch.nn.Sequential(*(layer for pair in layers for layer in pair), torch.nn.Linear(128, 3))
    optimizer = torch.optim.Adam(network.parameters(), 1e-3)
    decay = max(steps) - steps[0] + 1
    for step in range(1, max(steps) + 1):
        optimizer.param_groups[0]["lr"] = 1e-3 * min(1.0, 1.03 - (step - steps[0]) / decay)
        chosen = torch.randint(len(inputs), (4096,))
        optimizer.zero_grad()
        loss = (network(inputs[chosen]) - targets[chosen]).square().mean()
        loss.backward()
        optimizer.step()
        if step in steps:
            report(f"{step} steps", network)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--features", nargs="+", default=list(FEATURES), choices=list(FEATURES))
    parser.add_argument("--throws", type=int, default=60_000, help="per distribution, a sixth held out")
    parser.add_argument("--steps", type=int, nargs="+", default=[300, 1200], help="gradient steps, rising")
    parser.add_argument("--noise", type=float, default=5.0, help="largest error of an edge [px]")
    parser.add_argument("--radius", type=float, nargs=2, default=[0.03, 0.03], help="of the ball, range [m]")
    args = parser.parse_args()
    generator = torch.Generator().manual_seed(0)
    seen, tests = [], {}
    for name in DISTRIBUTIONS:
        flights = fly(name, args.throws * 5 // 6, generator)
        for _ in range(2):
            moment = torch.rand(len(flights[0]), generator=generator) * flights[3]
            seen.append(see(flights, moment, args.noise, args.radius, generator))
        flights = fly(name, args.throws // 6, generator)
        for moment in MOMENTS:
            tests[name, moment] = see(flights, flights[3] - moment, args.noise, args.radius, generator)
    boxes, ages, latest, crossing = (torch.cat(parts) for parts in zip(*seen, strict=True))
    print(f"| features | | {' | '.join(f'{name} {MOMENTS} s' for name in DISTRIBUTIONS)} | mean |")
    print("| --- " * 6 + "|")
    for name in args.features:
        learn(name, (boxes, ages, latest, crossing), tests, args.steps)


if __name__ == "__main__":
    main()
