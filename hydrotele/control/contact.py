"""Detection of contact of the tool with its environment in logs, from the pressures of the drives.

The external forces on the arm (`control.log_forces`) are y = H a + L m + R e + J' f + noise in each block
of 0.1 s. The parameter errors a of the machine are constant. The masses m of a load on the tool are constant
while the tool is free. The tip force f is 0 without contact. An unmodelled force e of one drive, such as the
friction of a scored bore, is a difference between machine and model and not contact.

The tool has four states: free, free while the load changes, free with an unmodelled force of one drive, and contact,
in which the load may change as well. The prior of the size of a force is uniform in its logarithm. The filter and
smoother of Kim give the probabilities of the states, and a Kalman smoother then gives a and m. A force
that acts on several drives is contact, because no single drive explains it. One that acts on a single drive is
more probable as an unmodelled force, which has fewer free components.

Source: Kim 1994, Journal of Econometrics 60 (switching state-space model).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, log_ndtr

from hydrotele.control.log_forces import BLOCK_SECONDS, FILTER_SECONDS, ExternalForces, compute_external_forces
from hydrotele.control.tip_balance import arm_joints
from hydrotele.core.errors import InputError
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
from hydrotele.logs.masked_intervals import MaskedInterval, find_unmasked_rows
from hydrotele.logs.resampling import average_rows
from hydrotele.logs.run_files import RunFiles
from hydrotele.machine.machine import Machine

_FREE, _LOAD_CHANGES, _CONTACT, _DRIVE_FORCE = range(4)  # states of the tool; the last is followed by other drives
_TASKS = ("r", "theta", "z", "attitude", "head")
_MEAN_INTERVAL_S = 3.0  # [s] prior mean duration of contact, and of the time between contacts
_LOAD_CHANGE_S = 1.0  # [s] time in which a load in contact may change by its prior standard deviation
_SIZE_RATIO = 2.0  # ratio of neighbouring sizes of a force in its prior
_MIN_SINGULAR_RATIO = 1e-3  # smaller singular values of the parameter effects over the noise are omitted


@dataclass(frozen=True)
class Contact:
    """Contact of the tool during one run or piece of a run, in b blocks.

    Attributes:
        run: name of the run in the data.
        time: (b,) mean time of each block [s].
        probability: (b,) probability of contact [1].
        load_probability: (b,) probability that the load is larger than the smallest load of the run, or changes
            without contact, as when a bucket is emptied [1].
        task: names of the m task coordinates of the force.
        force: (b, m) force of the environment on the tip [N] or [N m].
        force_std: (b, m) its standard deviation, with the uncertainty of machine and load.
        load: (b,) mass of the load on the tool, less the smallest mean of the run over 3 s [kg]. A constant
            load cannot be distinguished from errors of the machine's masses.
        load_std: (b,) its standard deviation [kg].
    """

    run: str
    time: np.ndarray
    probability: np.ndarray
    load_probability: np.ndarray
    task: tuple[str, ...]
    force: np.ndarray
    force_std: np.ndarray
    load: np.ndarray
    load_std: np.ndarray

    @property
    def is_contact(self) -> np.ndarray:
        """Whether contact is more probable than no contact (b,)."""
        return self.probability > 0.5

    @property
    def is_loaded(self) -> np.ndarray:
        """Whether the tool is free, and a load is more probable than none (b,)."""
        return ~self.is_contact & (self.load_probability > 0.5)

    def find_intervals(self, marked: np.ndarray) -> list[tuple[float, float]]:
        """Return start and end [s] of the intervals of marked blocks (b,).

        The first and the last block extend over the first and last rows of the run, which have no block.
        """
        edges = np.flatnonzero(np.diff(marked, prepend=False, append=False))
        begin, end = self.time - 0.5 * BLOCK_SECONDS, self.time + 0.5 * BLOCK_SECONDS
        begin[0], end[-1] = begin[0] - 0.5 * FILTER_SECONDS, end[-1] + 0.5 * FILTER_SECONDS
        return [(float(begin[a]), float(end[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


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
    _check_pressures(files, machine)
    data, origin = _prepare_runs(files, machine, sensors, masks)
    records, last, _ = build_records(data)
    runs = (*data.fit, data.heldout)
    return tuple(
        _detect_in_run(compute_external_forces(data, run, record), machine, origin[run.name])
        for run, record in zip(runs, (*records, last), strict=True)
    )


def contact_masks(found: Sequence[Contact], files: Sequence[RunFiles]) -> tuple[MaskedInterval, ...]:
    """Return the masked intervals of contact and of loads, with times as in the log files."""
    start = {run.name: run.logs[0].origin for run in files}
    return tuple(
        MaskedInterval(one.run, begin + start[one.run], end + start[one.run])
        for one in found for begin, end in one.find_intervals(one.is_contact | one.is_loaded)
    )  # fmt: skip


def find_contact_rows(found: Contact, time: np.ndarray) -> np.ndarray:
    """Return for each time (n,) [s] of a run whether the tool is in contact."""
    return ~find_unmasked_rows([MaskedInterval("", *pair) for pair in found.find_intervals(found.is_contact)], "", time)


def _check_pressures(files: Sequence[RunFiles], machine: Machine) -> None:
    """Check that the machine has an arm, and that the logs of all runs contain the pressures of all valves.

    Raises:
        InputError: the machine has no arm, or a pressure is missing.
    """
    where = f"contact of {machine.name}"
    arm_joints(machine)
    for run in files:
        missing = [channel for axis in machine.hydraulic_axes for side in ("head", "rod")
                   if not any((channel := f"pressure_{side}.{axis}") in log for log in run.logs)]  # fmt: skip
        if missing:
            message = f"run {run.name} has no {', '.join(missing)}: log both pressures of every drive"
            raise InputError(where, message)


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
    observed, load = _observation_matrix(forces, load_std)
    unit = _unit_force_covariance(forces, machine)
    valves = actuator_order(machine)[: len(machine.hydraulic_axes)]
    largest = [max_drive_force(machine, axis) for axis in valves]
    cylinders = [force for axis, force in zip(valves, largest, strict=True) if machine.axes[axis].cylinder]
    sizes = _force_sizes(forces, unit, max(cylinders, default=0.0))
    contact = sizes[:, None, None, None] ** 2 * unit
    drives = [np.einsum("bi,bj->bij", arm, arm) for arm in np.moveaxis(forces.moment_arm, 1, 0)]
    jumps = [contact, *(_force_sizes(forces, one, most)[:, None, None, None] ** 2 * one
                        for one, most in zip(drives, largest, strict=True))]  # fmt: skip
    states = _state_probabilities(forces, observed, load, jumps, load_std)
    task, probability = _TASKS[: forces.jacobian.shape[1]], states[:, _CONTACT]
    mean, spread, error, doubt = _smooth_states(forces, observed, load, unit * sizes[-1] ** 2, states)
    force, force_std = _tip_force(forces, error, forces.covariance + doubt, sizes[-1])
    mass, mass_std = (load_std * v for v in _load_mass(mean, spread, slice(-forces.load_effect.shape[2], None)))
    count = min(round(_MEAN_INTERVAL_S / BLOCK_SECONDS), len(mass))
    means = np.convolve(mass, np.full(count, 1.0 / count), "valid")
    least = int(np.argmin(means))
    mass, mass_std = mass - means[least], np.hypot(mass_std, mass_std[least + count // 2])
    loaded = np.maximum(states[:, _LOAD_CHANGES], _load_probability(mass, mass_std, load_std))
    return Contact(run, forces.time, probability, loaded, task, force, force_std, mass, mass_std)


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


def _load_mass(mean: np.ndarray, spread: np.ndarray, load: slice) -> tuple[np.ndarray, np.ndarray]:
    """Return mass and standard deviation (...,) of the load, relative to the prior standard deviation of its mass."""
    variance = spread[..., load, load].sum(axis=(-2, -1))
    return mean[..., load].sum(axis=-1), np.sqrt(np.maximum(variance, 1e-12))


def _load_probability(mass: np.ndarray, mass_std: np.ndarray, load_std: float) -> np.ndarray:
    """Return the probability (b,) of a load, given the estimate (b,) of its mass and its standard deviation [kg].

    A load and no load are equally probable before. A load has a half-normal prior of standard deviation `load_std`.
    """
    total = np.hypot(mass_std, load_std)
    positive = log_ndtr(mass * load_std / (mass_std * total)) - log_ndtr(0.0)
    ratio = np.log(mass_std / total) + 0.5 * (mass / mass_std) ** 2 * (load_std / total) ** 2 + positive
    return expit(ratio)


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


def _force_sizes(forces: ExternalForces, unit: np.ndarray, largest: float) -> np.ndarray:
    """Return the sizes of a force in its prior, from its noise up to the largest one [N] or [N m].

    `unit` (b, n, n) is the covariance of external forces for a force of size 1.
    """
    directions = np.linalg.matrix_rank(unit[0])
    share = np.einsum("bij,bji->b", np.linalg.inv(forces.covariance), unit) / directions
    least = float(np.median(1.0 / np.sqrt(share)))
    count = max(1, math.ceil(math.log(max(largest / least, 1.0), _SIZE_RATIO)))
    return least * _SIZE_RATIO ** np.arange(count + 1)


def _state_probabilities(
    forces: ExternalForces, observed, load: slice, jumps: Sequence[np.ndarray], load_std: float
) -> np.ndarray:
    """Return the probabilities (b, 3 + h) of the states of the tool by the filter and smoother of Kim.

    The continuous state holds parameter errors and load, of unit prior variance, and the external forces
    of a contact or of one drive. In the other states these forces are 0. They change from block to block by a
    mixture of normal distributions. In contact the load may change as well.

    Args:
        forces: external forces.
        observed: (b, n, k) effect of parameter errors and load.
        load: columns of the load.
        jumps: covariances (l, b, n, n) of the change of external forces, the l components of the mixture; first of
            the contact, then of each drive.
        load_std: prior standard deviation of the load [kg].
    """
    b, n, k = observed.shape
    matrix = np.concatenate([observed, np.broadcast_to(np.eye(n), (b, n, n))], axis=2)
    force = slice(k, k + n)
    modes = np.repeat(range(2 + len(jumps)), [1, 1, *map(len, jumps)])
    jump, states = np.concatenate(jumps), 2 + len(jumps)
    entry = np.array([1.0, 1.0, 1.0, *[1.0 / (states - _DRIVE_FORCE)] * (states - _DRIVE_FORCE)])
    stay = math.exp(-BLOCK_SECONDS / _MEAN_INTERVAL_S)
    step = np.tile(entry, (states, 1)) * (1.0 - np.eye(states))
    step = (1.0 - stay) * step / step.sum(axis=1, keepdims=True) + stay * np.eye(states)
    share = step[:, modes] / np.bincount(modes)[modes]  # of component c after each state
    walk = np.zeros((len(modes), k + n, k + n))
    changes = (modes == _LOAD_CHANGES) | (modes == _CONTACT)
    walk[changes, load, load] = np.eye(load.stop - load.start) * BLOCK_SECONDS / _LOAD_CHANGE_S
    kept = np.ones((states, len(modes), k + n))
    kept[np.arange(states)[:, None] != modes, force] = 0.0  # a state begins without force
    mean, spread = np.zeros((states, k + n)), np.zeros((states, k + n, k + n))
    spread[:, :k, :k] = np.eye(k)
    spread[_CONTACT, force, force] = jumps[0][:, 0].mean(axis=0)
    filtered, predicted, now = np.zeros((b, states)), np.zeros((b, states)), entry / entry.sum()
    for t in range(b):
        predicted[t] = now @ step
        walk[modes >= _CONTACT, force, force] = jump[:, t]
        x = mean[:, None] * kept
        p = spread[:, None] * kept[..., :, None] * kept[..., None, :] + walk
        x, p, fit = _update(
            x.reshape(-1, k + n), p.reshape(-1, k + n, k + n), forces.force[t], matrix[t], forces.covariance[t],
            load, load_std * forces.load_inertia[t],
        )  # fmt: skip
        weight = np.log(np.maximum(now[:, None] * share, 1e-300)).ravel() + fit
        weight = np.exp(weight - weight.max())
        for j in range(states):
            some = np.tile(modes == j, states)
            now[j] = max(weight[some].sum(), 1e-300)
            mean[j], spread[j] = _collapse(x[some], p[some], np.maximum(weight[some], 1e-300))
        now = filtered[t] = now / now.sum()
    out = filtered.copy()
    for t in range(b - 2, -1, -1):
        out[t] = filtered[t] * (step @ (out[t + 1] / predicted[t + 1]))
        out[t] /= out[t].sum()
    return out


def _update(x, p, value, matrix, noise, load: slice, inertia) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Update c Gaussian states by one observation; also return the log likelihood (c,) of the observation.

    The mass of the load is not negative: the likelihood is multiplied by the probability of a positive
    mass after the observation over that before it. A load may move on the tool, so that its force of
    inertia has its own size as standard deviation.
    """
    mass, mass_std = _load_mass(x, p, load)
    before, moved = log_ndtr(mass / mass_std), np.maximum(mass, 0.0)[:, None] * inertia
    cross = p @ matrix.T
    total = matrix @ cross + noise + moved[:, :, None] * moved[:, None]
    error = value - x @ matrix.T
    solved = np.linalg.solve(total, np.concatenate([cross.transpose(0, 2, 1), error[:, :, None]], axis=2))
    gain, weighted = solved[:, :, :-1], solved[:, :, -1]
    x = x + np.einsum("cnk,cn->ck", gain, error)
    p = p - cross @ gain
    p = 0.5 * (p + p.transpose(0, 2, 1))
    fit = -0.5 * (np.linalg.slogdet(total)[1] + np.einsum("cn,cn->c", error, weighted))
    return x, p, fit + log_ndtr(np.divide(*_load_mass(x, p, load))) - before


