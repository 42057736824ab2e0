"""Encoding of terms as one array that every simulator reads, and their compiled evaluation.

Compiled code finds laws in a table of function addresses of this process, which it refers to by a
symbol. Models and exported files therefore contain no addresses, and compiled code can be cached on
disk. The row of a term has the law's index in that table and a checksum of its name. If both do not
match, as in a file from another process, the term adds nothing.
"""
# pyright: reportCallIssue=false, reportPrivateImportUsage=false, reportArgumentType=false
# numba's intrinsics are called without their typing context.

import threading
import zlib
from collections.abc import Mapping, Sequence

import numpy as np
from llvmlite import binding, ir
from numba import carray, cfunc, njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from hydrotele.core.compiled import allocation_free, compiled
from hydrotele.core.errors import InputError
from hydrotele.terms.law import BALANCES, LAWS, VARIABLES, DriveState, Law, Numbers, Term, Variable

# numpy integers, since numba compiles a function again for every Python integer literal
FORCE, FLOW_HEAD, FLOW_ROD, COMMAND, FLOW_SUPPLY = np.arange(len(BALANCES), dtype=np.int64)
ANY = np.int64(-1)  # any drive
MARKER = 215326.75  # first value of a table of terms, to find it among the custom numerics
NO_TERMS = np.zeros(0)
COUNT = 1  # index of the number of terms, after the marker
(
    _AXIS,
    _BALANCE,
    _LAW,
    _CHECKSUM,
    _PARAMETERS,
    _DOMAIN,
    _RANGES,
    _OTHERS,
    _BEGIN,
    _END,
    _WAY,
    _PLACE,
    _REMEMBERED,
    _SHIFT,
    _SCALE,
    _ROW,
) = range(16)  # columns of a term's row; _ROW is their number
PLAY, SWITCH = 1, 2  # kinds of hysteresis of a term, 0 for none
_BAND = 0.1  # width of a switch's ramps, as a fraction of the interval between its thresholds
_HEAD = 2
_OTHER = 4  # values of a variable of another drive: variable, drive, and the drive's two areas
_MOST = 1024  # largest number of laws in a process
_EDGE = 0.1  # s, duration of the ramps at the ends of a term's window
_ALWAYS = (-1.0e18, 1.0e18)  # s, finite, because MJCF files store numbers as text
_SPEED = 1.0e-6  # absolute [m/s or rad/s] and relative step of the velocity derivative
_PRESSURE = 100.0  # Pa, step of pressure derivatives: small against the smoothing of an orifice

_registered = np.zeros((_MOST, 2), np.int64)  # address and checksum of every law
_kept: list = []  # keeps the compiled functions at these addresses alive
_places: dict[str, tuple[Law, int]] = {}
_lock = threading.Lock()
binding.add_symbol("hydrotele_laws", _registered.ctypes.data)


def law_place(name: str) -> int:
    """Return the index of a law in the law table of this process; compile it on first use.

    Raises:
        InputError: the law is not known in this process, or numba cannot compile it.
    """
    with _lock:
        if name not in LAWS:
            message = "is not known in this process; load the file that defines it first"
            raise InputError(f"law {name}", message)
        law, place = _places.get(name, (None, 0))
        if law is not LAWS[name]:
            if len(_kept) == _MOST:
                raise InputError(f"law {name}", f"exceeds the limit of {_MOST} laws in a process")
            called = _callable_from_c(LAWS[name])
            _registered[len(_kept)] = called.address, checksum(name)
            _kept.append(called)
            place = len(_kept) - 1
            _places[name] = LAWS[name], place
        return place


def checksum(name: str) -> int:
    """Return a checksum of a law's name that a float represents exactly."""
    return zlib.crc32(name.encode())


