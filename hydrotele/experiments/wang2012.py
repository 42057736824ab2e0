"""Wang 2012: kinematic calibration of the serial-parallel robot IWR, repeated in simulation.

The published text that we have ends with section 3.1.2 (page 34); of what follows the lists of
figures and tables say what was done. Dimensions, noise and errors are chosen here
(models/iwr/README.md), so that rows compare what is claimed, not digits.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.calibrate.estimation import Prior
from hydrotele.calibrate.hybrid import (
    Calibration,
    Equations,
    calibrate,
    equations,
    redundancy,
    subset,
)
from hydrotele.calibrate.hybrid_data import Measurement, measurement_of_wires
from hydrotele.calibrate.posterior import Evolution, Posterior, evolve, sample_posterior
from hydrotele.experiments.finding import Finding, Marginals, Panel, Progress, performed
from hydrotele.kinematics.hybrid import (
    ErrorModel,
    Hybrid,
    Pose,
    carriage_pose,
    corrected,
    document_parameters,
    error_model,
    first_order,
    forward,
    forward_evolution,
    inverse,
    leg_readings,
    load_hybrid,
    pose_difference,
)
from hydrotele.kinematics.wires import pose_covariance, pose_of_wires, wire_lengths
from hydrotele.simulate.hybrid import (
    hybrid_mechanism,
    manufactured_errors,
    measured_poses,
    mechanism_pose,
    random_poses,
    shipped_wires,
)

NOISE = {"leg": 1e-5, "slide": 1e-5, "turn": 2e-5, "wire": 2e-5}  # m, rad
ACCURACY = 1e-4  # m: "high accuracy (+-0.1 mm)", page 19
_EXACT = 1e-9  # m and rad: far below any sensor, far above rounding
_SEED = 2012
_BOX = 5.0  # sizes of the errors that DE searches
_CAPTIONS = {
    12: ("a4", "theta4", "a1x", "a2x"), 13: ("a4", "a3x", "a4x", "a5x"),
    15: ("d4", "a3y", "a4y", "a5y"), 16: ("theta4", "a1z", "a2z", "a3z"),
    17: ("alpha4", "a1z", "a2z", "a3z"),
}  # fmt: skip
"""Figure -> the parameters that its caption names; Fig. 14 has one (dd) of no known meaning."""


class Trial(NamedTuple):
    """A robot as built, measured.

    Attributes:
        model: error model of its errors.
        errors: (p,) planted.
        robot: as built.
        measurement: poses to calibrate from.
        unused: true commands of further poses: joints (M, n) and leg readings (M, 6).
    """

    model: ErrorModel
    errors: np.ndarray
    robot: Hybrid
    measurement: Measurement
    unused: tuple[np.ndarray, np.ndarray]


def trial(
    seed: int, poses: int, kind: str = "dh", document: bool = True, noise: float = 1.0,
    unused: int = 25,
) -> Trial:  # fmt: skip
    """Build a robot with errors of 1 mm and 1 mrad, and measure it with wires.

    Args:
        seed: of errors, poses and noise.
        poses: to calibrate from.
        kind: error model of the planted errors.
        document: plant errors in the document's 36 parameters only.
        noise: factor on `NOISE`; 0 measures exactly.
        unused: number of further poses.
    """
    rng, wires, nominal = np.random.default_rng([_SEED, seed]), shipped_wires(), load_hybrid("iwr")
    model = error_model(nominal, "dh" if kind == "dh" else "poe")
    errors = manufactured_errors(model, rng, document_parameters(model) if document else None)
    built = corrected(model, errors)
    sizes = {name: noise * size for name, size in NOISE.items()}
    read = measured_poses(built, *random_poses(nominal, poses, rng, wires), wires, sizes, rng)
    stated = sizes if noise > 0.0 else NOISE
    measurement = measurement_of_wires(
        nominal, read.joints, read.legs, read.wires, wires, stated, f"trial {seed}"
    )
    return Trial(model, errors, built, measurement, random_poses(nominal, unused, rng, wires))


def unused_errors(one: Trial, robot: Hybrid) -> tuple[np.ndarray, np.ndarray]:
    """Errors of a robot's forward kinematics at the poses not used: (M,) [m] and (M,) [rad]."""
    away = pose_difference(forward(robot, *one.unused), forward(one.robot, *one.unused))
    return np.linalg.norm(away[:, :3], axis=1), np.linalg.norm(away[:, 3:], axis=1)


