"""What each possible difference of a mechanism does to the forces of its drives, column by column.

Inverse dynamics of the measured motion tells the drives' forces; what is measured beyond them is
the gap. Parameters of bodies and friction enter linearly; defects of sensors, a tilt of the base
and springs have columns by small differences about what is known of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import fftconvolve

from hydrotele.core.errors import InputError
from hydrotele.estimate.levels import STATED_WIDTH
from hydrotele.identify.equations import (
    RateErrors,
    apply_low_pass,
    build_equations,
    design_low_pass,
    low_pass_forces,
    predict_forces,
)
from hydrotele.identify.joint_motion import Processing, compute_joint_motion, estimate_resolution
from hydrotele.identify.mechanism import Mechanism, convert_to_given_joints
from hydrotele.identify.record import (
    IdentificationRecord,
    correct_sensor_error,
    trim_missing_positions,
)
from hydrotele.identify.regressor_setup import RegressorSetup
from hydrotele.machine.sensors import SensorError
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.regressor import BODY_PARAMETERS

STRIBECK = (0.03, 0.1, 0.3)  # of a joint's RMS rate: Stribeck velocities that are tried
_DRY = ("coulomb", "stribeck")  # terms of dry friction
_ROWS = 5.0  # rows per period of the band that columns of small differences need
_SMOOTH = 1.5  # times the band, to which rates of late positions are smoothed before
_READINGS = 20.0  # rows per period of the band that all else needs; more are averaged
_LATE, _AWAY, _TILT = 0.01, 1e-3, 0.01  # s, of a joint's travel, rad: the small differences; a
# step of dry friction must move by about a row
_RESOLVED = 5e-3  # s, over which positions are averaged before it is asked what they resolve
_WIDEST = 25.0  # Hz: what is faster tells of drives and sensors, not of a mechanism
_SLOWEST = 8.0  # rows of one run that a band leaves at least
TYPICAL, LEAST = 0.3, 0.01  # share of a drive's force RMS that an effect moves, typically; at least
_WHERE = "gap"
Key = tuple[str, str]


@dataclass(frozen=True)
class Columns:
    """Equations of some runs, one below the other: n of them, k drives, m columns.

    Attributes:
        names: of the m columns, such as `mass.link`, `delay.force.slide_1`.
        matrix: (n, k, m) what a unit of each adds to the measured forces.
        measured: (n, k) low-passed forces, less defects of sensors that are known [N] or [N m].
        modelled: (n, k) of the given model.
        time: (n,) from each run's start [s].
        starts: at which row each run starts, and the number of rows.
        doubt: (n, k) how uncertain the sign of the drives' dry friction is, 0 .. 1.
        states: name -> (n,) positions and rates of the measured joints, low-passed.
        sizes: joint -> (mean, travel, RMS rate) of its motion [rad] or [m], and per s.
        band: of the low-pass [Hz].
        spacing: between rows [s].
        row: between the readings that they are made of [s].
        runs: names.
        drives: names of the k drives.
        units: of their forces.
        max_noise: (k,) largest plausible noise of the low-passed forces [N] or [N m].
    """

    names: tuple[str, ...]
    matrix: np.ndarray
    measured: np.ndarray
    modelled: np.ndarray
    time: np.ndarray
    starts: tuple[int, ...]
    doubt: np.ndarray
    states: Mapping[str, np.ndarray]
    sizes: Mapping[str, tuple[float, float, float]]
    band: float
    spacing: float
    row: float
    runs: tuple[str, ...]
    drives: tuple[str, ...]
    units: tuple[str, ...] = ()
    max_noise: np.ndarray | float = np.inf

    @property
    def gap(self) -> np.ndarray:
        """(n, k) measured less modelled."""
        return self.measured - self.modelled

    def moved(self, value: Mapping[str, float]) -> "Columns":
        """Columns whose model has some coefficients, column -> value, added."""
        at = [self.names.index(name) for name in value]
        added = self.matrix[:, :, at] @ np.array(list(value.values())) if value else 0.0
        return replace(self, modelled=self.modelled + added)


Errors = Mapping[str, SensorError]


def separate_setup(setup: RegressorSetup) -> RegressorSetup:
    """A setup in which every body and joint stands for itself, with all friction terms.

    Args:
        setup: of a mechanism, which may state what is alike or absent.

    Returns:
        The setup with a column for everything that may differ.
    """
    extra = {"viscous_asymmetry": 0.0, "quadratic": 0.0}
    drives = setup.chain.drives
    rubbing = tuple(
        replace(one, nominal={**(extra if one.location in drives else {}), **one.nominal})
        for one in setup.friction_terms
    )
    inertia = dict.fromkeys((*setup.drive_inertia, *drives))
    return replace(
        setup, equal_groups=(), zero_parameters=(), offsets={}, friction_terms=rubbing, drive_inertia=tuple(inertia)
    )


def corrected(record: IdentificationRecord, drives: Sequence[str], errors: Errors):
    """A record as measured, freed of sensor defects.

    Args:
        record: in the measured joints.
        drives: whose forces it has.
        errors: `position.JOINT` or `force.DRIVE` -> defect.

    Returns:
        The record, cut where a late sensor tells nothing.
    """
    position, force = record.position.copy(), record.force.copy()
    for k, joint in enumerate(record.axes):
        if known := errors.get(f"position.{joint}"):
            position[:, k] = correct_sensor_error(position[:, k], known, record.period)
    for k, drive in enumerate(drives):
        if known := errors.get(f"force.{drive}"):
            force[:, k] = correct_sensor_error(force[:, k], known, record.period)
    return trim_missing_positions(replace(record, position=position, force=force))


def common_band(records: Sequence[IdentificationRecord], mechanism: Mechanism) -> float:
    """Band [Hz] in which the forces of all runs are compared.

    Half of what the positions resolve; beyond it accelerations are noise.

    Args:
        records: in the measured joints.
        mechanism: that they are of.

    Returns:
        The band, at most 25 Hz and 0.2 of the sample rate.

    Raises:
        InputError: nothing moves in any run.
    """
    bands, moves = [], []
    for whole in records:
        many = max(1, int(_RESOLVED / whole.period))
        record = convert_to_given_joints(_averaged(whole, many), mechanism.setup)
        found = estimate_resolution(record.position, record.period, record.position_noise)
        bands.append(min(0.5 * found.bandwidth, _WIDEST, 0.2 / record.period))
        bands[-1] = max(bands[-1], _SLOWEST / (len(record.force) * record.period))
        moves.append(found.is_moving)
    if not np.any(moves):
        raise InputError(_WHERE, "no joint moves in any run: record a motion")
    return min(bands)


def build_columns(
    records: Sequence[IdentificationRecord], mechanism: Mechanism, band: float,
    errors: Errors | None = None, about: Mapping[str, float] | None = None,
) -> Columns:  # fmt: skip
    """Columns of some runs.

    Args:
        records: in the measured joints.
        mechanism: the given model.
        band: in which forces are compared [Hz].
        errors: of sensors, known so far; they are taken off the readings.
        about: parameter -> how much it differs from the given one, as far as is known: defects of
            sensors have columns about that model's forces, the gap stays that of the given one.

    Returns:
        The columns. Rows in which a drive's force is not known are left out.

    Raises:
        InputError: a run cannot be followed by the chain, or no run has all forces.
    """
    setup, parts, row = separate_setup(mechanism.setup), [], records[0].period
    records = [corrected(r, setup.chain.drives, errors or {}) for r in records]
    records = [_averaged(r, max(1, int(1.0 / (_READINGS * band * r.period)))) for r in records]
    sizes = _sizes(records)
    for record in records:
        parts.append(_run_columns(record, setup, band, sizes, about or {}))
    names = parts[0][0]
    keep = [np.isfinite(p[2]).all(axis=1) for p in parts]
    if not any(rows.any() for rows in keep):
        raise InputError(_WHERE, "no run has the forces of all drives: add them to the mapping")
    starts = np.cumsum([0, *(int(rows.sum()) for rows in keep)])

    def stacked(place: int) -> np.ndarray:
        return np.concatenate([p[place][rows] for p, rows in zip(parts, keep, strict=True)])

    states = {
        key: np.concatenate([p[6][key][rows] for p, rows in zip(parts, keep, strict=True)]) for key in parts[0][6]
    }
    return Columns(
        names, stacked(1), stacked(2), stacked(3), stacked(4), tuple(map(int, starts)), stacked(5),
        states, sizes, band, parts[0][7], row, tuple(r.name for r in records), tuple(setup.chain.drives),
        tuple(force_unit(setup.chain, drive) for drive in setup.chain.drives), _max_noise(records, band),
    )  # fmt: skip


def _max_noise(records: Sequence[IdentificationRecord], band: float) -> np.ndarray:
    """Return the noise (k,) of the low-passed forces that the readings allow with 95 %, coloured noise included.

    The noise of a reading is the stated one, or that of third differences of the readings.
    """
    low, _ = design_low_pass(band, records[0].period)
    squares = []
    for record in records:
        steps = np.abs(np.diff(record.force, n=3, axis=0))
        rough = 1.4826 * np.nanmedian(steps, axis=0) / np.sqrt(20.0)  # of normal noise; robust against jumps
        is_stated = np.isfinite(record.force_noise)
        width = np.where(is_stated, STATED_WIDTH, 2.0 * STATED_WIDTH)
        squares.append((np.where(is_stated, record.force_noise, rough) * np.exp(2.0 * width)) ** 2)
    return np.sqrt(np.sum(low**2) * np.mean(squares, axis=0))


def force_unit(chain: Chain, joint: str) -> str:
    """Return the unit of the force of a joint, or of the friction of a closure."""
    return "N" if joint in chain.joints and chain.tree.is_slide[chain.index(joint)] else "N m"


def _averaged(record: IdentificationRecord, many: int) -> IdentificationRecord:
    """Means of some rows each, positions and forces alike."""
    count = len(record.force) // many
    if many == 1 or count < 10:
        return record
    position, force = (
        values[: count * many].reshape(count, many, -1).mean(axis=1) for values in (record.position, record.force)
    )
    small = many**-0.5
    return replace(
        record, period=many * record.period, position=position, force=force,
        position_noise=small * record.position_noise, force_noise=small * record.force_noise,
    )  # fmt: skip


def _sizes(records: Sequence[IdentificationRecord]) -> dict[str, tuple[float, float, float]]:
    out = {}
    for k, joint in enumerate(records[0].axes):
        all_of = np.concatenate([r.position[:, k] for r in records])
        step = max(1, round(0.02 / records[0].period))
        rates = [np.diff(r.position[::step, k]) / (step * r.period) for r in records]
        rate = np.concatenate(rates)
        out[joint] = (
            float(np.nanmean(all_of)), max(float(np.nanmax(all_of) - np.nanmin(all_of)), 1e-6),
            max(float(np.sqrt(np.nanmean(rate**2))), 1e-6),
        )  # fmt: skip
    return out


def _run_columns(
    raw: IdentificationRecord, setup: RegressorSetup, band: float,
    sizes: Mapping[str, tuple[float, float, float]], about: Mapping[str, float],
):  # fmt: skip
    """Names, matrix, measured, modelled, time, doubt, states, spacing of one run."""
    how = Processing("zero_phase", band=band)
    record = convert_to_given_joints(raw, setup)
    found = estimate_resolution(record.position, record.period, record.position_noise)
    plain = estimate_resolution(raw.position, raw.period, raw.position_noise)
    lengths = compute_joint_motion(raw.position, raw.period, plain, how)
    errors = RateErrors(raw.axes, lengths.rate_std)
    own, table = build_equations(record, setup, how, found, rate_errors=errors)
    motion = compute_joint_motion(record.position, record.period, found, how)
    stride = max(1, int(1.0 / (_ROWS * band * record.period)))
    rows = slice(None, None, stride)
    whole = np.stack([motion.value, motion.rate, motion.acceleration])[:, rows]
    smooth, _ = design_low_pass(_SMOOTH * band, record.period)  # what few rows can still tell
    rate = fftconvolve(lengths.rate, smooth[:, None], mode="same", axes=0)
    measured = np.stack([lengths.value, rate])[:, rows]
    value = table.nominal + [about.get(name, 0.0) for name in table.names]
    slippery = np.where([name.startswith(_DRY) for name in table.names], 0.0, value)
    late = _Differences(setup, whole, measured, raw.axes, record.period * stride, slippery)
    names, slow = late.columns(sizes)
    extra = _onto(slow, band, record.period * stride, own.time)
    fine = np.stack([motion.value, motion.rate, motion.acceleration])
    of_drives, quick = _drive_columns(setup, fine, motion.rate_std, sizes, (table.nominal, value), record.period)
    quick = _onto(quick, band, record.period, own.time)
    rubs, turns, calm = _dry_friction(setup, fine, band, record.period)
    turns, calm = (_onto(one, band, record.period, own.time) for one in (turns, calm))
    dry = [table.names.index(f"coulomb.{drive}") for drive in rubs]
    for k, drive in enumerate(rubs):
        if f"delay.position.{drive}" in names:
            extra[:, :, names.index(f"delay.position.{drive}")] += value[dry[k]] * turns[:, :, k]
    names = [*names, *of_drives, *(f"sharpness.{drive}" for drive in rubs)]
    extra = np.concatenate([extra, quick, calm - own.matrix[:, :, dry]], axis=2)
    low, thin = design_low_pass(band, record.period)
    force = low_pass_forces(record.force, record.period, low, thin)
    matrix = np.concatenate([own.matrix, extra], axis=2)
    states = {}
    for k, joint in enumerate(raw.axes):
        for what, values in (("position", lengths.value), ("velocity", lengths.rate)):
            states[f"{what}.{joint}"] = apply_low_pass(values[:, k], low, thin)
    return (
        (*table.names, *names), matrix, force,
        own.matrix @ table.nominal + force - own.force, own.time, own.friction_sign_uncertainty, states, own.spacing,
    )  # fmt: skip


def _onto(slow: np.ndarray, band: float, period: float, time: np.ndarray) -> np.ndarray:
    """Rows (n, k, m) after the low-pass, at other times."""
    low, _ = design_low_pass(band, period)
    passed = apply_low_pass(slow, low, 1)
    own = (np.arange(len(passed)) + (len(low) - 1) / 2) * period
    return CubicSpline(own, passed, axis=0)(np.clip(time, own[0], own[-1]))


def _drive_columns(setup: RegressorSetup, motion: np.ndarray, rate_std: np.ndarray, sizes, values, period: float):
    """Force sensors, springs, and friction near rest, of the drives: names, and (n, k, m).

    A scale has the forces of the given parameters, the first of `values`: with friction that was found, it could take
    the place of that friction.
    """
    chain = setup.chain
    found = setup.project_motion_on_drives(*motion)
    given, base = (predict_forces(setup, motion, numbers, rate_std) for numbers in values)
    change = np.gradient(base, period, axis=0)
    names, out = ["delay.force"], [-change]
    for k, drive in enumerate(chain.drives):
        own = np.arange(len(chain.drives)) == k
        names += [f"scale.force.{drive}", f"delay.force.{drive}"]
        out += [given * own, -change * own]
        j = chain.index(drive)
        share, rate = found.joint_projection[:, :, j], found.rate[:, j]
        middle = float(found.position[:, j].mean()) if drive not in sizes else sizes[drive][0]
        names.append(f"spring.{drive}")
        out.append(share * (found.position[:, j, None] - middle))
        speed = sizes[drive][2] if drive in sizes else float(np.sqrt(np.mean(rate**2)))
        for number, part in enumerate(STRIBECK):
            shape = np.exp(-((rate / (part * speed)) ** 2)) * np.sign(rate)
            names.append(f"stribeck{number}.{drive}")
            out.append(share * shape[:, None])
    return names, np.stack(out, axis=2)


def _dry_friction(setup: RegressorSetup, motion: np.ndarray, band: float, period: float):
    """Where dry friction of d drives turns: their names, and twice (n, k, d), per unit of friction.

    How fast its sign turns, which a late position of the drive delays; and the sign of the rate in
    the band. That may be nearer to what friction does where it turns than the sign which is
    expected of an uncertain rate.
    """
    chain, rubs = (
        setup.chain,
        {one.location for one in setup.friction_terms if "coulomb" in one.nominal},
    )
    drives = [drive for drive in chain.drives if drive in rubs]
    found, places = setup.project_motion_on_drives(*motion), [chain.index(name) for name in drives]
    share, rate = found.joint_projection[:, :, places], found.rate[:, places]
    low, _ = design_low_pass(band, period)
    calm = fftconvolve(rate, low[:, None], mode="same", axes=0)
    turns = np.gradient(share * np.sign(rate)[:, None], period, axis=0)
    return drives, turns, share * np.sign(calm)[:, None]


@dataclass(frozen=True)
class _Differences:
    """Columns by small differences, along every few rows of one run.

    `value` is without dry friction: that of the drives has the sign of the measured rates, and
    differences of a sign are all or nothing.
    """

    setup: RegressorSetup
    motion: np.ndarray
    measured: np.ndarray
    axes: tuple[str, ...]
    period: float
    value: np.ndarray

    def columns(self, sizes) -> tuple[list[str], np.ndarray]:
        """Names, and (n, k, m)."""
        chain = self.setup.chain
        found = self.setup.project_motion_on_drives(*self.motion)
        here = [chain.index(name) for name in self.axes]
        moves = np.linalg.solve(found.joint_projection[:, :, here], found.joint_projection)  # q_v per measured joint
        given = [chain.index(name) for name in self.setup.given_joints]
        base = predict_forces(self.setup, self.motion, self.value)
        names, out = [], []

        def add(name: str, column: np.ndarray) -> None:
            names.append(name)
            out.append(column)

        for k, joint in enumerate(self.axes):
            way = moves[:, k, given]
            step = _AWAY * sizes[joint][1]
            add(f"offset.position.{joint}", -self._moved(way * step, base) / step)
            late = max(_LATE, self.period)
            lag = self.measured[1][:, k, None] * way * late
            add(f"delay.position.{joint}", self._moved(lag, base) / late)
        for axis, letter in ((0, "x"), (1, "y")):
            add(f"tilt.{letter}", self._tilted(axis, base) / _TILT)
        return names, np.stack(out, axis=2)

    def _rate(self, values: np.ndarray, order: int = 1) -> np.ndarray:
        """Derivatives of rows by a cubic spline: differences of so few rows are too small."""
        time = np.arange(len(values)) * self.period
        return CubicSpline(time, values, axis=0)(time, order)

    def _moved(self, change: np.ndarray, base: np.ndarray) -> np.ndarray:
        """What the model's forces gain where the given joints are elsewhere by (n, k)."""
        away = np.stack([change, self._rate(change), self._rate(change, 2)])
        return -(base - predict_forces(self.setup, self.motion + away, self.value))

    def _tilted(self, axis: int, base: np.ndarray) -> np.ndarray:
        """What they gain where the base is turned about x or y of the world by the step."""
        chain = self.setup.chain
        turn = np.zeros(3)
        turn[axis] = _TILT
        down = tilted(chain.tree.gravity, turn)
        moved = replace(self.setup, chain=replace(chain, tree=chain.tree._replace(gravity=down)))
        return predict_forces(moved, self.motion, self.value) - base


