"""The experiments of Abdellatif 2008 on the hexapod PaLiDA, section 5, in simulation.

Identification: base parameters, excitation, data processing, estimates and their covariance.
Control: what identified parameters buy.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import f

from hydrotele.core.files import models_folder
from hydrotele.experiments.finding import Finding, Panel, Progress, performed
from hydrotele.experiments.palida import (
    CHI2_95,
    HIGH,
    LOW,
    RATE,
    SYMBOLS,
    TABLE,
    Experiment,
    circle,
    control_gains,
    excitation,
    excited,
    experiment,
    force_covariance,
    limits,
    measured,
    robot,
    square,
    track,
)
from hydrotele.identify.estimation import Estimate, Reduction, estimate, reduce_parameters
from hydrotele.identify.excitation import Excitation, information
from hydrotele.identify.mechanism import ColumnMapping, in_coordinates, load_mechanism
from hydrotele.identify.motion import Processing, joint_motion, resolution
from hydrotele.identify.record import IdentificationRecord
from hydrotele.multibody.inverse_dynamics import project

_PERIODS = 4  # of the motion in one experiment
_HARMONICS = 5
_PUBLISHED = np.array([one.value for one in TABLE])
_STD = np.array([one.std for one in TABLE])
_RANDOM = 20  # motions to compare the designed one with


def base_parameters() -> Finding:
    """Which parameters the closed chain has, found from its regressor alone."""
    own = robot()
    said = [own.told.text(int(k)) for k in own.order]
    agrees = [_combination(text) == _combination(MEANING[k]) for k, text in enumerate(said[:10])]
    worst = float(np.abs(own.truth - _PUBLISHED).max())
    return Finding(
        "base parameters",
        "Table 1, section 5.1",
        "the rigid-body part contains 10 base parameters, the friction model 14: 24 in all",
        f"rank {len(own.told.base)} of {len(own.told.names)} columns, singular values across the"
        f" rank {own.told.gap[0]:.1e} and {own.told.gap[1]:.0e}; {sum(agrees)} of 10 combinations"
        f" have the members of Table 1; the model's differ from Table 2 by {worst:.0e} at most",
        len(own.told.base) == 24 and all(agrees) and worst < 1e-9,
    )


# Table 1 with the model's names. `m_3 sum(r_B)` are the platform joints' places. The table writes
# s_y3 for p5; beside I_yy2 + I_zz3 in p1, the strut's axis is z of frame 3, and so it is here.
MEANING = (
    "inertia_zz.ring_1 + inertia_yy.stator_1 + inertia_zz.slider_1",
    "inertia_xx.stator_1 + inertia_xx.slider_1 - inertia_yy.stator_1 - inertia_zz.slider_1",
    "inertia_zz.stator_1 + inertia_yy.slider_1",
    "moment_y.stator_1",
    "moment_z.slider_1",
    "inertia_xx.platform + 0.108075 mass.slider_1",
    "inertia_yy.platform + 0.108075 mass.slider_1",
    "inertia_zz.platform + 0.04335 mass.slider_1",
    "moment_z.platform + 0.72 mass.slider_1",
    "mass.platform + 6 mass.slider_1",
)


def _combination(text: str) -> dict[str, float]:
    """Member -> coefficient, without the model's armature, which Table 1 does not have."""
    out, sign = {}, 1.0
    size = 1.0
    for word in text.split():
        if word in "+-":
            sign = -1.0 if word == "-" else 1.0
        elif word[0].isdigit():
            size = float(word)
        else:
            if not word.startswith("drive_inertia"):
                out[word] = round(sign * size, 6)
            sign = size = 1.0
    return out


