"""Neuromuscular dynamics of arm and hand: convert a reference displacement to muscle forces on the handle."""

from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.contiguous_state import split_array

_NOTCH_FORCE_FACTOR = 1.15  # factor on the force at a notch's edge, to overcome it
_MAX_POSITION_GAP, _MAX_ROTATION_GAP = (
    4e-4,
    4e-3,
)  # m, rad: limit on the position error that is integrated


class NeuromuscularState(NamedTuple):
    """Parameters and state of the neuromuscular dynamics of arm and hand, for the six handle axes.

    Attributes:
        reference: (6,) reference displacement of the handle [m], [rad].
        spring: (6,) expected stiffness of the joystick [N/m], [N m/rad].
        detent: (3, 6) detents: edge [m], [rad], force drop [N], [N m], stiffness outside the edge
            [N/m], [N m/rad], negative without a detent.
        correction: (6,) additional force, the integral of the delayed position error [N], [N m].
        force: (6,) force of the muscles on the handle [N], [N m].
        arm: (6,) stiffness of arm and hand [N/m], [N m/rad].
        cross: (1,) coupling stiffness of the arm between x and y [N/m].
        max_force: (6,) maximum force [N], [N m].
        weight: (6,) weight of the hand, which the muscles carry [N], [N m].
        gain: (1,) integral gain of the correction [1/s].
        rest: (6,) rest position of the arm after the neuromuscular lag [m], [rad].
        rate: (6,) rate of `rest` [m/s], [rad/s].
        lag: (6,) discrete neuromuscular lag for one control period, from `discretise_neuromuscular_lag`.
    """

    reference: np.ndarray
    spring: np.ndarray
    detent: np.ndarray
    correction: np.ndarray
    force: np.ndarray
    arm: np.ndarray
    cross: np.ndarray
    max_force: np.ndarray
    weight: np.ndarray
    gain: np.ndarray
    rest: np.ndarray
    rate: np.ndarray
    lag: np.ndarray


@compiled
def unpack_neuromuscular_state(flat):
    """Return the fields of NeuromuscularState as views of a flat array.

    Args:
        flat: (80,) array, as from `flat_view` of a NeuromuscularState.

    Returns:
        NeuromuscularState.

    Source: order and shapes of NeuromuscularState.
    """
    wanted, rest = split_array(flat, 6)
    spring, rest = split_array(rest, 6)
    notch, rest = split_array(rest, 18)
    correction, rest = split_array(rest, 6)
    force, rest = split_array(rest, 6)
    arm, rest = split_array(rest, 6)
    cross, rest = split_array(rest, 1)
    most, rest = split_array(rest, 6)
    weight, rest = split_array(rest, 6)
    gain, rest = split_array(rest, 1)
    place, rest = split_array(rest, 6)
    rate, lag = split_array(rest, 6)
    return NeuromuscularState(
        wanted, spring, notch.reshape(3, 6), correction, force, arm, cross, most, weight, gain,
        place, rate, lag,
    )  # fmt: skip


@compiled
def compute_muscle_forces(muscles, history, tremor, handle, tick, period):
    """Compute the muscle forces on the handle in one control period from the handle's reference.

    The rest position of the arm follows the reference through the neuromuscular lag. The force
    deflects the springs of arm and joystick to the rest position. A correction, which integrates
    the delayed position error, and tremor are added. The force is limited, and the weight of the
    hand is added.

    Args:
        muscles: NeuromuscularState. The result is `force`, the force on the handle; `rest` and
            `rate` (rest position of the arm and its rate) and `correction` (integrated force) are
            updated.
        history: (d + 1, 6) ring buffer of handle displacements for a reflex delay of d periods,
            written [m], [rad].
        tremor: (n, 6) tremor forces [N], [N m].
        handle: (6,) present displacement [m], [rad].
        tick: number of the period, scalar.
        period: control period, scalar [s].

    Returns:
        Nothing.

    Source: equilibrium-point control with a delayed integral; Feldman 1986. The rest position
        follows the reference through the neuromuscular lag; McRuer and Jex 1967.
    """
    rows, lag = len(history), muscles.lag
    noise = tick % len(tremor)
    for i in range(6):
        place, rate = muscles.rest[i], muscles.rate[i]
        muscles.rest[i] = lag[0] * place + lag[1] * rate + lag[2] * muscles.reference[i]
        muscles.rate[i] = lag[3] * place + lag[4] * rate + lag[5] * muscles.reference[i]
    for i in range(6):
        history[tick % rows, i] = handle[i]
        late = history[(tick + 1) % rows, i]
        spring, most, wanted = muscles.spring[i], muscles.max_force[i], muscles.rest[i]
        firm = muscles.arm[i] + spring
        known = firm * wanted
        beyond = abs(wanted) - muscles.detent[0, i]
        if muscles.detent[2, i] >= 0.0 and beyond > 0.0:
            firm = muscles.arm[i] + muscles.detent[2, i]
            back = spring * muscles.detent[0, i] - muscles.detent[1, i] + muscles.detent[2, i] * beyond
            if (late if wanted > 0.0 else -late) < muscles.detent[0, i]:
                back = _NOTCH_FORCE_FACTOR * spring * muscles.detent[0, i]  # force to overcome the notch's edge
            known = muscles.arm[i] * wanted + (back if wanted > 0.0 else -back)
        if i < 2:
            known += muscles.cross[0] * muscles.rest[1 - i]
        fine = _MAX_POSITION_GAP if i < 3 else _MAX_ROTATION_GAP
        gap = min(fine, max(-fine, wanted - late))
        more = muscles.gain[0] * period * firm * gap
        muscles.correction[i] = min(most, max(-most, muscles.correction[i] + more))
        force = known + muscles.correction[i] + tremor[noise, i]
        muscles.force[i] = min(most, max(-most, force)) + muscles.weight[i]


REFLEX_DELAY = 0.05  # s, delay from hand position to muscle force: stretch reflex and cortex
