"""Named tasks: what is thrown at a robot in training, and what disturbs it there."""

from dataclasses import replace
from math import radians

from pixel2catch.envs.cfg import CatchEnvCfg, TaskVariant
from pixel2catch.errors import UnknownNameError
from pixel2catch.mdp.dynamics_file import GainRanges
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.scene.objects import SIZES

GAINS = ((0.7, 1.3),)
"""Factors on stiffness and damping of every joint. Source: stress suite, wrists identified from slow motion.
"""

LATE_ROBOT = RandomizationCfg(
    gains=GainRanges(stiffness_scale=GAINS, damping_scale=GAINS),
    mass_scale=(0.45, 2.1),
    restitution=(0.0, 0.6),
    command_delay=(0.0, 1.2),
    command_delay_grid=0.0,
    air_density=(0.0, 1.5),
)
"""A robot that is not the identified one, behind a network: commands up to 40 ms late. Objects of 13 to 63 g
(foam to tennis balls), hard ones too; air with up to a quarter more drag than a mean face has."""

OUTSIDE_CAMERA = SensingCfg(
    latency_steps=(0.6, 4.3),
    latency_grid=0.0,
    camera_offset=(0.0, 0.025),
    camera_turn=(0.0, radians(1.25)),
    focal_error=(0.0, 0.03),
    box_bias=(0.0, 6.0),
    noise_scale=(0.0, 1.0),
    drop_rate=(0.0, 0.2),
    blackout_steps=(0.0, 3.4),
    image_period=(1.0, 2.6),
    clock_error=(0.0, 0.02),
    stamp_jitter=(0.0, 0.004),
    unstamped=0.05,
)
"""A camera and a detector that were set up with care, and images 20 to 143 ms old, of which that is known to
20 ms: the sources of the stress suite's axes, without its highest levels. Perception that takes up to 85 ms
looks at one image in 1 to 2.6. Boxes are exact to 5 px, or, as the tracker's, to less. Source: rehearsals in
step."""

GOOD_CAMERA = SensingCfg(latency_steps=(0.8, 2.0), latency_grid=0.0, noise_scale=(0.0, 1.0))
"""The sight of the paper's task, and better: images from 0.8 control steps on at the decision, and boxes
that are up to 5 px off in one episode, exact in another. Source: rehearsals in step, 0.9 and 1 px."""

HELD_STEPS = (5, 75)
"""Control steps for which people hold what they throw. Source: ours, 2.5 s: a policy that never waited for
more than 19 steps drifts away where boxes are noisy, and after 60 misses one object in nine."""

PRACTISED_THROWS = replace(ThrowCfg(), spin=14.0, hover_steps=HELD_STEPS)
"""Throws of training, with spin, after a longer wait."""

HUMAN_THROWS = ThrowCfg(
    release_x=(1.9, 3.1),
    release_y=(-0.45, 0.45),
    release_z=(0.75, 1.35),
    peak_z=(1.4, 2.05),
    speed_deviation=(0.0, 0.06),
    angle_deviation=(0.0, radians(3.0)),
    spin=14.0,
    hover_steps=HELD_STEPS,
)
"""Throws of people: nearer, farther, wider, higher and lower, with the scatter of the stress suite."""

AIR = RandomizationCfg(air_density=(0.0, 1.5))  #: The robot of the paper's task, in air.

WIDE = replace(
    CatchEnvCfg(),
    name="wide",
    value_sees_parameters=True,
    episode=EpisodeCfg(max_steps=EpisodeCfg().max_steps + HELD_STEPS[1] - ThrowCfg().hover_steps[1]),
    variants=(
        TaskVariant(share=0.25, throws=PRACTISED_THROWS, randomization=LATE_ROBOT, sensing=OUTSIDE_CAMERA),
        TaskVariant(share=0.2, throws=HUMAN_THROWS, randomization=LATE_ROBOT, sensing=OUTSIDE_CAMERA),
        TaskVariant(share=0.2, throws=HUMAN_THROWS, randomization=AIR, sensing=GOOD_CAMERA),
        TaskVariant(share=0.1, throws=PRACTISED_THROWS, randomization=LATE_ROBOT, sensing=GOOD_CAMERA),
    ),
)
"""The world outside in three of four episodes, in part with good sight; the paper's task in the fourth, so
that nothing is lost there."""

WIDE_SHARP = replace(WIDE.with_sensing(corner_noise=2.0), name="wide_sharp")
"""The same with boxes as exact as the detectors find them. Source: perception on rendered video, 2 px."""

SIDEWAYS = replace(ThrowCfg(), aim_y=(-0.55, 0.55))
"""Throws to the middle and to either side. Source: ours: 10 cm past the base of each of two robots."""

SIZES_TASK = CatchEnvCfg(
    name="sizes",
    objects=SIZES,
    throws=SIDEWAYS,
    randomization=RandomizationCfg(mass_scale=(0.7, 1.4)),
    value_sees_parameters=True,
)
"""Balls and boxes of 6 to 28 cm and 21 to 392 g, thrown to the middle and to either side."""

TASKS = {task.name: task for task in (CatchEnvCfg(), WIDE, WIDE_SHARP, SIZES_TASK)}


def find_task(name: str) -> CatchEnvCfg:
    """The task of that name.

    Raises:
        UnknownNameError: With the valid names.
    """
    if name not in TASKS:
        raise UnknownNameError("task", name, TASKS)
    return TASKS[name]
