"""Identification of the operator model from a record of compensatory tracking.

In compensatory tracking the operator sees the error between target and response, and keeps it small.
The operator observes the error between target and response and moves the hand. The describing
function `Yp = K (equalisation) e^(-tau s) omega^2 / (s^2 + 2 zeta omega s + omega^2)` is fitted to
error and hand. The operator's noise passes through the loop and is part of the error, so that an
ordinary fit is biased. The part of the error that the target causes, e_target, is therefore the instrument
(refined instrumental variables): the equations
`sum dYp/dtheta e_target * W (hand - Yp error) = 0` hold at the true parameters theta for any remnant,
and their covariance gives the standard errors. The remnant is the part of the hand's motion that Yp
does not explain; the filter W whitens it.

The instrument is estimated as well. Its errors come from the same remnant as the residual. If the
remnant is most of the error, they determine the scatter of the estimates. Standard errors are
therefore those of a jackknife, which estimates instrument and parameters again without each part
of the record in turn.

Source: Van den Hof and Schrama 1993 (two-stage method); Soderstrom and Stoica 1983 (instrumental
variables); Bekker 1994 (variance with many weak instruments); form of Yp: McRuer and Jex 1967.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from hydrotele.core.errors import InputError
from hydrotele.core.units import si_unit_and_factor
from hydrotele.logs.table import read_table
from hydrotele.teleop.manual_control import FORMS, TrackingRecord
from hydrotele.teleop.operator_parameters import load_operator_file

EQUALISATIONS = ("integral", "lag", "gain", "lead")
_MIN_SAMPLING_RATE, _MAX_SAMPLING_RATE = (
    10.0,
    25.0,
)  # Hz, minimum and maximum sampling rate of the analysis
_MIN_DURATION = 20.0  # s
_MAX_MISSING_FRACTION = 0.05  # maximum fraction of samples that are interpolated
_HIGHPASS_FREQUENCY = 0.15  # rad/s: slower motion of the hand is drift
_SETTLING_TIME = 6.0  # s, settling time of the filters at the start of the record
_RESPONSE_LENGTH, _TAP_SPACING = (
    3.0,
    0.06,
)  # s, length and tap spacing of the response of the error to the target
_INSTRUMENT_PARTS, _MIN_SINGULAR_RATIO = (
    6,
    3e-3,
)  # parts of the record; smallest relative singular value that is used
_WHITENER_LENGTH = 0.6  # s of the autoregression of the remnant
_NOISE_FLOOR = 3e-2  # white noise relative to the variance of the remnant: limits the whitener's gain
_BOUNDS = {
    "gain": (1e-9, 1e9), "delay": (0.02, 1.0), "time_constant": (0.02, 50.0),
    "neuromuscular_frequency": (3.0, 60.0), "neuromuscular_damping": (0.03, 2.0),
}  # fmt: skip
_UNITS = {"delay": "s", "time_constant": "s", "neuromuscular_frequency": "rad/s",
          "neuromuscular_damping": "1", "remnant": "1", "crossover": "rad/s",
          "phase_margin": "rad", "gain_margin": "1"}  # fmt: skip
_MAX_LOG_ERROR = 0.5  # maximum standard error of a logarithm for an identifiable parameter
_JACKKNIFE = 8  # parts of the record
_STUDENT_QUANTILE = 2.36  # Student's t for 95 % with _JACKKNIFE - 1 degrees of freedom
_SAMPLE_COUNT = 400


class ParameterEstimate(NamedTuple):
    """An estimated parameter with its 95 % confidence interval.

    Attributes:
        value: estimate.
        low: lower end of the 95 % confidence interval.
        high: upper end of the interval.
        unit: unit of all three.
        identified: whether the record determines the value: the standard error of its logarithm is
            at most 0.5, and the fit did not stop at a bound of the parameter. For crossover and
            margins the ratio of `high` to `low` has the corresponding limit, about 11.
    """

    value: float
    low: float
    high: float
    unit: str
    identified: bool


class OperatorFit(NamedTuple):
    """Operator model identified from a record.

    Attributes:
        equalisation: `gain`, `lead`, `lag` or `integral`.
        estimates: name -> estimate: gain (hand per error), delay, time_constant of lead or lag,
            neuromuscular_frequency, neuromuscular_damping, remnant (noise-to-signal ratio). If the
            controlled element is one of the known forms, also crossover (frequency), phase_margin
            and gain_margin (loop gain at -180 degrees).
        element: form of the controlled element, such as `K/s`; empty if it is not a known form.
        explained_fraction: fraction of the hand's variance that the model predicts from the target [1].
        rate: sampling rate of the analysis [Hz].
        duration: analysed duration [s].
        notes: warnings for the user.
        frequencies: (m,) frequencies of the describing function [rad/s].
        response: (m,) complex describing function Yp of the model, hand per error.
    """

    equalisation: str
    estimates: Mapping[str, ParameterEstimate]
    element: str
    explained_fraction: float
    rate: float
    duration: float
    notes: tuple[str, ...]
    frequencies: np.ndarray
    response: np.ndarray


def read_tracking_record(path: Path, names: Mapping[str, str] | None = None) -> tuple[TrackingRecord, list[str]]:
    """Read time, target, response and hand motion of a tracking task from a CSV or Parquet file.

    Columns are `time`, `target`, `response` and `hand`, or the names in `names`. Without a column
    `hand`, a column `force` is used as the operator's output (an isometric stick). A unit in the
    header (`time [ms]`) is converted. Samples need not be equidistant; single missing values are
    interpolated.

    Args:
        path: path of the file.
        names: `time`, `target`, `response`, `hand` -> column.

    Returns:
        The record as sampled, and notes for the user on repaired data.

    Raises:
        InputError: the file is invalid; the message gives file, column, row and a remedy.
    """
    table = read_table(path, missing=True)
    given, notes = dict(names or {}), []
    lower = {name.lower(): name for name in table.names}
    columns: dict[str, np.ndarray] = {}
    for key in ("time", "target", "response", "hand"):
        name = given.get(key) or lower.get(key)
        if key == "hand" and name is None and "force" in lower:
            name = lower["force"]
            notes.append("no column hand: the force is used as the operator's output")
        if name is None or name not in table.names:
            has = ", ".join(table.names)
            message = f"has no column {name or key!r}; columns: {has}; name it with --{key} COLUMN"
            raise InputError(path, message)
        if name in table.faults:
            raise table.faults[name]
        place = table.names.index(name)
        unit, values = table.units[place], np.array(table.values[place], float)
        if unit is not None:
            values *= si_unit_and_factor(unit)[1]
        if np.isinf(values).any():
            row = int(np.flatnonzero(np.isinf(values))[0])
            raise InputError(table.location(str(name), row), "is infinite: remove the row")
        columns[key] = values
    time = columns.pop("time")
    if len(time) < 10:
        raise InputError(path, f"has {len(time)} rows; a record needs at least {_MIN_DURATION:g} s")
    bad = np.flatnonzero(~(np.diff(time) > 0.0))
    if len(bad):
        message = "does not increase here: sort the rows and keep each time once"
        raise InputError(table.location("time", int(bad[0]) + 1), message)
    for key, values in columns.items():
        missing = np.isnan(values)
        if missing.mean() > _MAX_MISSING_FRACTION:
            share = 100.0 * missing.mean()
            row = int(np.flatnonzero(missing)[0])
            message = f"has {share:.0f} % missing values; at most {100 * _MAX_MISSING_FRACTION:g} % are allowed"
            raise InputError(table.location(given.get(key, key), row), message)
        if missing.any():
            notes.append(f"{int(missing.sum())} missing values of {key} were interpolated")
            columns[key] = np.interp(time, time[~missing], values[~missing])
        if np.ptp(columns[key]) == 0.0:
            raise InputError(f"{path}, column {given.get(key, key)}", "is constant")
    return TrackingRecord(time, *(columns[k] for k in ("target", "response", "hand"))), notes


def identify_operator(record: TrackingRecord, equalisation: str | None = None, source: str = "record") -> OperatorFit:
    """Identify gain, delay, equalisation and neuromuscular lag of a person from a tracking record.

    Args:
        record: record as sampled.
        equalisation: `gain`, `lead`, `lag` or `integral`, the form of the operator's compensation.
            By default the converged fit with the smallest Bayesian information criterion is
            selected.
        source: name of the record in messages.

    Returns:
        The fitted operator model with confidence intervals and warnings.

    Raises:
        InputError: the record is too short or too slow, or the hand does not respond to the target.
    """
    if equalisation is not None and equalisation not in EQUALISATIONS:
        message = f"{equalisation!r}; valid: {', '.join(EQUALISATIONS)}"
        raise InputError("--equalisation", message)
    step, signals, notes = _resample_record(record, source)
    filtered = {
        name: _filter_with_transfer_function(values, step, _highpass_response) for name, values in signals.items()
    }
    target, seen, hand = filtered["target"], filtered["error"], filtered["hand"]
    from_target = _estimate_instrumental_variable(target, seen, step)
    data = _TrackingData(step, target, seen, from_target, hand)
    kinds = (equalisation,) if equalisation else EQUALISATIONS
    fits = [fit for kind in kinds if (fit := _fit_equalisation(data, kind)) is not None]
    if not fits:
        raise InputError(source, "has no response of the hand to the target: check the columns")
    best = min(fits, key=lambda fit: (not fit.has_converged, fit.criterion))
    best = best._replace(covariance=_log_covariance(data, best))
    if not best.has_converged:
        notes.append("the fit did not converge and is not valid: use a longer record, or a target"
                     " with more motion")  # fmt: skip
    return _build_operator_fit(best, data, signals, record, notes)


class _TrackingData(NamedTuple):
    step: float
    target: np.ndarray
    error: np.ndarray
    target_error: np.ndarray
    hand: np.ndarray


class _EqualisationFit(NamedTuple):
    kind: str
    names: tuple[str, ...]
    sign: float
    log_parameters: np.ndarray
    covariance: np.ndarray  # empty before `_log_covariance`
    noise: np.ndarray
    whitening_filter: np.ndarray
    criterion: float
    has_converged: bool


def _resample_record(record: TrackingRecord, source: str) -> tuple[float, dict[str, np.ndarray], list[str]]:
    """Resample a record to equidistant signals without mean, at no more than about 25 Hz.

    Return sampling period [s], signals `target`, `error`, `hand` and `response`, and notes for the
    user. Raise InputError for a short, slow or interrupted record.
    """
    time, notes = record.time, []
    spacing = float(np.median(np.diff(time)))
    if time[-1] - time[0] < _MIN_DURATION:
        message = f"is {time[-1] - time[0]:.1f} s long; at least {_MIN_DURATION:g} s are needed"
        raise InputError(source, message)
    if 1.0 / spacing < _MIN_SAMPLING_RATE:
        message = f"has {1.0 / spacing:.2g} samples per second; at least {_MIN_SAMPLING_RATE:g} are needed"
        raise InputError(source, message)
    if (gap := float(np.diff(time).max())) > 0.5:
        at = float(time[int(np.argmax(np.diff(time)))])
        message = f"has a gap of {gap:.2f} s at {at:.2f} s: use only the longer part"
        raise InputError(source, message)
    if np.abs(np.diff(time) / spacing - 1.0).max() > 0.5:
        notes.append("samples are not equidistant: they were interpolated")
    error = record.target - record.response
    every = max(1, math.ceil(1.0 / spacing / _MAX_SAMPLING_RATE - 0.01))
    grid = np.arange(time[0], time[-1], spacing)
    made = {}
    for name, values in (("target", record.target), ("error", error), ("hand", record.hand),
                         ("response", record.response)):  # fmt: skip
        even = np.interp(grid, time, values)
        if every > 1:
            from scipy.signal import decimate

            even = decimate(even, every, ftype="fir", zero_phase=True)
        made[name] = even - even.mean()
    return spacing * every, made, notes


def _highpass_response(s: np.ndarray) -> np.ndarray:
    return s / (s + _HIGHPASS_FREQUENCY)


def _filter_with_transfer_function(values: np.ndarray, step: float, response) -> np.ndarray:
    """Filter a sampled signal with the transfer function `response(s)`, starting from rest."""
    pad = len(values) + round(4.0 * _SETTLING_TIME / step)
    s = 2j * np.pi * np.fft.rfftfreq(pad, step)
    return np.fft.irfft(np.fft.rfft(values, pad) * response(s), pad)[: len(values)]


def _estimate_instrumental_variable(
    target: np.ndarray, seen: np.ndarray, step: float, kept: np.ndarray | None = None
) -> np.ndarray:  # fmt: skip
    """Estimate the part of the tracking error that the target causes, as instrumental variable.

    This part contains none of the operator's own noise (remnant). The impulse response from target to
    the error `seen` is fitted by least squares to the rows in `kept`. Each part of the record uses the
    response that is fitted to the other parts, so that its own remnant has no influence (jackknife
    instrumental variables, Angrist et al. 1999). Return this part of the error, (n,).
    """
    apart = max(1, round(_TAP_SPACING / step))
    lags = np.arange(0, round(_RESPONSE_LENGTH / step), apart)
    table = np.zeros((len(target), len(lags)))
    for column, lag in enumerate(lags):
        table[lag:, column] = target[: len(target) - lag]
    rows = np.arange(len(target))
    usable = rows >= round(_SETTLING_TIME / step)
    usable = usable if kept is None else usable & kept
    parts = np.array_split(rows, _INSTRUMENT_PARTS)
    inside = [part[usable[part]] for part in parts]
    squares = [table[part].T @ table[part] for part in inside]
    products = [table[part].T @ seen[part] for part in inside]
    made = np.zeros(len(target))
    for part, square, product in zip(parts, squares, products, strict=True):
        size, way = np.linalg.eigh(sum(squares) - square)
        known = size > _MIN_SINGULAR_RATIO**2 * size[-1]
        taps = (way[:, known].T @ (sum(products) - product)) / size[known]
        made[part] = table[part] @ (way[:, known] @ taps)
    return made


def _parameter_names(kind: str) -> tuple[str, ...]:
    timed = ("time_constant",) if kind in ("lead", "lag") else ()
    return ("gain", "delay", *timed, "neuromuscular_frequency", "neuromuscular_damping")


def _operator_response(kind: str, logs: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return the operator's describing function Yp, hand displacement per error, at complex frequencies s.

    `kind` is the form of the operator's compensation: gain, lead, lag or integral. `logs` are the
    logarithms of the model's parameters.
    """
    p = dict(zip(_parameter_names(kind), np.exp(logs), strict=True))
    w, z = p["neuromuscular_frequency"], p["neuromuscular_damping"]
    made = p["gain"] * np.exp(-p["delay"] * s) * w**2 / (s**2 + 2.0 * z * w * s + w**2)
    if kind == "lead":
        made = made * (1.0 + p["time_constant"] * s)
    elif kind == "lag":
        made = made / (1.0 + p["time_constant"] * s)
    elif kind == "integral":
        made = made / np.where(s == 0.0, np.inf, s)
    return made