def friction_reduced(sets: int = 20) -> Finding:
    """From 24 friction parameters of the passive joints to 2, on many sets of data."""
    found = [reduced_friction(seed) for seed in range(sets)]
    good = sum(
        len(one.groups) == 24
        and sorted(len(g) for g in one.groups if _passive(g[0])) == [6, 6]
        and all(g[0].startswith("coulomb") for g in one.groups if _passive(g[0]))
        for one in found
    )
    steps = found[0].steps
    dropped, merged = (sum(s.action == a for s in steps) for a in ("drop", "merge"))
    figures = [s.figure for s in steps if s.action == "merge"]
    number = np.arange(len(steps))
    return Finding(
        "friction of the passive joints reduced",
        "sections 2.2 and 5.1",
        "parameters beneath the disturbance level are eliminated, those with high correlation get"
        " a common one; what is left is only dry friction, one parameter for all alpha joints and"
        " one for all beta joints",
        f"{good} of {sets} sets of data lead from {steps[0].parameters} parameters to these 24; in"
        f" the first, {dropped} are dropped and {merged} merged, with correlations from"
        f" {max(figures):.2f} down to {min(figures):.2f} that the residuals allow;"
        f" {steps[-1].parameters} are left",
        good >= 0.8 * sets,  # by its 5 % of false effects, 19 of 20 are expected
        (
            Panel("parameters left", number,
                  {"": np.array([s.parameters for s in steps], float)}, "step"),
            Panel("estimate over its standard deviation (dropped), correlation (merged) [1]",
                  number, {"": np.array([s.figure for s in steps])}, "step"),
            Panel("weighted squared residual per degree of freedom [1]", number,
                  {"": np.array([s.misfit for s in steps])}, "step"),
        ),
    )  # fmt: skip


def _passive(name: str) -> bool:
    return name.partition(".")[2].startswith(("alpha", "beta"))


def reduced_friction(seed: int = 0, periods: int = _PERIODS) -> Reduction:
    """Reduction of the model in which every passive hinge has dry and viscous friction."""
    own, folder = robot(), models_folder() / "palida"
    mapping = own.mechanism.mapping
    full = ColumnMapping(
        position=mapping.position, force=mapping.force, coordinates=mapping.coordinates,
        passive_friction=mapping.passive_friction, offsets=False,
        alike=tuple(g for g in mapping.alike if not g[0].startswith(("alpha", "beta"))),
        absent=tuple(a for a in mapping.absent if not a.startswith("viscous")),
    )  # fmt: skip
    setup = load_mechanism(folder / "palida.xml", full).setup
    data = mean_period(measured(excited(), periods, np.random.default_rng(seed)), excited().period)
    table = setup.table(project(setup.chain, setup.given, *data.motion))
    rigid = [one.column for one in TABLE[:10]]
    names = [*rigid, *(n for n in table.names if n.startswith(("coulomb", "viscous")))]
    columns = [table.names.index(name) for name in names]
    kinds = [
        [n for n in names if n.startswith(f"{kind}.{joint}")]
        for kind in ("coulomb", "viscous")
        for joint in ("alpha", "beta")
    ]
    return reduce_parameters(
        table.matrix[:, :, columns], data.force, data.covariance / periods, names, kinds
    )


def design() -> Finding:
    """The designed motion against random ones within the same limits."""
    own, best, bounds = robot(), excitation(), limits()
    time = np.arange(240) * best.period / 240
    base = own.told.base[own.order]
    rng, others = np.random.default_rng(0), []
    while len(others) < _RANDOM:
        wide = 0.3 * bounds.half[:, None] / np.arange(1, _HARMONICS + 1)
        one = Excitation(
            bounds.axes, best.period, bounds.middle, wide * rng.normal(size=(6, _HARMONICS)),
            wide * rng.normal(size=(6, _HARMONICS)), 0.0, 0.0, 24,
        )  # fmt: skip
        for _ in range(200):
            if _use(one, time) <= 1.0:
                break
            one = replace(one, sin=0.95 * one.sin, cos=0.95 * one.cos)
        others.append(_criterion(one, time, base))
    mine, use = _criterion(best, time, base), _use(best, time)
    motion = best.motion(time)[0]
    return Finding(
        "D-optimal excitation",
        "Fig. 5, equations (22) to (26)",
        "five harmonics per coordinate of the pose, optimised for ln det of the information with"
        " the disturbances' full covariance, under limits of the actuators",
        f"ln det {mine:.1f}; {len(others)} random motions scaled up to the same limits:"
        f" {max(others):.1f} at best, {np.median(others):.1f} in the median; the tightest limit is"
        f" used to {100 * use:.0f} %",
        mine > max(others) and use <= 1.0,
        (
            Panel("position [m]", time, dict(zip(("x", "y", "z"), motion.T[:3], strict=True))),
            Panel("orientation [deg]", time,
                  dict(zip(("phi", "theta", "psi"), np.degrees(motion.T[3:]), strict=True))),
            Panel("leg lengths [m]", time,
                  {f"{k + 1}": c for k, c in enumerate(own.lengths(motion).T)}),
        ),
    )  # fmt: skip


