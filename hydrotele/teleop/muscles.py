"""Muscles of the simulated operator: from a wanted displacement to forces on the handle."""

from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled

_THROUGH = 1.15  # times the force at a notch's edge, to get over it
_FINE, _FINE_TURN = 4e-4, 4e-3  # m, rad: a larger gap is a way to go, nothing to learn from


class Muscles(NamedTuple):
    """Numbers and state of the muscles.

    Attributes:
        wanted: (6,) displacement of the handle [m], [rad].
        spring: (6,) what the joystick is expected to push back with [N/m], [N m/rad].
        notch: (3, 6) of its detents: edge [m], [rad], drop [N], [N m], slope outside [N/m], < 0
            without a detent.
        correction: (6,) what was learnt to be missing [N], [N m].
        force: (6,) on the handle [N], [N m].
        arm: (6,) stiffness of arm and hand [N/m], [N m/rad].
        most: (6,) largest force [N], [N m].
        weight: (6,) of the hand, which they carry [N], [N m].
        gain: (1,) of the correction [1/s].
    """

    wanted: np.ndarray
    spring: np.ndarray
    notch: np.ndarray
    correction: np.ndarray
    force: np.ndarray
    arm: np.ndarray
    most: np.ndarray
    weight: np.ndarray
    gain: np.ndarray


@compiled
def unpack_muscles(flat):
    """The parts of `flat_view(Muscles)`.

    Args:
        flat: (61,) array.

    Returns:
        Muscles, views of it.

    Source: order and shapes of Muscles.
    """
    return Muscles(
        flat[0:6], flat[6:12], flat[12:30].reshape(3, 6), flat[30:36], flat[36:42], flat[42:48],
        flat[48:54], flat[54:60], flat[60:61],
    )  # fmt: skip


@compiled
def pull(muscles, past, tremor, handle, tick, period):
    """Forces of one period: the arm's rest moves with what is wanted, the rest is corrected late.

    Args:
        muscles: Muscles; `correction` and `force` are written.
        past: (reflex + 1, 6) displacements of the last periods, written [m], [rad].
        tremor: (n, 6) of the run [N], [N m].
        handle: (6,) displacement of now [m], [rad].
        tick: number of the period, scalar.
        period: scalar [s].

    Returns:
        Nothing.

    Source: equilibrium-point control with a late integral; Feldman 1986.
    """
    rows = len(past)
    noise = tick % len(tremor)
    for i in range(6):
        past[tick % rows, i] = handle[i]
        late = past[(tick + 1) % rows, i]
        wanted, spring, most = muscles.wanted[i], muscles.spring[i], muscles.most[i]
        firm = muscles.arm[i] + spring
        known = firm * wanted
        beyond = abs(wanted) - muscles.notch[0, i]
        if muscles.notch[2, i] >= 0.0 and beyond > 0.0:
            firm = muscles.arm[i] + muscles.notch[2, i]
            back = spring * muscles.notch[0, i] - muscles.notch[1, i] + muscles.notch[2, i] * beyond
            if (late if wanted > 0.0 else -late) < muscles.notch[0, i]:
                back = _THROUGH * spring * muscles.notch[0, i]  # first over the notch's edge
            known = muscles.arm[i] * wanted + (back if wanted > 0.0 else -back)
        fine = _FINE if i < 3 else _FINE_TURN
        gap = min(fine, max(-fine, wanted - late))
        more = muscles.gain[0] * period * firm * gap
        muscles.correction[i] = min(most, max(-most, muscles.correction[i] + more))
        force = known + muscles.correction[i] + tremor[noise, i]
        muscles.force[i] = min(most, max(-most, force)) + muscles.weight[i]
