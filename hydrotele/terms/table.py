"""Encoding of terms as one array that every simulator reads, and their compiled evaluation.

A term is a law with parameters that adds to the force, flow or command of a drive. Compiled code
finds the laws in a table of function addresses of this process, which it refers to by a symbol.
Models and exported files therefore contain no addresses, and compiled code can be cached on disk.
The row of a term has the law's index in that table and a checksum of its name. If index and checksum
do not match, as in a file from another process, the term adds nothing.
"""
# pyright: reportCallIssue=false, reportPrivateImportUsage=false, reportArgumentType=false
# numba's intrinsics are called without their typing context.

import threading
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import carray, njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from hydrotele.core.compiled import Callback, compile_without_allocation, compiled
from hydrotele.core.errors import InputError
from hydrotele.terms.drive_state import VARIABLES, DriveState
from hydrotele.terms.law import LAWS, Law, Numbers, Variable
from hydrotele.terms.term import BALANCES, Term

# numpy integers, since numba compiles a function again for every Python integer literal
FORCE, FLOW_HEAD, FLOW_ROD, COMMAND, FLOW_SUPPLY = np.arange(len(BALANCES), dtype=np.int64)
ANY_DRIVE = np.int64(-1)  # any drive
TERMS_MARKER = 215326.75  # first value of a table of terms, to find it among the custom numerics
NO_TERMS = np.zeros(0)
COUNT_INDEX = 1  # index of the number of terms, after the marker
(
    _AXIS,
    _BALANCE,
    _LAW,
    _CHECKSUM,
    _PARAMETERS,
    _DOMAIN,
    _RANGES,
    _OTHERS,
    _WINDOW_START,
    _WINDOW_STOP,
    _HYSTERESIS,
    _STATE_INDEX,
    _HYSTERESIS_VARIABLE,
    _SHIFT,
    _SCALE,
    _ROW_SIZE,
) = range(16)  # columns of a term's row; _ROW_SIZE is their number
PLAY, SWITCH = 1, 2  # kinds of hysteresis of a term, 0 for none
_SWITCH_RAMP_FRACTION = 0.1  # width of a switch's ramps, as a fraction of the interval between its thresholds
_HEADER_SIZE = 2
_OTHER_SIZE = 4  # values of a variable of another drive: variable, drive, and the drive's two areas
_MAX_LAWS = 1024  # largest number of laws in a process
_WINDOW_RAMP = 0.1  # s, duration of the ramps at the ends of a term's window
_NO_WINDOW = (-1.0e18, 1.0e18)  # s, finite, because MJCF files store numbers as text
_VELOCITY_STEP = 1.0e-6  # absolute [m/s or rad/s] and relative step of the velocity derivative
_PRESSURE_STEP = 100.0  # Pa, step of pressure derivatives: small against the smoothing of an orifice

_law_addresses = np.zeros((_MAX_LAWS, 2), np.int64)  # address and checksum of every law
_kept_functions: list = []  # keeps the compiled functions at these addresses alive
_law_indices: dict[str, tuple[Law, int]] = {}
_lock = threading.Lock()
binding.add_symbol("hydrotele_laws", _law_addresses.ctypes.data)


def law_index(name: str) -> int:
    """Return the index of a law in this process's table of law addresses.

    The law is compiled and added to the table on its first use.

    Raises:
        InputError: the law is not known in this process, or numba cannot compile it.
    """
    with _lock:
        if name not in LAWS:
            message = "is not known in this process; load the file that defines it first"
            raise InputError(f"law {name}", message)
        law, place = _law_indices.get(name, (None, 0))
        if law is not LAWS[name]:
            if len(_kept_functions) == _MAX_LAWS:
                raise InputError(f"law {name}", f"exceeds the limit of {_MAX_LAWS} laws in a process")
            called = _compile_c_function(LAWS[name])
            _law_addresses[len(_kept_functions)] = called.address, name_checksum(name)
            _kept_functions.append(called)
            place = len(_kept_functions) - 1
            _law_indices[name] = LAWS[name], place
        return place


def name_checksum(name: str) -> int:
    """Return the CRC-32 checksum of a law's name, an integer that a float represents exactly."""
    return zlib.crc32(name.encode())