def _callable_from_c(law: Law):
    """Compile a law to a C function `double(double *parameters, double *state)`."""
    places, arguments = 1, []
    for kind in law.kinds.values():
        if kind is Numbers:
            arguments.append(f"p[int(p[{places}]) : int(p[{places + 1}])]")
            places += 2
        else:
            arguments.append(f"int(p[{places}])" if kind is Variable else f"p[{places}]")
            places += 1
    state = ", ".join(f"s[{k}]" for k in range(len(DriveState._fields)))
    text = (
        "def call(parameters, s):\n"
        "    p = carray(parameters, (int(parameters[0]),))\n"
        f"    return float(function(DriveState({state}), {', '.join(arguments)}))\n"
    )
    own = compiled(law.function) if not law.source else _compiled_anew(law.function)
    names = {"carray": carray, "DriveState": DriveState, "function": own}
    exec(text, names)  # generated code, because the number of arguments differs between laws
    pointer = types.CPointer(types.float64)
    try:
        return cfunc(types.float64(pointer, pointer), error_model="numpy")(names["call"])
    except Exception as error:  # numba raises many types for an invalid user function
        if not law.source:
            raise
        why = str(error).strip().splitlines()
        message = f"cannot be compiled by numba: {why[0]} ... {why[-1]}"
        raise InputError(f"{law.source}: law {law.name}", message) from None


def _compiled_anew(function):
    """Compile a user's function without cache, which would miss changes of the files it uses."""
    return njit(error_model="numpy", nogil=True)(function)


def terms_table(
    terms: Sequence[Term], order: Sequence[str], memory: int = 0,
    areas: Mapping[str, Sequence[float]] | None = None,
) -> np.ndarray:  # fmt: skip
    """Encode terms as an array for compiled code.

    Args:
        terms: terms of a machine.
        order: axis names in actuator order.
        memory: activation index of the internal state of the first term with hysteresis; those of
            further terms follow. 0 if there are no such activations: the internal states are
            then 0.
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
    rows, back, first = [], [], _HEAD + _ROW * len(terms)
    places = {id(term): memory + k for k, term in enumerate(remembering(terms)) if memory}
    for term in terms:
        place = law_place(term.law)
        numbers = LAWS[term.law].numbers(term.parameters)
        ranges = [x for name, ends in term.domain.items() for x in (VARIABLES[name], *ends)]
        at = first + len(back)
        rows += [
            order.index(term.axis), BALANCES.index(term.balance), place, checksum(term.law), at,
            at + len(numbers), len(term.domain), len(term.of), *(term.window or _ALWAYS),
            *_memory_numbers(term, places.get(id(term), 0)),
        ]  # fmt: skip
        others = [
            x for name, axis in term.of.items()
            for x in (VARIABLES[name], order.index(axis), *(areas or {}).get(axis, (0.0, 0.0)))
        ]  # fmt: skip
        back += [*numbers, *ranges, *others]
    return np.array([MARKER, len(terms), *rows, *back], float)


def remembering(terms: Sequence[Term]) -> list[Term]:
    """Return the terms with hysteresis, in their order."""
    return [term for term in terms if term.play or term.switch]


def _memory_numbers(term: Term, place: int) -> tuple[float, ...]:
    """Return kind, activation index, variable, shift and scale of a term's hysteresis."""
    if term.play:
        return PLAY, place, VARIABLES[term.play.variable], 0.0, term.play.half_width
    if term.switch:
        switch = term.switch
        return SWITCH, place, VARIABLES[switch.variable], switch.off, switch.on - switch.off
    return 0, 0, 0, 0.0, 1.0


@intrinsic
def _laws(typingctx):
    """Return the address of the law table of this process."""

    def codegen(context, builder, signature, args):
        integer, name = ir.IntType(64), "hydrotele_laws"
        place = builder.module.globals.get(name) or ir.GlobalVariable(builder.module, integer, name)
        return builder.ptrtoint(place, integer)

    return types.int64(), codegen


@intrinsic
def _word(typingctx, address):
    """Return the int64 at an address."""

    def codegen(context, builder, signature, args):
        place = builder.inttoptr(args[0], ir.IntType(64).as_pointer())
        return builder.load(place)

    return types.int64(types.int64), codegen


@intrinsic
def _call(typingctx, function, terms, at, state):
    """Call the law at an address with the parameters at an index of the table; return its value."""

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


@allocation_free
def _seen(terms, at, k, value, s, drives):
    """Return a variable as the law of a term gets it: of the drive in `of`, clipped to `domain`."""
    first = int(terms[at + _DOMAIN])
    last = first + 3 * int(terms[at + _RANGES])
    for j in range(last, last + _OTHER * int(terms[at + _OTHERS]), _OTHER):
        if int(terms[j]) == k:
            value = _of_drive(terms, j, s, drives)
    for j in range(first, last, 3):
        if int(terms[j]) == k:
            value = min(terms[j + 2], max(terms[j + 1], value))
    return value


