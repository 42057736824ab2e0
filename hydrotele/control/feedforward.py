"""Computed-force feedforward: drive forces along a plan by inverse dynamics."""

import numpy as np

from hydrotele.control.plan import Plan
from hydrotele.control.servo import ForceReferences
from hydrotele.core.errors import InputError
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.identify.regressor_setup import machine_setup
from hydrotele.identify.smoothed_signal import SmoothedSignal
from hydrotele.identify.zero_phase_filter import filter_zero_phase
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine
from hydrotele.multibody.regressor import make_regressor
from hydrotele.scenario.scenario import Servo
from hydrotele.simulate.closed_loops import load_closed_chain

NOMINAL = "nominal"


_REFERENCE_CUTOFF_HZ = 8.0  # Hz, cutoff that removes steps and corners of tables from the forces


def compute_force_references(machine: Machine, plan: Plan, servo: Servo) -> ForceReferences:
    """Compute the drive forces that a plan requires, and their rates, by inverse dynamics of a machine model.

    Args:
        machine: machine of the scenario, without added effects.
        plan: joint references; all axes must be under feedback.
        servo: `force_model` is the name of the machine model whose dynamics are used, `nominal` for
            `machine`. The rates of the forces are those `lead` [s] later, which compensates the
            spool's lag.

    Returns:
        The force references, all zero if `force_model` is None.

    Raises:
        InputError: the machine does not exist or has other axes, or an axis has no reference.

    Source: Abdellatif 2008, section 5 (computed-force feedforward).
    """
    if servo.force_model is None:
        nothing = np.zeros(plan.reference.shape)
        return ForceReferences(False, nothing, nothing)
    where = "servo.force_model"
    if servo.force_model != NOMINAL:
        machine = load_machine(servo.force_model, machine.tool)
    if not np.all(plan.closed_loop):
        open_ones = ", ".join(a for a, c in zip(plan.axes, plan.closed_loop, strict=True) if not c)
        raise InputError(where, f"needs a reference for every axis; {open_ones} has none")
    axes = actuator_order(machine)
    if tuple(axes) != tuple(plan.axes):
        raise InputError(where, f"{machine.name} has the axes {', '.join(axes)}")
    joints = [machine.axes[a].joint for a in plan.axes]
    chain = load_closed_chain(machine, dict(zip(joints, plan.reference[0], strict=True)))
    setup = machine_setup(machine, chain)
    step = float(plan.time[1] - plan.time[0])
    motion = _smooth_and_differentiate_reference(plan.reference, step)
    found = setup.project_motion_on_drives(plan.reference, motion.rate, motion.acceleration)
    table = make_regressor(
        chain,
        found,
        bodies=setup.bodies,
        friction=setup.friction_terms,
        offsets=setup.offsets or {},
    )
    force = table.matrix @ table.nominal
    force += np.einsum("nkv,nv->nk", found.joint_projection, chain.damping * found.rate)
    ahead = np.minimum(plan.time + servo.lead, plan.time[-1])
    change = np.gradient(force, step, axis=0)
    rate = np.stack([np.interp(ahead, plan.time, column) for column in change.T], axis=1)
    return ForceReferences(True, np.ascontiguousarray(force), np.ascontiguousarray(rate))


def _smooth_and_differentiate_reference(reference: np.ndarray, step: float) -> SmoothedSignal:
    """Return a joint reference (n, k) with its rates and accelerations, low-pass filtered at 8 Hz without delay.

    `step` is the time between rows [s]. A reference shorter than 0.6 s is not filtered; its rates
    and accelerations are then difference quotients.
    """
    if len(reference) > 5.0 / (_REFERENCE_CUTOFF_HZ * step):
        return filter_zero_phase(reference, step, _REFERENCE_CUTOFF_HZ)
    rate = np.gradient(reference, step, axis=0)
    unknown = np.full_like(reference, np.nan)
    acceleration = np.gradient(rate, step, axis=0)
    return SmoothedSignal(reference, rate, acceleration, unknown, unknown, unknown)