def _compile_c_function(law: Law):
    """Compile a law to a C function `double(double *parameters, double *state)`.

    The parameters are the array of `Law.encode_parameters`, and the state the values of a
    `DriveState`. Raise InputError if numba cannot compile a user's law.
    """
    state = ", ".join(f"s[{k}]" for k in range(len(DriveState._fields)))
    text = (
        "def call(parameters, s):\n"
        "    p = carray(parameters, (int(parameters[0]),))\n"
        f"    return float(function(DriveState({state}), {law_arguments(law)}))\n"
    )
    own = compiled(law.function) if not law.source else _compile_uncached(law.function)
    names = {"carray": carray, "DriveState": DriveState, "function": own}
    exec(text, names)  # generated code, because the number of arguments differs between laws
    call, pointer = names["call"], types.CPointer(types.float64)
    call.__module__, call.__name__ = law.function.__module__, law.function.__name__  # the place of its cache
    call.__qualname__ = f"{law.function.__qualname__}_for_c"
    called = Callback(call, types.float64(pointer, pointer))
    try:
        _ = called.address  # compiles
    except Exception as error:  # numba raises many types for an invalid user function
        if not law.source:
            raise
        why = str(error).strip().splitlines()
        message = f"cannot be compiled by numba: {why[0]} ... {why[-1]}"
        raise InputError(f"{law.source}: law {law.name}", message) from None
    return called


def law_arguments(law: Law) -> str:
    """Return the source text of a law's arguments after the state, from `p`, the array of its parameters."""
    places, arguments = 1, []
    for kind in law.kinds.values():
        if kind is Numbers:
            arguments.append(f"p[int(p[{places}]) : int(p[{places + 1}])]")
            places += 2
        else:
            arguments.append(f"int(p[{places}])" if kind is Variable else f"p[{places}]")
            places += 1
    return ", ".join(arguments)


def make_law_functions(terms: Sequence[Term], wrap: Callable[[Any], Any]) -> dict[Any, Any]:
    """Return forms of functions of this module for processors without function addresses.

    `find_law` and `call_law` then select the laws of some terms by their index in this process's table of laws.
    Without terms all sums of terms are 0, which saves most of the compile time.

    Args:
        terms: terms of a machine.
        wrap: compiles a Python function for the processor; it may refer to compiled functions of this package.
    """
    if not terms:
        sums = {sum_terms: 0.0, sum_terms_with_slope: (0.0, 0.0), sum_flow_terms: (0.0, 0.0, 0.0, 0.0)}
        functions = {function: wrap(_make_constant_function(value)) for function, value in sums.items()}
        return functions | {has_term: wrap(lambda terms, balance, axis: False)}
    lines, scope = ["def call_law(law, terms, at, s):", "    p = terms[at:]"], {}
    for name in dict.fromkeys(term.law for term in terms):
        index = law_index(name)
        scope[f"law_{index}"] = compiled(LAWS[name].function)
        lines += [f"    if law == {index + 1}:", f"        return law_{index}(s, {law_arguments(LAWS[name])})"]
    text = "\n".join([*lines, "    return 0.0", f"def find_law(terms, at):\n    return 1 + int(terms[at + {_LAW}])\n"])
    exec(text, scope)  # generated code, because the number of laws and arguments differs
    return {find_law: wrap(scope["find_law"]), call_law: wrap(scope["call_law"])}


def _make_constant_function(value: Any) -> Any:
    """Return a function with the arguments of `sum_terms`, or of `sum_flow_terms`, that returns a constant."""
    if isinstance(value, tuple) and len(value) == 4:
        return lambda terms, axis, s, drives: value
    return lambda terms, balance, axis, s, drives: value


def _compile_uncached(function):
    """Compile a user's function without cache, which would miss changes of the files it uses."""
    return njit(error_model="numpy", nogil=True)(function)