def kinematics() -> list[Finding]:
    """Table 1 and Eq. 7, the counts of parameters, first-order errors, forward kinematics."""
    robot, rng = load_hybrid("iwr"), np.random.default_rng(_SEED)
    joints, legs = random_poses(robot, 200, rng)
    d1, d2, q3, q4 = joints.T
    a3, d3, a4 = robot.facts.carriage[2].a, robot.facts.carriage[2].d, robot.facts.carriage[3].a
    c3, s3, c4, s4 = np.cos(q3), np.sin(q3), np.cos(q4), np.sin(q4)
    printed = np.column_stack([
        d3 + a4 * s4, -(d2 + a3 * s3 + a4 * s3 * c4), d1 + a3 * c3 + a4 * c3 * c4,
    ])  # fmt: skip
    carriage = carriage_pose(robot, joints)
    off = np.abs(carriage[:, :3, 3] - printed).max()
    findings = [Finding(
        "carriage: forward kinematics", "Table 1, Eq. 7 (page 29)",
        "the product of the four D-H matrices of Table 1 puts the carriage's end at"
        " (d3 + a4 s4, d2 + a3 s3 + a4 s3 c4, d1 + a3 c3 + a4 c3 c4); minus signs are lost in the"
        " text that we have, Table 1 makes the second one negative",
        f"largest difference at 200 random poses {off:.1e} m (criterion: 1e-9 m, rounding)",
        off < _EXACT,
    )]  # fmt: skip
    findings += [_counts(robot), _free_counts(robot), _linear(robot, joints)]
    pose = forward(robot, joints, legs)
    newton = np.abs(leg_readings(robot, joints, pose) - legs).max()
    model = hybrid_mechanism(robot).compile()
    data = mujoco.MjData(model)
    worst_evolution = worst_mechanism = 0.0
    for k in range(5):
        one = Pose(pose.rotation[k], pose.position[k])
        evolved = forward_evolution(robot, joints[k], legs[k], seed=k)
        worst_evolution = max(worst_evolution, np.abs(pose_difference(evolved, one)).max())
        closed = mechanism_pose(model, data, robot, joints[k], legs[k])
        worst_mechanism = max(worst_mechanism, np.abs(pose_difference(closed, one)).max())
    findings.append(Finding(
        "hexapod: forward kinematics by DE", "section 2.2 (page 26), Eqs 8 and 11",
        "differential evolution finds numerical solutions of the robot's forward kinematics",
        f"DE and Newton's method differ by at most {worst_evolution:.1e} m or rad at 5 poses, the"
        f" closed-chain MuJoCo model and Newton's by {worst_mechanism:.1e}; the inverse kinematics"
        f" gives the lengths back to {newton:.1e} m (criterion: 1e-6, a hundredth of the accuracy)",
        max(worst_evolution, worst_mechanism, newton) < 0.01 * ACCURACY,
    ))  # fmt: skip
    return findings


def _counts(robot: Hybrid) -> Finding:
    count = len(error_model(robot, "dh").names)
    carriage = error_model(robot, "dh").carriage_count
    return Finding(
        "number of parameter errors",
        "section 3.1.2 (page 34)",
        "12 of the carriage (4 per revolute, 2 per prismatic joint) and 7 per leg, 42, of the"
        " Hexa-WH",
        f"{carriage} and {count - carriage}, {count} together",
        (carriage, count - carriage) == (12, 42),
    )


