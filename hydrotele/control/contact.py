"""Detection of contact of the tool with its environment in logs, from the pressures of the drives.

The external forces on the arm (`control.log_forces`) are y = H a + L m + J' f + noise in each block of
0.1 s. The parameter errors a of the machine are constant. The masses m of a load on the tool are constant
while the tool is free, and may change in contact. The tip force f is 0 while the tool is free.

A hidden Markov model has one state without contact, and states of contact with tip forces of
different sizes, so that the prior of the size is uniform in its logarithm. Forward-backward
recursions give the probability of contact, and a Kalman smoother gives a and m. Both are repeated until the
probabilities are constant (structured variational approximation).

Sources: Rabiner 1989, Proc. IEEE 77(2) (hidden Markov model); Ghahramani and Hinton 2000, Neural
Computation 12(4) (switching state-space model).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr, logsumexp

from hydrotele.control.log_forces import BLOCK_SECONDS, ExternalForces, compute_external_forces
from hydrotele.effects import EFFECTS
from hydrotele.effects.effect import max_drive_force
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.identify.record import build_records
from hydrotele.logs.cleaning import remove_faults
from hydrotele.logs.dataset import (
    Dataset,
    RunData,
    channel_noise,
    channels_predicted_and_logged,
    determine_sensors,
    make_piece_log,
    merge_runs,
    remove_truth,
)
from hydrotele.logs.masked_intervals import MaskedInterval
from hydrotele.logs.resampling import average_rows
from hydrotele.logs.run_files import RunFiles
from hydrotele.machine.machine import Machine

_TASKS = ("r", "theta", "z", "attitude", "head")
_MEAN_INTERVAL_S = 3.0  # [s] prior mean duration of contact, and of the time between contacts
_LOAD_CHANGE_S = 1.0  # [s] time in which a load in contact may change by its prior standard deviation
_SIZE_RATIO = 2.0  # ratio of the tip forces of neighbouring states of contact
_MAX_ITERATIONS = 40
_TOLERANCE = 1e-3  # largest change of a probability at convergence
_MIN_SINGULAR_RATIO = 1e-3  # smaller singular values of the parameter effects over the noise are omitted


@dataclass(frozen=True)
class Contact:
    """Contact of the tool during one run or piece of a run, in b blocks.

    Attributes:
        run: name of the run in the data.
        time: (b,) mean time of each block [s].
        probability: (b,) probability of contact [1].
        task: names of the m task coordinates of the force.
        force: (b, m) force of the environment on the tip [N] or [N m].
        force_std: (b, m) its standard deviation, with the uncertainty of machine and load.
        load: (b,) mass of the load on the tool [kg].
        load_std: (b,) its standard deviation [kg].
    """

    run: str
    time: np.ndarray
    probability: np.ndarray
    task: tuple[str, ...]
    force: np.ndarray
    force_std: np.ndarray
    load: np.ndarray
    load_std: np.ndarray

    @property
    def intervals(self) -> list[tuple[float, float]]:
        """Start and end [s] of the intervals in which contact is more probable than no contact."""
        touching = self.probability > 0.5
        edges = np.flatnonzero(np.diff(touching, prepend=False, append=False))
        half = 0.5 * BLOCK_SECONDS
        return [(self.time[a] - half, self.time[b - 1] + half)
                for a, b in zip(edges[::2], edges[1::2], strict=True)]  # fmt: skip


def detect_contact(
    files: Sequence[RunFiles], machine: Machine, sensors: str | None = None, masks: Sequence[MaskedInterval] = ()
) -> tuple[Contact, ...]:
    """Detect contact of the tool in the logs of a machine.

    Args:
        files: the runs.
        machine: the machine; all drives of its arm have pressure channels.
        sensors: name of the sensor set, None for that named by the logs.
        masks: intervals that are not used.

    Returns:
        One result per run, or per piece of a run that has pauses.

    Raises:
        InputError: the machine has no arm, or a position or pressure is not in the logs.
    """
    data, origin = _prepare_runs(files, machine, sensors, masks)
    records, last, _ = build_records(data)
    runs = (*data.fit, data.heldout)
    return tuple(
        _detect_in_run(compute_external_forces(data, run, record), machine, origin[run.name])
        for run, record in zip(runs, (*records, last), strict=True)
    )


def contact_masks(found: Sequence[Contact], files: Sequence[RunFiles]) -> tuple[MaskedInterval, ...]:
    """Return the masked intervals of detected contact, with times as in the log files."""
    start = {run.name: run.logs[0].origin for run in files}
    return tuple(
        MaskedInterval(one.run, begin + start[one.run], end + start[one.run])
        for one in found for begin, end in one.intervals
    )  # fmt: skip


def _prepare_runs(files, machine, sensors, masks) -> tuple[Dataset, dict[str, str]]:
    """Return a dataset of all runs without splitting it, and the run of each piece."""
    files = [remove_truth(run) for run in files]
    axes, channels = tuple(actuator_order(machine)), channels_predicted_and_logged(files, machine)
    known, _ = determine_sensors(files, machine, sensors)
    noise = np.array([channel_noise(machine, known, channel) for channel in channels])
    merged = merge_runs(files, machine, masks)
    logs = {run.name: run.logs for run in files}
    runs = []
    for name, rows in remove_faults(machine, known, axes, channels, noise, merged.pieces)[0].items():
        rows, behind, _ = average_rows(rows)
        log = make_piece_log(logs[merged.origin[name]], name, rows, axes, channels, False)
        runs.append(RunData(name, rows.start, rows.period, rows.command, rows.known & rows.valid, rows.reading, log,
                            rows.valid, behind))  # fmt: skip
    return Dataset(machine, axes, channels, noise, tuple(runs[:-1]), runs[-1], ()), merged.origin


def _detect_in_run(forces: ExternalForces, machine: Machine, run: str) -> Contact:
    """Compute the probability of contact, the tip force and the load in every block of a run."""
    load_std = next(iter(EFFECTS["payload"].parameters(machine, "tool").values())).prior_std
    observed, places = _observation_matrix(forces, load_std)
    unit = _unit_force_covariance(forces, machine)
    sizes = _force_sizes(forces, unit, machine)
    b, n = forces.force.shape
    k, size = observed.shape[2], forces.load_effect.shape[2]
    contact = np.zeros(b)
    states = forces.covariance[:, None] + sizes[None, :, None, None] ** 2 * unit[:, None]
    weights = np.zeros((b, len(sizes)))
    weights[:, 0] = 1.0
    inverse = np.linalg.inv(states)
    information = np.where(sizes > 0.0, BLOCK_SECONDS / _MEAN_INTERVAL_S, 1.0)
    prior = np.ones(k)
    mean = spread = None
    for _ in range(_MAX_ITERATIONS):
        precision = np.einsum("bs,bsij->bij", weights * information, inverse)
        walk = np.zeros((b, k))
        walk[:, places] = contact[:, None] * BLOCK_SECONDS / _LOAD_CHANGE_S
        mean, spread = _smooth_states(forces.force, observed, precision, prior, walk)
        error = forces.force - np.einsum("bik,bk->bi", observed, mean)
        doubt = np.einsum("bik,bkl,bjl->bij", observed, spread, observed)
        likelihood = _log_normal(error, states + doubt[:, None])
        load, load_error = _load_mass(mean, spread, places, load_std)
        likelihood[:, 0] += np.minimum(0.0, math.log(2.0) + log_ndtr(load / load_error)) * information[1]
        weights = _state_probabilities(likelihood)
        last, contact = contact, 1.0 - weights[:, 0]
        if np.abs(contact - last).max() < _TOLERANCE:
            break
    assert mean is not None and spread is not None
    error = forces.force - np.einsum("bik,bk->bi", observed, mean)
    doubt = np.einsum("bik,bkl,bjl->bij", observed, spread, observed)
    force, force_std = _tip_force(forces, error, forces.covariance + doubt, sizes[-1])
    load, load_error = _load_mass(mean, spread, places, load_std)
    task = _TASKS[: forces.jacobian.shape[1]]
    return Contact(run, forces.time, contact, task, force, force_std, load, load_error)


def _observation_matrix(forces: ExternalForces, load_std: float) -> tuple[np.ndarray, slice]:
    """Return the matrix (b, n, k) of parameter errors and load, with unit prior variances, and the load's columns.

    Combinations of parameters whose effect is far below the noise are omitted.
    """
    b, n, p = forces.parameter_effect.shape
    size = np.sqrt(np.einsum("bii->bi", forces.covariance))
    scaled = (forces.parameter_effect / size[:, :, None]).reshape(b * n, p)
    _, values, directions = np.linalg.svd(scaled, full_matrices=False)
    kept = directions[values > max(_MIN_SINGULAR_RATIO * values[0], 1.0 / math.sqrt(n))]
    reduced = forces.parameter_effect @ kept.T
    places = slice(len(kept), len(kept) + forces.load_effect.shape[2])
    return np.concatenate([reduced, load_std * forces.load_effect], axis=2), places


def _load_mass(mean, spread, places: slice, load_std: float) -> tuple[np.ndarray, np.ndarray]:
    """Return mass of the load (b,) [kg] and its standard deviation."""
    total = mean[:, places].sum(axis=1)
    variance = spread[:, places, places].sum(axis=(1, 2))
    return load_std * total, load_std * np.sqrt(np.maximum(variance, 1e-12))


def _unit_force_covariance(forces: ExternalForces, machine: Machine) -> np.ndarray:
    """Return the covariance (b, n, n) of external forces for a tip force of 1 N in every direction.

    The force acts somewhere on the tool: its moment about the tip has the arm of half the tool's length.
    """
    assert machine.arm
    arm = 0.5 * float(np.linalg.norm(machine.arm.tip.position))
    scale = np.ones((len(forces.time), forces.jacobian.shape[1]))
    scale[:, 1] = forces.radius
    scale[:, 3:] = arm
    moved = scale[:, :, None] * forces.jacobian
    return np.einsum("bmi,bmj->bij", moved, moved)


def _force_sizes(forces: ExternalForces, unit: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the tip force of each state [N]: 0, then from the noise up to what the drives can exert."""
    share = np.einsum("bij,bji->b", np.linalg.inv(forces.covariance), unit) / unit.shape[1]
    least = float(np.median(1.0 / np.sqrt(share)))
    valves = actuator_order(machine)[: len(machine.hydraulic_axes)]
    most = max(max_drive_force(machine, axis) for axis in valves if machine.axes[axis].cylinder)
    count = max(1, math.ceil(math.log(most / least, _SIZE_RATIO)))
    return np.concatenate([[0.0], least * _SIZE_RATIO ** np.arange(count + 1)])