def encode_terms_table(
    terms: Sequence[Term], order: Sequence[str], first_state_index: int = 0,
    areas: Mapping[str, Sequence[float]] | None = None,
) -> np.ndarray:  # fmt: skip
    """Encode a machine's terms as one array, which the compiled functions of this module read.

    Args:
        terms: terms of a machine.
        order: axis names in actuator order.
        first_state_index: index, in MuJoCo's activation vector, of the internal state of the first term with
            hysteresis; those of further terms follow. 0 if there are no such activations: all
            internal states then count as 0.
        areas: hydraulic axis -> (2,) areas on which its head- and rod-side pressures act [m^2] or
            [m^3/rad], for terms that use the force of another drive.

    Returns:
        (n,) array, empty without terms: marker, number of terms, one row per term, then parameters
        of the laws, ranges of variables, and variables of other drives.

    Raises:
        InputError: a law is not known in this process, or cannot be compiled.
    """
    if not terms:
        return NO_TERMS
    rows, back, first = [], [], _HEADER_SIZE + _ROW_SIZE * len(terms)
    places = {
        id(term): first_state_index + k for k, term in enumerate(terms_with_hysteresis(terms)) if first_state_index
    }
    for term in terms:
        place = law_index(term.law)
        numbers = LAWS[term.law].encode_parameters(term.parameters)
        ranges = [x for name, ends in term.domain.items() for x in (VARIABLES[name], *ends)]
        at = first + len(back)
        rows += [
            order.index(term.axis), BALANCES.index(term.balance), place, name_checksum(term.law), at,
            at + len(numbers), len(term.domain), len(term.variables_from), *(term.window or _NO_WINDOW),
            *_hysteresis_parameters(term, places.get(id(term), 0)),
        ]  # fmt: skip
        others = [
            x for name, axis in term.variables_from.items()
            for x in (VARIABLES[name], order.index(axis), *(areas or {}).get(axis, (0.0, 0.0)))
        ]  # fmt: skip
        back += [*numbers, *ranges, *others]
    return np.array([TERMS_MARKER, len(terms), *rows, *back], float)


def terms_with_hysteresis(terms: Sequence[Term]) -> list[Term]:
    """Return those of the terms that have hysteresis (backlash operator or relay), in the same order."""
    return [term for term in terms if term.play or term.switch]


def _hysteresis_parameters(term: Term, place: int) -> tuple[float, ...]:
    """Return kind, activation index, variable index, shift and scale of a term's hysteresis.

    The kind is PLAY, SWITCH, or 0 without hysteresis. The activation index, `place`, is that of the
    internal state. The hysteresis operates on `(variable - shift) / scale`.
    """
    if term.play:
        return PLAY, place, VARIABLES[term.play.variable], 0.0, term.play.half_width
    if term.switch:
        switch = term.switch
        return SWITCH, place, VARIABLES[switch.variable], switch.off, switch.on - switch.off
    return 0, 0, 0, 0.0, 1.0


@intrinsic
def _law_table_address(typingctx):
    """Return the address of this process's table of law functions (numba intrinsic)."""

    def codegen(context, builder, signature, args):
        integer, name = ir.IntType(64), "hydrotele_laws"
        place = builder.module.globals.get(name) or ir.GlobalVariable(builder.module, integer, name)
        return builder.ptrtoint(place, integer)

    return types.int64(), codegen


@intrinsic
def _read_int64(typingctx, address):
    """Return the int64 at a memory address (numba intrinsic)."""

    def codegen(context, builder, signature, args):
        place = builder.inttoptr(args[0], ir.IntType(64).as_pointer())
        return builder.load(place)

    return types.int64(types.int64), codegen


@intrinsic
def _call_law(typingctx, function, terms, at, state):
    """Call a compiled law and return its value (numba intrinsic).

    `function` is the address of the law, `at` the index of its parameters in the table `terms`, and
    `state` the DriveState.
    """

    def codegen(context, builder, signature, args):
        function, terms, at, state = args
        real = ir.DoubleType()
        table = context.make_array(signature.args[1])(context, builder, value=terms)
        parameters = builder.gep(table.data, [at])
        space = cgutils.alloca_once(builder, state.type)
        builder.store(state, space)
        kind = ir.FunctionType(real, [real.as_pointer()] * 2).as_pointer()
        variables = builder.bitcast(space, real.as_pointer())
        return builder.call(builder.inttoptr(function, kind), [parameters, variables])

    return types.float64(function, terms, at, state), codegen


