"""The simulation of an episode as its task sees it: MuJoCo's arrays by name."""

# pyright: reportCallIssue=false, reportPrivateImportUsage=false
# numba's intrinsics are called without their typing context, and carray is its documented API.

from typing import NamedTuple

import numpy as np
from numba import carray

from hydrotele.core.compiled import compiled
from hydrotele.simulate.pointers import field, floats, pointer
from hydrotele.tasks.memory import MEASURES


class World(NamedTuple):
    """Live arrays of one simulation.

    Attributes:
        qpos: (nq,) positions; staggered, see `simulate.record`.
        qvel: (nv,) velocities.
        act: (na,) activations.
        ctrl: (k,) commands that act.
        tip: (3,) place of the arm's tip at the time of the activations [m].
        xfrc: (6 nbody,) forces and torques from outside on bodies, world frame [N], [N m].
        xpos: (3 nbody,) places of bodies [m], of the last physics step.
        xipos: (3 nbody,) places of their centres of mass [m].
        xquat: (4 nbody,) quaternions of the bodies.
        xmat: (9 nbody,) their rotation matrices.
        eq_active: (neq,) uint8, which equalities act; part of the state.
        eq_data: (neq eq_width,) numbers of the equalities for the rest of this call.
        eq_rows: the same from the next call on; empty unless the task writes them.
        terrain: (width,) what the episode keeps of its ground, empty without.
        measures: (MEASURES,) figures of this step, for `info`.
        model: address of mjModel.
        data: address of mjData.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray
    tip: np.ndarray
    xfrc: np.ndarray
    xpos: np.ndarray
    xipos: np.ndarray
    xquat: np.ndarray
    xmat: np.ndarray
    eq_active: np.ndarray
    eq_data: np.ndarray
    eq_rows: np.ndarray
    terrain: np.ndarray
    measures: np.ndarray
    model: int
    data: int


@compiled
def world(f, m, d, sim):
    """The World of a simulation.

    Args:
        f: record of FACTS.
        m: address of its mjModel, scalar.
        d: address of its mjData, scalar.
        sim: its number, scalar.

    Returns:
        The World.

    Source: `simulate.layout`.
    """
    place = carray(pointer(d + f.at_site), (1,), np.int64)[0]
    active = carray(pointer(d + f.at_eq_active), (1,), np.int64)[0]
    numbers = f.neq * f.eq_width
    site = f.tip_site if f.tip_site >= 0 else 0
    return World(
        field(d, f.at_qpos, f.nq),
        field(d, f.at_qvel, f.nv),
        field(d, f.at_act, f.na),
        field(d, f.at_ctrl, f.axes),
        floats(place + 24 * site, 3),
        field(d, f.at_xfrc, 6 * f.nbody),
        field(d, f.at_xpos, 3 * f.nbody),
        field(d, f.at_xipos, 3 * f.nbody),
        field(d, f.at_xquat, 4 * f.nbody),
        field(d, f.at_xmat, 9 * f.nbody),
        carray(pointer(active), (f.neq,), np.uint8),
        field(m, f.at_eq_data, numbers),
        floats(f.eq_rows + 8 * sim * numbers, numbers if f.eq_rows else 0),
        floats(f.terrain + 8 * sim * f.width, f.width),
        floats(f.measures + 8 * sim * MEASURES, MEASURES),
        m,
        d,
    )
