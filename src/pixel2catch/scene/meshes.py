"""Objects from mesh files (.stl, .obj, ...): decomposition into convex parts, mass properties of the mesh.

Needs trimesh to read and CoACD to decompose: the extra `meshes`.
"""

import importlib
import warnings
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import ConvexHull

from pixel2catch.errors import InvalidValueError
from pixel2catch.files import read_bytes
from pixel2catch.installation import needs_extra
from pixel2catch.robots.poses import sphere_points
from pixel2catch.scene.objects import OBJECT_MASS, ObjectSpec, of_solid
from pixel2catch.scene.shapes import ConvexPart, moments

FORMATS = (".stl", ".obj", ".ply", ".off")  #: Supported formats, which refer to no other file.
MOST_BYTES, MOST_FACES = 2**26, 500_000  #: Largest size [bytes] and number of faces of a file. Source: ours.

CONCAVITY = 0.05  #: Largest concavity of a part, relative to the size of the mesh. Source: CoACD's default.

OUTLINE_POINTS = 48  #: Most vertices of the hull of all parts. Source: ours; the camera uses 64 points.

SEARCH = {"mcts_nodes": 10, "mcts_iterations": 20, "mcts_max_depth": 2, "resolution": 500}
"""Search effort of CoACD. Source: ours; a cup takes seconds instead of minutes."""

PART_POINTS = (64, 48, 32, 24, 16, 12, 8)
"""Limits on the vertices of a part, tried in this order until `OUTLINE_POINTS` holds. Source: ours."""


def mesh_object(
    name: str, file: str | Path, *, mass: float = OBJECT_MASS, scale: float = 1.0, max_parts: int = 8
) -> ObjectSpec:
    """Return an object of uniform density and mass [kg]; it collides as at most `max_parts` convex parts.

    The file has closed surfaces that do not overlap; one unit of it is `scale` metres, 0.001 for millimetres.
    """
    if not 0.0 < scale < np.inf or max_parts < 1:
        raise InvalidValueError(f"scale is {scale}, max_parts {max_parts}; both must be greater than 0.")
    mesh = _read(Path(file))
    mesh.apply_scale(scale)
    parts = _simplified(_decomposed(mesh, max_parts))
    solid = moments(np.asarray(mesh.triangles))
    if not mesh.is_watertight:
        warnings.warn(f"'{file}' is not closed: its convex parts give its mass properties", stacklevel=2)
        solid = np.sum([moments(part.faces) for part in parts], axis=0)
    return of_solid(name, parts, solid, mass)


def _read(file: Path) -> Any:
    """Read a mesh, turn its faces counter-clockwise seen from outside, and refuse it if it is flat."""
    with needs_extra("meshes", "an object of a mesh needs trimesh and CoACD", InvalidValueError):
        trimesh, _ = importlib.import_module("trimesh"), importlib.import_module("coacd")
    try:
        if file.suffix.lower() not in FORMATS:
            raise InvalidValueError(f"it must end in {', '.join(FORMATS)}")
        content = BytesIO(read_bytes(file, MOST_BYTES))
        mesh = trimesh.load_mesh(content, file_type=file.suffix[1:].lower(), skip_materials=True)
        if len(mesh.faces) > MOST_FACES:
            raise InvalidValueError(f"it has {len(mesh.faces):,} faces; simplify it to {MOST_FACES:,}")
        mesh.fix_normals()
        _ = ConvexPart(vertices=np.asarray(mesh.vertices)).hull  # it has a volume
    except Exception as error:  # trimesh's readers raise many types
        raise InvalidValueError(
            f"'{file}' cannot be read as a mesh ({error}); give a file such as .stl or .obj."
        ) from error
    return mesh


def _decomposed(mesh: Any, max_parts: int) -> list[Float[ndarray, "_ 3"]]:
    """Return the vertices of convex parts that fill the mesh; each surface is decomposed separately."""
    bodies = mesh.split(only_watertight=False)
    bodies = list(bodies) if 0 < len(bodies) <= max_parts else [mesh]
    convex = [np.asarray(body.vertices) for body in bodies if body.is_convex]
    others = [body for body in bodies if not body.is_convex]
    if not others or len(bodies) == max_parts:
        return convex + [np.asarray(body.vertices) for body in others]
    coacd = importlib.import_module("coacd")
    coacd.set_log_level("error")
    most = (max_parts - len(convex)) // len(others)
    cut = [
        coacd.run_coacd(
            coacd.Mesh(body.vertices, body.faces), threshold=CONCAVITY, max_convex_hull=most, seed=0, **SEARCH
        )
        for body in others
    ]
    return convex + [np.asarray(vertices) for parts in cut for vertices, _ in parts]


def _simplified(parts: list[Float[ndarray, "_ 3"]]) -> list[ConvexPart]:
    """Reduce the vertices of the parts until their common hull has at most `OUTLINE_POINTS`."""
    tries = ([_corners(part, most) for part in parts] for most in PART_POINTS)
    found = next((p for p in tries if len(ConvexHull(np.concatenate(p)).vertices) <= OUTLINE_POINTS), None)
    if found is None:
        raise InvalidValueError(f"the hull has more than {OUTLINE_POINTS} corners; lower max_parts.")
    return [ConvexPart(vertices=part) for part in found]


def _corners(vertices: Float[ndarray, "n 3"], most: int) -> Float[ndarray, "m 3"]:
    """Return the corners of a hull, or if there are more than `most`, the farthest in some directions."""
    corners = vertices[ConvexHull(vertices).vertices]
    if len(corners) <= most:
        return corners
    return corners[np.unique((corners @ sphere_points(most).T).argmax(axis=0))]
