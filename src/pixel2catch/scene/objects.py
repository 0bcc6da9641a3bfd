"""The catalogue of thrown objects: convex parts of uniform density.

The body frame of an object has its origin at the centre of mass and its axes along the principal axes of
inertia. Differs: the release's cone has its origin at half its height.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import pi, radians
from typing import Annotated

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pixel2catch.checks import NAME, Positive, require_valid
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.own_files import catalogue
from pixel2catch.robots.poses import principal_axes
from pixel2catch.scene import shapes
from pixel2catch.scene.shapes import ConvexPart, moments

OBJECT_MASS = 0.03  #: Mass of every object [kg]. Source: release.

OBJECT_BOUND = 0.3  #: Half the edge of a cube about the body origin that contains every object [m].
DENSITIES = (1.0, 23_000.0)  #: Of objects [kg/m³]. Source: air, osmium.


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectSpec:
    """A thrown object."""

    name: Annotated[str, NAME]  #: Its name in the catalogue.
    parts: tuple[ConvexPart, ...]  #: Convex parts in the body frame; they may overlap.
    mass: Positive  #: Mass [kg].
    inertia: Float[ndarray, "3"]  #: Principal moments of inertia about the axes of the body frame [kg·m²].
    radius: Positive  #: Radius of a ball of the same volume [m].

    def __post_init__(self) -> None:
        """Refuse what no body of this size can be, such as lengths in millimetres or a mass in grams."""
        require_valid(self, f"object '{self.name}'")
        size = np.abs(np.concatenate([part.vertices for part in self.parts])).max(axis=0)
        squares = (self.inertia.sum() / 2.0 - self.inertia) / self.mass  # means along the axes [m²]
        density = 0.75 * self.mass / (pi * self.radius**3)
        is_body = DENSITIES[0] <= density <= DENSITIES[1] and ((squares > 0.0) & (squares < size**2)).all()
        if size.max() > OBJECT_BOUND or not is_body:
            raise InvalidValueError(
                f"object '{self.name}' extends {100 * size.max():.3g} cm from its centre of mass, has "
                f"{density:.3g} kg/m³ and inertia {self.inertia} kg·m²; give up to {100 * OBJECT_BOUND:g}"
                f" cm, {DENSITIES[0]:g} to {DENSITIES[1]:g} kg/m³ and a possible inertia: lengths in m (a "
                "mesh in millimetres: scale 0.001), a mass in kg."
            )

    @property
    def drag_area(self) -> float:
        """Return drag coefficient times area, mean over all orientations [m²].

        The object is replaced by the box with its inertia, of drag coefficient 1. A face A contributes A / 4,
        the mean of A |n|³ over all directions n. Source: MuJoCo documentation, fluid forces, inertia model.
        """
        x, y, z = np.sqrt(6.0 / self.mass * (self.inertia.sum() / 2.0 - self.inertia) * 2.0)
        return float(x * y + y * z + z * x) / 4.0

    def scaled(self, factor: float) -> "ObjectSpec":
        """Return the object scaled by a factor, with the same mass."""
        parts = tuple(ConvexPart(vertices=part.vertices * factor) for part in self.parts)
        return replace(self, parts=parts, inertia=self.inertia * factor**2, radius=self.radius * factor)


def make_object(
    name: str, *parts: ConvexPart, mass: float = OBJECT_MASS, overlap: ConvexPart | None = None
) -> ObjectSpec:
    """Return an object of a mass [kg] and convex parts, such as `shapes.box(0.05, 0.05, 0.08)`.

    Parts are in any common frame [m]. The `overlap` of two parts counts once in the mass properties.
    """
    if not parts:
        raise InvalidValueError(f"object '{name}' has no parts; give one or more of `scene.shapes`.")
    solid = np.sum([moments(part.faces) for part in parts], axis=0)
    return of_solid(name, parts, solid - moments(overlap.faces) if overlap else solid, mass)


def of_solid(name: str, parts: Iterable[ConvexPart], solid: Float[ndarray, "4 4"], mass: float) -> ObjectSpec:
    """Return an object that collides as its parts, with a mass [kg] and the moments of a solid."""
    if not solid[0, 0] > 1e-12:
        raise InvalidValueError(f"object '{name}' has no volume; give parts larger than their overlap.")
    inertia = shapes.inertia(solid, mass)
    axes = _principal_axes(inertia)
    center = shapes.center_of_mass(solid)
    return ObjectSpec(
        name=name,
        parts=tuple(ConvexPart(vertices=(part.vertices - center) @ axes) for part in parts),
        mass=mass,
        inertia=np.diag(axes.T @ inertia @ axes).copy(),
        radius=float(np.cbrt(0.75 * solid[0, 0] / np.pi)),
    )


def _principal_axes(inertia: Float[ndarray, "3 3"]) -> Float[ndarray, "3 3"]:
    """Return right-handed principal axes as columns; the identity if the axes are nearly principal."""
    off_diagonal = inertia - np.diag(np.diag(inertia))
    is_principal = np.abs(off_diagonal).max() < 2e-3 * np.trace(inertia)
    return np.eye(3) if is_principal else principal_axes(inertia)[1]


def _l_block(name: str, leg: float, width: float, depth: float) -> ObjectSpec:
    """Return two bars at a right angle, with outer leg length, width, and depth along z [m]."""
    long_bar = shapes.box(leg, width, depth)
    short_bar = shapes.box(width, leg - width, depth).moved((-(leg - width) / 2, leg / 2, 0.0))
    return make_object(name, long_bar, short_bar)


def _bent(name: str, length: float, width: float, angle: float, mass: float) -> ObjectSpec:
    """Return two bars of a length and width [m] with an angle [rad] between them."""
    bar = shapes.box(length, width, width).moved((0.5 * (length - width * np.tan(0.25 * angle)), 0.0, 0.0))
    half = 0.5 * (np.pi - angle)
    turn = np.array([[np.cos(half), np.sin(half), 0.0], [-np.sin(half), np.cos(half), 0.0], [0.0, 0.0, 1.0]])
    right = bar.vertices @ turn.T
    return make_object(name, *(ConvexPart(vertices=right * (side, 1.0, 1.0)) for side in (1, -1)), mass=mass)


_GROUPS: dict[str, tuple[ObjectSpec, ...]] = {
    # Training objects: five shapes in two sizes. Source: release.
    "seen": (
        make_object("cone_s", shapes.cone(0.04, 0.08)),
        make_object("cone_l", shapes.cone(0.045, 0.09)),
        make_object("cylinder_s", shapes.cylinder(0.03, 0.06)),
        make_object("cylinder_l", shapes.cylinder(0.035, 0.07)),
        make_object("cube_s", shapes.box(0.05, 0.05, 0.05)),
        make_object("cube_l", shapes.box(0.06, 0.06, 0.06)),
        make_object("sphere_s", shapes.sphere(0.035)),
        make_object("sphere_l", shapes.sphere(0.04)),
        make_object("capsule_s", shapes.capsule(0.025, 0.04)),
        make_object("capsule_l", shapes.capsule(0.03, 0.05)),
    ),
    # Validation objects. Source: shapes: ours (paper, Fig. 3, shows but does not list them); sizes: ours.
    "unseen": (
        _l_block("l_block", 0.07, 0.03, 0.05),
        make_object("triangular_prism", shapes.prism(3, 0.07, 0.06)),
        make_object("hexagonal_prism", shapes.prism(6, 0.035, 0.06)),
        make_object("ellipsoid", shapes.ellipsoid(0.025, 0.03, 0.04)),
        make_object(
            "cross",
            shapes.box(0.08, 0.03, 0.05),
            shapes.box(0.03, 0.08, 0.05),
            overlap=shapes.box(0.03, 0.03, 0.05),
        ),
    ),
    # Objects of the real experiment. Source: shapes: paper; sizes: ours.
    "real": (
        make_object("real_cube", shapes.box(0.06, 0.06, 0.06)),
        _l_block("real_l_block", 0.08, 0.035, 0.06),
        make_object("real_triangle", shapes.prism(3, 0.08, 0.06)),
    ),
    # Balls and boxes for one hand and for two, named by their longest extent [cm]. Source: ours: toy balls
    # and parcels, the large ones of 20 to 70 kg/m³.
    "sizes": (
        make_object("ball_6", shapes.sphere(0.03), mass=0.03),
        make_object("ball_10", shapes.sphere(0.05), mass=0.05),
        make_object("ball_16", shapes.sphere(0.08), mass=0.1),
        make_object("ball_22", shapes.sphere(0.11), mass=0.18),
        make_object("ball_28", shapes.sphere(0.14), mass=0.28),
        make_object("box_6", shapes.box(0.06, 0.05, 0.04), mass=0.03),
        make_object("box_10", shapes.box(0.1, 0.08, 0.06), mass=0.05),
        make_object("box_16", shapes.box(0.16, 0.14, 0.11), mass=0.1),
        make_object("box_22", shapes.box(0.22, 0.18, 0.15), mass=0.18),
        make_object("box_28", shapes.box(0.28, 0.22, 0.18), mass=0.28),
    ),
    # Objects of similar sizes, not used in training. Source: ours.
    "sizes_unseen": (
        make_object("ball_8", shapes.sphere(0.04), mass=0.04),
        make_object("ball_19", shapes.sphere(0.095), mass=0.14),
        make_object("ball_25", shapes.sphere(0.125), mass=0.22),
        make_object("cube_20", shapes.box(0.2, 0.2, 0.2), mass=0.2),
        make_object("drum_24", shapes.cylinder(0.1, 0.24), mass=0.22),
    ),
    # Long and irregular things for one hand. Source: ours: an empty bottle of 0.5 l whose drag is that of the
    # recorded flights of one, a wooden rod, a foam bar, an elbow.
    "long": (
        make_object("empty_bottle", shapes.cylinder(0.032, 0.2), mass=0.032),
        make_object("rod_16", shapes.cylinder(0.012, 0.16), mass=0.05),
        make_object("bar_18", shapes.box(0.03, 0.03, 0.18), mass=0.03),
        _bent("elbow_14", length=0.1, width=0.03, angle=radians(90.0), mass=0.04),
    ),
    # Objects of the same kind, not used in training. Source: ours.
    "long_unseen": (
        make_object("stick_20", shapes.cylinder(0.0125, 0.2), mass=0.06),
        _bent("banana", length=0.1, width=0.035, angle=radians(130.0), mass=0.12),
    ),
}

OBJECTS: dict[str, ObjectSpec] = catalogue(
    ObjectSpec, {spec.name: spec for group in _GROUPS.values() for spec in group}, taken=_GROUPS
)
"""All objects by name, in the order of the object table; those of user files are last."""

OBJECT_GROUPS = {name: tuple(spec.name for spec in group) for name, group in _GROUPS.items()}
"""Names of the objects of each group."""

SEEN, UNSEEN, REAL, SIZES, SIZES_UNSEEN, LONG, LONG_UNSEEN = OBJECT_GROUPS.values()


def largest_radius(names: Iterable[str], scale: float = 1.0) -> float:
    """Return the radius of a ball with the volume of the largest object [m], rounded to 1 mm."""
    return round(scale * max(OBJECTS[name].radius for name in names), 3)


def num_parts() -> int:
    """Return the number of geoms of the object's body; geoms that an object does not need lie inside it."""
    return max(len(spec.parts) for spec in OBJECTS.values())