@compile_without_allocation
def find_law(terms, at):
    """Return the address of a term's law, 0 if this process does not know the law.

    Args:
        terms: (n,) table of `encode_terms_table`.
        at: index of the start of the term's row.
    """
    place = int(terms[at + _LAW])
    if place < 0 or place >= _MAX_LAWS:
        return 0
    entry = _law_table_address() + 16 * place
    return _read_int64(entry) if _read_int64(entry + 8) == int(terms[at + _CHECKSUM]) else 0


@compile_without_allocation
def call_law(law, terms, at, state):
    """Return the value of a law.

    Args:
        law: result of `find_law`.
        terms: (n,) table of `encode_terms_table`.
        at: index of the parameters of the law in `terms`.
        state: DriveState.
    """
    return _call_law(law, terms, at, state)


@compile_without_allocation
def _get_law_input(terms, at, k, value, s, drives):
    """Return the value of state variable k that the law of a term receives.

    If the term's `variables_from` contains the variable, it is the value of the drive named there,
    otherwise `value`. It is clipped to the range in the term's `domain`, if any. `at` is the start
    of the term's row in the table, and s the DriveState of the term's own drive.
    """
    first = int(terms[at + _DOMAIN])
    last = first + 3 * int(terms[at + _RANGES])
    for j in range(last, last + _OTHER_SIZE * int(terms[at + _OTHERS]), _OTHER_SIZE):
        if int(terms[j]) == k:
            value = _other_drive_variable(terms, j, s, drives)
    for j in range(first, last, 3):
        if int(terms[j]) == k:
            value = min(terms[j + 2], max(terms[j + 1], value))
    return value


@compile_without_allocation
def _hysteresis_state(terms, at, drives):
    """Return the internal state of a term's hysteresis from the activations, scalar [1].

    It is 0 if the activations do not contain the state. `at` is the start of the term's row in the
    table.
    """
    place = int(terms[at + _STATE_INDEX])
    return drives.act[place] if 0 < place < len(drives.act) else 0.0


@compile_without_allocation
def _hysteresis_variable(terms, at, s, drives):
    """Return the present value of the state variable on which a term's hysteresis depends [its unit].

    It is the value of another drive if `variables_from` contains the variable. `at` is the start of
    the term's row in the table.
    """
    k = int(terms[at + _HYSTERESIS_VARIABLE])
    last = int(terms[at + _DOMAIN]) + 3 * int(terms[at + _RANGES])
    for j in range(last, last + _OTHER_SIZE * int(terms[at + _OTHERS]), _OTHER_SIZE):
        if int(terms[j]) == k:
            return _other_drive_variable(terms, j, s, drives)
    return s[k]


@compile_without_allocation
def update_hysteresis(kind, state, scaled_variable):
    """Update a backlash operator or a relay with hysteresis for a new value of its variable.

    Args:
        kind: PLAY (backlash operator) or SWITCH (relay).
        state: previous internal state, scalar [1].
        scaled_variable: for a play the variable divided by the half width; for a switch the variable scaled to
            0 at the off threshold and 1 at the on threshold, scalar [1].

    Returns:
        New internal state, scalar [1]: the output of the backlash operator divided by its half
        width, or the factor 0 to 1 with which the relay multiplies the law.

    Source: play and relay with hysteresis, Visintin 1994, Differential Models of Hysteresis; the
        relay's jumps are ramps.
    """
    if kind == PLAY:
        return min(scaled_variable + 1.0, max(scaled_variable - 1.0, state))
    low = min(1.0, max(0.0, (scaled_variable - 1.0) / _SWITCH_RAMP_FRACTION + 0.5))
    high = min(1.0, max(0.0, scaled_variable / _SWITCH_RAMP_FRACTION + 0.5))
    return min(high, max(low, state))


@compile_without_allocation
def update_term_state(terms, term, value, state):
    """Update the hysteresis state of a term for a new value of its variable.

    Args:
        terms: (n,) table of `encode_terms_table`.
        term: number of a term with hysteresis among all terms of the table.
        value: present value of the variable of its hysteresis, scalar [its unit].
        state: previous internal state, scalar [1].

    Returns:
        New internal state, scalar [1]: the scaled output of a backlash operator, or the factor of a
        relay on its law.

    Source: `update_hysteresis`, with the variable scaled by the term's width or thresholds.
    """
    at = _HEADER_SIZE + _ROW_SIZE * term
    x = (value - terms[at + _SHIFT]) / terms[at + _SCALE]
    return update_hysteresis(terms[at + _HYSTERESIS], state, x)


