"""Pages in the browser: throws to play with, the operator's page, the digital twin.

Here is where a page is served; this module imports neither browser nor simulator.
"""

from dataclasses import dataclass
from typing import Annotated, final

from pixel2catch.checks import Requirement
from pixel2catch.errors import InvalidValueError


@final
@dataclass(frozen=True)
class HostAndPort(Requirement):
    """A host and a port, as HOST:PORT."""

    def require(self, name: str, value: str) -> None:  # noqa: D102 (documented in the interface)
        host, _, port = value.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65_536:
            raise InvalidValueError(
                f"{name} is '{value}'; give HOST:PORT with a port from 1 to 65535, such as 127.0.0.1:8080."
            )


@dataclass(frozen=True, kw_only=True)
class PageCfg:
    """Where a page is served."""

    #: Host and port of the page; of ports in use, the next free one. If other machines can reach it, as with
    #: 0.0.0.0:8080, the page's address has a token.
    address: Annotated[str, HostAndPort()] = "127.0.0.1:8080"

    @property
    def host(self) -> str:
        """Address to listen on."""
        return self.address.rpartition(":")[0].strip("[]")

    @property
    def port(self) -> int:
        """First port to try."""
        return int(self.address.rpartition(":")[2])
