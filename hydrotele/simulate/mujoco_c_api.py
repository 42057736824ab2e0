"""Memory layout of MuJoCo's structs and calls of MuJoCo's C functions from compiled code.

Field offsets are computed from MuJoCo's description of its structs (`mujoco.introspect`) and the C
layout rules, and are checked against the addresses and values of the Python bindings. C functions
are called by their address, an integer, so that the calling code can be cached on disk. The module
also gives access to MuJoCo's shared library.
"""

import ctypes
import functools
from pathlib import Path

import mujoco
import numpy as np
from llvmlite import ir
from mujoco.introspect import ast_nodes, structs
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


@functools.cache
def mujoco_library() -> ctypes.CDLL:
    """Return MuJoCo's shared library, the one that the Python bindings use.

    Raises:
        RuntimeError: the `mujoco` package contains no shared library.
    """
    found = next(Path(mujoco.__file__).parent.glob("*mujoco.*[0-9]*"), None)
    if found is None:
        raise RuntimeError(f"MuJoCo {mujoco.__version__} has no shared library in its package")
    return ctypes.CDLL(str(found))


_PRIMITIVES = {
    "int": 4, "float": 4, "double": 8, "mjtNum": 8, "char": 1, "unsigned char": 1, "mjtByte": 1,
    "mjtBool": 1, "bool": 1, "_Bool": 1, "size_t": 8, "uintptr_t": 8, "uint64_t": 8, "int64_t": 8,
    "mjtSize": 8, "unsigned int": 4,
}  # fmt: skip


def _size_and_alignment(node) -> tuple[int, int]:
    """Return size and alignment [byte] of a C type, given as a node of `mujoco.introspect`."""
    if isinstance(node, ast_nodes.PointerType):
        return 8, 8
    if isinstance(node, ast_nodes.ArrayType):
        size, alignment = _size_and_alignment(node.inner_type)
        return size * int(np.prod(node.extents)), alignment
    name = getattr(node, "name", "")
    if name in _PRIMITIVES:
        return _PRIMITIVES[name], _PRIMITIVES[name]
    for candidate in (name, name.removesuffix("_")):
        if candidate in structs.STRUCTS:
            fields = structs.STRUCTS[candidate].fields
            return _struct_layout(fields)[1:]
    if isinstance(node, ast_nodes.AnonymousStructDecl):
        return _struct_layout(node.fields)[1:]
    if name.startswith("mjt"):  # an enum
        return 4, 4
    raise RuntimeError(f"unknown C type {node!r} in MuJoCo {mujoco.__version__}")


