"""Conservation checks of a run: oil volume balance of each chamber and mechanical energy balance.

The first seconds are simulated again with the same commands (`mujoco.rollout`, bit-identical
states), and the balances of all physics steps are integrated by the trapezoidal rule.
"""

import mujoco
import numpy as np
from mujoco import rollout

from hydrotele.core.compiled import compiled
from hydrotele.hydraulics.circuit import ACTIVATIONS_PER_AXIS
from hydrotele.hydraulics.laws import air_compliance, pressure_without_released_air, relief_and_makeup_flow
from hydrotele.hydraulics.pump_drive import chamber_compliance, pump_speed_after_switching
from hydrotele.simulate.closed_loops import count_pins
from hydrotele.simulate.mechanism import drive_and_load_dofs
from hydrotele.simulate.plant import Plant, evaluate_terms
from hydrotele.simulate.record import align_staggered_positions
from hydrotele.simulate.true_values import compute_state_flows_and_forces, extract_drive_motion

_CONTACT_CHECK_INTERVAL = 10  # steps between two contact checks: a contact lasts longer
_FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS


def full_physics_state(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the full physics state (nstate,) (time, positions, velocities, activations) for `mujoco.rollout`."""
    state = np.empty(mujoco.mj_stateSize(model, _FULL_PHYSICS))
    mujoco.mj_getState(model, data, state, _FULL_PHYSICS)
    return state


def compute_balance_errors(plant: Plant, start: np.ndarray, controls: np.ndarray) -> dict[str, float | None]:
    """Simulate part of a run again and compute its relative errors of oil volume and energy balance.

    Args:
        plant: the plant of the run.
        start: (nstate,) full physics state at the start.
        controls: (nstep, nu) commands of every physics step.

    Returns:
        `seconds`: simulated time [s]. `flow_balance` [1]: largest |in - out - compressed| of a
        chamber, relative to the volume that flowed through it; None without hydraulic axes.
        `energy_balance` [1]: |work of the drives - damping - change of mechanical energy|, relative
        to the work of all drives (the sum of the magnitudes of its increments). It is None if the
        machine touched something, reached a joint limit, has drives without hydraulics, or did at
        most 1 J of work.
    """
    model = plant.model
    data = mujoco.MjData(model)
    states, _ = rollout.rollout(model, data, start[None, :], controls[None, :, :], persistent_pool=False)
    states = np.concatenate([start[None, :], states[0]])
    at = np.cumsum([1, model.nq, model.nv, model.na])
    qpos, qvel, act = states[:, 1 : at[1]], states[:, at[1] : at[2]], states[:, at[2] : at[3]]
    dt = model.opt.timestep
    qpos = align_staggered_positions(model, qpos[1:], qvel[1:])  # states at equal times, see record.py
    qvel, act = 0.5 * (qvel[1:] + qvel[:-1]), act[1:]
    x, v = extract_drive_motion(plant, qpos, qvel)
    more = evaluate_terms(plant.machine, states[1:, 0], act, x, v, controls)
    work, flow = _compute_work_and_volume_error(plant, x, v, act, more, dt)
    return {
        "seconds": len(controls) * dt,
        "flow_balance": flow,
        "energy_balance": _compute_energy_balance_error(plant, qpos, qvel, work, dt),
    }


def _compute_work_and_volume_error(plant, x, v, act, more, dt):
    """Compute the work of the hydraulic drives and the largest volume balance error of any chamber.

    The n rows are successive states, `dt` [s] apart: x and v (n, nu) are the drive positions and
    velocities, act (n, na) the activations, and `more` (n, nu, 3) the forces and flows of terms
    (`evaluate_terms`).

    Returns:
        (work since the first row (n,) [J], relative volume error [1] or None without hydraulic
        axes).
    """
    user, count = plant.model.actuator_user, plant.hydraulic
    if not count:
        return np.zeros(len(x)), None
    table = compute_state_flows_and_forces(user.ravel(), count, np.ascontiguousarray(act), x, v)
    worst = 0.0
    power = np.zeros(len(x))
    for i in range(count):
        power += (table[:, 4 * i + 3] + more[:, i, 0]) * v[:, i]
        worst = max(worst, *_volume_errors(plant, i, table, act, x, v, more, dt))
    return np.concatenate([[0.0], np.cumsum(0.5 * dt * (power[1:] + power[:-1]))]), worst


def _volume_errors(plant, i, table, act, x, v, more, dt):
    """Yield the relative oil volume balance error [1] of the head and then of the rod chamber of axis i.

    The error is |oil that entered - oil compressed|, divided by the volume that flowed in and out.
    `table` has the flows of `compute_state_flows_and_forces`; the other arguments are those of
    `_compute_work_and_volume_error`.
    """
    axis = plant.machine.axes[plant.axes[i]]
    if axis.pump:
        began = _flows_after_switching(plant, i, act, x, v)
        yield from _compute_pump_axis_volume_errors(axis, i, table, began, act, x, v, more, dt)
        return
    valve, supply = axis.valve, plant.machine.supply
    drive = axis.hydraulic_drive
    head, rod = drive.effective_areas
    volume_head, volume_rod = drive.chamber_volumes(x[:, i])
    p_head, p_rod = act[:, ACTIVATIONS_PER_AXIS * i + 2], act[:, ACTIVATIONS_PER_AXIS * i + 3]
    leak = drive.leakage * (p_head - p_rod)
    release = supply.dissolved_air * supply.bulk_modulus
    sides = (
        (p_head, table[:, 4 * i + 1] - leak + more[:, i, 1], head * v[:, i], volume_head),
        (p_rod, table[:, 4 * i + 2] + leak + more[:, i, 2], -rod * v[:, i], volume_rod),
    )
    for pressure, inflow, swept, volume in sides:
        port, bubbles, oil = _compute_port_flows_and_air(
            pressure, valve.port_relief, valve.port_relief_gain, supply.tank_pressure,
            valve.makeup_gain, supply.entrained_air, release,
        )  # fmt: skip
        net = inflow + port - swept
        entered = np.sum(0.5 * dt * (net[1:] + net[:-1]))
        middle = 0.5 * (volume[1:] + volume[:-1])
        soft = middle * (1.0 / supply.bulk_modulus + bubbles) + drive.hose_compliance
        compressed = np.sum(soft * np.diff(oil))
        through = np.sum(np.abs(inflow) + np.abs(port) + np.abs(swept)) * dt
        yield abs(entered - compressed) / max(through, 1e-12)


@compiled
def _compute_port_flows_and_air(pressure, relief, gain, tank, makeup, air, release):
    """Compute relief and make-up flow, and the effects of air, for one chamber with pressures (n,) [Pa].

    Returns:
        (n,) flow through port relief and make-up valve into the chamber [m^3/s], (n - 1,)
        compliance of air bubbles at the mean pressure of two rows [1/Pa], (n,) pressure without
        released air [Pa].
    """
    n = len(pressure)
    port, bubbles, oil = np.empty(n), np.empty(n - 1), np.empty(n)
    for row in range(n):
        port[row] = relief_and_makeup_flow(pressure[row], relief, gain, tank, makeup)[0]
        oil[row] = pressure_without_released_air(pressure[row], release)
    for row in range(n - 1):
        bubbles[row] = air_compliance(0.5 * (pressure[row] + pressure[row + 1]), air)
    return port, bubbles, oil


def _flows_after_switching(plant, i, act, x, v):
    """Return flows and forces at the start of every step, after the valve of axis i has switched.

    Axis i has its own pump. Its valve switches at the start of a step, while the pump keeps its
    speed. The result (n, 4 count) is that of `compute_state_flows_and_forces` with this signed
    pump speed.
    """
    switched, a = act.copy(), ACTIVATIONS_PER_AXIS * i
    switched[:-1, a] = [
        pump_speed_after_switching(speed, after) for speed, after in zip(act[:-1, a], act[1:, a], strict=True)
    ]
    return compute_state_flows_and_forces(plant.model.actuator_user.ravel(), plant.hydraulic, switched, x, v)


def _compute_pump_axis_volume_errors(axis, i, table, began, act, x, v, more, dt):
    """Yield the relative oil volume balance errors [1] of both chambers of an axis with its own pump.

    `table` has the flows of `compute_state_flows_and_forces` at the end of every step, and `began`
    those at its start (`_flows_after_switching`). The other arguments are those of
    `_compute_work_and_volume_error`.
    """
    cylinder, pump = axis.cylinder, axis.pump
    p_head, p_rod = act[:, ACTIVATIONS_PER_AXIS * i + 2], act[:, ACTIVATIONS_PER_AXIS * i + 3]
    leak = cylinder.leakage * (p_head - p_rod)
    head, rod = cylinder.chamber_volumes(x[:, i])
    sides = (
        (p_head, 1, more[:, i, 1] - leak, cylinder.area_head * v[:, i], head,
         pump.compliance_head, pump.air_head),
        (p_rod, 2, more[:, i, 2] + leak, -cylinder.area_rod * v[:, i], rod,
         pump.compliance_rod, pump.air_rod),
    )  # fmt: skip
    for pressure, column, besides, swept, volume, walls, air in sides:
        inflow, first = (t[:, 4 * i + column] + besides for t in (table, began))
        entered = np.sum(0.5 * dt * ((inflow - swept)[1:] + (first - swept)[:-1]))
        soft = np.array([
            chamber_compliance(each, pump.bulk_modulus, walls, air, p)
            for each, p in zip(volume, pressure, strict=True)
        ])  # fmt: skip
        compressed = np.sum(0.5 * (soft[1:] + soft[:-1]) * np.diff(pressure))
        through = np.sum(np.abs(inflow) + np.abs(swept)) * dt
        yield abs(entered - compressed) / max(through, 1e-12)


def _compute_energy_balance_error(plant, qpos, qvel, work, dt):
    """Compute the relative error of the energy balance of a run [1].

    It is |work of the drives - damping losses - change of mechanical energy| divided by the work.

    The divisor is the sum of the magnitudes of the increments of `work` (n,), the work since the
    first row [J]. The result is None if a contact or joint limit was active in a checked row, if a
    drive is not hydraulic, or if the divisor is at most 1 J.
    """
    if plant.hydraulic < len(plant.axes):
        return None
    model = plant.model
    data = mujoco.MjData(model)
    last = len(qpos) - 1
    energy, rows = np.empty(2), 3 * count_pins(model)
    for row in (*range(0, last, _CONTACT_CHECK_INTERVAL), last):
        data.qpos[:], data.qvel[:] = qpos[row], qvel[row]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        if data.ncon or data.nefc > rows:
            return None
        if row in (0, last):
            mujoco.mj_energyPos(model, data)
            mujoco.mj_energyVel(model, data)
            energy[min(row, 1)] = data.energy.sum()
    lost = np.sum(model.dof_damping * np.sum(qvel[1:] ** 2, axis=0)) * dt
    drives, loads = drive_and_load_dofs(plant.machine, model)
    slip = qvel[1:, drives] - qvel[1:, loads]
    lost += np.sum(model.tendon_damping * np.sum(slip**2, axis=0)) * dt
    done = np.sum(np.abs(np.diff(work)))
    return float(abs(work[-1] - lost - (energy[1] - energy[0])) / done) if done > 1.0 else None
