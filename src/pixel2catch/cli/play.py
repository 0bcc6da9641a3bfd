"""`pixel2catch play`: a video of throws."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from pixel2catch.viewer.config import PageCfg


@dataclass(frozen=True, kw_only=True)
class Play:
    """Write a video of throws: the robot's camera with the policy's box, and a view from outside."""

    #: Folder of a policy or of its training run, or a shipped name. Default: catch_alone+fit.
    policy: Positional[Path | None] = None
    out: Path = Path("play.mp4")  #: The video file.
    #: What is thrown: seen, unseen, real, names of objects, or several of them.
    objects: tuple[str, ...] = ("seen",)
    throws: int = 4  #: Number of throws.
    seed: int = 0  #: Seed of everything that is drawn.
    #: Dynamics file of the robot that is simulated. Default: the nominal robot, also for a policy that was
    #: trained with a dynamics file.
    dynamics: Path | None = None
    #: Camera file of the camera that is simulated. Default: the camera that the policy was trained for, known
    #: exactly.
    camera: Path | None = None
    view: Literal["rgb", "outside", "both"] = "both"  #: What the pictures show.
    web: bool = False  #: Whether to serve a page with throws to play with, instead of writing a video.
    page: PageCfg = field(default_factory=PageCfg)  #: Where that page is served.

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
        if self.web:
            from pixel2catch.cli.extras import needs_extra
            from pixel2catch.viewer.config import PlayCfg

            with needs_extra("viewer"):
                from pixel2catch.viewer.play import PlayPage
                from pixel2catch.viewer.process import serve_until_interrupted
            args = {"policy": self.policy, "objects": self.objects, "seed": self.seed, "page": self.page}
            cfg = PlayCfg(**args, dynamics=self.dynamics, camera=self.camera)
            return serve_until_interrupted(lambda: PlayPage(cfg))
        find_gl_backend()
        policy, method = load_policy(self.policy)
        task = task_of(policy, dynamics=self.dynamics, camera=self.camera)
        for remark in camera_remark(policy, task):
            say(remark)
        cfg = EvaluationCfg(
            objects=select_objects(self.objects), num_envs=self.throws, seed=self.seed, task=task
        )
        throws = recorded_throws(cfg, policy, method)
        say(f"drawing {self.throws} throws ...")
        num_pictures = write_video(self.out, throws, task.scene, self.view)
        print(f"wrote {self.out}: {num_pictures} pictures")
