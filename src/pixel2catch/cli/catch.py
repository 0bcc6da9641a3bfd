"""`pixel2catch catch`: evaluate the shipped policy in a few minutes on a CPU, as `make catch` does."""

from dataclasses import dataclass, replace
from pathlib import Path

from pixel2catch.checks import Count, FilmPath
from pixel2catch.cli.console import evaluating, prepare, results_console, say
from pixel2catch.errors import DeviceUnavailableError

VIDEO_THROWS = 2  #: Number of throws in the film.


@dataclass(frozen=True, kw_only=True)
class Catch:
    """Evaluate the shipped policy on seen and unseen objects, and write a short film."""

    throws: Count = 300  #: Number of throws of seen objects, and of unseen objects.
    video: FilmPath = Path("catch.mp4")  #: The film, as .mp4, .webp or .gif, or stills as .png.

    def run(self) -> None:
        """Evaluate, print the results beside the paper's, and write the film."""
        from pixel2catch.evaluation.loading import load_policy, task_of
        from pixel2catch.evaluation.metrics import assess
        from pixel2catch.evaluation.protocol import EvaluationCfg, recorded_throws
        from pixel2catch.evaluation.result_tables import result_tables
        from pixel2catch.rendering.film import write_throws
        from pixel2catch.rendering.renderer import find_gl_backend
        from pixel2catch.scene.objects import OBJECT_GROUPS

        prepare("cpu")
        policy, method = load_policy(None)
        rounds = max(1, round(self.throws / 500))
        cfg = EvaluationCfg(
            objects=OBJECT_GROUPS["seen"],
            num_envs=self.throws // rounds,
            trials=rounds,
            task=task_of(policy),
        )
        say(f"throwing {self.throws:,} seen and {self.throws:,} unseen objects, on the CPU ...")
        results = {}
        for name in ("seen", "unseen"):
            with evaluating(name) as watch:
                results[name] = assess(policy, method, replace(cfg, objects=OBJECT_GROUPS[name]), *watch)
        for table in result_tables(results, method.name):
            results_console().print(table)
        try:
            find_gl_backend()
        except DeviceUnavailableError as error:
            print(f"no film: {error}")
            return
        say(f"drawing {VIDEO_THROWS} throws ...")
        throws = recorded_throws(replace(cfg, num_envs=VIDEO_THROWS, trials=1), policy, method)
        self.video.parent.mkdir(parents=True, exist_ok=True)
        write_throws(self.video, throws, cfg.task.scene)
        print(f"wrote {self.video}: {VIDEO_THROWS} throws")
