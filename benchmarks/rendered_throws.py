"""Throws as a real camera would film them, with the truth beside each image, to judge perception by.

A furnished room, a thrower, an exposure time and a sensor's noise. Needs OpenGL (`find_gl_backend`) and, for
what looks at the images, OpenCV: the extra `perception`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pixel2catch.camera.boxes import box_of_mask
from pixel2catch.camera.image import Box, Image, Verdict
from pixel2catch.envs.detector import Detector
from pixel2catch.envs.episode import Episode
from pixel2catch.envs.world import CatchWorld
from pixel2catch.evaluation.box_scores import Score, score
from pixel2catch.evaluation.recorded_throws import RecordedThrow
from pixel2catch.mdp.control_step import Privileged
from pixel2catch.mdp.sensing import Detection
from pixel2catch.perception.labels import Phase, Truth
from pixel2catch.perception.regions import RobotMask
from pixel2catch.perception.segmenter import BoxPrompt, Segmenter
from pixel2catch.perception.tracker import ObjectTracker, Prompter
from pixel2catch.rendering.camera import CameraCfg, Exposure, Moment, RoomCamera
from pixel2catch.rendering.room import Bystanders
from pixel2catch.robots.geometry import first_chain
from pixel2catch.scene.constants import CONTROL_DT, OBJECT_POS, OBJECT_VEL
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.workcells import find_workcell

NUM_EMPTY_AGAIN = 3
"""Images of the empty room before every throw but the first: the room is known."""

CLICK_ERROR = 2.0
"""How far each edge of a person's box is off at most [px]. Source: ours."""

LEAST_SPEED = 0.5
"""Speed from which an object flies [m/s]."""

NEAR_HAND = 0.25
"""From the palm to the object [m]; what was nearer once is near the hand from then on. Source: ours, the last
two images of a flight."""

LEAST_PIXELS = 6
"""Visible pixels of the object from which it can be found. Source: as the gate's."""


@dataclass(frozen=True, kw_only=True)
class FilmCfg:
    """How throws are filmed.

    Attributes:
        scene: The scene of the simulation.
        camera: Exposure and noise.
        room: Seed of the room's looks.
        num_empty: Images of the room before there is an object.
        num_held: Images of the object in the thrower's hand before the episode begins.
        encoder_noise: Standard deviation of the joint positions that come with an image [rad]. Source: paper,
            Table I, observation noise.
    """

    scene: SceneCfg = field(default_factory=SceneCfg)
    camera: CameraCfg = field(default_factory=CameraCfg)
    room: int = 0
    num_empty: int = 40
    num_held: int = 15
    encoder_noise: float = 0.005


@dataclass(frozen=True, kw_only=True)
class LabelledImage:
    """One image and what it shows.

    Attributes:
        image: Red, green, blue; upper row first.
        joint_pos: What the encoders say in the middle of the exposure [rad].
        time: The middle of the exposure, since the release [s].
        box: The true box of the visible part of the object then [px]; zeros if there is none.
        num_pixels: Pixels of this part.
        palm_distance: From the palm to the object's centre [m].
    """

    image: UInt8[np.ndarray, "height width 3"]
    joint_pos: Float[np.ndarray, " num_joints"]
    time: float
    box: Float[Tensor, "1 4"]
    num_pixels: int
    palm_distance: float


