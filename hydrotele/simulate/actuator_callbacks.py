"""Hydraulics inside MuJoCo at native speed: compiled actuator callbacks.

Every hydraulic actuator has four activations, and its parameters are in `actuator_user`
(`actuator_layout.Slot`). The callback of the last one advances all of them, because they share the
supply, and MuJoCo clears an actuator's rates just before its callback. The last actuator also owns
the bristle states of all axes and the state of a pump with a time constant. A force drive with
bristles has two activations: the bristle state and the command, since MuJoCo computes the force
from the last activation. The force uses the pressures at the end of the step, as with `actearly`;
otherwise explicit stepping would add negative damping.

The callbacks use only their arguments mjModel and mjData. They are thread-safe, and a model can be
randomised through `actuator_user`. Actuators whose first parameter is not ACTUATOR_MARKER are
ignored. The terms (additional laws) of a machine are custom numerics of its model, which may differ
between the models of a batch.
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

from hydrotele.core.compiled import callback, compile_without_allocation, compiled
from hydrotele.core.memory import address_to_pointer, float64_view
from hydrotele.hydraulics.actuator import bristle_friction, bristle_rate, implicit_bristle_friction
from hydrotele.hydraulics.actuator_layout import ACTUATOR_MARKER, CURVE_KNOTS, CURVE_SIZE
from hydrotele.hydraulics.circuit import (
    FEED,
    MAX_AXES,
    NO_EXTRA_STATES,
    SCRATCH_SIZE,
    SLOT_COUNT,
    ActuatorKind,
    Slot,
    actuator_friction,
    add_command_terms,
    implicit_friction,
    make_drive_state,
    pump_drive_force,
    solve_state_supplies,
    step_circuit,
    write_term_state_rates,
)
from hydrotele.simulate.mujoco_c_api import field_offsets, mujoco_library, option_offset, verify_struct_offsets
from hydrotele.terms.drive_state import Drives
from hydrotele.terms.table import COMMAND, COUNT_INDEX, FORCE, has_term, sum_terms_with_slope
from hydrotele.terms.table import TERMS_MARKER as TERMS

_FIRST, _COUNT, _KIND = int(Slot.FIRST), int(Slot.COUNT), int(Slot.KIND)
_AREA_HEAD, _AREA_ROD = int(Slot.AREA_HEAD), int(Slot.AREA_ROD)
_OFFSET, _INERTIA = int(Slot.OFFSET), int(Slot.DRIVE_INERTIA)
_BRISTLE_STIFFNESS, _BRISTLE = int(Slot.BRISTLE_STIFFNESS), int(Slot.BRISTLE)
_BRISTLE_INERTIA, _EXTRA_STATES = int(Slot.BRISTLE_INERTIA), int(Slot.EXTRA_STATES)
_PUMP_TIME_CONSTANT, _DELIVERY, _CURVES = (
    int(Slot.PUMP_TIME_CONSTANT),
    int(Slot.DELIVERY),
    int(Slot.CURVES),
)
_ADDED, _GROUP, _MERGE = int(Slot.ADDED_DELIVERY), int(Slot.GROUP_SIZE), int(Slot.MERGE_CURVE)
_FROM, _TO = int(Slot.MERGE_FROM), int(Slot.MERGE_TO)
_FORCE, _PUMPED = float(ActuatorKind.FORCE), float(ActuatorKind.PUMP_DRIVE)
_GAIN_COUNT = int(mujoco.mjNGAIN)
_SIGNATURE = types.float64(types.int64, types.int64, types.intc)
# Separate callbacks for drives with bristles or further states keep the others fast.
_ADVANCE_EXTENDED = types.ExternalFunction("hydrotele_advance_remembering", _SIGNATURE)
_FORCE_EXTENDED = types.ExternalFunction("hydrotele_force_remembering", _SIGNATURE)


_kept_callbacks: list = []  # keeps the callbacks behind these symbols alive


@intrinsic
def _stack_space(typingctx, size):
    """Return the address of a work space on the stack of the calling function (numba intrinsic).

    The work space has room for 2 * SCRATCH_SIZE 64-bit numbers. It is private to the thread and
    valid until the calling function returns. `size` is not used.
    """

    def codegen(context, builder, signature, args):
        space = cgutils.alloca_once(builder, cgutils.voidptr_t, size=2 * SCRATCH_SIZE)
        return builder.bitcast(space, cgutils.voidptr_t)

    return types.voidptr(types.int64), codegen


@compiled
def _read_passive_force(m, d, i, m_nu, m_nv, m_njnt, m_trnid, m_dofadr, d_passive):
    """Return MuJoCo's passive (spring and damper) force on the joint of actuator i [N] or [N m].

    `m` and `d` are the addresses of mjModel and mjData. All further arguments are offsets of fields
    of these structs [byte].
    """
    nu = carray(address_to_pointer(m + m_nu), (1,), np.int64)[0]
    nv = carray(address_to_pointer(m + m_nv), (1,), np.int64)[0]
    joints = carray(address_to_pointer(m + m_njnt), (1,), np.int64)[0]
    at_trnid = carray(address_to_pointer(m + m_trnid), (1,), np.int64)[0]
    joint = carray(address_to_pointer(at_trnid), (2 * nu,), np.int32)[2 * i]
    at_dofadr = carray(address_to_pointer(m + m_dofadr), (1,), np.int64)[0]
    dof = carray(address_to_pointer(at_dofadr), (joints,), np.int32)[joint]
    at_passive = carray(address_to_pointer(d + d_passive), (1,), np.int64)[0]
    return carray(address_to_pointer(at_passive), (nv,), np.float64)[dof]


@compiled
def _read_gain(m, i, m_gainprm):
    """Return the force per unit of command of actuator i, its first gain parameter in mjModel.

    The value is 0 for a hydraulic actuator. `m` is the address of mjModel, and `m_gainprm` the
    offset of `actuator_gainprm` [byte].
    """
    at_gain = carray(address_to_pointer(m + m_gainprm), (1,), np.int64)[0]
    return float64_view(at_gain + 8 * _GAIN_COUNT * i, 1)[0]


@compiled
def _read_terms(m, m_nnumeric, m_adr, m_size, m_data):
    """Return a view (n,) of the table of terms (additional force and flow laws) in mjModel.

    The table is the custom numeric element of the model whose first value is TERMS_MARKER, with all
    elements after it. The view is empty if there is no such element. `m` is the address of mjModel;
    the other arguments are offsets of its `numeric` fields [byte].
    """
    count = carray(address_to_pointer(m + m_nnumeric), (1,), np.int64)[0]
    if count > 0:
        data = carray(address_to_pointer(m + m_data), (1,), np.int64)[0]
        at = carray(address_to_pointer(m + m_adr), (1,), np.int64)[0]
        sizes = carray(address_to_pointer(m + m_size), (1,), np.int64)[0]
        for k in range(count):
            place = data + 8 * np.int64(carray(address_to_pointer(at), (count,), np.int32)[k])
            own = carray(address_to_pointer(sizes), (count,), np.int32)
            if own[k] > COUNT_INDEX and float64_view(place, 1)[0] == TERMS:
                size = np.int64(0)
                for part in range(k, count):  # a long table continues in the next elements
                    size += own[part]
                return float64_view(place, size)
    return float64_view(m, 0)


class _DataOffsets(NamedTuple):
    """Offsets of fields of mjData [bytes]."""

    time: int
    ctrl: int
    act: int
    act_dot: int
    length: int
    velocity: int


@compiled
def _read_drive_state(d, at, i, user, gain, dt, nu, scratch):
    """Read the inputs of force terms (additional force laws) of drive i from mjData.

    Activations are extrapolated to the end of the step of length `dt`; the supply pressure follows
    from them. `d` is the address of mjData, `at` the offsets of its fields, `user` the parameters
    of all nu actuators, `gain` the force per unit of command of drive i, and `scratch` work space.

    Returns:
        (DriveState of drive i, Drives with the states of all drives).
    """
    count, act = int(user[_COUNT]), float64_view(d, 0)
    lengths = float64_view(carray(address_to_pointer(d + at.length), (1,), np.int64)[0], nu)
    velocities = float64_view(carray(address_to_pointer(d + at.velocity), (1,), np.int64)[0], nu)
    commands = float64_view(carray(address_to_pointer(d + at.ctrl), (1,), np.int64)[0], nu)
    x, velocity, command = lengths[i], velocities[i], _command_or_zero(commands, i)
    time, supply = float64_view(d + at.time, 1)[0], 0.0
    if count > 0:
        size = 4 * count + int(user[_EXTRA_STATES])
        start = float64_view(carray(address_to_pointer(d + at.act), (1,), np.int64)[0], size)
        rate = float64_view(carray(address_to_pointer(d + at.act_dot), (1,), np.int64)[0], size)
        act = scratch[SCRATCH_SIZE:]
        for k in range(size):
            act[k] = start[k] + dt * rate[k]
        solve_state_supplies(user, 0, count, act, scratch)
        supply = scratch[FEED + min(i, count - 1)]
    s = make_drive_state(user, i, count, act, supply, time, x, velocity, command, gain)
    return s, Drives(count, act, lengths, velocities, commands)


@compile_without_allocation
def _write_force_drive_rates(user, u, act, rate, velocity, command, low, high, dt):
    """Write the rates (2,) of the two activations of a force drive with presliding friction to `rate`.

    The first activation is the bristle state. The second follows the command, limited to `low` ..
    `high`, and reaches it at the end of the step of length `dt`. `act` (2,) are both at the start
    of the step, and u is the index of the first parameter of this drive in `user`.
    """
    rate[0] = bristle_rate(user, u, act[0], velocity, user[u + _BRISTLE_INERTIA], dt)
    rate[1] = (min(high, max(low, command)) - act[1]) / dt


@compile_without_allocation
def _step_circuit_with_extra_states(user, first, drives, dt, act_dot, scratch, terms, time, arrived):
    """Write the rates of all activations of the hydraulic axes over a step, including additional states.

    The additional states are those of bristles, of a pump and of terms with hysteresis. The
    arguments are those of `step_circuit`. `drives.command` includes the terms that change commands,
    and `arrived` (nu,) are the commands without these terms.
    """
    count, act, length, velocity, _ = drives
    memory = len(act) - 4 * count
    step_circuit(user, first, drives, dt, act_dot, scratch, terms, time, memory)
    for i in range(first, first + count):
        u = i * SLOT_COUNT
        if user[u + _BRISTLE_STIFFNESS] > 0.0:
            at = int(user[u + _BRISTLE])
            act_dot[at] = bristle_rate(user, u, act[at], velocity[i], user[u + _BRISTLE_INERTIA], dt)
    if len(terms) > 0 and first == 0:
        begun = Drives(count, act, length, velocity, arrived)
        write_term_state_rates(user, terms, begun, act_dot, dt, time, scratch[FEED:])


@compile_without_allocation
def _has_valid_indices(user, first, count, nu, free):
    """Return whether all indices among the parameters of the hydraulic axes are within bounds.

    The check is needed because user code can change these parameters in a model. `first` is the
    index of the first of `count` hydraulic actuators, and `nu` the number of all actuators. `free`
    is the number of activations from that of the first hydraulic actuator on. NaN counts as out of
    bounds.
    """
    if not (0 <= first and 1 <= count <= MAX_AXES and first + count <= nu):
        return False
    group = first * SLOT_COUNT
    size = 4.0 * count + user[group + _EXTRA_STATES]
    if not (4.0 * count <= size <= free):
        return False
    for u in range(group, (first + count) * SLOT_COUNT, SLOT_COUNT):
        if user[u + _BRISTLE_STIFFNESS] != 0.0 and not (4.0 * count <= user[u + _BRISTLE] < size):
            return False
        if user[u + _PUMP_TIME_CONSTANT] != 0.0 and not (4.0 * count <= user[u + _DELIVERY] < size):
            return False
        if user[u + _ADDED] != 0.0 and not (4.0 * count <= user[u + _ADDED] < size):
            return False
        if not (0.0 <= user[u + _FROM] < count and 0.0 <= user[u + _TO] < count):
            return False
        if not (0.0 <= user[u + _MERGE] <= CURVE_KNOTS and user[u + _GROUP] <= count):
            return False
        if not (0.0 <= user[u + _CURVES] <= CURVE_KNOTS):
            return False
        if not (0.0 <= user[u + _CURVES + CURVE_SIZE] <= CURVE_KNOTS):
            return False
    return True


@compile_without_allocation
def _command_or_zero(command, k):
    """Return the command of actuator k, or 0 if any command (nu,) is NaN, as MuJoCo does."""
    for value in command:
        if value != value:
            return 0.0
    return command[k]


@functools.cache
def _compile_callbacks():
    """Compile the hydraulic callbacks for MuJoCo, or load them from the cache on disk.

    Also register the callbacks for drives with bristles or other additional states as linker
    symbols; the returned callbacks call them.

    Returns:
        (callback for `mjcb_act_dyn`, callback for `mjcb_act_bias`).
    """
    verify_struct_offsets()
    remembering = _make_callbacks(True)
    for symbol, function in zip((_ADVANCE_EXTENDED.symbol, _FORCE_EXTENDED.symbol), remembering, strict=True):
        binding.add_symbol(symbol, function.address)
        _kept_callbacks.append(function)
    return _make_callbacks(False)


def _make_callbacks(has_extra_states):
    """Create the callbacks for the activation rates and for the actuator forces.

    With `has_extra_states`, the callbacks handle drives with bristles or other additional states.
    Otherwise they pass such drives on to the callbacks that were created with `has_extra_states`.

    Returns:
        (callback for `mjcb_act_dyn`, callback for `mjcb_act_bias`).
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
    def write_activation_rates(m, d, i):
        """Write activation rates to `act_dot` of mjData (callback `mjcb_act_dyn`); always return 0.

        `m` and `d` are the addresses of mjModel and mjData, and i is the index of an actuator. For
        the last hydraulic actuator, the rates of all hydraulic axes are written; for the others,
        nothing. For a force drive with presliding friction, its own two rates are written.
        """
        if carray(address_to_pointer(m + m_nuser), (1,), np.int64)[0] != SLOT_COUNT:
            return 0.0
        i = np.int64(i)
        nu = carray(address_to_pointer(m + m_nu), (1,), np.int64)[0]
        at_user = carray(address_to_pointer(m + m_user), (1,), np.int64)[0]
        user = carray(address_to_pointer(at_user), (nu * SLOT_COUNT,), np.float64)
        if user[i * SLOT_COUNT] != ACTUATOR_MARKER:
            return 0.0
        first, count = int(user[i * SLOT_COUNT + _FIRST]), int(user[i * SLOT_COUNT + _COUNT])
        if i != first + count - 1:
            if user[i * SLOT_COUNT + _KIND] != _FORCE or user[i * SLOT_COUNT + _BRISTLE_STIFFNESS] == 0.0:
                return 0.0
            if not has_extra_states:
                return _ADVANCE_EXTENDED(m, d, i)
            else:
                at_actadr = carray(address_to_pointer(m + m_actadr), (1,), np.int64)[0]
                start = 8 * np.int64(carray(address_to_pointer(at_actadr), (nu,), np.int32)[i])
                if start < 0 or start + 16 > 8 * carray(address_to_pointer(m + m_na), (1,), np.int64)[0]:
                    return 0.0
                at_range = carray(address_to_pointer(m + m_range), (1,), np.int64)[0]
                ends = float64_view(at_range + 16 * i, 2)
                _write_force_drive_rates(
                    user, i * SLOT_COUNT,
                    float64_view(carray(address_to_pointer(d + d_act), (1,), np.int64)[0] + start, 2),
                    float64_view(carray(address_to_pointer(d + d_act_dot), (1,), np.int64)[0] + start, 2),
                    float64_view(carray(address_to_pointer(d + d_velocity), (1,), np.int64)[0], nu)[i],
                    _command_or_zero(float64_view(carray(address_to_pointer(d + d_ctrl), (1,), np.int64)[0], nu), i),
                    ends[0], ends[1], float64_view(m + m_timestep, 1)[0],
                )  # fmt: skip
            return 0.0
        if not has_extra_states:
            if 0 <= first < nu and user[first * SLOT_COUNT + _EXTRA_STATES] > 0.0:
                return _ADVANCE_EXTENDED(m, d, i)
        at_actadr = carray(address_to_pointer(m + m_actadr), (1,), np.int64)[0]
        address = np.int64(carray(address_to_pointer(at_actadr), (nu,), np.int32)[max(0, min(first, nu - 1))])
        na = carray(address_to_pointer(m + m_na), (1,), np.int64)[0]
        if address < 0 or not _has_valid_indices(user, first, count, nu, na - address):
            return 0.0
        start = 8 * address
        at_act = carray(address_to_pointer(d + d_act), (1,), np.int64)[0]
        at_act_dot = carray(address_to_pointer(d + d_act_dot), (1,), np.int64)[0]
        at_ctrl = carray(address_to_pointer(d + d_ctrl), (1,), np.int64)[0]
        at_length = carray(address_to_pointer(d + d_length), (1,), np.int64)[0]
        at_velocity = carray(address_to_pointer(d + d_velocity), (1,), np.int64)[0]
        size = 4 * count
        if has_extra_states:
            size += int(user[first * SLOT_COUNT + _EXTRA_STATES])
        act = carray(address_to_pointer(at_act + start), (size,), np.float64)
        act_dot = carray(address_to_pointer(at_act_dot + start), (size,), np.float64)
        command = carray(address_to_pointer(at_ctrl), (nu,), np.float64)
        length = carray(address_to_pointer(at_length), (nu,), np.float64)
        velocity = carray(address_to_pointer(at_velocity), (nu,), np.float64)
        dt = carray(address_to_pointer(m + m_timestep), (1,), np.float64)[0]
        time = carray(address_to_pointer(d + d_time), (1,), np.float64)[0]
        scratch = carray(_stack_space(0), (2 * SCRATCH_SIZE,), np.float64)
        given = scratch[SCRATCH_SIZE:]
        for k in range(nu):
            if command[k] != command[k]:  # MuJoCo then sets all commands to 0 and warns
                for j in range(first, first + count):
                    given[j] = 0.0
                command = given
                break
        terms, arrived = float64_view(m, 0), command
        if carray(address_to_pointer(m + m_nnumeric), (1,), np.int64)[0] > 0:
            terms = _read_terms(m, m_nnumeric, m_at, m_size, m_data)
        if len(terms) > 0 and first == 0:
            drives = Drives(count, act, length, velocity, command)
            add_command_terms(user, terms, drives, dt, time, scratch, given)
            command = given
        drives = Drives(count, act, length, velocity, command)
        if not has_extra_states:
            step_circuit(
                user, first, drives, dt, act_dot, scratch, terms, time,
                np.int64(NO_EXTRA_STATES),  # numba would compile again for a literal
            )  # fmt: skip
        else:
            _step_circuit_with_extra_states(user, first, drives, dt, act_dot, scratch, terms, time, arrived)
        return 0.0

    @callback(_SIGNATURE)
    def force(m, d, i):
        """Return the force of actuator i after friction and terms (callback `mjcb_act_bias`) [N] or [N m].

        The pressures are those at the end of the step. For a force drive, the result does not
        contain gain times command, because MuJoCo adds that. `m` and `d` are the addresses of
        mjModel and mjData.
        """
        if carray(address_to_pointer(m + m_nuser), (1,), np.int64)[0] != SLOT_COUNT:
            return 0.0
        i = np.int64(i)
        nu = carray(address_to_pointer(m + m_nu), (1,), np.int64)[0]
        at_user = carray(address_to_pointer(m + m_user), (1,), np.int64)[0]
        user = carray(address_to_pointer(at_user), (nu * SLOT_COUNT,), np.float64)
        u = i * SLOT_COUNT
        if user[u] != ACTUATOR_MARKER:
            return 0.0
        if not has_extra_states:
            if user[u + _BRISTLE_STIFFNESS] > 0.0:
                return _FORCE_EXTENDED(m, d, i)
        at_velocity = carray(address_to_pointer(d + d_velocity), (1,), np.int64)[0]
        velocity = carray(address_to_pointer(at_velocity), (nu,), np.float64)[i]
        dt = carray(address_to_pointer(m + m_timestep), (1,), np.float64)[0]
        drive, p_load, p_head, p_rod = 0.0, 0.0, 0.0, 0.0
        if user[u + _KIND] == _FORCE:  # MuJoCo's gain gives the drive force
            drive = -user[u + _OFFSET]
        else:
            at_actadr = carray(address_to_pointer(m + m_actadr), (1,), np.int64)[0]
            start = 8 * np.int64(carray(address_to_pointer(at_actadr), (nu,), np.int32)[i])
            if start < 0 or start + 32 > 8 * carray(address_to_pointer(m + m_na), (1,), np.int64)[0]:
                return 0.0
            at_act = carray(address_to_pointer(d + d_act), (1,), np.int64)[0]
            at_act_dot = carray(address_to_pointer(d + d_act_dot), (1,), np.int64)[0]
            act = carray(address_to_pointer(at_act + start), (4,), np.float64)
            rate = carray(address_to_pointer(at_act_dot + start), (4,), np.float64)
            p_load = act[1] + dt * rate[1]
            p_head, p_rod = act[2] + dt * rate[2], act[3] + dt * rate[3]
            drive = user[u + _AREA_HEAD] * p_head - user[u + _AREA_ROD] * p_rod
        terms, more, steep = float64_view(m, 0), 0.0, 0.0
        if carray(address_to_pointer(m + m_nnumeric), (1,), np.int64)[0] > 0:
            terms = _read_terms(m, m_nnumeric, m_at, m_size, m_data)
        gain = _read_gain(m, i, m_gainprm) if user[u + _KIND] == _FORCE else 0.0
        if len(terms) > 0 and user[_COUNT] != 0.0:
            held = int(user[_COUNT])
            if not _has_valid_indices(user, 0, held, nu, carray(address_to_pointer(m + m_na), (1,), np.int64)[0]):
                terms = float64_view(m, 0)
        commanded = gain != 0.0 and has_term(terms, COMMAND, i)
        if commanded or has_term(terms, FORCE, i):
            at = _DataOffsets(d_time, d_ctrl, d_act, d_act_dot, d_length, d_velocity)
            scratch = carray(_stack_space(0), (2 * SCRATCH_SIZE,), np.float64)
            s, drives = _read_drive_state(d, at, i, user, gain, dt, nu, scratch)
            more, steep = sum_terms_with_slope(terms, FORCE, i, s, drives)
            if commanded:
                extra, slope = sum_terms_with_slope(terms, COMMAND, i, s, drives)
                more += gain * extra
                steep += gain * slope
        if user[u + _KIND] == _PUMPED:  # static friction also resists the terms
            return more + pump_drive_force(user, u, p_load, p_head, p_rod, velocity, more, dt)
        drive += more
        if not has_extra_states:
            if user[u + _INERTIA] == 0.0:
                return drive - actuator_friction(user, u, velocity)
        else:
            force_drive = user[u + _KIND] == _FORCE
            at_actadr = carray(address_to_pointer(m + m_actadr), (1,), np.int64)[0]
            owner = i if force_drive else max(0, min(nu - 1, np.int64(user[u + _FIRST])))
            place = np.int64(carray(address_to_pointer(at_actadr), (nu,), np.int32)[owner])
            place += 0 if force_drive else np.int64(user[u + _BRISTLE])
            if not 0 <= place < carray(address_to_pointer(m + m_na), (1,), np.int64)[0]:
                return 0.0
            share = float64_view(carray(address_to_pointer(d + d_act), (1,), np.int64)[0] + 8 * place, 1)[0]
            rising = float64_view(carray(address_to_pointer(d + d_act_dot), (1,), np.int64)[0] + 8 * place, 1)[0]
            share += dt * rising
            if user[u + _INERTIA] == 0.0:
                return drive - bristle_friction(user, u, share, velocity, user[u + _BRISTLE_INERTIA], dt)[0]
        push = drive + _read_passive_force(m, d, i, m_nu, m_nv, m_njnt, m_trnid, m_dofadr, d_passive)
        if gain != 0.0:
            at_ctrl = carray(address_to_pointer(d + d_ctrl), (1,), np.int64)[0]
            push += gain * _command_or_zero(carray(address_to_pointer(at_ctrl), (nu,), np.float64), i)
        damping = max(0.0, -steep)  # of the terms; implicit, because the drive side is light
        inertia = user[u + _INERTIA] + dt * damping
        if not has_extra_states:
            rubbing = implicit_friction(user, u, velocity, push, inertia, dt)
        else:
            rubbing = implicit_bristle_friction(user, u, share, velocity, push, inertia, dt)
        return drive - damping * (dt / inertia) * (push - rubbing) - rubbing

    return write_activation_rates, force


def stop_profiling_clock() -> None:
    """Remove MuJoCo's profiling clock from this process; its calls take 14 % of a step of small models.

    `mjData.timer` then stays zero in this process; `mujoco.set_mjcb_time` sets a clock again.
    """
    if hasattr(mujoco_library(), "mjcb_time"):
        ctypes.c_void_p.in_dll(mujoco_library(), "mjcb_time").value = None


def install_hydraulics() -> None:
    """Install hydrotele's hydraulic callbacks in MuJoCo for this process; further calls have no effect.

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