@compile_without_allocation
def locate_hysteresis_state(terms, term):
    """Return the index of a term's hysteresis state, and the variable and drive on which it depends.

    Returns:
        (index in MuJoCo's activation vector, 0 for none; actuator index of the drive; index of the
        variable in `DriveState`).
    """
    at = _HEADER_SIZE + _ROW_SIZE * term
    axis, k = int(terms[at + _AXIS]), int(terms[at + _HYSTERESIS_VARIABLE])
    last = int(terms[at + _DOMAIN]) + 3 * int(terms[at + _RANGES])
    for j in range(last, last + _OTHER_SIZE * int(terms[at + _OTHERS]), _OTHER_SIZE):
        if int(terms[j]) == k:
            axis = int(terms[j + 1])
    return int(terms[at + _STATE_INDEX]), axis, k


@compile_without_allocation
def _other_drive_variable(terms, j, s, drives):
    """Return the value of a variable of another drive.

    From index j, the table contains the index of the variable, the index of the drive and its two
    piston areas. Time, supply pressure and other shared variables are those of s. The value is 0 if
    the simulator does not provide the variable.
    """
    k, i = int(terms[j]), int(terms[j + 1])
    if i < 0 or i >= len(drives.velocity):
        return 0.0
    if k == 1:
        return drives.position[i]
    if k == 2:
        return drives.velocity[i]
    if k == 8:
        return drives.command[i] if drives.command[i] == drives.command[i] else 0.0
    if 3 <= k <= 6:
        return drives.act[4 * i + k - 3] if i < drives.count else 0.0
    if k == 9:
        if i >= drives.count:
            return 0.0
        return terms[j + 2] * drives.act[4 * i + 2] - terms[j + 3] * drives.act[4 * i + 3]
    return s[k]


def window_factor(time, begin, end):
    """Return the factor 0 to 1 by which a term's time window multiplies its law.

    The factor is 1 between `begin` and `end` and 0 outside, with linear ramps of 0.1 s centred on
    both. `time` is a scalar or an array [s].
    """
    return np.minimum(1.0, np.maximum(0.0, 0.5 + np.minimum(time - begin, end - time) / _WINDOW_RAMP))


_window_factor = compile_without_allocation(window_factor)


@compile_without_allocation
def has_term(terms, balance, axis):
    """Return whether any term adds to a given balance (force, a flow or command) of a drive.

    Args:
        terms: (n,) table of `encode_terms_table`.
        balance: what the terms add to: FORCE, FLOW_HEAD, FLOW_ROD, COMMAND or FLOW_SUPPLY.
        axis: index of the actuator, or ANY_DRIVE.

    Returns:
        True if at least one term does.
    """
    if len(terms) == 0:
        return False
    for term in range(int(terms[COUNT_INDEX])):
        at = _HEADER_SIZE + _ROW_SIZE * term
        if int(terms[at + _BALANCE]) == balance and (axis == ANY_DRIVE or int(terms[at + _AXIS]) == axis):
            return True
    return False