def _free_counts(robot: Hybrid) -> Finding:
    """Ranks against the counting formulas, from constants that may err in all six directions."""
    rng = np.random.default_rng(_SEED)
    joints, legs = random_poses(robot, 60, rng)
    step, columns = 1e-6, []
    for i in range(len(robot.constants)):
        for k in range(6):
            both = []
            for sign in (1.0, -1.0):
                change = np.eye(4)
                move = np.zeros(6)
                move[k] = sign * step
                x, y, z = move[3:]
                change[:3, :3] += [[0, -z, y], [z, 0, -x], [-y, x, 0]]
                change[:3, 3] = move[:3]
                constants = robot.constants.copy()
                constants[i] = constants[i] @ change
                both.append(carriage_pose(replace(robot, constants=constants), joints)[:, :3])
            columns.append(((both[0] - both[1]) / (2 * step)).ravel())
    serial = _rank(np.array(columns).T, 1e-6)
    model = error_model(robot, "dh")
    eq = equations(model, _exact(robot, joints, legs), model.names[model.carriage_count :])
    hexapod = redundancy(eq).rank
    return Finding(
        "independent parameters: counting formulas",
        "Eqs 4 and 5 (pages 23 and 24)",
        "C = 4R + 2P + T: 18 for the carriage with its pose measured; C = SS + 6L + 6(F - 1) of Eq."
        " 5: 42 for six legs between points (6 pairs, 5 loops, 2 frames)",
        f"rank {serial} of the carriage with errors in all directions of all links; rank {hexapod}"
        " of the hexapod's 42",
        (serial, hexapod) == (18, 42),
    )


def _rank(matrix: np.ndarray, share: float) -> int:
    length = np.linalg.norm(matrix, axis=0)
    there = length > share * length.max()
    s = np.linalg.svd(matrix[:, there] / length[there], compute_uv=False)
    return int(np.sum(s > share * s[0]))


def _linear(robot: Hybrid, joints: np.ndarray) -> Finding:
    model, rng = error_model(robot, "dh"), np.random.default_rng(_SEED)
    worst, moved = 0.0, 0.0
    for _ in range(20):
        errors = manufactured_errors(model, rng)
        true = carriage_pose(corrected(model, errors), joints)[:, :3, 3]
        straight = first_order(robot, errors[: model.carriage_count], joints)[:, :3, 3]
        nominal = carriage_pose(robot, joints)[:, :3, 3]
        worst = max(worst, float(np.linalg.norm(straight - true, axis=1).max()))
        moved = max(moved, float(np.linalg.norm(nominal - true, axis=1).max()))
    return Finding(
        "first-order error model",
        "Eqs 12 to 26 (pages 31 to 33)",
        "the first-order model is sufficiently accurate for most applications",
        f"of up to {1e3 * moved:.2f} mm at the carriage's end it leaves out {1e3 * worst:.4f} mm"
        " (20 robots with errors of 1 mm and 1 mrad, 200 poses; criterion: below the accuracy that"
        " is required, 0.1 mm)",
        worst < ACCURACY,
    )


def _exact(robot: Hybrid, joints: np.ndarray, legs: np.ndarray) -> Measurement:
    """Exact measurement of the nominal robot."""
    wires = shipped_wires()
    lengths = wire_lengths(wires, forward(robot, joints, legs))
    return measurement_of_wires(robot, joints, legs, lengths, wires, NOISE, "exact")


