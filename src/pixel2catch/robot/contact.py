"""Contact of the object: restitution as the damping of MuJoCo's direct `solref`."""


def contact_solref(restitution: float, physics_dt: float) -> tuple[float, float]:
    """Stiffness and damping of a contact, as the two negative numbers of a direct `solref`."""
    fraction = 0.2
    stiffness = fraction / physics_dt**2
    damping = (1.0 + restitution - 0.5 * fraction) / physics_dt
    return (-stiffness, -damping)