def _use(motion: Excitation, time: np.ndarray) -> float:
    whole, bounds = motion.motion(time), limits()
    inside = np.clip(whole[0], LOW, HIGH)
    return float(bounds.use(whole, np.stack([inside, whole[1], whole[2]])).max())


def _criterion(motion: Excitation, time: np.ndarray, base: np.ndarray) -> float:
    own = robot()
    held = information(own.setup, motion.motion(time), force_covariance(), base)
    return float(np.linalg.slogdet(held)[1])


class Processed(NamedTuple):
    """One period of data, ready for the regressor.

    Attributes:
        motion: (3, n, 6) poses, rates and accelerations.
        force: (n, 6) mean of all periods [N].
        covariance: (6, 6) of one force reading's noise, from the periods' differences [N^2].
    """

    motion: np.ndarray
    force: np.ndarray
    covariance: np.ndarray


def mean_period(record: IdentificationRecord, period: float) -> Processed:
    """Frequency-domain processing of repeated periods.

    The leg lengths' mean over the periods goes through forward kinematics; the pose keeps its first
    five harmonics and is differentiated with them.

    Args:
        record: leg lengths and forces of whole periods.
        period: [s].

    Returns:
        One period.

    Source: Abdellatif 2008, section 4.1, (27).
    """
    rows = round(period / record.period)
    length, force = (
        part.reshape(-1, rows, 6).copy() for part in (record.position, record.force)
    )  # fmt: skip
    mean, spare = force.mean(axis=0), len(force) - 1
    rest = (force - mean).reshape(-1, 6)
    lone = replace(record, position=length.mean(axis=0), force=mean)
    pose = in_coordinates(lone, robot().setup)
    found = resolution(pose.position, pose.period, pose.position_noise)
    way = Processing("periodic", period=period, harmonics=_HARMONICS)
    smoothed = joint_motion(pose.position, pose.period, found, way)
    motion = np.stack([smoothed.value, smoothed.rate, smoothed.acceleration])
    return Processed(motion, mean, rest.T @ rest / (max(spare, 1) * rows))


def gauss_markov(data: Processed, periods: int) -> Estimate:
    """Gauss-Markov estimate of Table 2's parameters, with the covariance of the periods."""
    return estimate(robot().matrix(data.motion), data.force, data.covariance / periods)


def trial(seed: int, periods: int = _PERIODS) -> tuple[np.ndarray, np.ndarray, float]:
    """One identification: estimates (24,), standard deviations (24,), squared distance of truth."""
    own, data = robot(), excited()
    record = measured(data, periods, np.random.default_rng([2008, seed]))
    found = gauss_markov(mean_period(record, data.period), periods)
    return found.value, found.std, found.ellipsoid(own.truth)


Trial = tuple[np.ndarray, np.ndarray, float]


def table_2(trials: Sequence[Trial]) -> Finding:
    """Estimates and standard deviations of the first trial."""
    value, std, _ = trials[0]
    away = np.abs(value - robot().truth) / _STD
    times = std / _STD
    worst = int(np.argmax(np.abs(np.log(times))))
    return Finding(
        "estimates and their standard deviations",
        "Table 2",
        "24 parameters with the printed standard deviations",
        f"first trial: at most {away.max():.2f} published standard deviations from the model's"
        f" values ({SYMBOLS[int(np.argmax(away))]}); own standard deviations {times.min():.2f} to"
        f" {times.max():.2f} times the published ones (farthest: {SYMBOLS[worst]}), geometric mean"
        f" {np.exp(np.mean(np.log(times))):.2f} (the noise level, one number, is chosen for this)",
        bool(away.max() < 2.0 and times.min() > 0.5 and times.max() < 2.0),
    )


