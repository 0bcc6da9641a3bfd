"""The plan of a film: the control steps it shows of a throw, their speed, and the distance of the view."""

from dataclasses import dataclass, replace

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.ndimage import uniform_filter1d

from pixel2catch.evaluation.recorded_throws import LOST, RecordedThrow
from pixel2catch.robots.geometry import chain_of
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT, OBJECT_POS

FPS = 25  #: Pictures of a film per second.
SLOW = 4  #: Ratio by which the catch is slower.
REACH = 0.12  #: Distance of object and palm from which the catch begins [m].
BEFORE_RELEASE, BEFORE_CATCH, AFTER_CATCH, AFTER_OUTCOME, LONGEST = 6, 5, 7, 12, 45
"""Control steps: shown before the release, slow before and after the catch, shown after the outcome, and
largest number shown after the catch."""

ZOOM_STEPS = 9  #: Control steps in which the view comes closer, before the catch.
FOLLOWED_STEPS = 15  #: Control steps over which the hand's motion is averaged for the view.
STILL_CLOSENESS = 0.8  #: Largest closeness of a still.


@dataclass(frozen=True, kw_only=True)
class Storyboard:
    """Plan of a film: what each picture shows."""

    steps: Float[ndarray, " num_pictures"]  #: Control step; fractions are between two steps.
    is_slow: Bool[ndarray, " num_pictures"]  #: Whether the picture is in slow motion.
    closeness: Float[ndarray, " num_pictures"]  #: 0 shows the whole room, 1 the hand.
    decision: int  #: Control step in which the outcome is known.
    catch: int  #: Control step in which the catch begins, or the object is nearest to a palm.
    focus: Float[ndarray, "num_pictures 3"]  #: Position of the hand; before the catch, that at the catch [m].

    def stills(self, num_pictures: int) -> "Storyboard":
        """Return the plan of a strip: the flight, the catch in the middle, the end."""
        middle = num_pictures // 2
        flight = np.linspace(self.steps[0] + BEFORE_RELEASE, self.catch, middle, endpoint=False)
        steps = np.concatenate((flight, np.linspace(self.catch, self.steps[-1], num_pictures - middle)))
        return replace(
            self,
            steps=steps,
            is_slow=np.zeros(num_pictures, dtype=bool),
            closeness=STILL_CLOSENESS * np.interp(steps, self.steps, self.closeness),
            focus=_between(steps, self.steps, self.focus),
        )


def storyboard(throw: RecordedThrow, workcell: WorkcellSpec) -> Storyboard:
    """Return the plan of a film from just before the release to the outcome."""
    catch, focus = _catch(throw, workcell)
    last = len(throw.qpos) - 1
    decision = last if throw.outcome == LOST else throw.num_untested - 1
    begin = max(throw.release - BEFORE_RELEASE, 0)
    end = max(min(last, decision + AFTER_OUTCOME, catch + LONGEST), catch)
    slow_from, slow_to = max(catch - BEFORE_CATCH, begin), min(catch + AFTER_CATCH, end)
    pace = 1.0 / (FPS * CONTROL_DT)
    steps = np.concatenate(
        (
            np.arange(begin, slow_from, pace),
            np.arange(slow_from, slow_to, pace / SLOW),
            np.arange(slow_to, end, pace),
            (end,),
        )
    )
    share = np.clip((steps - catch + ZOOM_STEPS) / ZOOM_STEPS, 0.0, 1.0)
    return Storyboard(
        steps=steps,
        is_slow=(steps >= slow_from) & (steps < slow_to),
        closeness=share * share * (3.0 - 2.0 * share),
        decision=decision,
        catch=catch,
        focus=_between(steps, np.arange(len(focus)), focus),
    )


def positions_between(
    model: mujoco.MjModel, throw: RecordedThrow, step: float
) -> Float[ndarray, " num_positions"]:
    """Return the interpolated positions of the simulation at a control step with fractions."""
    first = min(int(step), len(throw.qpos) - 1)
    second, change = min(first + 1, len(throw.qpos) - 1), np.zeros(model.nv)
    others = model.qpos0[throw.qpos.shape[1] :]  # joints behind those of the simulation
    before, after = (np.concatenate((throw.qpos[i], others)) for i in (first, second))
    mujoco.mj_differentiatePos(model, change, 1.0, before, after)
    mujoco.mj_integratePos(model, before, change, step - first)
    return before[: throw.qpos.shape[1]]


def _between(
    steps: Float[ndarray, " num_pictures"], known: ndarray, rows: Float[ndarray, "num_known 3"]
) -> Float[ndarray, "num_pictures 3"]:
    return np.stack([np.interp(steps, known, column) for column in rows.T], axis=-1)


def _catch(throw: RecordedThrow, workcell: WorkcellSpec) -> tuple[int, Float[ndarray, "num_steps 3"]]:
    """Return the control step of the catch, and the smoothed positions of the palm from then on."""
    qpos = torch.from_numpy(np.asarray(throw.qpos, dtype=np.float64))
    palms = torch.stack(
        [
            chain_of(workcell, palm, dtype=torch.float64).pose(qpos[:, palm.carriers])[0]
            for palm in workcell.palms
        ]
    )
    distances, nearest = (palms - qpos[:, OBJECT_POS]).norm(dim=-1).min(dim=0)
    reached = distances <= max(REACH, float(distances.min()))
    step = int(torch.nonzero(reached)[0])
    way = palms[int(nearest[step])].numpy().copy()
    way[:step] = way[step]
    return step, uniform_filter1d(way, FOLLOWED_STEPS, axis=0, mode="nearest")