def _collapse(x: np.ndarray, p: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of a mixture of c Gaussian distributions."""
    weight = weight / weight.sum()
    mean = weight @ x
    apart = x - mean
    return mean, np.einsum("c,cij->ij", weight, p) + np.einsum("c,ci,cj->ij", weight, apart, apart)


def _smooth_states(forces: ExternalForces, observed, load: slice, wide: np.ndarray, states: np.ndarray):
    """Estimate parameter errors and load by a Kalman filter and RTS smoother, given the states of the tool.

    The load is the sum of that at the start of the run and its change since then.

    Args:
        forces: external forces.
        observed: (b, n, k) effect of parameter errors and load.
        load: columns of the load.
        wide: (b, n, n) covariance of an unknown force, of a contact or of a drive.
        states: (b, 3 + h) probabilities of the states.

    Returns:
        Means (b, k + l) and covariances (b, k + l, k + l) of parameter errors, load at the start and change of
        the load; external forces (b, n) without their effect, and the covariance (b, n, n) of this effect.
    """
    start = observed.shape[2]
    observed = np.concatenate([observed, observed[:, :, load]], axis=2)
    load = slice(start, observed.shape[2])
    b, _, k = observed.shape
    walk = np.zeros((b, k))
    changes = states[:, _LOAD_CHANGES] + states[:, _CONTACT]
    walk[:, load] = changes[:, None] * BLOCK_SECONDS / _LOAD_CHANGE_S
    other = states[:, _CONTACT:].sum(axis=1) > 0.5  # blocks with an unknown force are not used
    noise = forces.covariance + other[:, None, None] * wide
    mean, spread = np.zeros((b, k)), np.zeros((b, k, k))
    ahead, ahead_spread = np.zeros((b, k)), np.zeros((b, k, k))
    x, p = np.zeros(k), np.diag(1.0 * (np.arange(k) < start))
    for t in range(b):
        p = p + np.diag(walk[t])
        ahead[t], ahead_spread[t] = x, p
        h = observed[t]
        gain = np.linalg.solve(h @ p @ h.T + noise[t], h @ p).T
        x = x + gain @ (forces.force[t] - h @ x)
        p = p - gain @ h @ p
        p = 0.5 * (p + p.T)
        mean[t], spread[t] = x, p
    for t in range(b - 2, -1, -1):
        back = np.linalg.solve(ahead_spread[t + 1] + 1e-12 * np.eye(k), spread[t]).T
        mean[t] = mean[t] + back @ (mean[t + 1] - ahead[t + 1])
        spread[t] = spread[t] + back @ (spread[t + 1] - ahead_spread[t + 1]) @ back.T
    error = forces.force - np.einsum("bik,bk->bi", observed, mean)
    return mean, spread, error, np.einsum("bik,bkl,bjl->bij", observed, spread, observed)


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