@allocation_free
def _held(terms, at, drives):
    """Return the internal state of a term, scalar [1]; 0 if it has no activation."""
    place = int(terms[at + _PLACE])
    return drives.act[place] if 0 < place < len(drives.act) else 0.0


@allocation_free
def _value(terms, at, s, drives):
    """Return the current value of the variable of a term's hysteresis [its unit]."""
    k = int(terms[at + _REMEMBERED])
    last = int(terms[at + _DOMAIN]) + 3 * int(terms[at + _RANGES])
    for j in range(last, last + _OTHER * int(terms[at + _OTHERS]), _OTHER):
        if int(terms[j]) == k:
            return _of_drive(terms, j, s, drives)
    return s[k]


@allocation_free
def remembered(way, held, x):
    """Update the internal state of a play or switch for a new value of its variable.

    Args:
        way: PLAY or SWITCH.
        held: previous internal state, scalar [1].
        x: for a play the variable divided by the half width; for a switch the variable scaled to
            0 at the off threshold and 1 at the on threshold, scalar [1].

    Returns:
        New internal state, scalar [1]: the output of the play divided by the half width, or the
        factor on the law.

    Source: play and relay with hysteresis, Visintin 1994, Differential Models of Hysteresis; the
        relay's jumps are ramps.
    """
    if way == PLAY:
        return min(x + 1.0, max(x - 1.0, held))
    low = min(1.0, max(0.0, (x - 1.0) / _BAND + 0.5))
    high = min(1.0, max(0.0, x / _BAND + 0.5))
    return min(high, max(low, held))


@allocation_free
def remember(terms, term, value, held):
    """Update the internal state of a term for a new value of its variable.

    Args:
        terms: (n,) table of `terms_table`.
        term: index of a term with hysteresis.
        value: value of its variable, scalar [its unit].
        held: previous internal state, scalar [1].

    Returns:
        New internal state, scalar [1].

    Source: `remembered`.
    """
    at = _HEAD + _ROW * term
    x = (value - terms[at + _SHIFT]) / terms[at + _SCALE]
    return remembered(terms[at + _WAY], held, x)


@allocation_free
def memory_of(terms, term):
    """Return (activation index, axis, variable) of a term's hysteresis; index 0 for none."""
    at = _HEAD + _ROW * term
    axis, k = int(terms[at + _AXIS]), int(terms[at + _REMEMBERED])
    last = int(terms[at + _DOMAIN]) + 3 * int(terms[at + _RANGES])
    for j in range(last, last + _OTHER * int(terms[at + _OTHERS]), _OTHER):
        if int(terms[j]) == k:
            axis = int(terms[j + 1])
    return int(terms[at + _PLACE]), axis, k


@allocation_free
def _of_drive(terms, j, s, drives):
    """Return the variable of another drive given by entry j; shared variables are those of s."""
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


def acting(time, begin, end):
    """Return the factor of a term's time window, 0 to 1, at a time or an array of times [s]."""
    return np.minimum(1.0, np.maximum(0.0, 0.5 + np.minimum(time - begin, end - time) / _EDGE))


_acting = allocation_free(acting)


@allocation_free
def acts_on(terms, balance, axis):
    """Return whether any term adds to a balance of a drive, so that its inputs are needed.

    Args:
        terms: (n,) table of `terms_table`.
        balance: FORCE, FLOW_HEAD, FLOW_ROD, COMMAND or FLOW_SUPPLY.
        axis: index of the actuator, or ANY.

    Returns:
        bool.
    """
    if len(terms) == 0:
        return False
    for term in range(int(terms[COUNT])):
        at = _HEAD + _ROW * term
        if int(terms[at + _BALANCE]) == balance and (axis == ANY or int(terms[at + _AXIS]) == axis):
            return True
    return False


