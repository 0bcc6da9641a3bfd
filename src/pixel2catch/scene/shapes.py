"""Convex shapes as vertex arrays, and their mass properties.

Frames: every shape is centred on its bounding box; axes of revolution and prisms are along z. Round shapes
are polyhedra of at most 64 vertices. Their radius is enlarged so that inside and outside errors of the
outline are equal: 0.2 mm on the rings of cylinders and cones, 0.7 mm on the spheres of radius 0.04.
"""

from dataclasses import dataclass
from functools import cached_property
from math import cos, pi, sqrt

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import ConvexHull

RING_POINTS = 32
"""Vertices of a circle. Source: ours."""

SPHERE_POINTS = 64
"""Vertices of a sphere or an ellipsoid. Source: ours."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ConvexPart:
    """A convex body of uniform density, given by the corners of its hull."""

    vertices: Float[ndarray, "num_vertices 3"]  #: Corners [m].

    @cached_property
    def faces(self) -> Float[ndarray, "num_faces 3 3"]:
        """Corners of the triangles of the hull, counter-clockwise seen from outside."""
        hull = ConvexHull(self.vertices)
        triangles = self.vertices[hull.simplices]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        is_inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0
        triangles[is_inward] = triangles[is_inward][:, ::-1]
        return triangles

    def moved(self, offset: tuple[float, float, float] | Float[ndarray, "3"]) -> "ConvexPart":
        """The same part, shifted by an offset [m]."""
        return ConvexPart(vertices=self.vertices + np.asarray(offset))

    def scaled(self, factor: float) -> "ConvexPart":
        """The same part, larger by a factor, as seen from the origin."""
        return ConvexPart(vertices=self.vertices * factor)

    def turned(self, rotation: Float[ndarray, "3 3"]) -> "ConvexPart":
        """The same part, rotated about the origin."""
        return ConvexPart(vertices=self.vertices @ rotation.T)


@dataclass(frozen=True, kw_only=True, eq=False)
class VolumeMoments:
    """Moments of a solid of density 1; they add up over disjoint solids and subtract over overlaps."""

    volume: float  #: Integral of 1 [m³].
    first: Float[ndarray, "3"]  #: Integral of x [m⁴].
    second: Float[ndarray, "3 3"]  #: Integral of x xᵀ [m⁵].

    def __add__(self, other: "VolumeMoments") -> "VolumeMoments":
        """Moments of two disjoint solids."""
        return VolumeMoments(
            volume=self.volume + other.volume,
            first=self.first + other.first,
            second=self.second + other.second,
        )

    def __sub__(self, other: "VolumeMoments") -> "VolumeMoments":
        """Moments of a solid without a part of it."""
        return VolumeMoments(
            volume=self.volume - other.volume,
            first=self.first - other.first,
            second=self.second - other.second,
        )

    def center(self) -> Float[ndarray, "3"]:
        """Centre of mass [m]."""
        return self.first / self.volume

    def inertia(self, mass: float) -> Float[ndarray, "3 3"]:
        """Inertia about the centre of mass [kg·m²] of a uniform solid of this mass [kg]."""
        center = self.center()
        covariance = mass * (self.second / self.volume - np.outer(center, center))
        return np.trace(covariance) * np.eye(3) - covariance


def moments(part: ConvexPart) -> VolumeMoments:
    """Integrate over the tetrahedra between the origin and each face."""
    faces = part.faces
    volumes = np.linalg.det(faces) / 6.0
    sums = faces.sum(axis=1)
    second = np.einsum("f,fi,fj->ij", volumes, sums, sums) + np.einsum("f,fki,fkj->ij", volumes, faces, faces)
    return VolumeMoments(volume=float(volumes.sum()), first=volumes @ sums / 4.0, second=second / 20.0)


def box(x: float, y: float, z: float) -> ConvexPart:
    """A box with these edge lengths [m]."""
    signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=float)
    return ConvexPart(vertices=0.5 * signs * (x, y, z))


def prism(outline: Float[ndarray, "num_corners 2"], height: float) -> ConvexPart:
    """The outline [m] in the xy plane, extruded along z."""
    low, high = (np.column_stack((outline, np.full(len(outline), z))) for z in (-height / 2, height / 2))
    return ConvexPart(vertices=np.concatenate((low, high)))


def polygon(num_corners: int, edge: float) -> Float[ndarray, "num_corners 2"]:
    """Corners [m] of a regular polygon with this edge length."""
    angles = 2 * pi * np.arange(num_corners) / num_corners
    return edge / (2 * np.sin(pi / num_corners)) * np.column_stack((np.cos(angles), np.sin(angles)))


def _ring(
    radius: float, z: float, num_points: int = RING_POINTS, turn: float = 0.0
) -> Float[ndarray, "num_points 3"]:
    """A circle [m] at height z, enlarged so that corners and edges err alike; `turn` in point spacings."""
    angles = 2 * pi * (np.arange(num_points) + turn) / num_points
    outer = 2 * radius / (1 + cos(pi / num_points))
    return np.column_stack((outer * np.cos(angles), outer * np.sin(angles), np.full(num_points, z)))


def cylinder(radius: float, height: float) -> ConvexPart:
    """A cylinder along z."""
    return ConvexPart(vertices=np.concatenate([_ring(radius, z) for z in (-height / 2, height / 2)]))


def cone(radius: float, height: float) -> ConvexPart:
    """A cone with its tip up."""
    return ConvexPart(vertices=np.concatenate((_ring(radius, -height / 2), [(0.0, 0.0, height / 2)])))


def capsule(radius: float, length: float) -> ConvexPart:
    """A cylinder of this length along z between half-spheres of rings at 0°, 32° and 64° and a pole."""
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


def ellipsoid(x: float, y: float, z: float) -> ConvexPart:
    """An ellipsoid with these semi-axes [m]; its vertices follow a spiral of equal areas."""
    k = np.arange(SPHERE_POINTS) + 0.5
    height = 1 - 2 * k / SPHERE_POINTS
    angle = pi * (1 + sqrt(5)) * k
    ring = np.sqrt(1 - height**2)
    points = np.column_stack((ring * np.cos(angle), ring * np.sin(angle), height))
    nearest_face = ConvexHull(points).equations[:, 3].max()
    return ConvexPart(vertices=points * 2 / (1 - nearest_face) * (x, y, z))


def sphere(radius: float) -> ConvexPart:
    """A sphere."""
    return ellipsoid(radius, radius, radius)
