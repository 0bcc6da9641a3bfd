"""`pixel2catch play`: a film of throws, or a page to play with."""

from dataclasses import dataclass, field
from pathlib import Path

from tyro.conf import Positional

from pixel2catch.checks import Count, FilmPath, Seed, require_used
from pixel2catch.cli.console import prepare, say
from pixel2catch.cli.fields import SimulatedTask
from pixel2catch.errors import InvalidValueError
from pixel2catch.installation import needs_extra
from pixel2catch.shipped import DEFAULT_POLICY, PolicyPath
from pixel2catch.viewer import PageCfg


@dataclass(frozen=True, kw_only=True)
class Play:
    """Write a film of throws, or serve a page to play with."""

    #: Folder of a policy or of its training run, an ONNX file, or a shipped name. Default: catch_alone+fit.
    policy: Positional[PolicyPath | None] = None
    #: The film, as .mp4, .webp or .gif; as .png it is a strip of stills of every throw. Default: play.mp4.
    out: FilmPath | None = None
    #: What is thrown: seen, unseen, real, sizes, names of objects, or several of them.
    objects: tuple[str, ...] = ("seen",)
    throws: Count = 4  #: Number of throws.
    seed: Seed = 0  #: Seed of all random numbers.
    web: bool = False  #: Serve a page with throws to play with, instead of writing a video.
    page: PageCfg = field(default_factory=PageCfg)  #: Where that page is served.
    task: SimulatedTask = field(default_factory=SimulatedTask)  #: What is simulated.

    def run(self) -> None:
        require_used(self.page, ("address",), self.web, "without --web")
        require_used(self, ("out", "throws"), not self.web, "with --web")
        if self.web and self.task.given:
            raise InvalidValueError("--web serves a page of the paper's task: leave out --env, or --web.")
        prepare("cpu")
        if self.web:
            with needs_extra("viewer"):
                from pixel2catch.viewer.play import serve_until_interrupted
                from pixel2catch.viewer.throws import ThrowOrder, ThrowPlayer
            objects, policy = ", ".join(self.objects), str(self.policy or DEFAULT_POLICY)
            thrower = ThrowPlayer(self.task.dynamics, self.task.camera)
            first = ThrowOrder(policy=policy, objects=objects)
            serve_until_interrupted(self.page, thrower, first, self.seed)
            return
        from pixel2catch.evaluation.loading import load_policy
        from pixel2catch.evaluation.protocol import EvaluationCfg, recorded_throws
        from pixel2catch.rendering.film import write_throws
        from pixel2catch.rendering.renderer import find_gl_backend
        from pixel2catch.scene.objects import select_objects

        find_gl_backend()
        policy, method = load_policy(self.policy)
        task, objects = self.task.make(policy), select_objects(self.objects)
        cfg = EvaluationCfg(objects=objects, num_envs=self.throws, seed=self.seed, task=task)
        out, throws = self.out or Path("play.mp4"), recorded_throws(cfg, policy, method)
        num_pictures = write_throws(
            out,
            throws,
            task.scene,
            on_throw=lambda number: say(f"drawing throw {number + 1} of {self.throws} ..."),
        )
        print(f"wrote {out}: {num_pictures} pictures")
