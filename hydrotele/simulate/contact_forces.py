"""Contact forces of the ground and of surrounding objects on a machine [N].

They are given in total and per object, in the world frame.
"""
# pyright: reportCallIssue=false
# numba's intrinsics are called without their typing context.

import mujoco
import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.memory import (
    address_record,
    float64_view,
    int32_view,
    int64_view,
)
from hydrotele.simulate.mujoco_c_api import (
    call_mj_contact_force,
    field_offsets,
    function_address,
    struct_size,
)
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.surroundings import is_surrounding_object


def mark_surrounding_bodies(plant: Plant) -> np.ndarray:
    """Return for each body (nbody,) whether it is the world, fixed to it, or a surrounding object."""
    model = plant.model
    named = [is_surrounding_object(model.body(b).name) for b in range(model.nbody)]
    return (model.body_weldid == 0) | (np.array(named) & bool(plant.surroundings))


def mark_surrounding_geoms(plant: Plant) -> np.ndarray:
    """Return for each geom (ngeom,) 1 if it belongs to the ground or a surrounding object, else 0."""
    return _geom_flags(plant.model, mark_surrounding_bodies(plant))


def surrounding_groups(plant: Plant) -> tuple[np.ndarray, tuple[str, ...]]:
    """Group the geoms of ground and surrounding objects for the recording of contact forces.

    Args:
        plant: the plant.

    Returns:
        (ngeom,) group of each geom: 0 for the machine, k + 1 for `names[k]` with k from 0. And the
        names: `ground`, including fixed geoms, then every plate, tree, stump and log.
    """
    model, numbers, names = plant.model, mark_surrounding_geoms(plant), ["ground"]
    for geom in np.flatnonzero(numbers):
        name, body = model.geom(geom).name, model.body(model.geom_bodyid[geom]).name
        thing = body if model.body_weldid[model.geom_bodyid[geom]] else name
        if plant.surroundings and is_surrounding_object(thing):
            if thing not in names:
                names.append(thing)
            numbers[geom] = names.index(thing) + 1
    return numbers, tuple(names)


def _geom_flags(model: mujoco.MjModel, around: np.ndarray) -> np.ndarray:
    return around[model.geom_bodyid].astype(np.int64)


def total_contact_force(model: mujoco.MjModel, data: mujoco.MjData, around: np.ndarray) -> np.ndarray:
    """Return the sum (3,) of the contact forces of ground and objects on the machine, world frame [N].

    Args:
        model: the model.
        data: its data, with contacts and contact forces.
        around: (nbody,) result of `mark_surrounding_bodies`.
    """
    total, around = np.zeros(3), _geom_flags(model, around)
    sum_contact_forces(make_contact_addresses(model, data, around), total)
    return total


CONTACTS_DTYPE = np.dtype(
    [(name, np.int64) for name in ("function", "model", "data", "count", "contacts", "geoms")]
    + [(name, np.int64) for name in ("size", "frame", "geom", "around")],
    align=True,
)
"""Record type of `make_contact_addresses`."""


def make_contact_addresses(model: mujoco.MjModel, data: mujoco.MjData, around: np.ndarray) -> np.ndarray:
    """Create the record with the addresses of contacts and forces for `sum_contact_forces`.

    Args:
        model: the model.
        data: its data; model and data must outlive the record.
        around: (ngeom,) result of `mark_surrounding_geoms`, which must outlive the record, too.

    Returns:
        (1,) record.
    """
    found, in_data = address_record(CONTACTS_DTYPE, {"around": around}), field_offsets("mjData")
    for name, value in {
        "function": function_address("mj_contactForce"), "model": model._address,
        "data": data._address, "count": data._address + in_data["ncon"],
        "contacts": data._address + in_data["contact"], "geoms": len(around),
        "size": struct_size("mjContact"), "frame": field_offsets("mjContact")["frame"],
        "geom": field_offsets("mjContact")["geom"],
    }.items():  # fmt: skip
        found[name] = value
    return found


@compiled
def sum_contact_forces(record, total):
    """Compute the sum of the contact forces of ground and objects on the machine, in compiled code.

    Args:
        record: record of `make_contact_addresses`.
        total: (3,) written: the sum, world frame [N].

    Returns:
        Nothing.

    Source: `total_contact_force`.
    """
    sum_contact_forces_by_group(record[0], total)


@compiled
def sum_contact_forces_by_group(r, totals):
    """Compute the sum of the contact forces on the machine for each of n groups of surrounding geoms.

    `r` is a record of `make_contact_addresses`; its `around` contains the group of every geom, 0
    for the machine. `totals` (3 n,) is written: x, y and z of group 1, then of group 2, and so on,
    in the world frame [N]. Groups above n are added to the last. Contacts within the machine, and
    those between surrounding objects, are omitted.
    """
    totals[:] = 0.0
    around, wrench, groups = int64_view(r.around, r.geoms), np.empty(6), len(totals) // 3
    first_contact = int64_view(r.contacts, 1)[0]
    for k in range(int32_view(r.count, 1)[0]):
        contact = first_contact + k * r.size
        geom = int32_view(contact + r.geom, 2)
        first, second = around[geom[0]], around[geom[1]]
        if (first > 0) == (second > 0):
            continue  # contact within the machine or between surrounding objects
        call_mj_contact_force(r.function, r.model, r.data, k, wrench.ctypes.data)
        frame, sign = float64_view(contact + r.frame, 9), 1.0 if first > 0 else -1.0
        start = 3 * (min(max(first, second), groups) - 1)
        for i in range(3):
            force = frame[i] * wrench[0] + frame[3 + i] * wrench[1]
            totals[start + i] += sign * (force + frame[6 + i] * wrench[2])
