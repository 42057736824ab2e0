"""Terms as one array of numbers that every simulator reads, and their compiled evaluation.

A law is found through a table of this process, address by address, whose place compiled code knows
as a symbol: so neither models nor exported files hold addresses, and compiled code can be cached on
disk. A row of terms holds the law's place in that table and a checksum of its name; where the two
do not agree, as in a file of another process, the term adds nothing.
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

# numpy's integers, since numba compiles a function anew for each of Python's that it is called with
FORCE, FLOW_HEAD, FLOW_ROD, COMMAND, FLOW_SUPPLY = np.arange(len(BALANCES), dtype=np.int64)
ANY = np.int64(-1)  # drive, where it does not matter which
MARKER = 215326.75  # of a table of terms among other custom numbers of a model
NO_TERMS = np.zeros(0)
COUNT = 1  # place of the number of terms, after the marker
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
) = range(16)  # of a term
PLAY, SWITCH = 1, 2  # ways in which a term has a memory, 0 for none
_BAND = 0.1  # of what lies between a switch's thresholds, over which it comes about
_HEAD = 2
_OTHER = 4  # numbers of a variable of another drive: variable, drive, and the drive's two areas
_MOST = 1024  # laws in a process
_EDGE = 0.1  # s, in which a term with a window comes and goes
_ALWAYS = (-1.0e18, 1.0e18)  # s, finite, as models keep numbers as text
_SPEED = 1.0e-6  # m/s or rad/s, and of the speed: difference for slopes, small against 5 mm/s
_PRESSURE = 100.0  # Pa, the same: small against the smoothing of an orifice

_registered = np.zeros((_MOST, 2), np.int64)  # address and checksum of every law
_kept: list = []  # the compiled functions at these addresses
_places: dict[str, tuple[Law, int]] = {}
_lock = threading.Lock()
binding.add_symbol("hydrotele_laws", _registered.ctypes.data)


def law_place(name: str) -> int:
    """Place of a law among those of this process; compiles it when it is first asked for.

    Raises:
        InputError: the law is not known here, or numba cannot compile it.
    """
    with _lock:
        if name not in LAWS:
            message = "is not known in this process; load the file that defines it first"
            raise InputError(f"law {name}", message)
        law, place = _places.get(name, (None, 0))
        if law is not LAWS[name]:
            if len(_kept) == _MOST:
                raise InputError(f"law {name}", f"is more than the {_MOST} that a process can use")
            called = _callable_from_c(LAWS[name])
            _registered[len(_kept)] = called.address, checksum(name)
            _kept.append(called)
            place = len(_kept) - 1
            _places[name] = LAWS[name], place
        return place


def checksum(name: str) -> int:
    """A number for a law's name that a float holds exactly."""
    return zlib.crc32(name.encode())


def _callable_from_c(law: Law):
    """C function `double(double *parameters, double *state)` of a law."""
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
    exec(text, names)  # the number of arguments differs from law to law
    pointer = types.CPointer(types.float64)
    try:
        return cfunc(types.float64(pointer, pointer), error_model="numpy")(names["call"])
    except Exception as error:  # whatever numba says of a user's function
        if not law.source:
            raise
        why = str(error).strip().splitlines()
        message = f"cannot be compiled by numba: {why[0]} ... {why[-1]}"
        raise InputError(f"{law.source}: law {law.name}", message) from None


def _compiled_anew(function):
    """A user's function; a cache on disk would miss changes of the files that it uses."""
    return njit(error_model="numpy", nogil=True)(function)


def terms_table(
    terms: Sequence[Term], order: Sequence[str], memory: int = 0,
    areas: Mapping[str, Sequence[float]] | None = None,
) -> np.ndarray:  # fmt: skip
    """Terms as the numbers that compiled code reads.

    Args:
        terms: of a machine.
        order: axis names in actuator order.
        memory: place, among the activations, of what the first term with a memory remembers; the
            others' follow. 0 where nothing keeps it: what those terms see has then not moved yet.
        areas: hydraulic axis -> (2,) areas on which its head- and rod-side pressures act [m^2] or
            [m^3/rad], for terms that see the force of another drive.

    Returns:
        (n,) numbers, none where there are no terms: marker, count, a row per term, then the laws'
        parameters, the ranges of variables, and variables with the drives that they are of.

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
    """The terms that have a memory."""
    return [term for term in terms if term.play or term.switch]


def _memory_numbers(term: Term, place: int) -> tuple[float, ...]:
    """Way, place, variable, shift and scale of a term's memory."""
    if term.play:
        return PLAY, place, VARIABLES[term.play.variable], 0.0, term.play.half_width
    if term.switch:
        switch = term.switch
        return SWITCH, place, VARIABLES[switch.variable], switch.off, switch.on - switch.off
    return 0, 0, 0, 0.0, 1.0


@intrinsic
def _laws(typingctx):
    """Address of the table of laws of this process."""

    def codegen(context, builder, signature, args):
        integer, name = ir.IntType(64), "hydrotele_laws"
        place = builder.module.globals.get(name) or ir.GlobalVariable(builder.module, integer, name)
        return builder.ptrtoint(place, integer)

    return types.int64(), codegen