def _log_normal(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the log density (b, s) of errors (b, n) under s covariances (b, s, n, n), up to a constant."""
    _, size = np.linalg.slogdet(covariance)
    solved = np.linalg.solve(covariance, np.broadcast_to(error[:, None, :, None], (*covariance.shape[:3], 1)))
    return -0.5 * (size + np.einsum("bi,bsi->bs", error, solved[..., 0]))


def _state_probabilities(likelihood: np.ndarray) -> np.ndarray:
    """Return the probabilities (b, s) of the states by forward-backward recursions.

    State 0 has no contact. Within contact, every size of the force is equally probable in every block.
    """
    b, s = likelihood.shape
    stay = math.exp(-BLOCK_SECONDS / _MEAN_INTERVAL_S)
    pair = np.stack([likelihood[:, 0], logsumexp(likelihood[:, 1:], axis=1) - math.log(s - 1)], axis=1)
    step = np.log(np.array([[stay, 1.0 - stay], [1.0 - stay, stay]]))
    forward, backward = np.zeros((b, 2)), np.zeros((b, 2))
    forward[0] = pair[0] - math.log(2.0)
    for t in range(1, b):
        forward[t] = pair[t] + logsumexp(forward[t - 1][:, None] + step, axis=0)
    for t in range(b - 2, -1, -1):
        backward[t] = logsumexp(step + (pair[t + 1] + backward[t + 1])[None], axis=1)
    both = forward + backward
    both = np.exp(both - logsumexp(both, axis=1)[:, None])
    inside = np.exp(likelihood[:, 1:] - logsumexp(likelihood[:, 1:], axis=1)[:, None])
    return np.concatenate([both[:, :1], both[:, 1:] * inside], axis=1)


def _smooth_states(value, observed, precision, prior, walk) -> tuple[np.ndarray, np.ndarray]:
    """Return means (b, k) and covariances (b, k, k) of a random walk by a Kalman filter and RTS smoother.

    Args:
        value: (b, n) observations.
        observed: (b, n, k) observation matrices.
        precision: (b, n, n) inverse covariances of their errors.
        prior: (k,) prior variances at the start.
        walk: (b, k) variances of the change before each block.
    """
    b, k = walk.shape
    mean, spread = np.zeros((b, k)), np.zeros((b, k, k))
    ahead, ahead_spread = np.zeros((b, k)), np.zeros((b, k, k))
    x, p = np.zeros(k), np.diag(prior)
    for t in range(b):
        p = p + np.diag(walk[t])
        ahead[t], ahead_spread[t] = x, p
        h = observed[t]
        s = np.linalg.inv(precision[t]) + h @ p @ h.T
        gain = np.linalg.solve(s, h @ p).T
        x = x + gain @ (value[t] - h @ x)
        p = p - gain @ h @ p
        p = 0.5 * (p + p.T)
        mean[t], spread[t] = x, p
    for t in range(b - 2, -1, -1):
        back = np.linalg.solve(ahead_spread[t + 1] + 1e-12 * np.eye(k), spread[t]).T
        mean[t] = mean[t] + back @ (mean[t + 1] - ahead[t + 1])
        spread[t] = spread[t] + back @ (spread[t + 1] - ahead_spread[t + 1]) @ back.T
    return mean, spread


def _tip_force(forces: ExternalForces, error, covariance, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the tip force (b, m) that explains external forces (b, n), and its standard deviation.

    The prior of the force is normal with the largest force of the drives, so that the force along a
    direction in which the arm is nearly singular is 0 with that standard deviation.
    """
    jacobian = forces.jacobian
    scale = np.ones(jacobian.shape[:2])
    scale[:, 1] = forces.radius
    weighted = np.linalg.solve(covariance, jacobian.transpose(0, 2, 1))
    information = jacobian @ weighted + np.einsum("bm,mk->bmk", 1.0 / (most * scale) ** 2, np.eye(jacobian.shape[1]))
    spread = np.linalg.inv(information)
    mean = np.einsum("bmk,bik,bi->bm", spread, weighted, error)
    return mean, np.sqrt(np.einsum("bmm->bm", spread))