def tilted(gravity: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Gravity (3,) [m/s^2] in the frame of a base that is turned by a small rotation (3,) [rad].

    >>> tilted(np.array([0.0, 0.0, -9.81]), np.array([0.1, 0.0, 0.0])).round(3)
    array([ 0.   , -0.979, -9.761])
    """
    angle = float(np.linalg.norm(turn))
    if angle == 0.0:
        return gravity.copy()
    axis = -turn / angle
    return (
        gravity * np.cos(angle) + np.cross(axis, gravity) * np.sin(angle)
        + axis * (axis @ gravity) * (1.0 - np.cos(angle))
    )  # fmt: skip


def nominal_parameters(mechanism: Mechanism) -> dict[str, float]:
    """Regressor's parameter -> its given value, of the setup with a column for everything.

    Args:
        mechanism: the model.

    Returns:
        The values; bodies' ten parameters are about their frames' origins.
    """
    setup = separate_setup(mechanism.setup)
    chain = setup.chain
    out = {
        f"{kind}.{body}": float(value)
        for body, row in zip(chain.bodies, chain.inertia, strict=True)
        for kind, value in zip(BODY_PARAMETERS, row, strict=True)
    }
    for one in setup.friction_terms:
        out |= {f"{kind}.{one.location}": float(value) for kind, value in one.nominal.items()}
    for joint in setup.drive_inertia:
        out[f"drive_inertia.{joint}"] = float(chain.armature[chain.index(joint)])
    return out


def strengths(columns: Columns) -> np.ndarray:
    """(m,) share of a drive's force RMS that a unit of each column moves, of the drive most so."""
    force = np.sqrt(np.mean(columns.measured**2, axis=0))
    moved = np.sqrt(np.mean(columns.matrix**2, axis=0))
    return (moved / np.maximum(force, 1e-12)[:, None]).max(axis=0)


def undone(columns: Columns, applied: Mapping[Key, np.ndarray], name_of: Mapping[Key, str]):
    """Columns whose readings have the sensors' defects again, to the first order.

    What is taken off the readings thus stays a question: columns are those about the numbers found
    so far, and the gap is that of the readings as they are.

    Args:
        columns: of readings from which defects are taken off.
        applied: effect -> its numbers.
        name_of: effect -> its column.

    Returns:
        The columns.
    """
    value = {}
    for key, numbers in applied.items():
        known = float(numbers[0])
        back = known if key[0] != "force_scale" else 1.0 - 1.0 / known
        value[name_of[key]] = -back
    return columns.moved(value)