@intrinsic
def _word(typingctx, address):
    """The int64 at an address."""

    def codegen(context, builder, signature, args):
        place = builder.inttoptr(args[0], ir.IntType(64).as_pointer())
        return builder.load(place)

    return types.int64(types.int64), codegen


@intrinsic
def _call(typingctx, function, terms, at, state):
    """Value of the law at an address, with its parameters at a place of the table."""

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
    """A variable as the law of a term sees it: of the drive that it names, inside its domain."""
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
    """What a term remembers, scalar [1]; 0 where nothing keeps it."""
    place = int(terms[at + _PLACE])
    return drives.act[place] if 0 < place < len(drives.act) else 0.0


@allocation_free
def _value(terms, at, s, drives):
    """The variable of a term's memory as it is now, of the drive that it is of [its unit]."""
    k = int(terms[at + _REMEMBERED])
    last = int(terms[at + _DOMAIN]) + 3 * int(terms[at + _RANGES])
    for j in range(last, last + _OTHER * int(terms[at + _OTHERS]), _OTHER):
        if int(terms[j]) == k:
            return _of_drive(terms, j, s, drives)
    return s[k]


@allocation_free
def remembered(way, held, x):
    """What a term remembers after a variable has moved.

    Args:
        way: PLAY or SWITCH.
        held: what it remembered before, scalar [1].
        x: of a play the variable over the half width; of a switch 0 where it goes off and 1 where
            it goes on, scalar [1].

    Returns:
        Scalar [1]: what is seen over the half width, or the share with which the law acts.

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
    """What a term remembers after its variable has come to a value.

    Args:
        terms: (n,) table of `terms_table`.
        term: index of a term with a memory.
        value: of its variable, scalar [its unit].
        held: what it remembered before, scalar [1].

    Returns:
        Scalar [1].

    Source: `remembered`.
    """
    at = _HEAD + _ROW * term
    x = (value - terms[at + _SHIFT]) / terms[at + _SCALE]
    return remembered(terms[at + _WAY], held, x)


@allocation_free
def memory_of(terms, term):
    """(place among the activations, axis, variable) of a term's memory, place 0 for none."""
    at = _HEAD + _ROW * term
    axis, k = int(terms[at + _AXIS]), int(terms[at + _REMEMBERED])
    last = int(terms[at + _DOMAIN]) + 3 * int(terms[at + _RANGES])
    for j in range(last, last + _OTHER * int(terms[at + _OTHERS]), _OTHER):
        if int(terms[j]) == k:
            axis = int(terms[j + 1])
    return int(terms[at + _PLACE]), axis, k


@allocation_free
def _of_drive(terms, j, s, drives):
    """A variable of another drive, as entry j says; what all drives share is that of the state."""
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
    """Share with which a term acts at a time, or at many; of scalars it is compiled, too."""
    return np.minimum(1.0, np.maximum(0.0, 0.5 + np.minimum(time - begin, end - time) / _EDGE))


_acting = allocation_free(acting)


@allocation_free
def acts_on(terms, balance, axis):
    """Whether a term adds to a balance of a drive: what it would see need not be known if not.

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
    """What the terms add to a balance of a drive.

    Args:
        terms: (n,) table of `terms_table`.
        balance: FORCE, FLOW_HEAD, FLOW_ROD, COMMAND or FLOW_SUPPLY.
        axis: index of the actuator.
        s: DriveState.
        drives: Drives, for variables that are another drive's.

    Returns:
        Their sum, scalar [N], [N m], [m^3/s], [1] or [V].
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
    """The state with another velocity and other pressures."""
    return DriveState(
        s.time, s.position, s.velocity + velocity, s.spool, s.spool_rate, s.pressure_head + head,
        s.pressure_rod + rod, s.pressure_supply, s.command, s.force, s.played,
        s.ahead,
    )  # fmt: skip


@allocation_free
def added_with_slope(terms, balance, axis, s, drives):
    """What the terms add to force or command, and its slope with respect to the velocity.

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
    """What the terms add to the flows into both chambers of an axis, and slopes for a stiff step.

    Args:
        terms: (n,) table of `terms_table`.
        axis: index of the actuator.
        s: DriveState.
        drives: Drives.

    Returns:
        (q_head, q_rod [m^3/s], d q_head/d p_head, d q_rod/d p_rod [m^3/(s Pa)], both <= 0), the
        slopes by forward differences.
    """
    head = added(terms, FLOW_HEAD, axis, s, drives)
    rod = added(terms, FLOW_ROD, axis, s, drives)
    more = added(terms, FLOW_HEAD, axis, _moved(s, 0.0, _PRESSURE, 0.0), drives)
    less = added(terms, FLOW_ROD, axis, _moved(s, 0.0, 0.0, _PRESSURE), drives)
    return head, rod, min(0.0, (more - head) / _PRESSURE), min(0.0, (less - rod) / _PRESSURE)
