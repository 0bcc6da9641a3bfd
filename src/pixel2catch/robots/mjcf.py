"""Model files of robots. Files that are too large or too deep are refused before MuJoCo reads them."""

from functools import lru_cache
from pathlib import Path
from xml.parsers import expat

import mujoco

from pixel2catch.errors import InvalidValueError
from pixel2catch.files import read_bytes, reading

MOST_MJCF = 2**24  #: Largest size of a model file [bytes]; robots have about 10,000. Source: ours.
MOST_ELEMENTS, MOST_NESTED = 20_000, 64
"""Largest number of elements of a model, and largest depth. Source: ours; an arm with a hand: 500 and 15."""

GROWING = ("include", "replicate", "composite", "flexcomp")
"""Elements that create other elements or read other files. They are refused."""

URDF_COMPILER = '<mujoco><compiler strippath="false" fusestatic="false" discardvisual="false"/></mujoco>'
"""Compiler settings for a URDF: keep all links, mesh paths and visual shapes."""

MESH_ENDINGS = (".stl", ".obj", ".msh")  #: Mesh formats that MuJoCo reads.


def read_mjcf(path: Path) -> mujoco.MjSpec:
    """Read a model, MJCF or URDF. Mesh paths are searched in its folder and in all folders above.

    Raises:
        InvalidValueError: It cannot be read, is too large or too deep, or creates elements.
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
    """Return the file of `package://NAME/PATH` or of a path, in a folder or in one above."""
    parts = Path(name.partition("://")[2] or name)
    for above in (folder, *folder.parents):
        for found in (above / parts, above / Path(*parts.parts[1:])):
            if found.is_file():
                return found
    raise InvalidValueError(f"there is no mesh '{name}' in {folder} or above; copy it there")


@lru_cache(maxsize=8)  # scenes with different objects share their robots
def _require_simple(content: bytes) -> str:
    """Return the name of the outermost element of a model without forbidden content."""
    depth = num_elements = 0
    root = ""

    def begin(name: str, _: object) -> None:
        nonlocal depth, num_elements, root
        root = root or name
        depth, num_elements = depth + 1, num_elements + 1
        if depth > MOST_NESTED or num_elements > MOST_ELEMENTS:
            raise InvalidValueError(
                f"it has more than {MOST_ELEMENTS} elements, or is more than {MOST_NESTED} levels deep"
            )
        if name in GROWING:
            raise InvalidValueError(f"it has the element '{name}'; write out the elements that it creates")

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def declare(*_: object) -> None:
        raise InvalidValueError("it declares a document type or entities; remove them")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.StartDoctypeDeclHandler = declare
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise InvalidValueError(f"it is not XML ({error})") from error
    return root
