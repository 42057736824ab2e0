"""Hydraulics inside MuJoCo at native speed: compiled actuator callbacks.

Every hydraulic actuator has four activations, and its parameters are in `actuator_user`
(`parameters.Slot`). The callback of the last one advances all of them, because they share the
supply, and MuJoCo clears an actuator's rates just before its callback. The last actuator also owns
the bristle states of all axes and the state of a pump with a time constant. A force drive with
bristles has two activations: the bristle state and the command, since MuJoCo computes the force
from the last activation. The force uses the pressures at the end of the step, as with `actearly`;
otherwise explicit stepping would add negative damping.

The callbacks use only their arguments mjModel and mjData. They are thread-safe, and a model can be
randomised through `actuator_user`. Actuators without the marker are ignored. The terms of a machine
are custom numerics of its model, which may differ between the models of a batch.
"""
# pyright: reportCallIssue=false, reportPrivateImportUsage=false
# numba's intrinsics are called without their typing context, and carray is its documented API.

import ctypes
import functools
from typing import NamedTuple

import mujoco
import numpy as np
from llvmlite import binding
from numba import carray, types
from numba.core import cgutils
from numba.extending import intrinsic

from hydrotele.core.compiled import allocation_free, callback, compiled
from hydrotele.core.memory import floats, pointer
from hydrotele.hydraulics.actuator import bristle_friction, bristle_rate, settled_bristle_friction
from hydrotele.hydraulics.circuit import (
    MAX_AXES,
    NO_MEMORY,
    SCRATCH,
    SLOTS,
    Kind,
    Slot,
    actuator_friction,
    add_to_commands,
    advance_memories,
    circuit_supply,
    delivered_share,
    drive_state,
    open_ports,
    pumped_force,
    settled_friction,
    step_circuit,
)
from hydrotele.hydraulics.parameters import CURVE, CURVE_KNOTS, MARKER
from hydrotele.simulate.layout import field_offsets, mujoco_library, option_offset, verify_layout
from hydrotele.terms.law import Drives
from hydrotele.terms.table import COMMAND, COUNT, FORCE, acts_on, added_with_slope
from hydrotele.terms.table import MARKER as TERMS

_FIRST, _COUNT, _KIND = int(Slot.FIRST), int(Slot.COUNT), int(Slot.KIND)
_AREA_HEAD, _AREA_ROD = int(Slot.AREA_HEAD), int(Slot.AREA_ROD)
_OFFSET, _INERTIA = int(Slot.OFFSET), int(Slot.DRIVE_INERTIA)
_STIFFNESS, _BRISTLE = int(Slot.BRISTLE_STIFFNESS), int(Slot.BRISTLE)
_FELT, _MEMORY = int(Slot.BRISTLE_INERTIA), int(Slot.MEMORY)
_LAG, _DELIVERY, _CURVES = int(Slot.PUMP_TIME_CONSTANT), int(Slot.DELIVERY), int(Slot.CURVES)
_ADDED = int(Slot.ADDED_DELIVERY)
_FORCE, _PUMPED = float(Kind.FORCE), float(Kind.PUMPED)
_GAINS = int(mujoco.mjNGAIN)
_SIGNATURE = types.float64(types.int64, types.int64, types.intc)
# Separate callbacks for drives with bristles or further states keep the others fast.
_ADVANCE_REMEMBERING = types.ExternalFunction("hydrotele_advance_remembering", _SIGNATURE)
_FORCE_REMEMBERING = types.ExternalFunction("hydrotele_force_remembering", _SIGNATURE)


_kept: list = []  # keeps the callbacks behind these symbols alive


@intrinsic
def _stack(typingctx, size):
    """Return work space on the stack of the calling function, which is private to the thread."""

    def codegen(context, builder, signature, args):
        space = cgutils.alloca_once(builder, cgutils.voidptr_t, size=2 * SCRATCH)
        return builder.bitcast(space, cgutils.voidptr_t)

    return types.voidptr(types.int64), codegen


@compiled
def _passive_force(m, d, i, m_nu, m_nv, m_njnt, m_trnid, m_dofadr, d_passive):
    """Return the spring and damper force on the joint of actuator i.

    `m` and `d` are the addresses of mjModel and mjData; all further arguments are field offsets.
    """
    nu = carray(pointer(m + m_nu), (1,), np.int64)[0]
    nv = carray(pointer(m + m_nv), (1,), np.int64)[0]
    joints = carray(pointer(m + m_njnt), (1,), np.int64)[0]
    at_trnid = carray(pointer(m + m_trnid), (1,), np.int64)[0]
    joint = carray(pointer(at_trnid), (2 * nu,), np.int32)[2 * i]
    at_dofadr = carray(pointer(m + m_dofadr), (1,), np.int64)[0]
    dof = carray(pointer(at_dofadr), (joints,), np.int32)[joint]
    at_passive = carray(pointer(d + d_passive), (1,), np.int64)[0]
    return carray(pointer(at_passive), (nv,), np.float64)[dof]