def parameters_54(steps: int) -> list[Finding]:
    """Redundancy of the 54 parameters: SVD and QR against posterior correlation."""
    one = trial(54, 25, document=False)
    eq = equations(one.model, one.measurement)
    told = redundancy(eq)
    scales = eq.scales
    prior = Prior(np.zeros(54), scales)
    fit = calibrate(load_hybrid("iwr"), one.measurement, "dh", prior=prior).fit
    sample = sample_posterior(
        lambda x: -eq.misfit(x) - 0.5 * np.sum((x / scales) ** 2, axis=1), fit.values,
        fit.covariance, eq.names, steps=steps, burn=1000, walkers=110, seed=_SEED,
    )  # fmt: skip
    scaled = sample.flat / scales
    size, vectors = np.linalg.eigh(np.cov(scaled, rowvar=False))
    unknown = vectors[:, size > 0.5]  # of which the data tell less than the prior did
    _, singular, rows = np.linalg.svd(eq.jacobian(np.zeros(54)) * scales)
    hidden = rows[singular < 1.0]  # the same by the Jacobian: an effect below the noise
    angles = [_angle(told.directions, unknown), _angle(hidden, unknown)]
    same = unknown.shape[1] == len(hidden)
    correlation = np.abs(np.corrcoef(scaled, rowvar=False))
    at = {name: k for k, name in enumerate(eq.names)}
    pairs = {(f"Fig. {figure}", names[0], other): correlation[at[names[0]], at[other]]
             for figure, names in _CAPTIONS.items() for other in names[1:]
             if other[0] == "a" and other[-1] in "xyz"}  # fmt: skip
    least = min(pairs, key=lambda key: pairs[key])
    involved = {n for names in _CAPTIONS.values() for n in names} <= set(told.takes_part)
    shown = [at[n] for n in ("a4", "theta4", "a1x", "a2x", "a1z")]
    tilt_free = _without_tilt()
    return [
        Finding(
            "54 parameters: the redundancy, by two methods", "section 4.2.1, Table 3 (title)",
            "QR of the identification Jacobian (section 2.1) and MCMC posteriors show which"
            " parameters are redundant",
            f"SVD and QR: rank {told.rank}, {len(told.held)} redundant; {told.words[0]}. MCMC"
            f" ({sample.status}): {unknown.shape[1]} directions of which the data tell less than 1"
            f" mm or 1 mrad; by singular values below the noise {len(hidden)}. The null space lies"
            f" within {angles[0]:.2f} deg of those of MCMC, all below the noise within"
            f" {angles[1]:.1f} deg (criterion: same number, 5 and 20 deg, sample converged)",
            same and angles[0] < 5.0 and angles[1] < 20.0 and sample.converged,
            marginals=Marginals(tuple(eq.names[k] for k in shown),
                                1e3 * sample.flat[:, shown], 1e3 * one.errors[shown]),
        ),
        Finding(
            "54 parameters: what is correlated", "captions of Figs 12, 13, 15, 16 and 17",
            "a4 with a1x to a5x, d4 with a3y to a5y, theta4 and alpha4 with a1z to a3z",
            f"all of them take part in the null space: {'yes' if involved else 'no'}; least"
            f" posterior correlation {pairs[least]:.2f} ({least[0]}: {least[1]} and {least[2]};"
            " criterion: 0.3 each). theta4 and alpha4 act on z of all A_i at once, in shares that"
            " the dimensions decide",
            involved and pairs[least] > 0.3,
        ),
        Finding(
            "54 parameters: how many are left", "titles of Tables 3 to 5",
            "54 parameters are refined to 36",
            f"{told.rank} are independent, {len(told.told)} are told better than half of 1 mm or"
            f" 1 mrad by this noise. Without tilt of the platform {tilt_free[0]} (D-H) and"
            f" {tilt_free[1]} (POE) would be: then A_i and B_i cannot be told apart, and 36 is what"
            " 54 leave without the 18 coordinates of A_i (criterion: 36 independent ones)",
            told.rank == 36,
            (Panel("singular values of the Jacobian, columns of length 1", np.arange(1, 55),
                   {"54 parameters": np.maximum(told.singular, 1e-16)}, "number", True),),
        ),
    ]  # fmt: skip


def _angle(inner: np.ndarray, outer: np.ndarray) -> float:
    """Largest angle [deg] of orthonormal rows (k, p) with a space of orthonormal columns."""
    if len(inner) > outer.shape[1]:
        return 90.0
    overlap = np.linalg.svd(inner @ outer, compute_uv=False)
    return float(np.degrees(np.arccos(np.clip(overlap.min(), 0.0, 1.0))))