class ThrowFilm:
    """Films one throw; close it, or use it as a context manager."""

    def __init__(
        self, cfg: FilmCfg, object_name: str, release_pos: Float[np.ndarray, "3"], seed: int
    ) -> None:
        """Furnish the room and place the thrower.

        Args:
            cfg: How to film.
            object_name: What is thrown.
            release_pos: Where it is held before [m].
            seed: Of noise and of the bystanders' swing.

        Raises:
            DeviceUnavailableError: If no OpenGL back end works.
        """
        self._cfg, self._object_name, self._rng = cfg, object_name, np.random.default_rng(seed)
        phase = float(self._rng.uniform(0.0, 2.0 * np.pi))
        self._bystanders = Bystanders(release_pos=release_pos, phase=phase)
        self._camera = RoomCamera(cfg.scene, seed, cfg.camera, room=cfg.room, shadows=True)

    def lead_in(self, start: Moment, num_empty: int) -> Iterator[LabelledImage]:
        """Yield images of the room, then of the object in the hand, up to the one before the start.

        Args:
            start: The beginning of the episode; robot and object wait in this position.
            num_empty: Images without the object.
        """
        for left in range(num_empty + self._cfg.num_held, 0, -1):
            moment = replace(start, qvel=np.zeros_like(start.qvel), time=start.time - left * CONTROL_DT)
            yield self.shot(moment, is_empty=left > self._cfg.num_held)

    def shot(self, moment: Moment, *, is_empty: bool = False) -> LabelledImage:
        """Take an image, with the object or as if there were none."""
        name = None if is_empty else self._object_name
        exposure = Exposure(moment=moment, object_name=name, thrower=self._bystanders.joint_pos)
        mask = self._camera.object_mask(exposure)
        box, _ = box_of_mask(torch.from_numpy(mask)[None])
        workcell = find_workcell(self._cfg.scene.workcell)
        joint_pos = moment.qpos[: len(workcell.joints)]
        arm = joint_pos[None, workcell.palms[0].carriers]
        palm_pos, _ = first_chain(workcell).pose(torch.from_numpy(arm))
        return LabelledImage(
            image=self._camera.image(exposure),
            joint_pos=joint_pos + self._cfg.encoder_noise * self._rng.standard_normal(len(joint_pos)),
            time=moment.time,
            box=box,
            num_pixels=int(mask.sum()),
            palm_distance=float(np.linalg.norm(moment.qpos[OBJECT_POS] - palm_pos[0].numpy())),
        )

    def close(self) -> None:
        """Free the drawing context."""
        self._camera.close()

    def __enter__(self) -> "ThrowFilm":
        """Return the film itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the film."""
        self.close()


def moments(throw: RecordedThrow) -> list[Moment]:
    """The states of a throw until the success or the end, with their times since the release."""
    qpos, qvel = throw.qpos[: throw.num_untested], throw.qvel[: throw.num_untested]
    flying = np.flatnonzero(np.linalg.norm(qvel[:, OBJECT_VEL], axis=-1) > LEAST_SPEED)
    release = int(flying[0]) if len(flying) else len(qvel)
    return [Moment(qpos=qpos[i], qvel=qvel[i], time=(i - release) * CONTROL_DT) for i in range(len(qpos))]


def truths(shots: Sequence[LabelledImage]) -> list[Truth]:
    """What the images of a film show."""
    found, is_near = [], False
    for shot in shots:
        is_near = is_near or shot.palm_distance < NEAR_HAND
        phase: Phase = "near the hand" if is_near else "flight" if shot.time > 0.0 else "held"
        xmin, ymin, xmax, ymax = shot.box[0].tolist()
        box = (xmin, ymin, xmax, ymax) if shot.num_pixels >= LEAST_PIXELS else None
        found.append(Truth(phase=phase, box=box))
    return found


def film_scores(shots: Sequence[LabelledImage], boxes: Sequence[Box]) -> list[Score]:
    """Compare what was seen in the images of a film with the truth."""
    return [score(truth, seen) for truth, seen in zip(truths(shots), boxes, strict=True)]


