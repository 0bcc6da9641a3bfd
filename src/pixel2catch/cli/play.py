"""`pixel2catch play`: a video of throws."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from pixel2catch.checks import CameraPath, Count, DynamicsPath, Seed, VideoPath
from pixel2catch.shipped import PolicyPath


@dataclass(frozen=True, kw_only=True)
class Play:
    """Write a video of throws: the robot's camera with the policy's box, and a view from outside."""

    #: Folder of a policy or of its training run, or a shipped name. Default: catch_alone+fit.
    policy: Positional[PolicyPath | None] = None
    out: VideoPath = Path("play.mp4")  #: The video file.
    #: What is thrown: seen, unseen, real, names of objects, or several of them.
    objects: tuple[str, ...] = ("seen",)
    throws: Count = 4  #: Number of throws.
    seed: Seed = 0  #: Seed of everything that is drawn.
    #: Dynamics file of the robot that is simulated. Default: the nominal robot, also for a policy that was
    #: trained with a dynamics file.
    dynamics: DynamicsPath | None = None
    #: Camera file of the camera that is simulated. Default: the camera that the policy was trained for, known
    #: exactly.
    camera: CameraPath | None = None
    view: Literal["rgb", "outside", "both"] = "both"  #: What the pictures show.

    def run(self) -> None:
        """Throw, draw and write."""
        from pixel2catch.cli.console import say
        from pixel2catch.cli.device import prepare
        from pixel2catch.evaluation.loading import camera_remark, load_policy, task_of
        from pixel2catch.evaluation.protocol import EvaluationCfg, recorded_throws
        from pixel2catch.rendering.renderer import find_gl_backend
        from pixel2catch.rendering.video import write_video
        from pixel2catch.scene.objects import select_objects

        prepare("cpu")
        find_gl_backend()
        policy, method = load_policy(self.policy)
        task = task_of(policy, dynamics=self.dynamics, camera=self.camera)
        for remark in camera_remark(policy, task):
            say(remark)
        cfg = EvaluationCfg(
            objects=select_objects(self.objects), num_envs=self.throws, seed=self.seed, task=task
        )
        throws = recorded_throws(cfg, policy, method)
        say(f"drawing {self.throws} throw{'s' if self.throws > 1 else ''} ...")
        self.out.parent.mkdir(parents=True, exist_ok=True)
        num_pictures = write_video(self.out, throws, task.scene, self.view)
        print(f"wrote {self.out}: {num_pictures} pictures")