@compiled
def _gain(m, i, m_gainprm):
    """Return the force per command of a force drive; 0 for a valve."""
    at_gain = carray(pointer(m + m_gainprm), (1,), np.int64)[0]
    return floats(at_gain + 8 * _GAINS * i, 1)[0]


@compiled
def _terms_of(m, m_nnumeric, m_adr, m_size, m_data):
    """Return the table of terms of a model (n,); empty without terms."""
    count = carray(pointer(m + m_nnumeric), (1,), np.int64)[0]
    if count > 0:
        data = carray(pointer(m + m_data), (1,), np.int64)[0]
        at = carray(pointer(m + m_adr), (1,), np.int64)[0]
        sizes = carray(pointer(m + m_size), (1,), np.int64)[0]
        for k in range(count):
            place = data + 8 * np.int64(carray(pointer(at), (count,), np.int32)[k])
            own = carray(pointer(sizes), (count,), np.int32)
            if own[k] > COUNT and floats(place, 1)[0] == TERMS:
                size = np.int64(0)
                for part in range(k, count):  # a long table continues in the next elements
                    size += own[part]
                return floats(place, size)
    return floats(m, 0)


class _Fields(NamedTuple):
    """Offsets of fields of mjData [bytes]."""

    time: int
    ctrl: int
    act: int
    act_dot: int
    length: int
    velocity: int


@compiled
def _state(d, at, i, user, gain, dt, nu, scratch):
    """Return the DriveState of drive i with end-of-step pressures, and the Drives."""
    count, act = int(user[_COUNT]), floats(d, 0)
    lengths = floats(carray(pointer(d + at.length), (1,), np.int64)[0], nu)
    velocities = floats(carray(pointer(d + at.velocity), (1,), np.int64)[0], nu)
    commands = floats(carray(pointer(d + at.ctrl), (1,), np.int64)[0], nu)
    x, velocity, command = lengths[i], velocities[i], _given(commands, i)
    time, supply = floats(d + at.time, 1)[0], 0.0
    if count > 0:
        size = 4 * count + int(user[_MEMORY])
        start = floats(carray(pointer(d + at.act), (1,), np.int64)[0], size)
        rate = floats(carray(pointer(d + at.act_dot), (1,), np.int64)[0], size)
        act = scratch[SCRATCH:]
        for k in range(size):
            act[k] = start[k] + dt * rate[k]
        open_ports(user, act, act, scratch, 0, count, 0.0, act)
        supply = circuit_supply(user, 0, count, scratch, delivered_share(user, 0, act))
    s = drive_state(user, i, count, act, supply, time, x, velocity, command, gain)
    return s, Drives(count, act, lengths, velocities, commands)


@allocation_free
def _advance_force_drive(user, u, act, rate, velocity, command, low, high, dt):
    """Write the rates of the two activations of a force drive: bristle state and command."""
    rate[0] = bristle_rate(user, u, act[0], velocity, user[u + _FELT], dt)
    rate[1] = (min(high, max(low, command)) - act[1]) / dt


@allocation_free
def _advance_with_memory(user, first, drives, dt, act_dot, scratch, terms, time, arrived):
    """Run `step_circuit` and write the rates of bristles and of the internal states of terms."""
    count, act, length, velocity, _ = drives
    memory = len(act) - 4 * count
    _, supply = step_circuit(user, first, drives, dt, act_dot, scratch, terms, time, memory)
    for i in range(first, first + count):
        u = i * SLOTS
        if user[u + _STIFFNESS] > 0.0:
            at = int(user[u + _BRISTLE])
            act_dot[at] = bristle_rate(user, u, act[at], velocity[i], user[u + _FELT], dt)
    if len(terms) > 0 and first == 0:
        begun = Drives(count, act, length, velocity, arrived)
        advance_memories(user, terms, begun, act_dot, dt, time, supply)


