"""Names of what is added to a machine's MJCF; a prefix keeps them apart from the user's own."""

OWN = "hydrotele_"
"""What the names begin with of all that no file of the user names."""

GROUND = f"{OWN}ground"
"""Name of the ground's geom, texture and material."""

TIP_SITE = f"{OWN}tip"
"""Name of the site at the arm's tip."""


def pin_site(closure: str, end: str) -> str:
    """Name of the site at an end, a or b, of a closure; a cylinder's is `<axis>_pin`."""
    return f"{OWN}{closure}_{end}"