def _without_tilt() -> tuple[int, int]:
    """Ranks of both models where the platform stays parallel to the connecting platform."""
    robot, rng = load_hybrid("iwr"), np.random.default_rng(_SEED)
    joints, legs = random_poses(robot, 60, rng, tilt=0.0)
    measured = _exact(robot, joints, legs)
    ranks = [redundancy(equations(error_model(robot, kind), measured)).rank
             for kind in ("dh", "poe")]  # fmt: skip
    return ranks[0], ranks[1]


def refined_exact() -> Finding:
    """Table 4: the 36 parameters without noise."""
    one = trial(4, 25, noise=0.0)
    done = calibrate(load_hybrid("iwr"), one.measurement, "dh", document_parameters(one.model))
    kept = one.model.index(done.fit.names)
    worst = float(np.abs(done.fit.values - one.errors[kept]).max())
    return Finding(
        "36 parameters without noise",
        "Table 4 (title)",
        "the refined 36-parameter model without measurement noise: assumed and identified errors",
        f"rank {done.redundancy.rank}; least squares brings back every assumed error to"
        f" {worst:.1e} m or rad (criterion: rank 36 and 1e-9)",
        done.redundancy.rank == 36 and worst < _EXACT,
    )


def refined_noisy(steps: int) -> list[Finding]:
    """Table 5, Fig. 18: 36 parameters with noise, by least squares, DE and MCMC."""
    one = trial(5, 25)
    names = document_parameters(one.model)
    done = calibrate(load_hybrid("iwr"), one.measurement, "dh", names)
    eq, fit = subset(done), done.fit
    evolved = _evolved(eq)
    sample = _sampled(eq, fit, steps)
    of_evolution = float(np.max(np.abs(evolved.values - fit.values) / fit.deviations))
    of_sample = float(np.max(np.abs(sample.mean - fit.values) / fit.deviations))
    ratio = sample.deviations / fit.deviations
    truth = one.errors[one.model.index(names)]
    inside = int(np.sum((truth > sample.intervals[:, 0]) & (truth < sample.intervals[:, 1])))
    before, after = unused_errors(one, done.model.nominal), unused_errors(one, done.robot)
    shown = [names.index(n) for n in ("a4", "theta4", "b1x", "b6z")]
    poses = np.arange(1, len(before[0]) + 1)
    return [
        Finding(
            "36 parameters with noise: three methods", "Table 5 (title), Fig. 18 (caption)",
            "posterior means and standard deviations of the 36 parameters with measurement noise",
            f"DE differs from least squares by at most {of_evolution:.2f} standard deviations, the"
            f" posterior means by {of_sample:.2f}; posterior over least-squares deviations"
            f" {ratio.min():.2f} to {ratio.max():.2f}; {sample.status}; {inside} of 36 assumed"
            " errors within the posteriors' 95 % (criterion: within 0.5 and 0.2 deviations, 0.9 to"
            " 1.1, sample converged, at least 31: fewer are seen in 1 % of such trials)",
            of_evolution < 0.5 and of_sample < 0.2 and 0.9 < ratio.min() and ratio.max() < 1.1
            and sample.converged and inside >= 31,
            marginals=Marginals(tuple(names[k] for k in shown), 1e3 * sample.flat[:, shown],
                                1e3 * truth[shown]),
        ),
        Finding(
            "36 parameters with noise: poses not used", "abstract, section 1.1 (page 19)",
            "an accuracy of +-0.1 mm is required; calibration corrects the robot's errors",
            f"position error at 25 poses not used: RMS {_mm(before[0]):.2f} mm before,"
            f" {_mm(after[0]):.3f} mm after, largest {1e3 * before[0].max():.2f} and"
            f" {1e3 * after[0].max():.3f} mm (criterion: from above 1 mm to below 0.1 mm, RMS and"
            " largest)",
            _mm(before[0]) > 1.0 and after[0].max() < ACCURACY,
            (Panel("position error at poses not used [mm]", poses,
                   {"before": 1e3 * before[0], "after": 1e3 * after[0]}, "pose", True),),
        ),
    ]  # fmt: skip


def _mm(errors: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(np.mean(errors**2)))


