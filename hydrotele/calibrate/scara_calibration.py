"""Calibration of a planar two-joint arm (SCARA) from measured positions of its end.

This is Wang's introductory example: error model, measurement, least squares, corrected model. The
error model of Eq. 2 has two length errors; joint offsets are added if they improve the prediction
of left-out positions.

Source: Wang 2012, section 1.1, Eqs 1-3.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hydrotele.calibrate.estimation import ParameterFit, least_squares
from hydrotele.calibrate.pose_selection import PoseSelection, leave_one_out, select_poses
from hydrotele.core.datafile import PositiveFloat, StrictModel, read_yaml, validate_data
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_text
from hydrotele.kinematics.serial_chain import (
    Element,
    SerialChain,
    chain_poses,
    chain_poses_and_derivatives,
)

MEASURED_FILE, NOMINAL_FILE = "measured.csv", "nominal.yaml"
COLUMNS = ("theta", "phi", "u", "v")
_SCALES = {"length": 1e-3, "offset": 1e-3}  # m and rad: typical tolerances
_MAX_ANGLE = 2.0 * np.pi + 0.2  # rad


class ScaraSpec(StrictModel):
    """Nominal lengths of the links [m]."""

    length_a: PositiveFloat
    length_b: PositiveFloat


@dataclass(frozen=True)
class MeasuredPositions:
    """Measured poses of a planar two-joint arm.

    Attributes:
        joints: (n, 2) theta of the first and phi of the second joint [rad].
        ends: (n, 2) measured end positions u, v [m].
    """

    joints: np.ndarray
    ends: np.ndarray


@dataclass(frozen=True)
class ScaraCalibration:
    """Result of the calibration of a planar two-joint arm.

    Distances are those of predicted from measured end positions.

    Attributes:
        fit: fit of the lengths and, if `has_offsets`, the joint offsets.
        has_offsets: whether joint offsets were fitted.
        model_errors: leave-one-out RMS distance [m] by model: each fitted pose is predicted by a fit
            to the other ones.
        nominal_rms: RMS distance with the nominal lengths, of the validation poses, or of all poses
            without validation poses [m].
        heldout_rms: RMS distance with the calibrated arm of the validation poses; without
            validation poses, the leave-one-out RMS distance [m].
    """

    fit: ParameterFit
    has_offsets: bool
    model_errors: dict[str, float]
    nominal_rms: float
    heldout_rms: float


def scara_chain(nominal: ScaraSpec) -> SerialChain:
    """Build the chain of a planar arm with two revolute joints, theta and phi, and two links, a and b.

    Its parameters are the joint offsets (nominally 0) and the link lengths.
    """
    return SerialChain(
        ("theta", "phi"),
        (
            Element("rz", "offset.theta", 0.0, 0),
            Element("tx", "length.a", nominal.length_a),
            Element("rz", "offset.phi", 0.0, 1),
            Element("tx", "length.b", nominal.length_b),
        ),
    )


def load_scara(folder: Path) -> tuple[ScaraSpec, MeasuredPositions]:
    """Read the nominal link lengths and the measured poses of a two-joint arm from a folder.

    Args:
        folder: folder with `nominal.yaml` and `measured.csv` (theta, phi [rad], u, v [m], with a
            header line).

    Returns:
        The lengths and the poses.

    Raises:
        InputError: a file is invalid; the message names file, row and column.
    """
    data, lines = read_yaml(folder / NOMINAL_FILE)
    nominal = validate_data(ScaraSpec, data, str(folder / NOMINAL_FILE), lines)
    path = folder / MEASURED_FILE
    rows = [line.split(",") for line in read_text(path).splitlines() if line.strip()]
    if not rows or tuple(word.strip() for word in rows[0]) != COLUMNS:
        raise InputError(path, f"the first row must be {','.join(COLUMNS)}")
    values = []
    for number, words in enumerate(rows[1:], start=2):
        if len(words) != len(COLUMNS):
            raise InputError(f"{path}: row {number}", f"has {len(words)} columns, must have 4")
        for name, word in zip(COLUMNS, words, strict=True):
            try:
                good = np.isfinite(float(word))
            except ValueError:
                good = False
            if not good:
                raise InputError(f"{path}: row {number}, column {name}", f"{word!r} is not a finite number")
        values.append([float(word) for word in words])
    if len(values) < 4:
        raise InputError(path, f"has {len(values)} poses; measure at least 4 different ones")
    table = np.array(values)
    if np.abs(table[:, :2]).max() > _MAX_ANGLE:
        raise InputError(path, "angles exceed one turn: they must be in rad, positions in m")
    reach = 1.5 * (nominal.length_a + nominal.length_b)
    if np.abs(table[:, 2:]).max() > reach:
        raise InputError(path, f"positions beyond the arm's reach of {reach / 1.5:g} m: in mm?")
    return nominal, MeasuredPositions(table[:, :2], table[:, 2:])


def calibrate_scara(nominal: ScaraSpec, measured: MeasuredPositions, heldout: Sequence[int] = ()) -> ScaraCalibration:
    """Calibrate a two-joint arm by least squares on its end positions, with or without joint offsets.

    Both models are fitted. The one with the smaller leave-one-out error is returned: each fitted
    pose is predicted by a fit to the other ones.

    Args:
        nominal: nominal lengths.
        measured: measured poses.
        heldout: indices of validation poses, which are not fitted; may be empty.

    Returns:
        The calibration.

    Raises:
        InputError: no parameter is identifiable, or there are too few poses.

    Examples:
        An arm whose first link is 2 mm longer than its drawing says:

        >>> nominal = ScaraSpec(length_a=0.5, length_b=0.4)
        >>> measured = simulate_scara(nominal, errors=(0.0, 2.0e-3, 0.0, 0.0), poses=20, noise=2.0e-5, seed=1)
        >>> found = calibrate_scara(nominal, measured, heldout=range(15, 20))
        >>> dict(zip(found.fit.names, (1e3 * found.fit.values).round(2).tolist()))  # mm
        {'length.a': 502.0, 'length.b': 400.0}
        >>> f"{1e3 * found.nominal_rms:.2f} mm before, {1e3 * found.heldout_rms:.2f} mm after"
        '2.00 mm before, 0.02 mm after'
    """
    chain = scara_chain(nominal)
    everything = range(len(measured.joints))
    fitted = [k for k in everything if k not in set(heldout)]

    def rms_of_fit(fit: ParameterFit, poses: Sequence[int]) -> float:
        values = chain.nominal_values.copy()
        for name, value in zip(fit.names, fit.values, strict=True):
            values[chain.parameters.index(name)] = value
        return _rms_distance(chain, measured, poses, values)

    rivals, whole = {}, {}
    for model in ("lengths", "lengths and offsets"):
        whole[model] = fit_scara(chain, measured, fitted, model != "lengths")
        errors = leave_one_out(
            fitted,
            lambda rest, model=model: fit_scara(chain, measured, rest, model != "lengths"),
            lambda fit, one: rms_of_fit(fit, [one]),
        )
        rivals[model] = float(np.sqrt(np.mean(np.square(list(errors.values())))))
    best = min(rivals, key=lambda model: rivals[model])
    left = rms_of_fit(whole[best], list(heldout)) if len(heldout) else rivals[best]
    before = _rms_distance(chain, measured, list(heldout) or list(everything), chain.nominal_values)
    return ScaraCalibration(whole[best], best != "lengths", rivals, before, left)


def fit_scara(chain: SerialChain, measured: MeasuredPositions, poses: Sequence[int], offsets: bool) -> ParameterFit:
    """Fit link lengths, or lengths and joint offsets, of a two-joint arm to some measured poses.

    Args:
        chain: chain of the nominal arm.
        measured: measured poses.
        poses: indices of the poses to fit.
        offsets: whether joint offsets are also fitted.

    Returns:
        The fit.

    Raises:
        InputError: no parameter is identifiable, or there are too few poses.
    """
    names = [n for n in chain.parameters if offsets or n.startswith("length")]
    places = [chain.parameters.index(name) for name in names]
    joints, ends = measured.joints[list(poses)], measured.ends[list(poses)]

    def insert_parameters(x: np.ndarray) -> np.ndarray:
        values = chain.nominal_values.copy()
        values[places] = x
        return values

    return least_squares(
        lambda x: (chain_poses(chain, joints, insert_parameters(x)).position[:, :2] - ends).ravel(),
        chain.nominal_values[places], names, _parameter_scales(names),
        jac=lambda x: chain_poses_and_derivatives(chain, joints, insert_parameters(x))
        .position_by_parameter[:, :2][:, :, places].reshape(-1, len(places)),
    )  # fmt: skip


def select_scara_poses(nominal: ScaraSpec, measured: MeasuredPositions, count: int) -> PoseSelection:
    """Select the poses that are most informative about lengths and offsets (D-optimal).

    Args:
        nominal: nominal lengths.
        measured: candidate poses.
        count: number of poses to select.

    Returns:
        The selection.
    """
    chain = scara_chain(nominal)
    rates = chain_poses_and_derivatives(chain, measured.joints).position_by_parameter[:, :2]
    return select_poses(rates * _parameter_scales(chain.parameters), count)


def simulate_scara(
    nominal: ScaraSpec, errors: Sequence[float], poses: int, noise: float, seed: int
) -> MeasuredPositions:
    """Simulate measured poses, at random joint angles, of a planar two-joint arm with errors.

    Args:
        nominal: nominal lengths.
        errors: (4,) errors of theta's offset [rad], a [m], phi's offset [rad], b [m].
        poses: number of poses.
        noise: standard deviation of u and v [m].
        seed: seed of poses and noise.

    Returns:
        The poses.
    """
    rng = np.random.default_rng(seed)
    chain = scara_chain(nominal)
    joints = np.column_stack([rng.uniform(-1.5, 1.5, poses), rng.uniform(0.3, 2.4, poses)])
    ends = chain_poses(chain, joints, chain.nominal_values + np.asarray(errors)).position[:, :2]
    return MeasuredPositions(joints, ends + noise * rng.standard_normal(ends.shape))


def save_scara(folder: Path, nominal: ScaraSpec, measured: MeasuredPositions) -> None:
    """Write the nominal lengths to `nominal.yaml` and the measured poses to `measured.csv` in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    text = f"length_a: {nominal.length_a!r}\nlength_b: {nominal.length_b!r}\n"
    (folder / NOMINAL_FILE).write_text(text, encoding="utf-8")
    table = np.column_stack([measured.joints, measured.ends])
    np.savetxt(folder / MEASURED_FILE, table, delimiter=",", header=",".join(COLUMNS), comments="",
               fmt="%.9f")  # fmt: skip


def _parameter_scales(names: Sequence[str]) -> np.ndarray:
    return np.array([_SCALES[name.partition(".")[0]] for name in names])


def _rms_distance(chain, measured: MeasuredPositions, poses: Sequence[int], values: np.ndarray) -> float:
    ends = chain_poses(chain, measured.joints[list(poses)], values).position[:, :2]
    return float(np.sqrt(np.mean(np.sum((ends - measured.ends[list(poses)]) ** 2, axis=1))))