def histories(trials: Sequence[Trial]) -> Finding:
    """Estimates of repeated trials within the 95 % interval about their mean."""
    values, stds = np.array([t[0] for t in trials]), np.array([t[1] for t in trials])
    mean, reach = values.mean(axis=0), 2.0 * stds.mean(axis=0)
    inside = np.mean(np.abs(values - mean) <= reach, axis=0)
    number, panels = np.arange(1.0, len(trials) + 1), []
    for k in (1, 4, 9, 10, 12, 18):
        ones = np.ones(len(trials))
        panels.append(Panel(
            f"{SYMBOLS[k]} over its mean [1]", number,
            {"estimate": values[:, k] / mean[k],
             "upper bound": (1.0 + abs(reach[k] / mean[k])) * ones,
             "lower bound": (1.0 - abs(reach[k] / mean[k])) * ones}, "trial",
        ))  # fmt: skip
    return Finding(
        "history of the estimates",
        "Fig. 8",
        "over 100 repeated experiments the estimates remain mostly within the 95 % confidence"
        " intervals",
        f"of {len(trials)} trials, {100 * inside.min():.0f} to {100 * inside.max():.0f} % per"
        f" parameter lie within two standard deviations of the mean, {100 * inside.mean():.1f} % of"
        " all",
        bool(inside.min() >= 0.85 and inside.mean() > 0.9),
        tuple(panels),
    )


def ellipsoid(trials: Sequence[Trial]) -> Finding:
    """Whole parameter sets against the 95 % confidence ellipsoid."""
    size = np.array([t[2] for t in trials])
    passed = int(np.sum(size < CHI2_95))
    low, high = 0.90 * len(trials), 0.99 * len(trials)
    number = np.arange(1.0, len(trials) + 1)
    return Finding(
        "confidence ellipsoid of the whole set",
        "Fig. 9",
        "excepting the first trial, all sets lie within the 95 % ellipsoid of radius 36.42",
        f"{passed} of {len(trials)} sets lie within it, mean {size.mean():.1f} (24 degrees of"
        " freedom); of independent trials with a right covariance 90 to 99 % should, all 100 would"
        " mean that it is too large",
        low <= passed <= high,
        (Panel("squared distance [1]", number,
               {"trial": size, "radius 36.42": np.full(len(size), CHI2_95)}, "trial"),),
    )  # fmt: skip


WAYS = ("raw", "zero_phase", "periodic")
_SAID = {"raw": "raw", "zero_phase": "time domain", "periodic": "frequency domain"}


def processed(record: IdentificationRecord, period: float, way: str) -> np.ndarray:
    """Poses, rates and accelerations (3, n, 6) of measured lengths, by one of the `WAYS`."""
    pose = in_coordinates(record, robot().setup)
    found = resolution(pose.position, pose.period, pose.position_noise)
    how = Processing("periodic", period=period, harmonics=_HARMONICS)
    smoothed = joint_motion(
        pose.position,
        pose.period,
        found,
        how if way == "periodic" else Processing(way),  # pyright: ignore
    )
    return np.stack([smoothed.value, smoothed.rate, smoothed.acceleration])


_SPEED, _RADIUS = 0.5, 0.10  # m/s and m, of the circle that judges


def unseen_circle() -> Experiment:
    """One lap of a circle at constant speed, which is no part of any fit."""
    lap = 2.0 * np.pi * _RADIUS / _SPEED
    rows = round(lap * RATE)
    angle = 2.0 * np.pi * np.arange(rows) / rows
    turn = 2.0 * np.pi / (rows / RATE)
    pose, rate, acceleration = np.zeros((3, rows, 6))
    pose[:] = 0.5 * (LOW + HIGH)
    pose[:, 0] += _RADIUS * np.cos(angle)
    pose[:, 1] += _RADIUS * np.sin(angle)
    rate[:, 0], rate[:, 1] = -_RADIUS * turn * np.sin(angle), _RADIUS * turn * np.cos(angle)
    acceleration[:, :2] = -(turn**2) * (pose[:, :2] - 0.5 * (LOW + HIGH)[:2])
    return experiment(np.stack([pose, rate, acceleration]), rows / RATE)