@compile_without_allocation
def sum_terms(terms, balance, axis, s, drives):
    """Return the sum of all terms that add to a given balance (force, a flow or command) of a drive.

    Time windows and relays multiply the values of the laws.

    Args:
        terms: (n,) table of `encode_terms_table`.
        balance: what the terms add to: FORCE, FLOW_HEAD, FLOW_ROD, COMMAND or FLOW_SUPPLY.
        axis: index of the actuator.
        s: DriveState of the drive.
        drives: Drives, for variables of other drives and hysteresis states.

    Returns:
        Sum, scalar [N], [N m], [m^3/s], [1] or [V]. Laws that this process does not know add 0.
    """
    total = 0.0
    if len(terms) == 0:
        return total
    for term in range(int(terms[COUNT_INDEX])):
        at = _HEADER_SIZE + _ROW_SIZE * term
        if int(terms[at + _AXIS]) != axis or int(terms[at + _BALANCE]) != balance:
            continue
        share = _window_factor(s.time, terms[at + _WINDOW_START], terms[at + _WINDOW_STOP])
        if terms[at + _HYSTERESIS] == SWITCH:
            share *= _hysteresis_state(terms, at, drives)
        if share == 0.0:
            continue
        law = find_law(terms, at)
        if law == 0:
            continue
        seen = s
        played = terms[at + _HYSTERESIS] == PLAY
        let_through, own = 0.0, 0.0
        if played:
            let_through = terms[at + _SCALE] * _hysteresis_state(terms, at, drives)
            own = _hysteresis_variable(terms, at, s, drives)
        if played or terms[at + _RANGES] > 0.0 or terms[at + _OTHERS] > 0.0:
            seen = DriveState(
                _get_law_input(terms, at, np.int64(0), s.time, s, drives),
                _get_law_input(terms, at, np.int64(1), s.position, s, drives),
                _get_law_input(terms, at, np.int64(2), s.velocity, s, drives),
                _get_law_input(terms, at, np.int64(3), s.spool, s, drives),
                _get_law_input(terms, at, np.int64(4), s.spool_rate, s, drives),
                _get_law_input(terms, at, np.int64(5), s.pressure_head, s, drives),
                _get_law_input(terms, at, np.int64(6), s.pressure_rod, s, drives),
                _get_law_input(terms, at, np.int64(7), s.pressure_supply, s, drives),
                _get_law_input(terms, at, np.int64(8), s.command, s, drives),
                _get_law_input(terms, at, np.int64(9), s.force, s, drives),
                let_through,
                own - let_through,
            )
        total += share * call_law(law, terms, int(terms[at + _PARAMETERS]), seen)
    return total


@compile_without_allocation
def _shift_state(s, velocity, head, rod):
    """Return a copy of a DriveState with increments added to velocity, head-side and rod-side pressure.

    It is used for derivatives by finite differences.
    """
    return DriveState(
        s.time, s.position, s.velocity + velocity, s.spool, s.spool_rate, s.pressure_head + head,
        s.pressure_rod + rod, s.pressure_supply, s.command, s.force, s.play_output,
        s.play_difference,
    )  # fmt: skip


@compile_without_allocation
def sum_terms_with_slope(terms, balance, axis, s, drives):
    """Return the sum of the force or command terms of a drive, and its derivative by the velocity.

    Args:
        terms: (n,) table of `encode_terms_table`.
        balance: FORCE or COMMAND.
        axis: index of the actuator.
        s: DriveState of the drive.
        drives: Drives, for variables of other drives.

    Returns:
        (sum [N], [N m], [1] or [V]; its derivative by the velocity), the second by a forward difference.
    """
    value = sum_terms(terms, balance, axis, s, drives)
    step = _VELOCITY_STEP * (1.0 + abs(s.velocity))
    beyond = sum_terms(terms, balance, axis, _shift_state(s, step, 0.0, 0.0), drives)
    return value, (beyond - value) / step


@compile_without_allocation
def sum_flow_terms(terms, axis, s, drives):
    """Return the flows that a machine's terms add to both chambers of a drive, and their derivatives.

    Each flow is differentiated by the pressure of the chamber that it enters.

    Args:
        terms: (n,) table of `encode_terms_table`.
        axis: index of the actuator.
        s: DriveState of the drive.
        drives: Drives, for variables of other drives and hysteresis states.

    Returns:
        (q_head, q_rod [m^3/s], d q_head/d p_head, d q_rod/d p_rod [m^3/(s Pa)]). The slopes are
        forward differences, limited to values <= 0 for a stable implicit step.
    """
    head = sum_terms(terms, FLOW_HEAD, axis, s, drives)
    rod = sum_terms(terms, FLOW_ROD, axis, s, drives)
    more = sum_terms(terms, FLOW_HEAD, axis, _shift_state(s, 0.0, _PRESSURE_STEP, 0.0), drives)
    less = sum_terms(terms, FLOW_ROD, axis, _shift_state(s, 0.0, 0.0, _PRESSURE_STEP), drives)
    return (
        head,
        rod,
        min(0.0, (more - head) / _PRESSURE_STEP),
        min(0.0, (less - rod) / _PRESSURE_STEP),
    )
