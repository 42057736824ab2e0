"""Closed kinematic loops of a machine: dependent joints, closed poses, velocities and loads.

The loops of the MuJoCo model are closed with `multibody.closures`, starting from the home position
of the Machine. Each linkage keeps the assembly mode that it has at home.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.kinematics.drive_linkage import has_ball_ends
from hydrotele.machine import machine as loops
from hydrotele.machine.machine import Machine
from hydrotele.multibody import closures
from hydrotele.multibody.chain import Chain, load_chain
from hydrotele.multibody.closures import close_loops_from
from hydrotele.simulate.mechanism import (
    compile_mechanism,
    drive_and_load_dofs,
    pin_site_name,
    set_drives_to_load_positions,
    tilt_joint_name,
)

_MAX_JOINT_STEP = 0.2  # largest move of an independent joint between two solutions [rad] or [m]
_MAX_NEWTON_STEP = 0.3  # largest move of a dependent joint in an iteration of Newton's method [rad] or [m]
_CLOSED_TOLERANCE = 1.0e-12  # pin opening that counts as closed [m]: rounding of a 10 m machine
_MOTION_TOLERANCE = 1.0e-9  # the same for poses that are only displayed [m]


def dependent_joints(machine: Machine) -> tuple[str, ...]:
    """Return the names of the joints whose positions follow from the closed loops.

    These are the hinges of tubes, the slides of rods, and the undriven joints of links within a
    closure.
    """
    cylinders = [name for name, axis in machine.axes.items() if axis.cylinder]
    bars = [f"{name}_{part}" for name in cylinders for part in ("tube", "rod")]
    tilts = [tilt_joint_name(name) for name in cylinders if has_ball_ends(machine, name)]
    return (*bars, *tilts, *loops.find_dependent_joints(machine))


def independent_loop_joints(machine: Machine) -> list[str]:
    """Return the names of the independent joints that change the shape of a closed loop.

    These are the joints that a cylinder moves and the driven joints within a closure. The joint of
    a saw, for example, is part of no loop.
    """
    following = dependent_joints(machine)
    joints = [axis.joint for axis in machine.axes.values() if axis.cylinder]
    for closure in machine.closures.values():
        for link in loops.find_links_between(machine, closure.a.link, closure.b.link):
            joint = machine.links[link].joint
            joints += [joint.name] if joint else []
    return [name for name in dict.fromkeys(joints) if name not in following]


def count_pins(model: mujoco.MjModel) -> int:
    """Return the number of pins that close loops, the `connect` constraints of a MuJoCo model."""
    return int(np.count_nonzero(model.eq_type == mujoco.mjtEq.mjEQ_CONNECT))


def compute_loop_closure_error(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Return the largest loop closure error: the distance between the two halves of a pin [m].

    The positions are those of `data.site_xpos`, which are not recomputed.
    """
    return max_pin_opening(data.site_xpos, *pin_sites(model))