def _response_derivatives(kind: str, logs: np.ndarray, s: np.ndarray) -> list[np.ndarray]:
    """Return the derivatives of the describing function Yp by the logarithms of its parameters.

    The list has one array per parameter, with the shape of the complex frequencies `s`. `kind` is
    the form of the operator's compensation.
    """
    p = dict(zip(_parameter_names(kind), np.exp(logs), strict=True))
    w, z = p["neuromuscular_frequency"], p["neuromuscular_damping"]
    whole = _operator_response(kind, logs, s)
    lag = s**2 + 2.0 * z * w * s + w**2
    factor = {
        "gain": np.ones_like(s), "delay": -p["delay"] * s,
        "neuromuscular_frequency": 2.0 - (2.0 * z * w * s + 2.0 * w**2) / lag,
        "neuromuscular_damping": -2.0 * z * w * s / lag,
    }  # fmt: skip
    if kind in ("lead", "lag"):
        t = p["time_constant"] * s
        factor["time_constant"] = (1.0 if kind == "lead" else -1.0) * t / (1.0 + t)
    return [whole * factor[name] for name in _parameter_names(kind)]


def _predict_hand_motion(data: _TrackingData, kind: str, logs: np.ndarray, values: np.ndarray) -> np.ndarray:
    return _filter_with_transfer_function(values, data.step, lambda s: _operator_response(kind, logs, s))


