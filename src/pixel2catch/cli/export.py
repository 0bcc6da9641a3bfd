"""`pixel2catch export`: a policy for elsewhere."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a policy as a page that runs it in a browser."""

    #: Folder of a policy or of its training run, or a shipped name. Default: catch_alone+fit.
    policy: Positional[Path | None] = None
    #: Folder of a static page, in which one throws with the mouse and the policy catches.
    web_demo: Path

    def run(self) -> None:
        """Write the page."""
        from pixel2catch.cli.console import say
        from pixel2catch.evaluation.web_demo import write_web_demo

        missing = write_web_demo(self.policy, self.web_demo)
        if missing:
            say(
                f"the page needs {' and '.join(missing)}: fetch them and export again\n"
                f"  npm install --prefix {self.web_demo} {' '.join(missing)}"
            )
        print(f"wrote {self.web_demo}; look at it: python -m http.server --directory {self.web_demo}")