class PerceptionRunner:
    """The perception looks at one film after the other; what it learned of the room stays.

    A person points the object out in the first image of each film that shows it.
    """

    def __init__(self, segmenter: Segmenter, workcell: str = "ur5e_allegro", seed: int = 0) -> None:
        """Begin before the first film.

        Args:
            segmenter: What finds the object's pixels.
            workcell: The robots.
            seed: Of the person's errors.
        """
        self._person, self._rng = Prompter(), np.random.default_rng(seed)
        robot = RobotMask(find_workcell(workcell))
        self._tracker = ObjectTracker(segmenter, self._person, robot=robot)
        self._is_prompted, self._num_seen = False, 0
        self.durations: list[float] = []  #: Time of each image [s].

    def begin(self) -> None:
        """A new film begins."""
        self._is_prompted = False

    def see(self, shot: LabelledImage) -> Box:
        """Look at the next image of the film."""
        if shot.num_pixels and not self._is_prompted:
            self._is_prompted = True
            self._tracker.reset()
            edges = shot.box[0].numpy() + self._rng.uniform(-CLICK_ERROR, CLICK_ERROR, 4)
            xmin, ymin, xmax, ymax = edges.tolist()
            self._person.give(BoxPrompt(box=(xmin, ymin, xmax, ymax)))
        now = self._num_seen * CONTROL_DT
        self._num_seen += 1
        image = Image(pixels=shot.image, stamp=now, joint_pos=shot.joint_pos)
        box = self._tracker.step(image, now)
        self.durations.append(self._tracker.durations["total"])
        return box


class RenderedDetector(Detector):
    """Films the one environment and delivers the boxes that the perception finds in the images.

    The detector that it replaces still looks: it draws what it always draws, so that throws and noise stay
    those of its own boxes, and it tracks the object's position, which no image gives.

    It films one episode after `open`; closed, it sees what the other sees.

    Attributes:
        shots: The images of this episode, from its beginning to its end or to `close`.
        boxes: What was found in each.
    """

    def __init__(
        self, other: Detector, world: CatchWorld, cfg: FilmCfg, perception: PerceptionRunner
    ) -> None:
        """Look into a world of one environment on the CPU.

        Args:
            other: The detector whose place it takes.
            world: What is looked at.
            cfg: How to film.
            perception: What looks at the film.
        """
        self._other, self._world, self._cfg, self._perception = other, world, cfg, perception
        self._qpos, self._qvel = (world.simulation.bind(name) for name in ("qpos", "qvel"))
        self._film: ThrowFilm | None = None
        self._num_throws = 0
        self._is_open = False
        self.shots: list[LabelledImage] = []
        self.boxes: list[Box] = []

    def look(self, truth: Privileged, episode: Episode) -> Detection:
        """See `Detector.look`."""
        detection = self._other.look(truth, episode)
        steps = int(episode.record.steps[0])
        if steps == 0 and self.shots:
            self.close()
        if not self._is_open:
            return detection
        moment = Moment(
            qpos=self._qpos[0].numpy().copy(),
            qvel=self._qvel[0].numpy().copy(),
            time=(steps - int(episode.throw.hover_steps[0])) * CONTROL_DT,
        )
        film = self._film or self._begun(episode, moment)
        self.shots.append(film.shot(moment))
        self.boxes.append(self._perception.see(self.shots[-1]))
        is_found = self.boxes[-1].verdict is Verdict.SEEN
        box = torch.tensor([self.boxes[-1].edges])
        return replace(detection, box=box, is_seen=torch.tensor([is_found]))

    def disturbed(self, detection: Detection, episode: Episode) -> Detection:
        """See `Detector.disturbed`: an image needs no noise but its own."""
        drawn = self._other.disturbed(detection, episode)
        if not self._is_open:
            return drawn
        return replace(drawn, box=detection.box, is_seen=detection.is_seen)

    def open(self) -> None:
        """Film the next episode; call it before the environment's reset."""
        self.close()
        self._is_open, self.shots, self.boxes = True, [], []

    def close(self) -> None:
        """Film no more, and free the drawing context."""
        if self._film is not None:
            self._film.close()
        self._film, self._is_open = None, False

    def _begun(self, episode: Episode, start: Moment) -> ThrowFilm:
        """A new film, of which the images before the episode have been seen."""
        name = self._world.objects.names[int(episode.parameters.object_id[0])]
        film = ThrowFilm(self._cfg, name, episode.throw.pos[0].double().numpy(), self._num_throws)
        self._film = film
        self._perception.begin()
        for shot in film.lead_in(start, NUM_EMPTY_AGAIN if self._num_throws else self._cfg.num_empty):
            self._perception.see(shot)
        self._num_throws += 1
        return film