def pin_sites(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return two arrays (p,) of MuJoCo site ids: those at the first and at the second half of p pins.

    The pins are the `connect` constraints of the model.
    """
    pins = model.eq_type == mujoco.mjtEq.mjEQ_CONNECT
    return model.eq_obj1id[pins], model.eq_obj2id[pins]


@compiled
def max_pin_opening(site_positions, first_sites, second_sites):
    """Return the largest distance between the two halves of any pin, which is 0 for closed loops.

    Args:
        site_positions: (nsite, 3) positions of all sites [m].
        first_sites: (p,) site ids of the first halves, see `pin_sites`.
        second_sites: (p,) site ids of the second halves.

    Returns:
        The distance, scalar [m]; 0 without pins.

    Source: this module.
    """
    widest = 0.0
    for k in range(len(first_sites)):
        gap = 0.0
        for i in range(3):
            gap += (site_positions[first_sites[k], i] - site_positions[second_sites[k], i]) ** 2
        widest = max(widest, gap)
    return np.sqrt(widest)


class _Linkage(NamedTuple):
    """A model, its kinematic chain, and the indices (m,) of the dependent joints in the chain."""

    model: mujoco.MjModel
    chain: Chain
    following: np.ndarray


def _make_linkage(machine: Machine, model: mujoco.MjModel) -> _Linkage:
    chain, following = load_chain(model), dependent_joints(machine)
    return _Linkage(model, chain, np.array([chain.index(name) for name in following], np.int64))


def load_closed_chain(machine: Machine, target: Mapping[str, float] | None = None) -> Chain:
    """Return the kinematic chain of a machine; its start position (`Chain.start`) has closed loops.

    Args:
        machine: the machine.
        target: joint name -> angle [rad] or position [m] in the start position; other joints are at
            home.

    Raises:
        InputError: the linkages do not close at this position.
    """
    model = compile_mechanism(machine, ground=False, visuals=False)
    data = mujoco.MjData(model)
    close_loops(machine, model, data, target or {})
    chain = load_chain(model)
    return dataclasses.replace(chain, start=data.qpos[chain.qpos_indices])


def close_loops(machine: Machine, model: mujoco.MjModel, data: mujoco.MjData, target: Mapping[str, float]) -> None:
    """Move the independent joints to their target and close every loop.

    Starts from the machine's home position and moves to the target in small steps, so that each
    linkage keeps its assembly mode.

    Args:
        machine: the machine.
        model: its model.
        data: `qpos` is written; drive sides of transmissions get the position of their loads.
        target: joint name -> angle [rad] or position [m]; others stay at home.

    Raises:
        InputError: a loop cannot be closed (the target is outside the reach of a linkage).
    """
    _close_from_home(machine, model, data, target, _make_linkage(machine, model))


def _close_from_home(machine, model, data, target, linkage: _Linkage) -> None:
    """Move the independent joints from home to their targets in small steps, and close the loops.

    The loops are closed at each step. `target` is that of `close_loops`, and `data.qpos` is
    written. Raise InputError if a loop does not close.
    """
    following = dependent_joints(machine)
    names = [n for n in machine.joints if n not in following]
    places = [model.joint(n).qposadr[0] for n in names]
    home = np.array([machine.home.get(n, 0.0) for n in names])
    goal = np.array([target.get(n, h) for n, h in zip(names, home, strict=True)])
    data.qpos[:] = model.qpos0
    for name in following:
        data.qpos[model.joint(name).qposadr[0]] = machine.home.get(name, 0.0)
    shaping = np.isin(names, independent_loop_joints(machine))
    parts = 1 + int(np.max(np.abs(goal - home)[shaping], initial=0.0) / _MAX_JOINT_STEP)
    for part in range(parts + 1):
        data.qpos[places] = home + (goal - home) * part / parts
        if part == 0:
            _aim_cylinders(machine, model, data)
        if not _solve_closure(linkage, data, _CLOSED_TOLERANCE):
            where = ", ".join(f"{n} {v:.3f}" for n, v in zip(names, data.qpos[places], strict=True))
            raise InputError(f"machine {machine.name}", f"the linkages do not close at {where}")
    set_drives_to_load_positions(machine, model, data)


def _solve_closure(linkage: _Linkage, data: mujoco.MjData, tolerance: float) -> bool:
    """Close all loops by moving the dependent joints, starting from their positions in `data.qpos`.

    Also update the positions of bodies and sites in `data`. Newton's method stops when the largest
    distance between the two halves of a pin is `tolerance` [m].

    Returns:
        Whether the remaining distance is less than 1000 times the tolerance.
    """
    _, chain, following = linkage
    if not len(following):
        return True
    q = data.qpos[chain.qpos_indices]
    left = close_loops_from(chain.tree, q, following, tolerance, _MAX_NEWTON_STEP)
    data.qpos[chain.qpos_indices] = q
    mujoco.mj_kinematics(linkage.model, data)
    mujoco.mj_comPos(linkage.model, data)
    return bool(left < 1e3 * tolerance)


def close_along_motion(
    machine: Machine,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    joints: Mapping[str, np.ndarray],
) -> np.ndarray:
    """Compute the poses of the whole machine with closed loops along a motion of its independent joints.

    The first row, and each row in which a joint of a loop jumps by more than 0.2 rad or 0.2 m, is
    closed from the home position. The other rows are closed by Newton's method from the previous
    row. Thus every linkage keeps its assembly mode.

    Args:
        machine: the machine.
        model: its model.
        data: `qpos` is written with the pose of the last row.
        joints: independent joint name -> (n,) angles [rad] or positions [m]; others stay at home.

    Returns:
        (n, nq) values of `qpos` [m], [rad], with the pins closed to 1e-9 m.

    Raises:
        InputError: a joint is not independent, or a loop cannot be closed in some row.
    """
    following, linkage = dependent_joints(machine), _make_linkage(machine, model)
    free = [name for name in machine.joints if name not in following]
    if strange := [name for name in joints if name not in free]:
        raise InputError(f"joint {strange[0]}", f"cannot be set; the independent joints are {free}")
    values = np.stack([np.asarray(v, float) for v in joints.values()], 1) if joints else None
    if values is None or not len(values):
        _close_from_home(machine, model, data, {}, linkage)
        return np.tile(data.qpos, (0 if joints else 1, 1))
    places = [model.joint(n).qposadr[0] for n in joints]
    shaping = np.isin(list(joints), independent_loop_joints(machine))
    poses = np.empty((len(values), model.nq))
    for row, target in enumerate(values):
        moved = np.abs(target - values[row - 1])[shaping]
        near = row > 0 and moved.max(initial=0.0) <= _MAX_JOINT_STEP
        data.qpos[places] = target
        if not (near and _solve_closure(linkage, data, _MOTION_TOLERANCE)):
            asked = dict(zip(joints, target.tolist(), strict=True))
            try:
                _close_from_home(machine, model, data, asked, linkage)
            except InputError as error:
                raise InputError(f"{error.where}, row {row}", error.message) from None
        set_drives_to_load_positions(machine, model, data)
        poses[row] = data.qpos
    return poses


def _aim_cylinders(machine, model, data) -> None:
    """Set tube angles and rod displacements in `data.qpos` so that every tube points to its rod pin.

    This is the start value of Newton's method.
    """
    for _ in range(2):
        for name, axis in machine.axes.items():
            if not axis.cylinder:
                continue
            mujoco.mj_kinematics(model, data)
            tube = model.body(f"{name}_tube").id
            rod_pin = model.site(pin_site_name(f"{name}_pin", "b")).id
            way = data.site_xpos[rod_pin] - data.xpos[tube]
            parent = data.xmat[model.body_parentid[tube]].reshape(3, 3)
            hinge = model.joint(f"{name}_tube")
            along = np.array([1.0, 0.0, 0.0])  # the tube at angle 0
            across = np.cross(hinge.axis, along)
            local = parent.T @ way
            data.qpos[hinge.qposadr[0]] = np.arctan2(local @ across, local @ along)
            reach = np.linalg.norm(way) - axis.cylinder.closed_length
            data.qpos[model.joint(f"{name}_rod").qposadr[0]] = reach


def independent_dofs(machine: Machine, model: mujoco.MjModel) -> np.ndarray:
    """Return the indices in `qvel` of the independent joints, in ascending order.

    The drive sides of transmissions are excluded, because here they move with their loads.
    """
    dependent = [model.joint(n).dofadr[0] for n in dependent_joints(machine)]
    drives, _ = drive_and_load_dofs(machine, model)
    return np.setdiff1d(np.arange(model.nv), [*dependent, *drives])


def motion_basis(machine: Machine, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the velocities of all joints per unit velocity of each independent joint.

    Args:
        machine: the machine.
        model: its model.
        data: a configuration with closed loops.

    Returns:
        (nv, n) matrix N with `qvel = N @ qvel[independent_dofs(machine, model)]`. The drive sides of
        transmissions move with their loads.
    """
    _, chain, following = _make_linkage(machine, model)
    free = np.setdiff1d(np.arange(len(chain.joints)), following)
    every = np.eye(model.nv)
    moves = closures.motion_basis(chain, data.qpos[chain.qpos_indices], free)
    every[np.ix_(chain.dof_indices, chain.dof_indices[free])] = moves
    basis = every[:, independent_dofs(machine, model)]
    drives, loads = drive_and_load_dofs(machine, model)
    basis[drives] = basis[loads]
    return basis


def holding_forces(machine: Machine, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Compute the actuator forces that hold the machine at rest in its pose, without contact.

    By virtual work, `N^T (qfrc_bias - qfrc_passive) = N^T A^T F`, with N of `motion_basis` and the
    actuator moment arms A (nu, nv) of MuJoCo. The equations are solved for F by least squares.

    Args:
        machine: the machine.
        model: its model.
        data: a configuration with closed loops; velocity is taken as zero.

    Returns:
        (nu,) forces [N] or torques [N m].

    Source: Khoshzaban 1992, section 4.3 (forces of the minor links projected on the joints).
    """
    scratch = mujoco.MjData(model)
    scratch.qpos[:] = data.qpos
    mujoco.mj_fwdPosition(model, scratch)
    mujoco.mj_fwdVelocity(model, scratch)
    moment = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(
        moment, scratch.actuator_moment, scratch.moment_rownnz, scratch.moment_rowadr,
        scratch.moment_colind,
    )  # fmt: skip
    basis = motion_basis(machine, model, scratch)
    load = basis.T @ (scratch.qfrc_bias - scratch.qfrc_passive)
    return np.linalg.lstsq(basis.T @ moment.T, load, rcond=1e-10)[0]
