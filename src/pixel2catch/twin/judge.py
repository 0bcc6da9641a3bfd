"""Whether a throw was caught, counted as the evaluation counts it."""

from dataclasses import replace

import torch

from pixel2catch.envs.draws import Episode
from pixel2catch.envs.episodes import EpisodeRecord
from pixel2catch.envs.physics_log import PhysicsLog
from pixel2catch.evaluation.protocol import TRIAL_STEPS
from pixel2catch.mdp.snapshot import Privileged, Transition
from pixel2catch.mdp.terminations import is_near


class Judge:
    """Follows one throw at the control rate; after its end nothing counts any more.

    The time in which a success counts begins before the release, with the steps that the object would hover
    in an episode: what an operator waits for longer does not count.

    Attributes:
        record: What became of the throw so far.
        is_over: Whether it is decided: caught, dropped, or out of time.
    """

    def __init__(self, episode: Episode, now: Privileged) -> None:
        """Begin with a release.

        Args:
            episode: What is thrown.
            now: The state at the release.
        """
        self._before = now
        self.record: EpisodeRecord = replace(episode.record, steps=episode.throw.hover_steps)
        self.is_over = False

    def follow(self, now: Privileged, log: PhysicsLog) -> None:
        """Count a control step.

        Args:
            now: The state at its end.
            log: What happened in it.
        """
        if self.is_over:
            return
        transition = Transition(
            before=self._before,
            now=now,
            action=torch.zeros(1, 0),
            joint_pos_target=torch.zeros(1, 0),
            held_steps=torch.where(is_near(now), self.record.held_steps + 1, 0),
            episode_steps=self.record.steps + 1,
        )
        self.record = self.record.advanced(transition, log)
        self._before = now
        is_late = int(self.record.steps) >= TRIAL_STEPS
        self.is_over = is_late or bool(self.record.is_success) or bool(self.record.is_dropped)