@allocation_free
def added(terms, balance, axis, s, drives):
    """Return the sum of all terms of a balance of a drive.

    Args:
        terms: (n,) table of `terms_table`.
        balance: FORCE, FLOW_HEAD, FLOW_ROD, COMMAND or FLOW_SUPPLY.
        axis: index of the actuator.
        s: DriveState.
        drives: Drives, for variables of other drives.

    Returns:
        Sum, scalar [N], [N m], [m^3/s], [1] or [V].
    """
    total = 0.0
    if len(terms) == 0:
        return total
    for term in range(int(terms[COUNT])):
        at = _HEAD + _ROW * term
        if int(terms[at + _AXIS]) != axis or int(terms[at + _BALANCE]) != balance:
            continue
        share = _acting(s.time, terms[at + _BEGIN], terms[at + _END])
        if terms[at + _WAY] == SWITCH:
            share *= _held(terms, at, drives)
        if share == 0.0:
            continue
        place = int(terms[at + _LAW])
        if place < 0 or place >= _MOST:
            continue
        entry = _laws() + 16 * place
        address = _word(entry)
        if address == 0 or _word(entry + 8) != int(terms[at + _CHECKSUM]):
            continue
        seen = s
        played = terms[at + _WAY] == PLAY
        let_through, own = 0.0, 0.0
        if played:
            let_through = terms[at + _SCALE] * _held(terms, at, drives)
            own = _value(terms, at, s, drives)
        if played or terms[at + _RANGES] > 0.0 or terms[at + _OTHERS] > 0.0:
            seen = DriveState(
                _seen(terms, at, np.int64(0), s.time, s, drives),
                _seen(terms, at, np.int64(1), s.position, s, drives),
                _seen(terms, at, np.int64(2), s.velocity, s, drives),
                _seen(terms, at, np.int64(3), s.spool, s, drives),
                _seen(terms, at, np.int64(4), s.spool_rate, s, drives),
                _seen(terms, at, np.int64(5), s.pressure_head, s, drives),
                _seen(terms, at, np.int64(6), s.pressure_rod, s, drives),
                _seen(terms, at, np.int64(7), s.pressure_supply, s, drives),
                _seen(terms, at, np.int64(8), s.command, s, drives),
                _seen(terms, at, np.int64(9), s.force, s, drives),
                let_through,
                own - let_through,
            )
        total += share * _call(address, terms, int(terms[at + _PARAMETERS]), seen)
    return total


@allocation_free
def _moved(s, velocity, head, rod):
    """Return the state with increments added to velocity and chamber pressures."""
    return DriveState(
        s.time, s.position, s.velocity + velocity, s.spool, s.spool_rate, s.pressure_head + head,
        s.pressure_rod + rod, s.pressure_supply, s.command, s.force, s.played,
        s.ahead,
    )  # fmt: skip


@allocation_free
def added_with_slope(terms, balance, axis, s, drives):
    """Return the sum of the force or command terms, and its derivative by the velocity.

    Args:
        terms: (n,) table of `terms_table`.
        balance: FORCE or COMMAND.
        axis: index of the actuator.
        s: DriveState.
        drives: Drives.

    Returns:
        (sum, d sum / d velocity), by a forward difference.
    """
    value = added(terms, balance, axis, s, drives)
    step = _SPEED * (1.0 + abs(s.velocity))
    beyond = added(terms, balance, axis, _moved(s, step, 0.0, 0.0), drives)
    return value, (beyond - value) / step


@allocation_free
def added_flows(terms, axis, s, drives):
    """Return the flows that terms add to both chambers of an axis, and their slopes.

    Args:
        terms: (n,) table of `terms_table`.
        axis: index of the actuator.
        s: DriveState.
        drives: Drives.

    Returns:
        (q_head, q_rod [m^3/s], d q_head/d p_head, d q_rod/d p_rod [m^3/(s Pa)]). The slopes are
        forward differences, limited to values <= 0 for a stable implicit step.
    """
    head = added(terms, FLOW_HEAD, axis, s, drives)
    rod = added(terms, FLOW_ROD, axis, s, drives)
    more = added(terms, FLOW_HEAD, axis, _moved(s, 0.0, _PRESSURE, 0.0), drives)
    less = added(terms, FLOW_ROD, axis, _moved(s, 0.0, 0.0, _PRESSURE), drives)
    return head, rod, min(0.0, (more - head) / _PRESSURE), min(0.0, (less - rod) / _PRESSURE)
