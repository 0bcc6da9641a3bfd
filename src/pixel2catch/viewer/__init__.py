"""Pages in the browser: throws to play with, the operator's page, the digital twin.

Here is where a page is served; this module imports neither browser nor simulator.
"""

from dataclasses import dataclass

from pixel2catch.checks import Port


@dataclass(frozen=True, kw_only=True)
class PageCfg:
    """Where a page is served."""

    port: Port = 8080  #: Port of the page; if it is in use, the next free one.
    #: Address to listen on. If other machines can reach it, the page's address has a token.
    host: str = "127.0.0.1"
