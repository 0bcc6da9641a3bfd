"""Who says which thing is the object, and how soon."""

from itertools import islice

import numpy as np
import painted
import pytest
from painted import HEIGHT, NUM_EMPTY, RED, WIDTH, Disc

from pixel2catch.perception.color import ColorRange
from pixel2catch.perception.foreground import LEARNING_IMAGES, Foreground
from pixel2catch.perception.prompt import Prompter
from pixel2catch.perception.segmenter import BoxPrompt, PointPrompt, Prompt

BLANK = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
REDS = ColorRange(hue=(340.0, 20.0))
NUM_STILL, NUM_FLYING = 0, 20
BALL = Disc(path=painted.thrown(NUM_STILL, NUM_FLYING), radius=9.0)


def first_prompt(
    prompter: Prompter, discs: tuple[Disc, ...], ignored: Disc | None = None, first: int = 0
) -> tuple[int, Prompt] | None:
    """Step and answer of the first answer in a stream from a first step on."""
    foreground, num_steps = Foreground(), len(discs[0].path)
    for step, image in islice(enumerate(painted.images(discs, num_steps)), first, None):
        motion = foreground.step(image, None if ignored is None else ignored.mask(step))
        prompt = prompter.look(image, motion)
        if prompt is not None:
            return step, prompt
    return None


def test_a_given_prompt_is_given_once_in_every_throw():
    click = PointPrompt(center=(3.0, 4.0))
    prompter = Prompter(click)
    assert [prompter.look(BLANK) for _ in range(3)] == [click, None, None]
    prompter.reset()
    assert prompter.look(BLANK) == click


def test_a_click_in_the_middle_of_a_stream_is_for_the_next_image():
    click = PointPrompt(center=(3.0, 4.0))
    prompter = Prompter()
    assert prompter.look(BLANK) is None
    prompter.give(click)
    assert [prompter.look(BLANK) for _ in range(2)] == [click, None]
    prompter.give(click)
    prompter.reset()
    assert prompter.look(BLANK) is None


def test_the_largest_thing_of_a_colour_is_prompted_with_its_box():
    image = BLANK.copy()
    image[10:20, 30:50] = RED
    image[100:105, 200:205] = RED
    assert Prompter(colors=REDS).look(image) == BoxPrompt(box=(30.0, 10.0, 50.0, 20.0))


def test_a_region_of_interest_leaves_the_rest_out():
    image = BLANK.copy()
    image[10:20, 30:50] = RED
    image[100:105, 200:205] = RED
    region = (190.0, 90.0, 220.0, 120.0)
    assert Prompter(colors=REDS, region=region).look(image) == BoxPrompt(box=(200.0, 100.0, 205.0, 105.0))
    assert Prompter(colors=REDS, region=(0.0, 150.0, 300.0, 240.0)).look(image) is None


def test_a_red_wall_is_no_object():
    assert Prompter(colors=REDS).look(np.full((HEIGHT, WIDTH, 3), RED, dtype=np.uint8)) is None


def test_a_flight_is_found_in_its_third_image():
    answer = first_prompt(Prompter(), (BALL,))
    assert answer is not None
    step, prompt = answer
    assert step == NUM_EMPTY + 2
    assert isinstance(prompt, BoxPrompt)
    assert np.abs(np.array(prompt.box) - painted.box_of(BALL.mask(step))).max() <= 2


def test_flights_are_found_once_the_background_was_seen_for_a_second():
    first = NUM_EMPTY + 10 - LEARNING_IMAGES
    answer = first_prompt(Prompter(), (BALL,), first=first)
    assert answer is not None
    assert answer[0] + 1 - first == LEARNING_IMAGES + 2


def swinging(num_steps: int, amplitude: float, radius: float) -> Disc:
    times = np.arange(num_steps)[:, None]
    path = (160.0, 120.0) + amplitude * np.sin(times * (0.9, 1.1))
    path[:NUM_EMPTY] = -100.0
    return Disc(path=path, radius=radius)


@pytest.mark.parametrize(
    ("amplitude", "radius"),
    [(60.0, 55.0), (5.0, 9.0), (30.0, 10.0)],
    ids=["an arm", "something slow", "something that turns back"],
)
def test_what_does_not_fly_is_not_found(amplitude: float, radius: float):
    assert first_prompt(Prompter(), (swinging(NUM_EMPTY + 20, amplitude, radius),)) is None


def test_the_robots_own_motion_is_not_found():
    assert first_prompt(Prompter(), (BALL,), ignored=BALL) is None


def test_what_a_person_gave_is_preferred_to_the_colour():
    click = PointPrompt(center=(3.0, 4.0))
    both = Prompter(click, colors=REDS)
    image = BLANK.copy()
    image[10:20, 30:50] = RED
    box = BoxPrompt(box=(30.0, 10.0, 50.0, 20.0))
    assert [both.look(image), both.look(image)] == [click, box]
    both.reset()
    assert both.look(image) == click