def _fit_whitening_filter(noise: np.ndarray, step: float) -> np.ndarray:
    """Fit an autoregression to a noise and return the filter that makes the noise white.

    The filter is returned as its coefficients (taps): 1, followed by the negative autoregression
    coefficients. It spans 0.6 s; `step` is the sampling period [s].
    """
    from scipy.linalg import solve_toeplitz

    order = max(4, round(_WHITENER_LENGTH / step))
    noise = noise - noise.mean()
    size = len(noise)
    spectrum = np.abs(np.fft.rfft(noise, 2 * size)) ** 2
    r = np.fft.irfft(spectrum)[: order + 1] / size
    r[0] *= 1.0 + _NOISE_FLOOR
    return np.concatenate([[1.0], -solve_toeplitz(r[:order], r[1 : order + 1])])


def _fit_equalisation(data: _TrackingData, kind: str) -> _EqualisationFit | None:
    """Fit the operator model with one form of equalisation by refined instrumental variables.

    The fit starts from the best of several delays. It repeats two steps: fit the filter that
    whitens the unexplained hand motion, and solve the instrumental-variable equations for a
    parameter step. The criterion of the result is the Bayesian information criterion of the hand
    motion that the target-caused error does not explain. Return None if the hand does not respond.
    """
    from scipy.optimize import least_squares
    from scipy.signal import lfilter

    names, first = _parameter_names(kind), round(_SETTLING_TIME / data.step)
    low, high = (np.log([_BOUNDS[n][side] for n in names]) for side in (0, 1))
    starts = []
    for delay in (0.1, 0.2, 0.35, 0.5):
        for constant in (0.3, 2.0) if "time_constant" in names else (1.0,):
            usual = {"gain": 1.0, "delay": delay, "time_constant": constant,
                     "neuromuscular_frequency": 12.0, "neuromuscular_damping": 0.4}  # fmt: skip
            logs = np.log([usual[n] for n in names])
            one = _predict_hand_motion(data, kind, logs, data.target_error)[first:]
            gain = float(one @ data.hand[first:] / max(one @ one, 1e-300))
            rest = float(np.sum((data.hand[first:] - gain * one) ** 2))
            starts.append((rest, gain, logs))
    _, gain, logs = min(starts, key=lambda start: start[0])
    if gain == 0.0 or not math.isfinite(gain):
        return None
    sign, logs = math.copysign(1.0, gain), logs.copy()
    logs[0] = math.log(abs(gain))
    hand = sign * data.hand
    logs = np.clip(logs, low + 1e-6, high - 1e-6)

    def residual(x: np.ndarray) -> np.ndarray:
        return (hand - _predict_hand_motion(data, kind, x, data.target_error))[first:]

    logs = least_squares(residual, logs, bounds=(low, high), x_scale=0.3).x
    noise, white, settled = hand, np.ones(1), False
    for turn in range(30):
        noise = (hand - _predict_hand_motion(data, kind, logs, data.error))[first:]
        white = _fit_whitening_filter(noise, data.step)
        z, d, rest = _build_instrumental_equations(data, kind, logs, sign, white, data.target_error)
        move = _solve_instrumental_equations(z, d, rest)[: len(logs)]
        logs = np.clip(logs + np.clip(move, -0.3, 0.3) * (1.0 if turn < 20 else 0.5), low, high)
        settled = bool(np.abs(move).max() < 1e-3)
        if np.abs(move).max() < 1e-4:
            break
    rest = residual(logs)
    left = _fit_whitening_filter(rest, data.step)
    power = float(np.var(np.asarray(lfilter(left, [1.0], rest))[len(left) :]))
    size = len(rest)
    criterion = size * math.log(max(power, 1e-300)) + len(logs) * math.log(size)
    return _EqualisationFit(kind, names, sign, logs, np.zeros((0, 0)), noise, white, criterion, settled)


