"""What pages are told, as the command line takes it; nothing here needs a browser or the simulator."""

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class PageCfg:
    """Where a page is served."""

    port: int = 8080  #: Port of the page; if it is taken, one of the next.
    #: Address that it listens on. On any but this machine's own, its address has a token in it.
    host: str = "127.0.0.1"


@dataclass(frozen=True, kw_only=True)
class PlayCfg:
    """What is thrown at first; all but the files can be changed on the page."""

    page: PageCfg = field(default_factory=PageCfg)  #: Where the page is served.
    policy: Path | None = None  #: Folder of a policy or of its training run, or a shipped name.
    objects: tuple[str, ...] = ("seen",)  #: What is thrown, as `select_objects` takes it.
    seed: int = 0  #: Of the first throw; the next has the next.
    dynamics: Path | None = None  #: Dynamics file of the robot that is simulated.
    camera: Path | None = None  #: Camera file of the camera that is simulated.
