"""What to say where an optional package is missing."""

from collections.abc import Iterator
from contextlib import contextmanager

from pixel2catch.errors import PerceptionError
from pixel2catch.installation import install_command


@contextmanager
def needs_extra(extra: str) -> Iterator[None]:
    """Turn a failed import of an optional package into an error that says which extra to install.

    Raises:
        PerceptionError: If something in this context cannot be imported.
    """
    try:
        yield
    except ImportError as error:
        raise PerceptionError(
            f"a package that this needs cannot be imported ({error}): {install_command(extra)}."
        ) from None
