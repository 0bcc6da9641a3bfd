"""How methods to follow an object stand faults, one at a time, with exact truth: a table by fault and method.

Throws are painted into images of rendered rooms, or of videos that show only a room. The last row is what an
image takes of one core.

nice python benchmarks/perception_on_composites.py --out composites.json
python benchmarks/perception_on_composites.py --backgrounds room.mp4 --faults "plain,shake 2 px" --throws 4
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from composites import (
    WIDTH,
    Fault,
    Film,
    Flight,
    Thing,
    dropped,
    exposure_step,
    film,
    flicker,
    h264,
    jpeg,
    noisy,
    shake,
)
from peers import Results, methods, parser_of

from pixel2catch.camera.image import Image, Pixels
from pixel2catch.perception.sources import ImageFit, video_images
from pixel2catch.rendering.camera import CameraCfg, Exposure, Moment, RoomCamera
from pixel2catch.rendering.room import Bystanders
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.workcells import find_workcell

NUM_EMPTY, FEW = 40, 6  #: Images of the room before the object; how many are few.
RELEASE = (2.6, 0.1, 0.8)  #: Where the thrower in a rendered room holds nothing [m].
NUM_BACKGROUNDS = 100  #: Images of a video of a room that are used.

RED = Thing(colors=((205, 40, 45),))
GREY, WHITE = Thing(colors=((150, 148, 145),)), Thing(colors=((236, 236, 232),))
TUMBLING = Thing(colors=((200, 60, 50), (60, 90, 180), (225, 205, 80), (230, 230, 230)), is_box=True)
FAINT = Thing(colors=((0, 0, 0),), contrast=14.0)
BEFORE_A_WALL = replace(GREY, shadow=(26.0, 16.0))  # its shadow touches it
BLURRED = replace(GREY, exposure=0.6)


@dataclass(frozen=True, kw_only=True)
class Case:
    """What is thrown how, and what is wrong with the images."""

    thing: Thing = RED
    fault: Fault | None = None
    num_empty: int = NUM_EMPTY
    change: Callable[[Flight], Flight] = field(default=lambda flight: flight)
    others: Callable[[Flight], tuple[Flight, ...]] = field(default=lambda _: ())
    period: float = 1.0  #: Of the images [control steps].


def tossed(flight: Flight) -> Flight:
    """A flight that leaves the image at the top for about half a second, and comes back."""
    start, velocity = (flight.start[0], 190.0), (0.5 * flight.velocity[0], -15.5)
    return replace(flight, start=start, velocity=velocity, num_flying=60)


def crossing(flight: Flight) -> tuple[Flight, ...]:
    """Another flight from the other side, that crosses this one."""
    start = (WIDTH - flight.start[0], flight.start[1] + 20.0)
    return (replace(flight, start=start, velocity=(-flight.velocity[0], flight.velocity[1])),)


def bouncing(flight: Flight, *, kept: tuple[float, float] = (0.8, -0.7)) -> Flight:
    """A flight that falls on the floor, or that a wall stops."""
    velocity, time = (flight.velocity[0], -13.0), 21.0 if kept[1] < 0.0 else 11.0
    return replace(flight, velocity=velocity, gravity=1.5, bounce=time, kept=kept, num_held=5, num_flying=34)


def fast(flight: Flight, speed: float = 45.0) -> Flight:
    """A flight with this motion across in a control step [px]."""
    side = np.sign(flight.velocity[0])
    start, velocity = (320.0 - 290.0 * side, 300.0), (speed * side, -0.35 * speed)
    return replace(flight, start=start, velocity=velocity, gravity=2.0, num_held=6, num_flying=15)


def close(flight: Flight) -> Flight:
    """A flight of something that is 80 px wide, and becomes 110 px wide."""
    side = np.sign(flight.velocity[0])
    start, velocity = (320.0 - 220.0 * side, 300.0), (24.0 * side, -17.0)
    return replace(flight, start=start, velocity=velocity, sizes=(40.0, 55.0), gravity=1.6, num_flying=18)


def twins(flight: Flight) -> tuple[Flight, ...]:
    """Two of the same that are put beside the path before the throw, and lie still."""
    places = [(flight.at(time)[0], flight.at(time)[1] + 34.0 * side) for time, side in ((6.0, 1), (15.0, -1))]
    sizes = flight.sizes[0], flight.sizes[0]
    still = replace(flight, velocity=(0.0, 0.0), gravity=0.0, sizes=sizes, begin=-3.5)
    return tuple(replace(still, start=place) for place in places)


CASES: dict[str, Case] = {
    "plain": Case(),
    "grey on grey": Case(thing=GREY),
    "white": Case(thing=WHITE),
    "tumbling, many colours": Case(thing=TUMBLING),
    "low contrast": Case(thing=FAINT),
    "flicker 6 %": Case(fault=flicker),
    "exposure step 15 %": Case(fault=exposure_step),
    "JPEG 30": Case(fault=jpeg),
    "shake 2 px": Case(fault=shake),
    "two fly": Case(others=crossing),
    "held 1.2 s": Case(thing=GREY, change=lambda flight: replace(flight, num_held=36)),
    "leaves and comes back": Case(change=tossed),
    "few background images": Case(num_empty=FEW),
    "grey, flicker 6 %": Case(thing=GREY, fault=flicker),
    "grey, shake 2 px": Case(thing=GREY, fault=shake),
    "tumbling, shake 2 px": Case(thing=TUMBLING, fault=shake),
    "tumbling, few background images": Case(thing=TUMBLING, num_empty=FEW),
    "bounces on the floor": Case(change=bouncing),
    "grey, bounces on the floor": Case(thing=GREY, change=bouncing),
    "tumbling, a wall stops it": Case(thing=TUMBLING, change=partial(bouncing, kept=(-0.5, 0.9))),
    "15 Hz": Case(period=2.0),
    "15 Hz, fast, white": Case(thing=WHITE, change=fast, period=2.0),
    "white, dropped images": Case(thing=WHITE, change=partial(fast, speed=30.0), fault=dropped),
    "80 to 110 px, blurred": Case(thing=BLURRED, change=close),
    "80 to 110 px, red, few images": Case(thing=replace(RED, exposure=0.6), change=close, num_empty=FEW),
    "shadow beside it": Case(thing=BEFORE_A_WALL),
    "red, shadow beside it": Case(thing=replace(RED, shadow=(26.0, 16.0))),
    "like ones lie still": Case(thing=WHITE, others=twins),
    "H.264 crf 42": Case(thing=WHITE, fault=h264),
    "grey, H.264 crf 42": Case(thing=GREY, fault=h264),
    "JPEG 10": Case(fault=partial(jpeg, quality=10)),
}


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--throws", type=int, default=6, help="of every case")
    parser.add_argument(
        "--backgrounds", type=Path, nargs="*", default=[], help="videos of rooms without objects"
    )
    parser.add_argument("--faults", default="", help="some of the table's rows, by commas")
    options = parser.parse_args()
    results = Results(options.methods)
    for throw in range(options.throws):
        rng = np.random.default_rng([options.seed, throw])
        room, flight = backgrounds(options.backgrounds, throw, rng), drawn(rng)
        for name in options.faults.split(",") if options.faults else CASES:
            case = CASES[name]
            shown = made(case, room, flight, np.random.default_rng([options.seed, throw, 1]))
            hue = (350.0, 16.0) if case.thing is RED else None
            pairs = zip(shown.images, shown.times, strict=True)
            images = [Image(pixels=each, stamp=time * CONTROL_DT) for each, time in pairs]
            results.add(name, images, shown.truths, methods(hue), throw)
        print(f"throw {throw} of {options.throws}", flush=True)
    results.report(options.out)


def made(case: Case, room: list[Pixels], flight: Flight, rng: np.random.Generator) -> Film:
    """The images of a case."""
    changed = case.change(flight)
    others = case.others(changed)
    shown = film(room, case.thing, changed, case.num_empty, *others, period=case.period)
    if len(room) == 1:  # one that was drawn has no noise
        shown = replace(shown, images=tuple(noisy(image, rng) for image in shown.images))
    return case.fault(shown, rng) if case.fault else shown


def drawn(rng: np.random.Generator) -> Flight:
    """A flight from one side of the image towards the other, and nearer."""
    side = 1.0 if rng.uniform() < 0.5 else -1.0
    start = (320.0 - side * float(rng.uniform(160, 230)), float(rng.uniform(170, 230)))
    velocity = (side * float(rng.uniform(9, 15)), float(rng.uniform(-9, -5)))
    radius = float(rng.uniform(8, 12))
    return Flight(start=start, velocity=velocity, sizes=(radius, radius * float(rng.uniform(1.4, 2.2))))


def backgrounds(paths: list[Path], throw: int, rng: np.random.Generator) -> list[Pixels]:
    """Images of a room without an object: one that is drawn, or those of one of the videos."""
    if not paths:
        scene, people = SceneCfg(), Bystanders(release_pos=np.array(RELEASE), phase=0.3)
        model, joints = build_model(scene), find_workcell(scene.workcell).joints
        qpos = model.qpos0.copy()
        qpos[: len(joints)] = [joint.home for joint in joints]
        moment = Moment(qpos=qpos, qvel=np.zeros(model.nv), time=0.0)
        empty = Exposure(moment=moment, object_name=None, thrower=people.joint_pos)
        camera_cfg = replace(CameraCfg(), read_noise=0.0, shot_noise=0.0)
        with RoomCamera(scene, throw, camera_cfg, room=int(rng.integers(1000)), shadows=True) as camera:
            return [camera.image(empty)]
    frames = islice(video_images(paths[throw % len(paths)], []), NUM_BACKGROUNDS)
    images = [frame.pixels for frame in frames]
    fit = ImageFit(own=(images[0].shape[1], images[0].shape[0]))
    return [fit.image(image) for image in images]


if __name__ == "__main__":
    main()
