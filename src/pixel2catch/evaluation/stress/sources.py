"""Where the levels of the stress suite come from: what the tables of the suite print beside them."""

CAMERA_POSITION = (
    "1 cm: hand-eye calibration with a board (ours); 1 to 3 cm: users' errors of a D435 beside an arm "
    "(librealsense issue 9784); 4 cm: twice its mean"
)
FOCAL = (
    "2 %: two D435 differ by 1.5 % (608.9 px of realsense-ros issue 701, 618.2 px of the release); 5 %: the "
    "maker's tolerance of the field of view, 69° ± 3°"
)
BIAS = (
    "motion blur: in 8 ms of exposure an object of 4.5 m/s at 2.5 m moves by 9 px; a box that follows one "
    "end of the streak is half of that off; 10 px: twice as dark"
)
DROPS = "ours; 30 %: background subtraction by KNN lost the object in 7 of 24 synthetic throws"
LATENCY = (
    "exposure, transfer and SAM 2 (18 to 20 ms on one H100, measured) are 2 to 3 steps; more than 100 ms of "
    "a D435 alone is librealsense issue 6036; 0: no latency at all; 1, 2: those of training; between whole "
    "steps: no camera's images fall on control steps"
)
CLOCK = (
    "ours: images that are stamped as they arrive instead of as they are taken, or by another computer's "
    "clock: 10 ms: a readout; 20 ms: with half an exposure in a dim room; 40 ms: a frame at 30 Hz in a "
    "buffer, and more; no stamps: every image is taken to be as old as the mean of the training"
)
GAINS = "30 %: stiffness of the wrists identified from slow motion is 19 to 35 % off; 50 %: ours"
DELAY = "servoj's look-ahead time, 0.03 s by default and 0.1 s as often set, minus what the gains lag"
LATENCY_AND_DELAY = (
    "levels of the two axes above at once, as on a robot; and half a step less of both, between whole steps"
)
RESTITUTION = (
    "0.75: a tennis ball that falls 2.54 m rebounds to 1.35 to 1.47 m (ITF rules), which is 0.73 to 0.76; 0 "
    "and 0.5: the ends of the training; 0.25: its middle"
)
AIR = "density of air at 20 °C (International Standard Atmosphere); the thrower makes up for mean drag"
HUMAN = (
    "derived: speed 5 % within a thrower (2.4 % in throwing contests, Walsh and Heazlewood; 7 % is the 95th "
    "percentile of handball players, Int. J. Computer Science in Sport 15/1); 2.5° of angle from a release "
    "timed to about 10 ms (Hore et al. 1996, J. Neurophysiol. 75, 1013, tennis balls at 3 m; taken as two "
    "standard deviations) by a hand that turns at 9 rad/s (4.5 m/s on a radius of 0.5 m); released between "
    "hip and chest, 2 to 3 m away"
)
REALITY = (
    "a careful laboratory: the smallest level of each axis, a third of a blur streak of bias, and what "
    "cannot be avoided: air, spin, unknown mass. Throws are those of training: the thrower practises"
)
