"""What the terms of a machine add in given states, for logs, balances and the state of rest."""

import mujoco
import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.hydraulics.circuit import (
    ACTIVATIONS,
    SCRATCH,
    circuit_supply,
    delivered_share,
    drive_state,
    open_ports,
)
from hydrotele.hydraulics.parameters import actuator_order, actuator_parameters, extra_state_names
from hydrotele.machine.machine import Machine
from hydrotele.terms.law import Drives
from hydrotele.terms.table import COMMAND, FLOW_HEAD, FLOW_ROD, FORCE, added, terms_table


def added_by_terms(
    machine: Machine, time: np.ndarray, act: np.ndarray, x: np.ndarray, v: np.ndarray,
    command: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Forces and flows that terms add in n states of a machine with nu drives.

    Args:
        machine: the machine.
        time: (n,) [s].
        act: (n, >= 4 count) activations.
        x: (n, nu) drive positions [m] or [rad].
        v: (n, nu) drive velocities [m/s] or [rad/s].
        command: (n, nu) commands as they arrive [1] or [V].

    Returns:
        (n, nu, 3): force [N] or [N m], with what a force drive makes of a command's terms; flows
        into the head-side and the rod-side chamber [m^3/s].
    """
    out = np.zeros((len(time), len(machine.axes), 3))
    if machine.terms:
        order = actuator_order(machine)
        drives = [machine.axes[name].force for name in order]
        _evaluate(
            np.concatenate(list(actuator_parameters(machine).values())),
            terms_table(machine.terms, order), len(machine.hydraulic_axes),
            np.array([drive.gain if drive else 0.0 for drive in drives]),
            np.ascontiguousarray(time, float), np.ascontiguousarray(act, float),
            np.ascontiguousarray(x, float), np.ascontiguousarray(v, float),
            np.ascontiguousarray(command, float), out,
        )  # fmt: skip
    return out


@compiled
def _evaluate(user, terms, count, gain, time, act, x, v, command, out):
    """Fill `out` of `added_by_terms`."""
    scratch = np.zeros(SCRATCH)
    for row in range(len(time)):
        supply = 0.0
        if count > 0:
            open_ports(user, act[row], act[row], scratch, 0, count, 0.0, act[row])
            share = delivered_share(user, 0, act[row])
            supply = circuit_supply(user, 0, count, scratch, share)
        drives = Drives(count, act[row], x[row], v[row], command[row])
        for i in range(len(gain)):
            s = drive_state(
                user, i, count, act[row], supply, time[row], x[row, i], v[row, i], command[row, i],
                gain[i],
            )  # fmt: skip
            out[row, i, 0] = added(terms, FORCE, i, s, drives)
            if i >= count:
                out[row, i, 0] += gain[i] * added(terms, COMMAND, i, s, drives)
            out[row, i, 1] = added(terms, FLOW_HEAD, i, s, drives)
            out[row, i, 2] = added(terms, FLOW_ROD, i, s, drives)


def terms_at_rest(
    machine: Machine, data: mujoco.MjData, drive_qpos: np.ndarray, forces: np.ndarray
) -> np.ndarray:
    """Forces that terms add to drives at rest, at time 0 and without commands.

    Args:
        machine: the machine.
        data: at rest.
        drive_qpos: (nu,) places of the drives in `qpos`.
        forces: (nu,) that hold the machine [N] or [N m]; terms that depend on pressures see them
            carried on the head side.

    Returns:
        (nu,) [N] or [N m].
    """
    if not machine.terms:
        return np.zeros(len(forces))
    act = np.zeros((1, ACTIVATIONS * len(machine.hydraulic_axes) + len(extra_state_names(machine))))
    for i, axis in enumerate(machine.hydraulic_axes.values()):
        act[0, ACTIVATIONS * i + 2] = forces[i] / axis.hydraulic_drive.areas[0]
    still = np.zeros((1, len(forces)))
    x = data.qpos[drive_qpos][None, :]
    return added_by_terms(machine, np.zeros(1), act, x, still, still)[0, :, 0]
