"""An eye that looks at images: boxes for the policy from the perception instead of from geometry."""

from dataclasses import replace

import torch

from pixel2catch.envs.draws import Episode
from pixel2catch.envs.eye import Eye
from pixel2catch.envs.world import CatchWorld
from pixel2catch.evaluation.rendered.camera import Moment
from pixel2catch.evaluation.rendered.film import FilmCfg, Shot, ThrowFilm
from pixel2catch.evaluation.rendered.watcher import Watcher
from pixel2catch.mdp.sensing import Detection
from pixel2catch.mdp.snapshot import Privileged
from pixel2catch.perception.extractor import Extraction
from pixel2catch.perception.plausibility import Verdict
from pixel2catch.robot.constants import CONTROL_DT

NUM_EMPTY_AGAIN = 3
"""Images of the empty room before every throw but the first: the room is known."""


class ImageEye(Eye):
    """Films the one environment and delivers the boxes that the perception finds in the images.

    The other eye still looks: it draws what it always draws, so that throws and noise stay those of its own
    boxes, and it tracks the object's position, which no image gives.

    It films one episode after `open`; closed, it sees what the other eye sees.

    Attributes:
        shots: The images of this episode, from its beginning to its end or to `close`.
        extractions: What was made of each.
    """

    def __init__(self, other: Eye, world: CatchWorld, cfg: FilmCfg, watcher: Watcher) -> None:
        """Look into a world of one environment on the CPU.

        Args:
            other: The eye whose place it takes.
            world: What is looked at.
            cfg: How to film.
            watcher: Who looks at the film.
        """
        self._other, self._world, self._cfg, self._watcher = other, world, cfg, watcher
        self._qpos, self._qvel = (world.simulation.bind(name) for name in ("qpos", "qvel"))
        self._film: ThrowFilm | None = None
        self._num_throws = 0
        self._is_open = False
        self.shots: list[Shot] = []
        self.extractions: list[Extraction] = []

    def look(self, truth: Privileged, episode: Episode) -> Detection:
        """See `Eye.look`."""
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
        self.extractions.append(self._watcher.see(self.shots[-1]))
        is_found = self.extractions[-1].verdict is Verdict.SEEN
        return replace(detection, box=self.extractions[-1].box, is_seen=torch.tensor([is_found]))

    def disturbed(self, detection: Detection, episode: Episode) -> Detection:
        """See `Eye.disturbed`: an image needs no noise but its own."""
        drawn = self._other.disturbed(detection, episode)
        if not self._is_open:
            return drawn
        return replace(drawn, box=detection.box, is_seen=detection.is_seen)

    def open(self) -> None:
        """Film the next episode; call it before the environment's reset."""
        self.close()
        self._is_open, self.shots, self.extractions = True, [], []

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
        self._watcher.begin()
        for shot in film.lead_in(start, NUM_EMPTY_AGAIN if self._num_throws else self._cfg.num_empty):
            self._watcher.see(shot)
        self._num_throws += 1
        return film
