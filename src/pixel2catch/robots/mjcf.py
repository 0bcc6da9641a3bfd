"""Model files of robots, looked at before MuJoCo reads them: what is too large, deep or grows is refused."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from xml.parsers import expat

import mujoco

from pixel2catch.errors import InvalidValueError
from pixel2catch.files import read_bytes, reading

MOST_MJCF = 2**24  #: Bytes of a model; those of robots have some ten thousand. Source: ours.
MOST_ELEMENTS, MOST_NESTED = 20_000, 64
"""Elements of a model, and how many of them may be in each other.

Source: ours; an arm with a hand has some 500, and 15 in each other.
"""

GROWING = ("include", "replicate", "composite", "flexcomp")
"""Elements that make others, or read other files; a robot has none."""


URDF_COMPILER = '<mujoco><compiler strippath="false" fusestatic="false" discardvisual="false"/></mujoco>'
"""What MuJoCo is told about a URDF: to keep all links, and of meshes the paths and what is only seen."""

MESH_ENDINGS = (".stl", ".obj", ".msh")  #: What MuJoCo reads of meshes.


def read_mjcf(path: Path) -> mujoco.MjSpec:
    """Read a model, MJCF or URDF, whose meshes are where it says or in a folder above.

    Raises:
        InvalidValueError: It cannot be read, or is too large, too deep or grows.
    """
    with reading("model", path, "Write MJCF, as for MuJoCo, or URDF without macros."):
        content = read_bytes(path, MOST_MJCF)
        if _require_simple(content) != "robot":
            return mujoco.MjSpec.from_file(str(path))
        spec = mujoco.MjSpec.from_string(content.decode().replace("</robot>", f"{URDF_COMPILER}</robot>"))
        for mesh in tuple(spec.meshes):
            if Path(mesh.file).suffix.lower() in MESH_ENDINGS:
                mesh.file = str(_find_mesh(mesh.file, path.parent.resolve()))
            else:
                for geom in tuple(spec.geoms):
                    if geom.meshname == mesh.name:
                        spec.delete(geom)
                spec.delete(mesh)
        return spec


def _find_mesh(name: str, folder: Path) -> Path:
    """The file of `package://NAME/PATH`, or of a path, from a folder or one above."""
    parts = Path(name.partition("://")[2] or name)
    for above in (folder, *folder.parents):
        for found in (above / parts, above / Path(*parts.parts[1:])):
            if found.is_file():
                return found
    raise InvalidValueError(f"there is no mesh '{name}' in {folder} or above")


@lru_cache(maxsize=8)  # a scene of each object has the same robots
def _require_simple(content: bytes) -> str:
    """The name of the outermost element."""
    depth = num_elements = 0
    root = ""

    def begin(name: str, _: object) -> None:
        nonlocal depth, num_elements, root
        root = root or name
        depth, num_elements = depth + 1, num_elements + 1
        if depth > MOST_NESTED or num_elements > MOST_ELEMENTS:
            raise InvalidValueError(
                f"it has more than {MOST_ELEMENTS} elements, or more than {MOST_NESTED} in each other"
            )
        if name in GROWING:
            raise InvalidValueError(f"it has the element '{name}'; write out what that makes")

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def declare(*_: object) -> None:
        raise InvalidValueError("it declares a type of document, or entities; a model needs none")

    parser = expat.ParserCreate()
    handlers: dict[str, Callable[..., None]] = {
        "StartElementHandler": begin,
        "EndElementHandler": end,
        "StartDoctypeDeclHandler": declare,
    }
    for name, handler in handlers.items():
        setattr(parser, name, handler)
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise InvalidValueError(f"it is no XML ({error})") from error
    return root