def signals(seed: int = 0, periods: int = 2) -> tuple[Finding, Finding]:
    """Reconstructed motion, and prediction on an unseen circle, by three ways of processing."""
    data, lap, own = excited(), unseen_circle(), robot()
    rng = np.random.default_rng([7, seed])
    record, judged = measured(data, periods, rng), measured(lap, 3, rng)
    true = np.tile(data.motion, (1, periods, 1))
    errors, variance, shown, rebuilt = {}, {}, {}, {}
    middle = slice(len(lap.force), 2 * len(lap.force))
    for way in WAYS:
        motion = processed(record, data.period, way)
        errors[way] = np.sqrt(np.mean((motion - true) ** 2, axis=(1, 2)))
        rebuilt[way] = motion[2, : len(data.force), 1]
        found = estimate(own.matrix(motion), record.force, force_covariance(), order=0)
        predicted = own.matrix(processed(judged, lap.period, way)[:, middle]) @ found.value
        variance[way] = float(np.mean((predicted - lap.force) ** 2))
        shown[way] = predicted[:, 4]
    time = np.arange(len(data.force)) / RATE
    rebuild = Finding(
        "reconstruction of the motion",
        "Fig. 6",
        "signals calculated in the frequency domain exhibit almost no noise",
        "RMS error of the accelerations: "
        + ", ".join(f"{errors[w][2]:.3g} m/s^2 or rad/s^2 {_SAID[w]}" for w in WAYS)
        + f"; of {np.sqrt(np.mean(true[2] ** 2)):.2g} in all",
        errors["periodic"][2] < 0.1 * errors["zero_phase"][2],
        (
            Panel("y acceleration, raw [m/s^2]", time, {"raw": rebuilt["raw"]}),
            Panel("y acceleration [m/s^2]", time,
                  {"frequency domain": rebuilt["periodic"], "time domain": rebuilt["zero_phase"]}),
        ),
    )  # fmt: skip
    time = np.arange(len(lap.force)) / RATE
    ratio = variance["periodic"] / variance["zero_phase"]
    predict = Finding(
        "prediction on an unseen circle",
        "Fig. 7",
        "frequency-domain processing yields the smallest error variance, time-domain filtering is"
        " not accurate enough, raw data are worst",
        "variance of predicted less true force: "
        + ", ".join(f"{variance[w]:.3g} N^2 {_SAID[w]}" for w in WAYS)
        + f"; frequency over time domain {ratio:.2f}, at most 0.5 asked for",
        ratio <= 0.5 and variance["zero_phase"] < variance["raw"],
        tuple(
            Panel(f"force of drive 5, {_SAID[w]} [N]", time,
                  {"predicted": shown[w], "true": lap.force[:, 4]})
            for w in ("raw", "zero_phase", "periodic")
        ),
    )  # fmt: skip
    return rebuild, predict


Bias = dict[tuple[str, str], np.ndarray]


def bias_trial(seed: int, periods: int = 2) -> Bias:
    """Estimates (24,) by estimator and data, where encoder noise is in positions and forces.

    The controllers react to the noise of the encoders, so that it is in the forces, too, and the
    disturbances of regressor and forces are cross-correlated.
    """
    own, data = robot(), excited()
    record = measured(data, periods, np.random.default_rng([21, seed]), control_gains())
    out: Bias = {}
    sampled = own.matrix(processed(record, data.period, "raw"))
    mean = mean_period(record, data.period)
    averaged = own.matrix(mean.motion)
    out["least squares", "samples"] = _least_squares(sampled, record.force)
    out["Gauss-Markov", "samples"] = estimate(
        sampled, record.force, mean.covariance, order=0
    ).value  # fmt: skip
    out["least squares", "periods"] = _least_squares(averaged, mean.force)
    out["Gauss-Markov", "periods"] = estimate(
        averaged, mean.force, mean.covariance, order=0
    ).value  # fmt: skip
    return out