def select_objects(names: str | Iterable[str]) -> tuple[str, ...]:
    """Return the names of objects for names of objects and groups, in the given order without repeats.

    A string may have several names with commas between them. Raises UnknownNameError for any other name.
    """
    texts = [names] if isinstance(names, str) else names
    wanted = [name.strip() for text in texts for name in text.split(",")]
    if not wanted:
        raise InvalidValueError("no object was given; give an object or a group: " + ", ".join(OBJECT_GROUPS))
    selected: dict[str, None] = {}
    for name in wanted:
        if name not in OBJECTS and name not in OBJECT_GROUPS:
            raise UnknownNameError("object", name, [*OBJECT_GROUPS, *OBJECTS])
        selected |= dict.fromkeys(OBJECT_GROUPS.get(name, (name,)))
    return tuple(selected)


def surface_points(spec: ObjectSpec, num_points: int, seed: int = 0) -> Float[ndarray, "num_points 3"]:
    """Return points on the surface of an object, body frame [m].

    The first points are all vertices, or those of the convex hull of all parts if there are too many; they
    bound the outline in an image exactly. The others are uniformly distributed over the outer surface.
    """
    vertices = np.concatenate([part.vertices for part in spec.parts])
    if num_points < len(vertices):
        vertices = vertices[ConvexPart(vertices=vertices).hull.vertices]
    if num_points < len(vertices):
        raise InvalidValueError(f"num_points is {num_points}; '{spec.name}' needs at least {len(vertices)}.")
    rng = np.random.default_rng(seed)
    faces = np.concatenate([part.faces for part in spec.parts])
    areas = 0.5 * np.linalg.norm(np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]), axis=1)
    num_candidates = 8 * (num_points - len(vertices)) + 64
    chosen = faces[rng.choice(len(faces), num_candidates, p=areas / areas.sum())]
    weights = rng.dirichlet((1.0, 1.0, 1.0), num_candidates)
    candidates = np.einsum("nk,nkd->nd", weights, chosen)
    outside = candidates[~_is_inside(spec, candidates)]
    return np.concatenate((vertices, outside[: num_points - len(vertices)]))


def _is_inside(spec: ObjectSpec, points: Float[ndarray, "n 3"]) -> ndarray:
    """Return whether each point lies strictly inside a part, or on the face between two parts."""
    planes = [part.hull.equations for part in spec.parts]  # outward normals and offsets [m]
    depths = np.stack([-(points @ each[:, :3].T + each[:, 3]).max(axis=1) for each in planes])
    return (depths > 1e-6).any(axis=0) | ((depths > -1e-9).sum(axis=0) > 1)