@allocation_free
def _sound(user, first, count, nu, free):
    """Return whether the indices in the parameters of a group of axes are within bounds.

    User code can change these parameters in a model. `free` is the number of activations from the
    first axis on. The comparisons reject NaN.
    """
    if not (0 <= first and 1 <= count <= MAX_AXES and first + count <= nu):
        return False
    group = first * SLOTS
    size = 4.0 * count + user[group + _MEMORY]
    if not (4.0 * count <= size <= free):
        return False
    if user[group + _LAG] != 0.0 and not (4.0 * count <= user[group + _DELIVERY] < size):
        return False
    if user[group + _ADDED] != 0.0 and not (4.0 * count <= user[group + _ADDED] < size):
        return False
    for u in range(group, (first + count) * SLOTS, SLOTS):
        if user[u + _STIFFNESS] != 0.0 and not (4.0 * count <= user[u + _BRISTLE] < size):
            return False
        if not (0.0 <= user[u + _CURVES] <= CURVE_KNOTS):
            return False
        if not (0.0 <= user[u + _CURVES + CURVE] <= CURVE_KNOTS):
            return False
    return True


@allocation_free
def _given(command, k):
    """Return the command of actuator k, or 0 if any command is NaN, as MuJoCo does."""
    for value in command:
        if value != value:
            return 0.0
    return command[k]


@functools.cache
def _compile_callbacks():
    """Compile the activation and force callbacks for this MuJoCo, or load them from the cache."""
    verify_layout()
    remembering = _callbacks(True)
    for symbol, function in zip(
        (_ADVANCE_REMEMBERING.symbol, _FORCE_REMEMBERING.symbol), remembering, strict=True
    ):
        binding.add_symbol(symbol, function.address)
        _kept.append(function)
    return _callbacks(False)


