"""How large parameters are, to tell whether data say anything about them."""

from collections.abc import Sequence

import numpy as np

from hydrotele.identify.regressor import BODY_PARAMETERS, Regressor
from hydrotele.identify.setup import Setup

_PART = 0.05  # of a drive's force that friction or an offset may be where none is given
_SPEED = 0.1  # m/s or rad/s, at which viscous friction may be as large
_LEVER = 0.1  # m: friction of a pin acts on its radius, that of a drive on a lever ten times longer


def reference_sizes(
    table: Regressor, setup: Setup, forces: np.ndarray, drives: Sequence[str] | None = None
) -> np.ndarray:
    """Sizes of all parameters.

    A body's are its given mass and radius of gyration; friction's are as given, and at least a
    share of its drive's force.

    Args:
        table: the parameters.
        setup: of the regressor.
        forces: (k,) RMS of drives' forces [N] or [N m].
        drives: names of these drives; the table's by default.

    Returns:
        (m,) positive, in the parameters' units.
    """
    chain = setup.chain
    names = table.drives if drives is None else drives
    known = {d: float(f) for d, f in zip(names, forces, strict=True)}
    usual = float(np.max(forces)) if len(forces) else 1.0
    sizes = []
    for name, given in zip(table.names, table.nominal, strict=True):
        kind, _, place = name.partition(".")
        if kind in BODY_PARAMETERS:
            sizes.append(_body_size(chain.inertia, chain.bodies.index(place), kind))
        elif kind == "drive_inertia":
            sizes.append(max(float(chain.armature[chain.index(place)]), usual))
        else:
            size = _PART * known.get(place, _LEVER * usual)
            sizes.append(max(abs(given), size / _SPEED if kind.startswith("viscous") else size))
    return np.maximum(sizes, 1e-12)


def _body_size(inertia: np.ndarray, body: int, kind: str) -> float:
    mass = inertia[body, 0] or inertia[:, 0].max()
    own = inertia[body] if inertia[body, 0] else inertia[int(np.argmax(inertia[:, 0]))]
    radius = np.sqrt((own[4] + own[7] + own[9]) / 2.0 / mass)
    return float(mass * radius ** {"mass": 0, "moment": 1, "inertia": 2}[kind.partition("_")[0]])
