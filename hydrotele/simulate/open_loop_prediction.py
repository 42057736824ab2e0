"""Open-loop prediction error of a MuJoCo model that is driven by measured forces.

The simulation starts from measured states at several instants and is compared with the measured
motion after a fixed time.
"""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.inverse_dynamics import project_on_drives

_ERROR_LOCATION = "open loop"


def set_state_from_chain(
    model: mujoco.MjModel, data: mujoco.MjData, chain: Chain, position: np.ndarray, rate: np.ndarray
) -> None:
    """Set the joint positions and velocities of a MuJoCo model from those of its chain.

    Args:
        model: compiled model.
        data: its data; reset and written.
        chain: kinematic chain of the same mechanism.
        position: (v,) positions of all joints of the chain [rad] or [m].
        rate: (v,) their velocities [rad/s] or [m/s]; ball joints have Cardan angles and their rates.

    Source: MuJoCo manual, `mjtJoint`: a free joint's linear velocity is the world's, angular
    velocities are the body's.
    """
    mujoco.mj_resetData(model, data)
    where = {name: k for k, name in enumerate(chain.joints)}
    for j in range(model.njnt):
        name = model.joint(j).name or f"joint{j}"
        at, dof = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        if name in where:
            data.qpos[at], data.qvel[dof] = position[where[name]], rate[where[name]]
            continue
        if f"{name}_rx" not in where:  # an object that is not part of the mechanism
            continue
        if f"{name}_x" in where:
            places = [where[f"{name}_{letter}"] for letter in "xyz"]
            data.qpos[at : at + 3], data.qvel[dof : dof + 3] = position[places], rate[places]
            at, dof = at + 3, dof + 3
        turns = [where[f"{name}_r{letter}"] for letter in "xyz"]
        mujoco.mju_euler2Quat(data.qpos[at : at + 4], position[turns], "xyz")
        data.qvel[dof : dof + 3] = _cardan_rate_matrix(position[turns]) @ rate[turns]


def _cardan_rate_matrix(angles: np.ndarray) -> np.ndarray:
    """Return the (3, 3) matrix from rates of x-y-z Cardan angles to the angular velocity in body axes."""
    _, b, c = angles
    sb, cb, sc, cc = np.sin(b), np.cos(b), np.sin(c), np.cos(c)
    return np.array([[cb * cc, sc, 0.0], [-cb * sc, cc, 0.0], [sb, 0.0, 1.0]])


def open_loop_errors(
    model: mujoco.MjModel, chain: Chain, known_joints: Sequence[str], motion: np.ndarray,
    force: np.ndarray, period: float, horizon: float = 0.25, starts: int = 30,
) -> Mapping[str, float]:  # fmt: skip
    """Compute the position errors of open-loop simulations of a mechanism driven by measured forces.

    Each simulation starts from the measured state at another instant and lasts for `horizon`.

    The model's actuators are disabled; the measured forces act on the joints of the drives.

    Args:
        model: compiled model.
        chain: kinematic chain of the same mechanism.
        known_joints: names of the k joints with known motion.
        motion: (3, n, k) positions, rates and accelerations of these joints.
        force: (n, k) measured forces of the drives [N] or [N m]; no interval begins where NaN follow.
        period: time between rows [s].
        horizon: simulated time after which the positions are compared [s].
        starts: maximum number of start instants, equally spaced over the motion.

    Returns:
        Drive -> RMS position error after the horizon [rad] or [m].

    Raises:
        InputError: the motion is shorter than the horizon, forces are missing everywhere, or the simulation fails.
    """
    steps = round(horizon / model.opt.timestep)
    rows = round(horizon / period)
    if motion.shape[1] <= rows:
        raise InputError(_ERROR_LOCATION, f"the run is shorter than {horizon:g} s")
    missing = np.append(0, np.cumsum(~np.isfinite(force).all(axis=1)))
    possible = np.flatnonzero(missing[rows + 1 :] == missing[: -rows - 1])
    if not len(possible):
        raise InputError(_ERROR_LOCATION, f"forces are missing in every interval of {horizon:g} s")
    firsts = possible[np.unique(np.linspace(0, len(possible) - 1, starts).astype(int))]
    found = project_on_drives(chain, tuple(known_joints), *motion)
    data, drives = mujoco.MjData(model), [chain.index(name) for name in chain.drives]
    dofs = [int(chain.dof_indices[j]) for j in drives]
    places = [int(chain.qpos_indices[j]) for j in drives]
    times = np.arange(motion.shape[1]) * period
    total, flags = np.zeros(len(drives)), model.opt.disableflags
    model.opt.disableflags = flags | int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    try:
        for first in firsts:
            set_state_from_chain(model, data, chain, found.position[first], found.rate[first])
            at = times[first] + (np.arange(steps) + 0.5) * model.opt.timestep
            driving = np.column_stack([np.interp(at, times, column) for column in force.T])
            for row in driving:
                data.qfrc_applied[dofs] = row
                mujoco.mj_step(model, data)
            if not np.isfinite(data.qpos).all() or data.warning.number.any():
                raise InputError(_ERROR_LOCATION, "the simulation of the mechanism became unstable")
            total += (data.qpos[places] - found.position[first + rows, drives]) ** 2
    finally:
        model.opt.disableflags = flags
    return dict(zip(chain.drives, np.sqrt(total / len(firsts)).tolist(), strict=True))