def _evolved(eq: Equations, seed: int = 0) -> Evolution:
    return evolve(eq.misfit, -_BOX * eq.scales, _BOX * eq.scales, seed=seed)


def _sampled(eq: Equations, fit, steps: int) -> Posterior:
    free = ~fit.held
    return sample_posterior(
        lambda x: -eq.misfit(x), fit.values[free], fit.covariance[np.ix_(free, free)], eq.names,
        steps=steps, burn=steps // 8, seed=_SEED,
    )  # fmt: skip


def evolution_run(kind: str, seed: int, poses: int) -> tuple[np.ndarray, float, float]:
    """A search by DE of the 36 parameters: history, final and least-squares misfit per equation."""
    one = trial(seed, poses, kind)
    names = document_parameters(one.model)
    done = calibrate(load_hybrid("iwr"), one.measurement, one.model.kind, names)
    eq = subset(done)
    found = _evolved(eq, seed)
    best = float(eq.misfit(done.fit.values[~done.fit.held][None])[0])
    return found.history, found.cost, best


def evolution_runs(results, kind: str) -> Finding:
    """Figs 10, 11 (D-H) and 19 (POE): DE on several data sets."""
    excess = [cost - best for _, cost, best in results]
    longest = max(len(history) for history, _, _ in results)
    curves = {f"set {k}": np.pad(h, (0, longest - len(h)), mode="edge")
              for k, (h, _, _) in enumerate(results, 1)}  # fmt: skip
    source, what = (
        (
            "Figs 10 and 11 (captions), section 4.1",
            "simulation results of four data sets, and of 15 measurement poses in five different"
            " data sets",
        )
        if kind == "dh"
        else (
            "Fig. 19 (caption), section 4.3",
            "fitness values of four different runs with four different measurement data sets",
        )
    )
    return Finding(
        f"DE on {len(results)} data sets ({'D-H' if kind == 'dh' else 'POE'} model)", source,
        f"{what}: DE identifies the parameter errors",
        f"cost above that of least squares: {', '.join(f'{e:.3f}' for e in excess)} in units of log"
        f" likelihood, after {min(len(h) for h, _, _ in results)} to {longest} generations"
        " (criterion: 0.5 each, about a standard deviation of one parameter)",
        all(-1e-6 < e < 0.5 for e in excess),
        (Panel("best cost of a generation [log likelihood]", np.arange(1, longest + 1), curves,
               "generation", True),),
    )  # fmt: skip


def poe_poses() -> Finding:
    """Tables 7 to 9, Figs 20 and 21: the POE model, 25 poses before and after."""
    one = trial(9, 25, "poe")
    done = calibrate(load_hybrid("iwr"), one.measurement, "poe", document_parameters(one.model))
    before, after = done.before, done.after
    poses = np.arange(1, 26)
    unused = unused_errors(one, done.robot)[0]
    return Finding(
        "POE model: 25 poses before and after", "Table 9, Figs 20 and 21 (captions)",
        "position errors in the 25 end-effector poses, before and after calibration",
        f"RMS {_mm(before.position):.2f} mm before, {_mm(after.position):.3f} mm after at the"
        f" measured poses; {_mm(unused):.3f} mm at 25 others (criterion: every pose better, RMS"
        " below 0.1 mm at both)",
        bool((after.position < before.position).all())
        and max(_mm(after.position), _mm(unused)) < 0.1,
        (Panel("position error [mm]", poses, {"before": 1e3 * before.position,
               "after": 1e3 * after.position}, "pose", True),),
    )  # fmt: skip


