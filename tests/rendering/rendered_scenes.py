"""States of the scene and cameras that tests of pictures share."""

from math import inf

import numpy as np

from pixel2catch.rendering.camera import CameraCfg, Moment
from pixel2catch.rendering.room import Bystanders
from pixel2catch.scene.constants import OBJECT_POS, OBJECT_VEL
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

RELEASE = np.array((2.6, 0.1, 0.8))
MODEL = build_model(SceneCfg())
THROWER = Bystanders(release_pos=RELEASE, phase=0.3, release=inf)
STILL = CameraCfg(read_noise=0.0, shot_noise=0.0)


def moment(pos: np.ndarray = RELEASE, speed: float = 0.0, time: float = -1.0) -> Moment:
    """The robot at home, the object at a position with a speed along y."""
    qpos, qvel = MODEL.qpos0.copy(), np.zeros(MODEL.nv)
    qpos[: len(UR5E_ALLEGRO.joints)] = [joint.home for joint in UR5E_ALLEGRO.joints]
    qpos[OBJECT_POS], qvel[OBJECT_VEL] = pos, (0.0, speed, 0.0)
    return Moment(qpos=qpos, qvel=qvel, time=time)