def _callbacks(remembers):
    """Create the activation and force callbacks.

    With `remembers`, they handle bristles and further states; otherwise they pass such drives on.
    """
    model_at, data_at = field_offsets("mjModel"), field_offsets("mjData")
    m_user, m_actadr = model_at["actuator_user"], model_at["actuator_actadr"]
    m_nuser, m_timestep = model_at["nuser_actuator"], option_offset("timestep")
    m_nu, m_dofadr, m_nv = model_at["nu"], model_at["jnt_dofadr"], model_at["nv"]
    m_na = model_at["na"]
    m_trnid, m_njnt, m_gainprm = (
        model_at["actuator_trnid"],
        model_at["njnt"],
        model_at["actuator_gainprm"],
    )
    m_nnumeric, m_at = model_at["nnumeric"], model_at["numeric_adr"]
    m_size, m_data = model_at["numeric_size"], model_at["numeric_data"]
    m_range = model_at["actuator_ctrlrange"]
    d_passive, d_time = data_at["qfrc_passive"], data_at["time"]
    d_ctrl, d_act, d_act_dot = data_at["ctrl"], data_at["act"], data_at["act_dot"]
    d_length, d_velocity = data_at["actuator_length"], data_at["actuator_velocity"]

    @callback(_SIGNATURE)
    def advance(m, d, i):
        """Write the rates of all activations of the hydraulic axes (callback `mjcb_act_dyn`)."""
        if carray(pointer(m + m_nuser), (1,), np.int64)[0] != SLOTS:
            return 0.0
        i = np.int64(i)
        nu = carray(pointer(m + m_nu), (1,), np.int64)[0]
        at_user = carray(pointer(m + m_user), (1,), np.int64)[0]
        user = carray(pointer(at_user), (nu * SLOTS,), np.float64)
        if user[i * SLOTS] != MARKER:
            return 0.0
        first, count = int(user[i * SLOTS + _FIRST]), int(user[i * SLOTS + _COUNT])
        if i != first + count - 1:
            if user[i * SLOTS + _KIND] != _FORCE or user[i * SLOTS + _STIFFNESS] == 0.0:
                return 0.0
            if not remembers:
                return _ADVANCE_REMEMBERING(m, d, i)
            else:
                at_actadr = carray(pointer(m + m_actadr), (1,), np.int64)[0]
                start = 8 * np.int64(carray(pointer(at_actadr), (nu,), np.int32)[i])
                if start < 0 or start + 16 > 8 * carray(pointer(m + m_na), (1,), np.int64)[0]:
                    return 0.0
                at_range = carray(pointer(m + m_range), (1,), np.int64)[0]
                ends = floats(at_range + 16 * i, 2)
                _advance_force_drive(
                    user, i * SLOTS,
                    floats(carray(pointer(d + d_act), (1,), np.int64)[0] + start, 2),
                    floats(carray(pointer(d + d_act_dot), (1,), np.int64)[0] + start, 2),
                    floats(carray(pointer(d + d_velocity), (1,), np.int64)[0], nu)[i],
                    _given(floats(carray(pointer(d + d_ctrl), (1,), np.int64)[0], nu), i),
                    ends[0], ends[1], floats(m + m_timestep, 1)[0],
                )  # fmt: skip
            return 0.0
        if not remembers:
            if 0 <= first < nu and user[first * SLOTS + _MEMORY] > 0.0:
                return _ADVANCE_REMEMBERING(m, d, i)
        at_actadr = carray(pointer(m + m_actadr), (1,), np.int64)[0]
        address = np.int64(carray(pointer(at_actadr), (nu,), np.int32)[max(0, min(first, nu - 1))])
        na = carray(pointer(m + m_na), (1,), np.int64)[0]
        if address < 0 or not _sound(user, first, count, nu, na - address):
            return 0.0
        start = 8 * address
        at_act = carray(pointer(d + d_act), (1,), np.int64)[0]
        at_act_dot = carray(pointer(d + d_act_dot), (1,), np.int64)[0]
        at_ctrl = carray(pointer(d + d_ctrl), (1,), np.int64)[0]
        at_length = carray(pointer(d + d_length), (1,), np.int64)[0]
        at_velocity = carray(pointer(d + d_velocity), (1,), np.int64)[0]
        size = 4 * count
        if remembers:
            size += int(user[first * SLOTS + _MEMORY])
        act = carray(pointer(at_act + start), (size,), np.float64)
        act_dot = carray(pointer(at_act_dot + start), (size,), np.float64)
        command = carray(pointer(at_ctrl), (nu,), np.float64)
        length = carray(pointer(at_length), (nu,), np.float64)
        velocity = carray(pointer(at_velocity), (nu,), np.float64)
        dt = carray(pointer(m + m_timestep), (1,), np.float64)[0]
        time = carray(pointer(d + d_time), (1,), np.float64)[0]
        scratch = carray(_stack(0), (2 * SCRATCH,), np.float64)
        given = scratch[SCRATCH:]
        for k in range(nu):
            if command[k] != command[k]:  # MuJoCo then sets all commands to 0 and warns
                for j in range(first, first + count):
                    given[j] = 0.0
                command = given
                break
        terms, arrived = floats(m, 0), command
        if carray(pointer(m + m_nnumeric), (1,), np.int64)[0] > 0:
            terms = _terms_of(m, m_nnumeric, m_at, m_size, m_data)
        if len(terms) > 0 and first == 0:
            drives = Drives(count, act, length, velocity, command)
            add_to_commands(user, terms, drives, dt, time, scratch, given)
            command = given
        drives = Drives(count, act, length, velocity, command)
        if not remembers:
            step_circuit(
                user, first, drives, dt, act_dot, scratch, terms, time,
                np.int64(NO_MEMORY),  # numba would compile again for a literal
            )  # fmt: skip
        else:
            _advance_with_memory(user, first, drives, dt, act_dot, scratch, terms, time, arrived)
        return 0.0

    @callback(_SIGNATURE)
    def force(m, d, i):
        """Return the bias force of actuator i after friction (callback `mjcb_act_bias`)."""
        if carray(pointer(m + m_nuser), (1,), np.int64)[0] != SLOTS:
            return 0.0
        i = np.int64(i)
        nu = carray(pointer(m + m_nu), (1,), np.int64)[0]
        at_user = carray(pointer(m + m_user), (1,), np.int64)[0]
        user = carray(pointer(at_user), (nu * SLOTS,), np.float64)
        u = i * SLOTS
        if user[u] != MARKER:
            return 0.0
        if not remembers:
            if user[u + _STIFFNESS] > 0.0:
                return _FORCE_REMEMBERING(m, d, i)
        at_velocity = carray(pointer(d + d_velocity), (1,), np.int64)[0]
        velocity = carray(pointer(at_velocity), (nu,), np.float64)[i]
        dt = carray(pointer(m + m_timestep), (1,), np.float64)[0]
        drive, p_load, p_head, p_rod = 0.0, 0.0, 0.0, 0.0
        if user[u + _KIND] == _FORCE:  # MuJoCo's gain gives the drive force
            drive = -user[u + _OFFSET]
        else:
            at_actadr = carray(pointer(m + m_actadr), (1,), np.int64)[0]
            start = 8 * np.int64(carray(pointer(at_actadr), (nu,), np.int32)[i])
            if start < 0 or start + 32 > 8 * carray(pointer(m + m_na), (1,), np.int64)[0]:
                return 0.0
            at_act = carray(pointer(d + d_act), (1,), np.int64)[0]
            at_act_dot = carray(pointer(d + d_act_dot), (1,), np.int64)[0]
            act = carray(pointer(at_act + start), (4,), np.float64)
            rate = carray(pointer(at_act_dot + start), (4,), np.float64)
            p_load = act[1] + dt * rate[1]
            p_head, p_rod = act[2] + dt * rate[2], act[3] + dt * rate[3]
            drive = user[u + _AREA_HEAD] * p_head - user[u + _AREA_ROD] * p_rod
        terms, more, steep = floats(m, 0), 0.0, 0.0
        if carray(pointer(m + m_nnumeric), (1,), np.int64)[0] > 0:
            terms = _terms_of(m, m_nnumeric, m_at, m_size, m_data)
        gain = _gain(m, i, m_gainprm) if user[u + _KIND] == _FORCE else 0.0
        if len(terms) > 0 and user[_COUNT] != 0.0:
            held = int(user[_COUNT])
            if not _sound(user, 0, held, nu, carray(pointer(m + m_na), (1,), np.int64)[0]):
                terms = floats(m, 0)
        commanded = gain != 0.0 and acts_on(terms, COMMAND, i)
        if commanded or acts_on(terms, FORCE, i):
            at = _Fields(d_time, d_ctrl, d_act, d_act_dot, d_length, d_velocity)
            scratch = carray(_stack(0), (2 * SCRATCH,), np.float64)
            s, drives = _state(d, at, i, user, gain, dt, nu, scratch)
            more, steep = added_with_slope(terms, FORCE, i, s, drives)
            if commanded:
                extra, slope = added_with_slope(terms, COMMAND, i, s, drives)
                more += gain * extra
                steep += gain * slope
        if user[u + _KIND] == _PUMPED:  # static friction also resists the terms
            return more + pumped_force(user, u, p_load, p_head, p_rod, velocity, more, dt)
        drive += more
        if not remembers:
            if user[u + _INERTIA] == 0.0:
                return drive - actuator_friction(user, u, velocity)
        else:
            force_drive = user[u + _KIND] == _FORCE
            at_actadr = carray(pointer(m + m_actadr), (1,), np.int64)[0]
            owner = i if force_drive else max(0, min(nu - 1, np.int64(user[u + _FIRST])))
            place = np.int64(carray(pointer(at_actadr), (nu,), np.int32)[owner])
            place += 0 if force_drive else np.int64(user[u + _BRISTLE])
            if not 0 <= place < carray(pointer(m + m_na), (1,), np.int64)[0]:
                return 0.0
            share = floats(carray(pointer(d + d_act), (1,), np.int64)[0] + 8 * place, 1)[0]
            rising = floats(carray(pointer(d + d_act_dot), (1,), np.int64)[0] + 8 * place, 1)[0]
            share += dt * rising
            if user[u + _INERTIA] == 0.0:
                return drive - bristle_friction(user, u, share, velocity, user[u + _FELT], dt)[0]
        push = drive + _passive_force(m, d, i, m_nu, m_nv, m_njnt, m_trnid, m_dofadr, d_passive)
        if gain != 0.0:
            at_ctrl = carray(pointer(d + d_ctrl), (1,), np.int64)[0]
            push += gain * _given(carray(pointer(at_ctrl), (nu,), np.float64), i)
        damping = max(0.0, -steep)  # of the terms; implicit, because the drive side is light
        inertia = user[u + _INERTIA] + dt * damping
        if not remembers:
            rubbing = settled_friction(user, u, velocity, push, inertia, dt)
        else:
            rubbing = settled_bristle_friction(user, u, share, velocity, push, inertia, dt)
        return drive - damping * (dt / inertia) * (push - rubbing) - rubbing

    return advance, force


def stop_profiling_clock() -> None:
    """Remove MuJoCo's profiling clock, which takes 14 % of a step of these small models.

    `mjData.timer` then stays zero in this process; `mujoco.set_mjcb_time` sets a clock again.
    """
    if hasattr(mujoco_library(), "mjcb_time"):
        ctypes.c_void_p.in_dll(mujoco_library(), "mjcb_time").value = None


def install_hydraulics() -> None:
    """Install the actuator callbacks in this process; further calls have no effect.

    Raises:
        RuntimeError: another package has installed actuator callbacks, or the layout of MuJoCo's
            structs is not as expected.
    """
    advance, force = _compile_callbacks()
    ours = (advance.ctypes, force.ctypes)
    present = (mujoco.get_mjcb_act_dyn(), mujoco.get_mjcb_act_bias())
    if present == ours:
        return
    if any(callback is not None for callback in present):
        raise RuntimeError(
            "another package has installed mjcb_act_dyn or mjcb_act_bias in this process;"
            " run hydrotele in a separate process"
        )
    mujoco.set_mjcb_act_dyn(ours[0])
    mujoco.set_mjcb_act_bias(ours[1])