def _least_squares(matrix: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Ordinary least squares: every equation counts alike."""
    return np.linalg.lstsq(matrix.reshape(-1, matrix.shape[2]), force.ravel(), rcond=None)[0]


def biased(trials: Sequence[Bias]) -> Finding:
    """Hotelling's t-test of the mean of many estimates against the truth."""
    truth, said, bias = robot().truth, [], {}
    n, p = len(trials), len(truth)
    for key in trials[0]:
        error = np.array([one[key] for one in trials]) - truth
        mean = error.mean(axis=0)
        squared = n * mean @ np.linalg.solve(np.cov(error.T), mean)
        chance = float(f.sf(squared * (n - p) / (p * (n - 1)), p, n - p))
        bias[key] = chance < 0.05
        worst = float(np.max(np.abs(mean) / _STD))
        said.append(
            f"{key[0]} on {key[1]}: p = {chance:.2g}, mean off by up to {worst:.2g} published"
            " standard deviations"
        )
    return Finding(
        "least squares biased",
        "section 3, after (21)",
        "neglecting the disturbances' cross-correlation by simple least squares leads to biased"
        " estimates",
        f"{n} trials, controllers that react to the encoders' noise; {'; '.join(said)}",
        bias["least squares", "samples"] and not bias["Gauss-Markov", "periods"],
    )


def least_squares_exact(trials: Sequence[tuple[np.ndarray, float, float]]) -> Finding:
    """What cross-correlation of the forces alone does: nothing to the mean, much to the spread."""
    truth = robot().truth
    error = np.array([t[0] for t in trials]) - truth
    n, p = error.shape
    mean = error.mean(axis=0)
    squared = n * mean @ np.linalg.solve(np.cov(error.T), mean)
    chance = float(f.sf(squared * (n - p) / (p * (n - 1)), p, n - p))
    inside = np.mean([t[1] < CHI2_95 for t in trials])
    wide = np.exp(np.mean([t[2] for t in trials]))
    return Finding(
        "least squares where only forces are cross-correlated",
        "section 3, after (21)",
        "neglecting the disturbances' cross-correlation by simple least squares leads to biased"
        " estimates",
        f"{n} trials: {'a' if chance < 0.05 else 'no'} bias is seen (p = {chance:.2g}); linear"
        " algebra says that there is none where the regressor has no noise. But standard"
        f" deviations are {wide:.2f} times those of Gauss-Markov, and"
        f" {100 * inside:.0f} % of the sets lie within the ellipsoid that least squares claims",
        chance < 0.05,
    )


def exact_trial(seed: int, periods: int = _PERIODS) -> tuple[np.ndarray, float, float]:
    """Ordinary least squares on mean periods.

    Returns:
        Estimates (24,), squared distance of the truth by the covariance that it claims, and the
        mean logarithm of its true standard deviations over those of Gauss-Markov.
    """
    own, data = robot(), excited()
    record = measured(data, periods, np.random.default_rng([2008, seed]))
    mean = mean_period(record, data.period)
    matrix = own.matrix(mean.motion)
    value = _least_squares(matrix, mean.force)
    flat = matrix.reshape(-1, matrix.shape[2])
    normal = np.linalg.inv(flat.T @ flat)
    error = mean.force - matrix @ value
    claimed = normal * np.sum(error**2) / (error.size - len(value))
    away = value - own.truth
    cover = force_covariance() / periods
    inverse = np.linalg.inv(cover)
    best = np.linalg.inv(np.einsum("nkp,kl,nlq->pq", matrix, inverse, matrix, optimize=True))
    true = normal @ np.einsum("nkp,kl,nlq->pq", matrix, cover, matrix, optimize=True) @ normal
    wide = 0.5 * np.mean(np.log(np.diag(true) / np.diag(best)))
    return value, float(away @ np.linalg.solve(claimed, away)), float(wide)


SPEEDS = (0.25, 0.5, 0.75, 1.0)  # m/s, of the tool
STRATEGIES = ("linear control", "nominal feedforward", "identified feedforward")
_PATHS: dict[str, Callable[..., np.ndarray]] = {"circle": circle, "square": square}


class Control(NamedTuple):
    """One path at one speed under all strategies.

    Attributes:
        path: its name.
        speed: of the tool [m/s].
        time: (n,) [s].
        error: strategy -> (n, 6) errors of the leg lengths [m].
        pose_error: strategy -> (n, 6) errors of the pose [m], [rad].
        warnings: of MuJoCo.
    """

    path: str
    speed: float
    time: np.ndarray
    error: dict[str, np.ndarray]
    pose_error: dict[str, np.ndarray]
    warnings: int


def controlled(path: str, speed: float, laps: float = 1.0) -> Control:
    """Drive a path with all strategies; identified parameters are those of the first trial."""
    identified, _, _ = trial(0)
    motion = _PATHS[path](speed, laps=laps)
    prior = np.array([one.prior for one in TABLE])
    error, pose, warnings, time = {}, {}, 0, np.zeros(0)
    for name, model in zip(STRATEGIES, (None, prior, identified), strict=True):
        found = track(motion, model)
        error[name], pose[name], time = found.error, found.pose_error, found.time
        warnings += found.warnings
    return Control(path, speed, time, error, pose, warnings)


def control(runs: Sequence[Control]) -> list[Finding]:
    """Figs 10 to 12."""
    out = []
    for path in _PATHS:
        some = [run for run in runs if run.path == path]
        speeds = np.array([run.speed for run in some])
        rms = {s: 1e3 * np.array([np.sqrt(np.mean(r.error[s] ** 2)) for r in some])
               for s in STRATEGIES}  # fmt: skip
        none, nominal, best = (rms[s] for s in STRATEGIES)
        grows = bool((np.diff(nominal - best) > 0).all() and none[-1] - nominal[-1] > none[0] -
                     nominal[0])  # fmt: skip
        rows = "; ".join(
            f"{v:g} m/s: {a:.3f}, {b:.3f}, {c:.3f} mm"
            for v, a, b, c in zip(speeds, none, nominal, best, strict=True)
        )
        out.append(Finding(
            f"control errors on the {path}",
            "Fig. 10",
            "linear control alone loses accuracy with speed, model knowledge always improves it,"
            " and the identified model clearly outperforms the nominal one",
            f"RMS of all actuators with linear control, nominal, identified: {rows}; the margin of"
            f" identified over nominal {'grows' if grows else 'does not grow'} with speed",
            bool((best < nominal).all() and (nominal < none).all() and grows)
            and not any(r.warnings for r in some),
            (Panel("RMS actuator error [mm]", speeds, rms, "speed [m/s]"),),
        ))  # fmt: skip
    fast = [max((r for r in runs if r.path == p), key=lambda r: r.speed) for p in _PATHS]
    for title, figure, said, of in (
        ("actuator 5", "Fig. 11", "tracking accuracy of actuator 5",
         lambda r, s: 1e3 * r.error[s][:, 4]),
        ("Cartesian", "Fig. 12", "Cartesian tracking accuracy",
         lambda r, s: 1e3 * np.linalg.norm(r.pose_error[s][:, :3], axis=1)),
    ):  # fmt: skip
        size = {(r.path, s): float(np.sqrt(np.mean(of(r, s) ** 2)))
                for r in fast for s in STRATEGIES[1:]}  # fmt: skip
        out.append(Finding(
            f"{title} error at the highest speed",
            figure,
            f"{said} is higher with the identified than with the nominal model",
            ", ".join(f"{path}: {size[path, STRATEGIES[1]]:.3f} mm nominal,"
                      f" {size[path, STRATEGIES[2]]:.3f} mm identified" for path in _PATHS),
            all(size[p, STRATEGIES[2]] < size[p, STRATEGIES[1]] for p in _PATHS),
            tuple(Panel(f"error on the {r.path} [mm]", r.time,
                        {s: of(r, s) for s in STRATEGIES[1:]}) for r in fast),
        ))  # fmt: skip
    return out


def abdellatif2008(
    seeds: int = 100, jobs: int | None = None, progress: Progress | None = None
) -> list[Finding]:
    """Run all experiments.

    Args:
        seeds: trials of the repeated identification; 100 in the document.
        jobs: processes; as many as there are cores by default.
        progress: called with what is done and the share that is done.

    Returns:
        The findings, in the order of the document.
    """
    tasks: list[tuple[Callable[..., Any], tuple]] = [
        (base_parameters, ()), (friction_reduced, ()), (design, ()), (signals, ()),
        *((trial, (seed,)) for seed in range(seeds)),
        *((exact_trial, (seed,)) for seed in range(seeds)),
        *((bias_trial, (seed,)) for seed in range(max(40, seeds // 2))),
        *((controlled, (path, speed)) for path in _PATHS for speed in SPEEDS),
    ]  # fmt: skip
    tasks.sort(key=lambda task: task[0] is not controlled)  # the longest first
    done: dict[Callable, list] = {}
    for number, result in enumerate(performed(tasks, jobs)):
        done.setdefault(tasks[number][0], []).append(result)
        if progress:
            what = tasks[number][0].__name__.replace("_", " ")
            progress(what, (number + 1) / len(tasks))
    trials = done[trial]
    return [
        done[base_parameters][0], done[friction_reduced][0], done[design][0], *done[signals][0],
        table_2(trials), histories(trials), ellipsoid(trials),
        least_squares_exact(done[exact_trial]), biased(done[bias_trial]),
        *control(done[controlled]),
    ]  # fmt: skip