def wire_method() -> Finding:
    """Chapter 5: 3-2-1 wires, three spheres, and how their errors reach the pose."""
    robot, wires = load_hybrid("iwr"), shipped_wires()
    rng = np.random.default_rng(_SEED)
    pose = forward(robot, *random_poses(robot, 100, rng, wires))
    lengths = wire_lengths(wires, pose)
    exact = np.abs(pose_difference(pose_of_wires(wires, lengths, pose), pose)).max()
    sigma = NOISE["wire"]
    covariance = pose_covariance(wires, pose, sigma)
    inverse_ = np.linalg.inv(covariance)
    squares = []
    for _ in range(50):
        noisy = lengths + sigma * rng.normal(size=lengths.shape)
        away = pose_difference(pose_of_wires(wires, noisy, pose), pose)
        squares.append(np.einsum("ni,nij,nj->n", away, inverse_, away))
    ratio = float(np.mean(squares) / 6.0)
    deviations = np.sqrt(np.einsum("nii->ni", covariance))
    position, turn = (np.median(np.linalg.norm(deviations[:, k : k + 3], axis=1)) for k in (0, 3))
    return Finding(
        "3-2-1 wires: pose by three spheres",
        "Figs 22 to 24, section 5.1, Tables 10 and 12 (titles)",
        "end-effector poses are calculated from six wire lengths by trilateration",
        f"exact lengths give the pose to {exact:.1e} m or rad. Errors of {1e3 * sigma:g} mm of the"
        f" wires become {1e3 * position:.3f} mm and {1e3 * turn:.3f} mrad of the pose in the"
        f" median; squared errors are {ratio:.3f} times what the propagated covariance says"
        " (criterion: 1e-9, and 0.95 to 1.05, five standard deviations of this mean)",
        exact < _EXACT and 0.95 < ratio < 1.05,
    )  # fmt: skip


def wire_calibration() -> list[Finding]:
    """Tables 13 to 15, Figs 25 to 30: 20 poses measured with the wires."""
    one = trial(13, 20, document=False)
    nominal = load_hybrid("iwr")
    done = calibrate(nominal, one.measurement, "dh")
    m = one.measurement
    legs = {name: 1e3 * np.abs(leg_readings(r, m.joints, m.pose) - m.legs)
            for name, r in (("before", nominal), ("after", done.robot))}  # fmt: skip
    poses = np.arange(1, 21)
    before, after = done.before, done.after
    unused = unused_errors(one, done.robot)[0]
    refined = calibrate(nominal, m, "dh", document_parameters(one.model))
    with_36 = unused_errors(one, refined.robot)[0]
    return [
        Finding(
            "20 poses with wires: leg errors", "Table 14, Figs 25 and 26 (captions)",
            "leg errors in 20 pose configurations before and after calibration",
            f"largest {legs['before'].max():.2f} mm before, {legs['after'].max():.3f} mm after"
            " (criterion: a tenth)",
            bool(legs["after"].max() < 0.1 * legs["before"].max()),
            (Panel("largest leg error [mm]", poses,
                   {k: v.max(axis=1) for k, v in legs.items()}, "pose", True),),
        ),
        Finding(
            "20 poses with wires: orientation and position", "Table 15, Figs 27 to 30 (captions)",
            "orientation and position errors in 20 pose configurations before and after",
            f"position RMS {_mm(before.position):.2f} to {_mm(after.position):.3f} mm, orientation"
            f" {1e3 * np.sqrt(np.mean(before.orientation**2)):.2f} to"
            f" {1e3 * np.sqrt(np.mean(after.orientation**2)):.3f} mrad; 25 poses not used:"
            f" {_mm(unused):.3f} mm RMS (criterion: a tenth each, and below 0.1 mm RMS not used)",
            _mm(after.position) < 0.1 * _mm(before.position)
            and after.orientation.max() < 0.1 * before.orientation.max() and _mm(unused) < 0.1,
            (Panel("position error [mm]", poses, {"before": 1e3 * before.position,
                   "after": 1e3 * after.position}, "pose", True),
             Panel("orientation error [mrad]", poses, {"before": 1e3 * before.orientation,
                   "after": 1e3 * after.orientation}, "pose", True)),
        ),
        Finding(
            "a robot with errors in all 54, identified with 36", "titles of Tables 3 to 5",
            "the 54-parameter model is refined to 36 parameters, which are identified",
            f"25 poses not used: RMS {_mm(with_36):.3f} mm with the 36, {_mm(unused):.3f} mm with"
            f" the {done.redundancy.rank} independent ones; errors of A_i of 1 mm are only partly"
            " like errors of B_i where the platform tilts (criterion: below 0.1 mm RMS with 36)",
            _mm(with_36) < 0.1,
        ),
        _compensated(one, nominal, done),
    ]  # fmt: skip