def _struct_layout(fields) -> tuple[dict[str, int], int, int]:
    """Return the field offsets, the size and the alignment [byte] of a C struct with the given fields."""
    offsets: dict[str, int] = {}
    position, alignment = 0, 1
    for field in fields:
        size, align = _size_and_alignment(field.type)
        position = -(-position // align) * align
        offsets[field.name] = position
        position += size
        alignment = max(alignment, align)
    return offsets, -(-position // alignment) * alignment, alignment


@functools.cache
def field_offsets(struct: str) -> dict[str, int]:
    """Return the byte offset of every field of a MuJoCo struct.

    Args:
        struct: "mjModel", "mjData" or "mjContact".

    Returns:
        Field name -> offset [byte].

    Raises:
        RuntimeError: the struct contains an unknown type.

    Source: `mujoco.introspect.structs` and the C layout rules.
    """
    return _struct_layout(structs.STRUCTS[struct].fields)[0]


@functools.cache
def struct_size(struct: str) -> int:
    """Return the size of a MuJoCo struct, padding included [byte]."""
    return _struct_layout(structs.STRUCTS[struct].fields)[1]


def _read_number(address: int, dtype) -> float:
    """Read the number of a numpy type (float64, int64 or int32) that is stored at a memory address."""
    kinds = {np.float64: ctypes.c_double, np.int64: ctypes.c_int64, np.int32: ctypes.c_int32}
    kind = kinds[dtype]
    return kind.from_address(address).value


@functools.cache
def option_offset(name: str) -> int:
    """Return the offset of a field of `mjModel.opt` from the start of mjModel [byte]."""
    option = _struct_layout(structs.STRUCTS["mjOption"].fields)[0]
    return field_offsets("mjModel")["opt"] + option[name]


_CHECKED_ARRAYS = (
    "actuator_user",
    "actuator_actadr",
    "numeric_adr",
    "numeric_size",
    "numeric_data",
)
_PROBE_MODEL = """<mujoco><option timestep="0.0123"/><custom><numeric name="n" data="1 2 3"/></custom>
<worldbody><geom type="plane" size="1 1 1"/><body><joint name="j" type="slide"/>
<geom size="0.1"/></body></worldbody><actuator>
<general joint="j" dyntype="integrator" user="1 2 3"/><motor joint="j"/></actuator></mujoco>"""


@functools.cache
def verify_struct_offsets() -> None:
    """Check the computed offsets of MuJoCo's structs against the Python bindings on a small model.

    Raises:
        RuntimeError: the offset of a field is wrong; native hydraulics cannot run with this MuJoCo
            version.
    """
    model = mujoco.MjModel.from_xml_string(_PROBE_MODEL)
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)  # its body touches the plane
    data.time = 0.456
    in_model, in_data = field_offsets("mjModel"), field_offsets("mjData")
    wrong = [
        name
        for name in (
            *_CHECKED_ARRAYS,
            "actuator_biastype",
            "actuator_dyntype",
            "actuator_ctrlrange",
        )
        if _read_number(model._address + in_model[name], np.int64) != getattr(model, name).ctypes.data
    ]
    wrong += [
        name
        for name in ("nu", "nuser_actuator", "nnumeric")
        if _read_number(model._address + in_model[name], np.int64) != getattr(model, name)
    ]
    wrong += [
        name
        for name in ("ctrl", "act", "act_dot", "actuator_velocity", "actuator_length")
        if _read_number(data._address + in_data[name], np.int64) != getattr(data, name).ctypes.data
    ]
    contact, first = data.contact, _read_number(data._address + in_data["contact"], np.int64)
    wrong += [
        f"contact.{name}"
        for name in ("frame", "geom")
        if first + field_offsets("mjContact")[name] != getattr(contact, name).ctypes.data
    ]
    if struct_size("mjContact") != contact.frame.strides[0]:
        wrong.append("the next contact")
    if _read_number(data._address + in_data["ncon"], np.int32) != data.ncon:
        wrong.append("ncon")
    if data._address + in_data["warning"] + 4 != data.warning.number.ctypes.data:
        wrong.append("warning")
    if _read_number(model._address + option_offset("timestep"), np.float64) != 0.0123:
        wrong.append("opt.timestep")
    if _read_number(data._address + in_data["time"], np.float64) != 0.456:
        wrong.append("time")
    if wrong:
        raise RuntimeError(
            f"MuJoCo {mujoco.__version__} stores {', '.join(wrong)} at other offsets than"
            " mujoco.introspect describes; install a version in the range of pyproject.toml"
        )


@intrinsic
def call_mj_step(typingctx, function, model, data):
    """Call `mj_step(model, data)`, or another C function of these arguments, from compiled code.

    All arguments are addresses, given as integers: of the function, of mjModel and of mjData.
    """

    def codegen(context, builder, signature, args):
        kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t] * 2)
        function, *places = args
        called = builder.inttoptr(function, kind.as_pointer())
        builder.call(called, [builder.inttoptr(place, cgutils.voidptr_t) for place in places])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), codegen


@intrinsic
def call_mj_contact_force(typingctx, function, model, data, contact, wrench):
    """Call `mj_contactForce(model, data, contact, wrench)` from compiled code to get a contact wrench.

    `contact` is the index of the contact; all other arguments are addresses, given as integers.
    """

    def codegen(context, builder, signature, args):
        place, integer = cgutils.voidptr_t, ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [place, place, integer, place])
        function, model, data, contact, wrench = args
        pointers = [builder.inttoptr(at, place) for at in (model, data, wrench)]
        called = builder.inttoptr(function, kind.as_pointer())
        builder.call(called, [*pointers[:2], builder.trunc(contact, integer), pointers[2]])
        return context.get_dummy_value()

    five = (types.int64,) * 5
    return types.void(*five), codegen


@intrinsic
def call_mj_set_state(typingctx, function, model, data, state, spec):
    """Call `mj_setState(model, data, state, spec)` from compiled code to set the simulation state.

    `spec` selects the parts of the state; all other arguments are addresses, given as integers.
    """

    def codegen(context, builder, signature, args):
        integer = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t] * 3 + [integer])
        function, *places, spec = args
        called = builder.inttoptr(function, kind.as_pointer())
        pointers = [builder.inttoptr(place, cgutils.voidptr_t) for place in places]
        builder.call(called, [*pointers, builder.trunc(spec, integer)])
        return context.get_dummy_value()

    five = (types.int64,) * 5
    return types.void(*five), codegen


@functools.cache
def function_address(name: str) -> int:
    """Return the memory address of a C function of MuJoCo's library, such as `mj_step`."""
    import ctypes

    return ctypes.cast(getattr(mujoco_library(), name), ctypes.c_void_p).value or 0
