"""Pages in the browser: throws to play with, the operator's page, the digital twin.

Here is where a page is served; this module imports neither browser nor simulator.
"""

import re
from dataclasses import dataclass
from typing import Annotated

from pixel2catch.checks import Meets


def _is_place(address: str) -> bool:
    found = re.fullmatch(r".+:(\d{1,5})", address)
    return found is not None and 0 < int(found[1]) < 65_536


HostAndPort = Annotated[
    str, Meets(_is_place, "give HOST:PORT with a port from 1 to 65535, such as 127.0.0.1:8080")
]


@dataclass(frozen=True, kw_only=True)
class PageCfg:
    """Where a page is served."""

    #: Host and port of the page; of ports in use, the next free one. If other machines can reach it, as with
    #: 0.0.0.0:8080, the page's address has a token.
    address: HostAndPort = "127.0.0.1:8080"

    @property
    def host(self) -> str:
        """Address to listen on."""
        return self.address.rpartition(":")[0].strip("[]")

    @property
    def port(self) -> int:
        """First port to try."""
        return int(self.address.rpartition(":")[2])
