"""Who watches a film: the perception, with a person who points the object out while it is held."""

import numpy as np

from pixel2catch.evaluation.rendered.film import Shot
from pixel2catch.perception.extractor import CameraFrame, Extraction, PixelFeatureExtractor
from pixel2catch.perception.factory import make_robot_mask
from pixel2catch.perception.prompt import Prompter
from pixel2catch.perception.segmenter import BoxPrompt, Segmenter
from pixel2catch.perception.timing import StageClock
from pixel2catch.robot.allegro import Handedness
from pixel2catch.robot.constants import CONTROL_DT

CLICK_ERROR = 2.0
"""How far each edge of a person's box is off at most [px]. Source: ours."""


class Watcher:
    """Looks at one film after the other, image by image; what it learned of the room stays."""

    def __init__(self, segmenter: Segmenter, handedness: Handedness = "left", seed: int = 0) -> None:
        """Begin before the first film.

        Args:
            segmenter: What finds the object's pixels.
            handedness: Which hand the robot has.
            seed: Of the person's errors.
        """
        self._person, self._rng = Prompter(), np.random.default_rng(seed)
        robot = make_robot_mask(handedness=handedness)
        self._extractor = PixelFeatureExtractor(segmenter, self._person, robot=robot)
        self._is_prompted, self._num_seen = False, 0

    @property
    def clock(self) -> StageClock:
        """How long each stage took."""
        return self._extractor.clock

    def begin(self) -> None:
        """A new film begins; in its first image with the object, the person points it out."""
        self._is_prompted = False

    def see(self, shot: Shot) -> Extraction:
        """Look at the next image of the film."""
        if shot.num_pixels and not self._is_prompted:
            self._is_prompted = True
            self._extractor.reset()
            edges = shot.box[0].numpy() + self._rng.uniform(-CLICK_ERROR, CLICK_ERROR, 4)
            xmin, ymin, xmax, ymax = edges.tolist()
            self._person.give(BoxPrompt(box=(xmin, ymin, xmax, ymax)))
        now = self._num_seen * CONTROL_DT
        self._num_seen += 1
        return self._extractor.step(CameraFrame(image=shot.image, stamp=now, joint_pos=shot.joint_pos), now)
