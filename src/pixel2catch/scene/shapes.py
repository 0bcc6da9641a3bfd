"""Convex shapes as vertex arrays, and their mass properties.

Frame: the origin is the centre of the bounding box; axes of revolution and of prisms are along z. Round
shapes are polyhedra of at most 64 vertices. Their radius is enlarged so that the largest errors inside and
outside the surface are equal: 0.2 mm on rings of cylinders and cones, 0.7 mm on spheres of radius 0.04 m.
"""

from dataclasses import dataclass
from functools import cached_property
from math import cos, pi

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError

from pixel2catch.checks import Count, Positive, typed
from pixel2catch.errors import InvalidValueError
from pixel2catch.robots.poses import sphere_points

RING_POINTS = 32  #: Vertices of a circle. Source: ours.
SPHERE_POINTS = 64  #: Vertices of a sphere or an ellipsoid. Source: ours.


@dataclass(frozen=True, kw_only=True, eq=False)
class ConvexPart:
    """A convex body of uniform density."""

    vertices: Float[ndarray, "num_vertices 3"]  #: Corners of its hull [m].

    def moved(self, by: tuple[float, float, float]) -> "ConvexPart":
        """Return the body shifted by a vector [m]."""
        return ConvexPart(vertices=self.vertices + np.array(by))

    @cached_property
    def hull(self) -> ConvexHull:
        """Return the hull of the corners."""
        try:
            return ConvexHull(self.vertices)
        except (QhullError, ValueError) as error:
            raise InvalidValueError(
                "a part has no volume; give corners [m] that are not in one plane."
            ) from error

    @cached_property
    def faces(self) -> Float[ndarray, "num_faces 3 3"]:
        """Return the triangles of the hull [m], counter-clockwise seen from outside."""
        triangles = self.vertices[self.hull.simplices]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        is_inward = np.einsum("ij,ij->i", normals, self.hull.equations[:, :3]) < 0
        triangles[is_inward] = triangles[is_inward][:, ::-1]
        return triangles


def moments(faces: Float[ndarray, "num_faces 3 3"]) -> Float[ndarray, "4 4"]:
    """Return the integral of (1, x) (1, x)ᵀ over the solid of density 1 in a closed surface [m³, m⁴, m⁵].

    Triangles [m] are counter-clockwise seen from outside. Integrals of disjoint solids add up.
    """
    volumes = np.linalg.det(faces) / 6.0
    sums = faces.sum(axis=1)
    second = np.einsum("f,fi,fj->ij", volumes, sums, sums) + np.einsum("f,fki,fkj->ij", volumes, faces, faces)
    first = volumes @ sums / 4.0
    return np.block([[volumes.sum(), first], [first[:, None], second / 20.0]])


def center_of_mass(solid: Float[ndarray, "4 4"]) -> Float[ndarray, "3"]:
    """Return the centre of mass [m] of a solid with these moments."""
    return solid[0, 1:] / solid[0, 0]


def inertia(solid: Float[ndarray, "4 4"], mass: float) -> Float[ndarray, "3 3"]:
    """Return the inertia about the centre of mass [kg·m²] of a solid with these moments and mass [kg]."""
    center = center_of_mass(solid)
    covariance = mass * (solid[1:, 1:] / solid[0, 0] - np.outer(center, center))
    return np.trace(covariance) * np.eye(3) - covariance


@typed
def box(x: Positive, y: Positive, z: Positive) -> ConvexPart:
    """Return a box with these edge lengths [m]."""
    signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=float)
    return ConvexPart(vertices=0.5 * signs * (x, y, z))


@typed
def prism(num_corners: Count, edge: Positive, height: Positive) -> ConvexPart:
    """Return a regular polygon with this edge length [m] in the xy plane, extruded along z."""
    angles = 2 * pi * np.arange(num_corners) / num_corners
    outline = edge / (2 * np.sin(pi / num_corners)) * np.column_stack((np.cos(angles), np.sin(angles)))
    low, high = (np.column_stack((outline, np.full(num_corners, z))) for z in (-height / 2, height / 2))
    return ConvexPart(vertices=np.concatenate((low, high)))


def _ring(
    radius: float, z: float, num_points: int = RING_POINTS, turn: float = 0.0
) -> Float[ndarray, "num_points 3"]:
    """Return a circle [m] at height z with balanced errors, rotated by `turn` point spacings."""
    angles = 2 * pi * (np.arange(num_points) + turn) / num_points
    outer = 2 * radius / (1 + cos(pi / num_points))
    return np.column_stack((outer * np.cos(angles), outer * np.sin(angles), np.full(num_points, z)))


@typed
def cylinder(radius: Positive, height: Positive) -> ConvexPart:
    """Return a cylinder along z [m]."""
    return ConvexPart(vertices=np.concatenate([_ring(radius, z) for z in (-height / 2, height / 2)]))


@typed
def cone(radius: Positive, height: Positive) -> ConvexPart:
    """Return a cone along z with its tip up [m]."""
    return ConvexPart(vertices=np.concatenate((_ring(radius, -height / 2), [(0.0, 0.0, height / 2)])))


@typed
def capsule(radius: Positive, length: Positive) -> ConvexPart:
    """Return a cylinder of this length [m] along z between half-spheres with rings at 0°, 32°, 64°."""
    rings = ((0.0, 16), (32.0, 10), (64.0, 5))
    caps = []
    for latitude, num_points in rings:
        angle = np.radians(latitude)
        ring = _ring(
            radius * np.cos(angle), length / 2 + radius * np.sin(angle), num_points, turn=latitude / 64
        )
        caps += [ring, ring * (1, 1, -1)]
    pole = length / 2 + radius
    return ConvexPart(vertices=np.concatenate((*caps, [(0, 0, pole), (0, 0, -pole)])))


@typed
def ellipsoid(x: Positive, y: Positive, z: Positive) -> ConvexPart:
    """Return an ellipsoid with these semi-axes [m]."""
    points = sphere_points(SPHERE_POINTS)
    nearest_face = ConvexHull(points).equations[:, 3].max()
    return ConvexPart(vertices=points * 2 / (1 - nearest_face) * (x, y, z))


def sphere(radius: float) -> ConvexPart:
    """Return a sphere [m]."""
    return ellipsoid(radius, radius, radius)
