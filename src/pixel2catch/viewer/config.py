"""Configuration of pages; imports neither browser nor simulator."""

from dataclasses import dataclass, field
from pathlib import Path

from pixel2catch.checks import Port, Seed


@dataclass(frozen=True, kw_only=True)
class PageCfg:
    """Where a page is served."""

    port: Port = 8080  #: Port of the page; if it is in use, the next free one.
    #: Address to listen on. If other machines can reach it, the page's address has a token.
    host: str = "127.0.0.1"


@dataclass(frozen=True, kw_only=True)
class PlayCfg:
    """What is thrown first; the page can change all but the files."""

    page: PageCfg = field(default_factory=PageCfg)  #: Where the page is served.
    policy: Path | None = None  #: Folder of a policy or of its training run, or a shipped name.
    objects: tuple[str, ...] = ("seen",)  #: What is thrown, names of `select_objects`.
    seed: Seed = 0  #: Seed of the first throw; the next throw has the next seed.
    dynamics: Path | None = None  #: Dynamics file of the simulated robot.
    camera: Path | None = None  #: Camera file of the simulated camera.