def _compensated(one: Trial, nominal: Hybrid, done: Calibration) -> Finding:
    """Desired poses by the inverse kinematics of the nominal and of the calibrated robot."""
    joints, legs = one.unused
    desired = forward(nominal, joints, legs)
    errors = []
    for robot in (nominal, done.robot):
        reached = forward(one.robot, joints, inverse(robot, desired, joints))
        errors.append(np.linalg.norm(pose_difference(reached, desired)[:, :3], axis=1))
    return Finding(
        "correction in the controller", "section 1.1 (page 21), final step",
        "identified errors are substituted into the model to obtain an accurate kinematic model",
        f"25 desired poses by the inverse kinematics: RMS {_mm(errors[0]):.2f} mm with the nominal,"
        f" {_mm(errors[1]):.3f} mm with the calibrated robot (criterion: below 0.1 mm)",
        _mm(errors[1]) < 0.1,
        (Panel("error of the reached position [mm]", np.arange(1, 26),
               {"nominal": 1e3 * errors[0], "calibrated": 1e3 * errors[1]}, "pose", True),),
    )  # fmt: skip


def covered(seed: int) -> tuple[int, int]:
    """Assumed errors within 95 % intervals of least squares: (inside, parameters)."""
    one = trial(1000 + seed, 25)
    names = document_parameters(one.model)
    fit = calibrate(load_hybrid("iwr"), one.measurement, "dh", names).fit
    truth = one.errors[one.model.index(fit.names)]
    return int(np.sum((truth > fit.intervals[:, 0]) & (truth < fit.intervals[:, 1]))), len(names)


def coverage(results: list[tuple[int, int]]) -> Finding:
    """Whether intervals hold the assumed errors as often as they should."""
    inside, total = np.sum(results, axis=0)
    share = inside / total
    return Finding(
        "intervals of the 36 parameters",
        "Table 5 (title): standard deviations",
        "identified posterior mean values and standard deviations of the 36 parameters",
        f"{100 * share:.1f} % of {total} assumed errors in {len(results)} trials lie within their"
        " 95 % intervals (criterion: 93 to 97 %)",
        0.93 < share < 0.97,
    )


def wang2012(
    seeds: int = 20, jobs: int | None = None, progress: Progress | None = None, steps: int = 12000
) -> list[Finding]:
    """Run all experiments.

    Args:
        seeds: trials of the intervals, times ten.
        jobs: processes; as many as there are cores by default.
        progress: called with what is done and the share that is done.
        steps: of MCMC.

    Returns:
        The findings, in the order of the thesis.
    """
    tasks: list[tuple[Callable, tuple]] = [
        (kinematics, ()), (parameters_54, (5 * steps // 4,)), (refined_exact, ()),
        (refined_noisy, (steps,)), (poe_poses, ()), (wire_method, ()), (wire_calibration, ()),
    ]  # fmt: skip
    single = len(tasks)
    tasks += [(evolution_run, ("dh", 100 + k, 15)) for k in range(5)]
    tasks += [(evolution_run, ("poe", 200 + k, 25)) for k in range(4)]
    runs = len(tasks)
    tasks += [(covered, (seed,)) for seed in range(10 * seeds)]
    results = []
    for number, result in enumerate(performed(tasks, jobs)):
        results.append(result)
        if progress:
            progress(tasks[number][0].__name__.replace("_", " "), (number + 1) / len(tasks))
    findings: list[Finding] = []
    for k, result in enumerate(results[:single]):
        findings += result if isinstance(result, list) else [result]
        if k == 0:
            findings.append(evolution_runs(results[single : single + 5], "dh"))
        if k == 3:
            findings.append(coverage(results[runs:]))
            findings.append(evolution_runs(results[single + 5 : runs], "poe"))
    return findings