def _build_instrumental_equations(
    data: _TrackingData, kind: str, logs: np.ndarray, sign: float, white: np.ndarray,
    instrument: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Build the instrumental-variable equations of the operator model at the present parameters.

    Return the instruments (n, m + 1), the derivatives (n, m + 1) of the predicted hand motion by the
    logarithms of m parameters, and the unexplained hand motion (n,). All are filtered so that the
    unexplained motion becomes white noise. The instruments are the same derivatives, but free of the
    operator's noise. The last column of both is the effect of one more unknown, the hand's displacement
    at the start.
    """
    from scipy.signal import lfilter

    first = round(_SETTLING_TIME / data.step)

    def apply_whitening(values: np.ndarray) -> np.ndarray:
        return np.asarray(lfilter(white, [1.0], values[first:]))[len(white) :]

    begun = apply_whitening(np.exp(-_HIGHPASS_FREQUENCY * data.step * np.arange(len(data.hand))))
    z, d = (
        np.column_stack([*(apply_whitening(_filtered_derivative(data, kind, logs, k, values))
                           for k in range(len(logs))), begun])
        for values in (instrument, data.error)
    )  # fmt: skip
    rest = apply_whitening(sign * data.hand - _predict_hand_motion(data, kind, logs, data.error))
    return z, d, rest


def _solve_instrumental_equations(z: np.ndarray, d: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Solve the instrumental-variable equations `z^T (rest - d x) = 0` for the parameter step x.

    z are the instruments, d the derivatives of the predicted hand motion by the parameters, and `rest`
    the hand motion that the model does not explain.
    """
    scale = np.linalg.norm(z, axis=0) + 1e-300
    matrix, right = (z / scale).T @ (d / scale), (z / scale).T @ rest
    return np.linalg.lstsq(matrix, right, rcond=1e-10)[0] / scale


def _log_covariance(data: _TrackingData, fit: _EqualisationFit) -> np.ndarray:
    """Return the covariance of the logarithms of an operator's fitted parameters.

    Of two estimates of each variance the larger one is used. The first follows from the residual and
    assumes that the part of the error that the target causes (the instrument) is known. The second is
    that of a jackknife: each part of the record is left out in turn, and instrument and parameters are
    estimated again.
    """
    arguments = data, fit.kind, fit.log_parameters, fit.sign, fit.whitening_filter
    z, d, rest = _build_instrumental_equations(*arguments, data.target_error)
    scale = np.linalg.norm(z, axis=0) + 1e-300
    inverse = np.linalg.pinv((z / scale).T @ (d / scale))
    equal = float(rest @ rest) / (len(rest) - z.shape[1])
    equal = equal * inverse @ ((z / scale).T @ (z / scale)) @ inverse.T / np.outer(scale, scale)
    gone, moves = len(data.hand) - len(rest), []
    for part in np.array_split(np.arange(len(rest)), _JACKKNIFE):
        kept = np.ones(len(data.hand), bool)
        kept[gone + part] = False
        anew = _estimate_instrumental_variable(data.target, data.error, data.step, kept)
        z = _build_instrumental_equations(*arguments, anew)[0]
        moves.append(_solve_instrumental_equations(z[kept[gone:]], d[kept[gone:]], rest[kept[gone:]]))
    apart = (_JACKKNIFE - 1) * np.var(moves, axis=0)
    larger = np.sqrt(np.maximum(1.0, apart / np.maximum(np.diag(equal), 1e-300)))
    many = len(fit.log_parameters)
    return (equal * np.outer(larger, larger))[:many, :many]


def _filtered_derivative(
    data: _TrackingData, kind: str, logs: np.ndarray, k: int, values: np.ndarray
) -> np.ndarray:  # fmt: skip
    return _filter_with_transfer_function(values, data.step, lambda s: _response_derivatives(kind, logs, s)[k])


def _build_operator_fit(
    fit: _EqualisationFit, data: _TrackingData, signals: Mapping[str, np.ndarray], record: TrackingRecord,
    notes: list[str],
) -> OperatorFit:  # fmt: skip
    """Build the user's result from a fit of the operator model.

    It contains all estimates with intervals: parameters, the operator's noise (remnant), crossover
    frequency and stability margins. Warnings for the user are appended to `notes`.
    """
    errors = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    estimates: dict[str, ParameterEstimate] = {}
    for name, log, error in zip(fit.names, fit.log_parameters, errors, strict=True):
        at_bound = min(abs(log - math.log(b)) for b in _BOUNDS[name]) < 1e-3
        error = error if fit.has_converged else math.inf
        estimates[name] = _make_parameter_estimate(log, error, _UNITS.get(name, "hand per error"), not at_bound)
        if at_bound or error > _MAX_LOG_ERROR:
            notes.append(f"{name} is not identifiable from this record")
    estimates["remnant"] = _estimate_remnant(fit, data)
    if fit.sign < 0.0:
        notes.append("the sign of the hand is reversed: a positive error moves it backwards")
    first = round(_SETTLING_TIME / data.step)
    hand = fit.sign * data.hand[first:]
    rest = hand - _predict_hand_motion(data, fit.kind, fit.log_parameters, data.target_error)[first:]
    explained = 1.0 - float(np.var(rest) / np.var(hand))
    if explained < 0.3:
        notes.append(f"the target explains only {100 * explained:.0f} % of the hand's motion")
    w = np.geomspace(0.1, 30.0, 600)
    element = _estimate_crossover(fit, data, signals, w, estimates, notes) if fit.has_converged else ""
    return OperatorFit(
        fit.kind, estimates, element, explained, 1.0 / data.step,
        float(record.time[-1] - record.time[0]), tuple(dict.fromkeys(notes)), w,
        _operator_response(fit.kind, fit.log_parameters, 1j * w),
    )  # fmt: skip


def _make_parameter_estimate(log: float, error: float, unit: str, inside: bool = True) -> ParameterEstimate:
    reach = min(_STUDENT_QUANTILE * error, 20.0)
    low, high = math.exp(log - reach), math.exp(log + reach)
    return ParameterEstimate(math.exp(log), low, high, unit, bool(inside and error <= _MAX_LOG_ERROR))


def _estimate_remnant(fit: _EqualisationFit, data: _TrackingData) -> ParameterEstimate:
    """Estimate the operator's observation noise (remnant), as a noise-to-signal ratio [1].

    It is the power density of the observation noise divided by pi times the variance of the observed
    error (and of its rate for an operator who generates lead).
    """
    from scipy.signal import welch

    length = min(len(fit.noise), round(15.0 / data.step))
    f, density = welch(fit.noise, 1.0 / data.step, nperseg=length, detrend="linear")
    w = 2.0 * np.pi * f
    p = dict(zip(fit.names, np.exp(fit.log_parameters), strict=True))
    band = (w >= 1.0) & (w <= min(8.0, 0.8 * p["neuromuscular_frequency"]))
    s = 1j * w[band]
    bare = np.abs(_operator_response(fit.kind, fit.log_parameters, s)) * np.abs(_highpass_response(s))
    first = round(_SETTLING_TIME / data.step)
    seen = data.error[first:]
    power = np.full(len(s), float(np.var(seen)))
    if fit.kind == "lead":  # error and rate are both observed
        lead = p["time_constant"]
        rate = float(np.var(np.gradient(seen, data.step)))
        power = (power + lead**2 * rate) / (1.0 + (lead * w[band]) ** 2)
    share = density[band] / 2.0 / bare**2 / (np.pi * power)  # two-sided
    count = max(1.0, 1.8 * len(fit.noise) / length * band.sum() * 0.6)
    whole = _operator_response(fit.kind, fit.log_parameters, s)  # only the product of gain and lead time counts
    slopes = np.array([np.real(k / whole).mean() for k in _response_derivatives(fit.kind, fit.log_parameters, s)])
    doubt = float(slopes @ fit.covariance @ slopes)
    error = math.sqrt(1.5 / count + 4.0 * max(0.0, doubt))
    return _make_parameter_estimate(math.log(float(share.mean())), error if fit.has_converged else math.inf, "1")


def _estimate_crossover(
    fit: _EqualisationFit, data: _TrackingData, signals: Mapping[str, np.ndarray], w: np.ndarray,
    estimates: dict[str, ParameterEstimate], notes: list[str],
) -> str:  # fmt: skip
    """Identify the controlled element K, K/s or K/s^2 and add crossover and margins to `estimates`.

    The element's form, gain and delay are those that predict the response from the hand with the
    smallest squared error. The intervals of crossover frequency and margins follow from random
    samples of the fitted operator parameters. Return the form of the element. It is empty if more
    than 20 % of the response's power is unexplained; then nothing is added to `estimates`.
    """
    first, hand = round(_SETTLING_TIME / data.step), signals["hand"]
    best = (math.inf, 0, 1.0, 0.0)

    def output_filter(s: np.ndarray) -> np.ndarray:
        return (s / (s + 1.0)) ** 2

    output = _filter_with_transfer_function(signals["response"], data.step, output_filter)[first:]
    for form in range(len(FORMS)):
        for late in np.arange(0.0, 0.61, 0.02):

            def element_response(s: np.ndarray, form=form, late=late) -> np.ndarray:
                return s ** (2 - form) / (s + 1.0) ** 2 * np.exp(-late * s)

            effect = _filter_with_transfer_function(hand, data.step, element_response)[first:]
            gain = float(effect @ output / max(effect @ effect, 1e-300))
            rest = float(np.sum((output - gain * effect) ** 2) / np.sum(output**2))
            best = min(best, (rest, form, gain, float(late)))
    rest, form, gain, late = best
    if rest > 0.2:
        notes.append("the controlled element is not K, K/s or K/s^2: no crossover is estimated")
        return ""
    rng = np.random.default_rng(1967)
    draws = rng.multivariate_normal(fit.log_parameters, fit.covariance, _SAMPLE_COUNT, check_valid="ignore")
    low, high = (np.log([_BOUNDS[n][side] for n in fit.names]) for side in (0, 1))
    draws = np.clip(draws, low, high)
    s = 1j * w
    element = abs(gain) * np.exp(-late * s) / s**form
    found = [_loop_margins(w, _operator_response(fit.kind, x, s) * element, form) for x in (fit.log_parameters, *draws)]
    for k, name in enumerate(("crossover", "phase_margin", "gain_margin")):
        values = np.array([one[k] for one in found[1:]])
        values = values[np.isfinite(values)]
        if not math.isfinite(found[0][k]) or len(values) < _SAMPLE_COUNT // 2:
            continue
        low, high = np.percentile(values, [2.5, 97.5])
        low, high = min(low, found[0][k]), max(high, found[0][k])
        known = bool(low > 0.0 and high / low < math.exp(2.0 * _STUDENT_QUANTILE * _MAX_LOG_ERROR))
        estimates[name] = ParameterEstimate(found[0][k], float(low), float(high), _UNITS[name], known)
    return FORMS[form]


def _loop_margins(w: np.ndarray, loop: np.ndarray, form: int) -> tuple[float, float, float]:
    """Return crossover frequency [rad/s], phase margin [rad], and loop gain at -180 degrees [1].

    `loop` is the open-loop response at the frequencies w; values that do not exist are NaN.
    """
    size, phase = np.log(np.abs(loop)), np.unwrap(np.angle(loop))
    phase -= 2.0 * math.pi * round((phase[0] + math.pi * (1.0 if form == 2 else 0.5)) / math.tau)
    falls = np.flatnonzero((size[:-1] >= 0.0) & (size[1:] < 0.0))
    turns = np.flatnonzero((phase[:-1] >= -math.pi) & (phase[1:] < -math.pi))
    crossover = margin = math.nan
    if len(falls):
        k = falls[0]
        share = size[k] / (size[k] - size[k + 1])
        crossover = float(w[k] * (w[k + 1] / w[k]) ** share)
        margin = float(math.pi + phase[k] + share * (phase[k + 1] - phase[k]))
    beyond = float(math.exp(size[turns[-1]])) if len(turns) else math.nan
    return crossover, margin, beyond


def format_operator_file(fit: OperatorFit, name: str, source: str) -> str:
    """Convert an identified operator to the YAML text of an operator file.

    A scenario uses the file as `perception: {file: ...}`.

    The file contains only the identifiable parameters; the others come from the default file.

    Args:
        fit: result of `identify_operator`.
        name: name of the operator.
        source: description of the record.

    Returns:
        The YAML text.

    Raises:
        InputError: no parameter is identifiable.
    """
    usual = load_operator_file().parameters
    lead = usual["lead_delay"].value if fit.equalisation == "lead" else 0.0
    known = {"visual_delay": "delay", "neuromuscular_frequency": "neuromuscular_frequency",
             "neuromuscular_damping": "neuromuscular_damping", "remnant": "remnant",
             "tracking_margin": "phase_margin", "gain_margin": "gain_margin"}  # fmt: skip
    parameters = {}
    for key, found in known.items():
        one = fit.estimates.get(found)
        if one is None or not one.identified:
            continue
        off = lead if key == "visual_delay" else 0.0
        value, low, high = (max(0.0, x - off) for x in (one.value, one.low, one.high))
        if key == "gain_margin" and not 0.0 < value < 1.0:
            continue
        parameters[key] = {
            "value": round(value, 5), "low": round(low, 5), "high": round(high, 5),
            "unit": one.unit, "basis": "identified", "source": source,
        }  # fmt: skip
    if not parameters:
        raise InputError(source, "no operator parameter is identifiable: use a longer record")
    document = {"name": name, "description": f"identified from {source}", "parameters": parameters}
    return yaml.safe_dump(document, sort_keys=False)
