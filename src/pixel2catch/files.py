"""Files that are either the old ones or the new ones, never half of each; and what is written into them."""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def write_atomically(contents: Mapping[Path, bytes]) -> None:
    """Write one or several files; when any write fails, all the files keep their old content.

    Every file is first written completely beside its place (`<name>.tmp`) and flushed to the disk; only then
    are the old ones replaced. A full disk or a kill in between leaves the old files as they were.

    Args:
        contents: The new content of each file. The folders must exist.

    Raises:
        OSError: The disk is full, read-only or gone; nothing was replaced.
    """
    temporaries = {path: path.with_name(path.name + ".tmp") for path in contents}
    try:
        for path, content in contents.items():
            with open(temporaries[path], "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        for path, temporary in temporaries.items():
            os.replace(temporary, path)
    finally:
        for temporary in temporaries.values():
            temporary.unlink(missing_ok=True)


def plain(value: Any) -> Any:
    """What JSON does not know, for `json.dumps(default=plain)`: arrays as lists, anything else as text.

    An infinite entry of an array is null, as JSON has no infinity.
    """
    return _without_infinity(value.tolist()) if hasattr(value, "tolist") else str(value)


def _without_infinity(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_infinity(entry) for entry in value]
    return None if isinstance(value, float) and math.isinf(value) else value
