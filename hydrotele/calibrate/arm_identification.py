"""Identification of a manipulator arm from the joint angles of an external calibrator.

The calibrator is a sensed linkage between the arm and a ball joint on the chassis. While link i
moves, the ball keeps its distance p_xy from the axis of joint i and its height p_z along it. These
are two equations per pose without the angle of joint i (Khoshzaban 1992, Eq. 3.25). Links are
identified one after the other from the outermost inwards, then optionally all together.

A stage is the set of poses recorded while one link moves and the other links of the arm are held.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
import scipy.sparse

from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.calibration_loop import (
    PARAMETER_KINDS,
    CalibrationLoop,
    ball_position_and_derivatives,
    ball_position_from_axis,
    unit_of,
)
from hydrotele.calibrate.estimation import classify_scaled_parameters, least_squares
from hydrotele.core.errors import InputError
from hydrotele.identify.identifiability import Identifiability

NOMINAL_ERRORS = {"m": 0.1, "rad": np.radians(5.0)}
"""Expected error of a nominal parameter, by unit: the accuracy of a tape and a protractor."""

LABORATORY_ERRORS = {"m": 1.0e-3, "rad": np.radians(0.05)}
"""Expected error of the calibrator's link parameters, measured in a laboratory (K 3.6.4)."""

TRUNCATION_LEVELS = (0.05, 0.01, 1.0e-3, 1.0e-5)
"""Truncation levels relative to the largest singular value: K's 5 %, lowered on convergence."""

_QUANTILE_95 = 1.959964
_MAX_REWEIGHTINGS = 3  # reweighting iterations; the second one already changes parameters by less than 1e-3
_MIN_EQUATIONS_PER_PARAMETER = 2  # equations per parameter
_MIN_JOINT_RANGE = np.radians(2.0)  # minimum range of a calibrator joint while a link moves

ParameterValues = dict[str, float]


@dataclass(frozen=True)
class StageFit:
    """Result of the identification of one moving link.

    Attributes:
        link: the moving link.
        names: the p identified parameters.
        identifiability: identifiability of the candidate parameters of this stage.
        hold_reasons: reason why a candidate keeps its nominal value, by parameter name.
        iterations: number of iterations of the search.
        poses: number of poses.
        rms: root mean square of both equations' residuals [m].
        chi: RMS residual over its value expected from sensor noise [1]; 1 without other errors.
        condition: condition number of the normalised columns of the identified parameters.
    """

    link: str
    names: tuple[str, ...]
    identifiability: Identifiability
    hold_reasons: Mapping[str, str]
    iterations: int
    poses: int
    rms: float
    chi: float
    condition: float


@dataclass(frozen=True)
class ArmFit:
    """Result of an arm calibration.

    Attributes:
        nominal: the chain before calibration.
        loop: the chain with the identified parameters.
        names: the p identified parameters, in the order of their stages.
        values: (p,) identified values [rad] or [m].
        covariance: (p, p) covariance of the values due to sensor noise of this and earlier stages.
        parameters: all parameters after calibration, including held angles and ball positions.
        start_parameters: all parameters before calibration.
        stages: results of the moving links, the outermost first.
        method: `hierarchical` or `joint`.
    """

    nominal: CalibrationLoop
    loop: CalibrationLoop
    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    parameters: Mapping[str, float]
    start_parameters: Mapping[str, float]
    stages: tuple[StageFit, ...]
    method: str

    @property
    def standard_deviations(self) -> np.ndarray:
        """(p,) standard deviations of the identified values [rad] or [m]."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def intervals(self) -> np.ndarray:
        """(p, 2) lower and upper bounds of the 95 % intervals of the identified values [rad] or [m]."""
        reach = _QUANTILE_95 * self.standard_deviations
        return np.column_stack([self.values - reach, self.values + reach])

    def value(self, name: str) -> float:
        """Return the value of a parameter by name [rad] or [m]; its start value if it was not identified."""
        return float(self.parameters[name])


def sort_stages(loop: CalibrationLoop, stages: Sequence[Poses]) -> list[Poses]:
    """Sort stages, each the poses of one moving link, from the outermost link to the chassis.

    Raises:
        InputError: a moving link is not a powered link of the chain, or two stages move the same link.
    """
    links = loop.links[: loop.powered_count]
    for poses in stages:
        if poses.link not in links:
            message = f"moves {poses.link!r}; links that can be calibrated: {', '.join(links)}"
            raise InputError(poses.source, message)
    names = [poses.link for poses in stages]
    for name in names:
        if names.count(name) > 1:
            twice = [poses.source for poses in stages if poses.link == name]
            raise InputError(twice[1], f"moves {name}, as does {twice[0]}: keep one of them")
    return sorted(stages, key=lambda poses: -links.index(poses.link))


def candidate_parameters(loop: CalibrationLoop, link: str) -> list[str]:
    """Return the names of the parameters that poses of one moving link may identify, by preference.

    Args:
        loop: the chain.
        link: the moving link.

    Returns:
        Names such as `alpha.boom`, the most preferred first. If only a combination of several
        parameters is identifiable, the first of them is identified and the others keep their values.
        All links have the ball's coordinates (`p_xy`, `p_z`) and their own D-H parameters. For the
        outermost powered link the calibrator's parameters follow, otherwise the held angle of the
        next outer link.
    """
    place = loop.links.index(link)
    first = [f"p_xy.{link}", f"p_z.{link}"]
    if place == loop.powered_count - 1:
        mount = loop.links[loop.powered_count]
        own = [f"{k}.{link}" for k in ("alpha", "a")]
        own += [f"{k}.{mount}" for k in ("offset", "alpha", "a", "d")]
        rest = loop.links[loop.powered_count + 1 :]
        own += [f"offset.{name}" for name in rest[:-1]]
        own += [f"offset.{rest[-1]}"]
        own += [f"{k}.{name}" for name in rest for k in ("d", "a", "alpha", "beta")]
        own += [f"beta.{mount}"]
    else:
        outer = loop.links[place + 1]
        own = [f"held.{outer}", f"alpha.{link}", f"a.{link}", f"d.{outer}"]
    own += [f"beta.{link}", f"d.{link}"]
    return first + own


def expected_parameter_error(loop: CalibrationLoop, name: str) -> float:
    """Return the expected error of a parameter's nominal value before calibration [rad] or [m].

    It is 0.1 m or 5 deg for parameters measured on the machine, and 1 mm or 0.05 deg for those
    measured in a laboratory. The latter are the parameters of all calibrator links but the first,
    except the sensor offsets (`offset`) of links before the last one.
    """
    kind, _, link = name.partition(".")
    known = loop.links[loop.powered_count + 1 :]
    if link in known and not (kind == "offset" and link != known[-1]):
        return LABORATORY_ERRORS[unit_of(name)]
    return NOMINAL_ERRORS[unit_of(name)]


class StageEquations:
    """The two residual equations of each of M poses while one link of a manipulator moves.

    The calibrator's end, a ball joint on the chassis (the ball), keeps its distance p_xy from the
    moving joint's axis and its height p_z along that axis.
    """

    MIN_DEVIATION = 1.0e-4
    """Minimum standard deviation [m] of an equation; bounds the weight of insensitive poses."""

    def __init__(self, loop: CalibrationLoop, poses: Poses) -> None:
        self.loop, self.poses = loop, poses
        self.place = loop.links.index(poses.link)
        self.outer = loop.links[self.place :]

    def chain_and_angles(self, parameters: Mapping[str, float]) -> tuple[CalibrationLoop, np.ndarray]:
        """Insert parameters, given by name, into the chain, and compute the joint angles beyond the moving link.

        The result is (chain, angles (M, number of links beyond the moving one) [rad]). Angles of
        held joints are parameters, plus their drift if it is known. Angles of calibrator joints are
        readings plus their offset parameters. The length d of the moving link keeps its nominal
        value, because only the difference of the ball's height and this length is identifiable.
        """
        loop, poses = self.loop, self.poses
        values = np.array([[parameters[f"{kind}.{link}"] for kind in PARAMETER_KINDS] for link in loop.links])
        values[self.place, PARAMETER_KINDS.index("d")] = loop.values[self.place, PARAMETER_KINDS.index("d")]
        theta = np.empty((len(poses), len(loop) - self.place - 1))
        for column, link in enumerate(self.outer[1:]):
            k = self.place + 1 + column
            if k < loop.powered_count:
                theta[:, column] = parameters[f"held.{link}"]
                if poses.drift and link in poses.drift.held:
                    theta[:, column] += poses.drift.held[link]
            else:
                theta[:, column] = poses.theta[:, k - loop.powered_count] + parameters[f"offset.{link}"]
        return dataclasses.replace(loop, values=values), theta

    def _error(self, s: np.ndarray, parameters: Mapping[str, float]) -> np.ndarray:
        reach, link = np.hypot(s[:, 0], s[:, 1]), self.poses.link
        error = np.stack([reach - parameters[f"p_xy.{link}"], s[:, 2] - parameters[f"p_z.{link}"]], axis=1)
        return error - self.poses.drift.ball[:, :2] if self.poses.drift else error

    def residual(self, parameters: Mapping[str, float]) -> np.ndarray:
        """Return the two errors of every pose (M, 2) [m], for parameters given by name.

        They are the ball's distance from the moving joint's axis minus the parameter p_xy, and its
        height along this axis minus the parameter p_z. If the poses have a known drift of held links,
        the displacement of the ball that it causes is subtracted.
        """
        loop, theta = self.chain_and_angles(parameters)
        return self._error(ball_position_from_axis(loop, self.place, theta), parameters)

    def residual_and_jacobian(self, parameters: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute both errors of `residual` at every pose, and their derivatives.

        Returns:
            (errors (M, 2) [m], derivatives by link parameters (M, 2, L, 5), derivatives by the S
            calibrator readings (M, 2, S) [m/rad]). The L links are those from the moving one
            outwards; their parameters are offset, alpha, a, d and beta.
        """
        loop, theta = self.chain_and_angles(parameters)
        s, by = ball_position_and_derivatives(loop, self.place, theta)
        way = s[:, :2] / np.hypot(s[:, :1], s[:, 1:2])
        plane = way[:, 0, None, None] * by[:, 0] + way[:, 1, None, None] * by[:, 1]
        rows = np.stack([plane, by[:, 2]], axis=1)
        return self._error(s, parameters), rows, rows[:, :, loop.powered_count - self.place :, 0]

    def select_parameter_derivatives(
        self, derivatives: np.ndarray, names: Sequence[str], own_d: bool = False
    ) -> np.ndarray:
        """Select the derivatives of both errors of every pose by p named parameters.

        Args:
            derivatives: (M, 2, links, 5) derivatives by all link parameters, from `residual_and_jacobian`.
            names: names of the parameters.
            own_d: whether to return the derivative by the moving link's length d; otherwise its
                column is zero, because the fit does not change this length.

        Returns:
            (M, 2, p) derivatives; zero for parameters without effect.
        """
        out = np.zeros((*derivatives.shape[:2], len(names)))
        for column, name in enumerate(names):
            kind, _, link = name.partition(".")
            if kind in ("p_xy", "p_z"):
                if link == self.poses.link:
                    out[:, 0 if kind == "p_xy" else 1, column] = -1.0
            elif link in self.outer:
                k = self.outer.index(link)
                held = 0 < k and self.place + k < self.loop.powered_count
                if k == 0 and kind == "d" and not own_d:
                    continue
                if kind == "held" and held:
                    out[:, :, column] = derivatives[:, :, k, 0]
                elif kind != "held" and not (kind == "offset" and self.place + k < self.loop.powered_count):
                    out[:, :, column] = derivatives[:, :, k, PARAMETER_KINDS.index(kind)]
        return out

    def whitening_factors(self, by_readings: np.ndarray) -> np.ndarray:
        """Return matrices (M, 2, 2) that scale the two residuals of each pose to unit covariance.

        The covariance follows from the noise of the S calibrator readings and the derivatives
        `by_readings` (M, 2, S) of the residuals by them [m/rad]. The square of 0.1 mm is added to both
        variances.
        """
        spread = by_readings * self.poses.sigma[..., None, :]
        covariance = spread @ spread.transpose(0, 2, 1) + self.MIN_DEVIATION**2 * np.eye(2)
        return np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1)


def initial_parameters(loop: CalibrationLoop, stages: Sequence[Poses]) -> ParameterValues:
    """Compute the start values of all parameters of an arm identification.

    Link parameters are nominal. The angle at which a link is held is the median reading of its joint's
    sensor, in the stage of the outermost link nearer to the chassis that has such readings. Without
    readings it is the home angle. The ball's coordinates `p_xy` and `p_z` of each stage are means
    over its poses, computed with the nominal chain.

    Args:
        loop: the nominal chain.
        stages: the poses, one item per moving link.

    Returns:
        Parameter values by name [rad] or [m].
    """
    numbers = {name: loop.value(name) for name in loop.parameter_names}
    for k, link in enumerate(loop.links[: loop.powered_count]):
        numbers[f"held.{link}"] = float(loop.home[k])
        inward = [p for p in stages if loop.links.index(p.link) < k and link in p.manipulator]
        if inward:
            outermost = max(inward, key=lambda p: loop.links.index(p.link))
            numbers[f"held.{link}"] = float(np.median(outermost.manipulator[link]) + loop.values[k, 0])
    for poses in stages:
        blank = numbers | {f"p_xy.{poses.link}": 0.0, f"p_z.{poses.link}": 0.0}
        mean = StageEquations(loop, poses).residual(blank).mean(axis=0)
        numbers[f"p_xy.{poses.link}"], numbers[f"p_z.{poses.link}"] = map(float, mean)
    return numbers


def identify_arm(
    loop: CalibrationLoop, stages: Sequence[Poses], *, weighted: bool = True,
    parameters_by_link: Mapping[str, Sequence[str]] | None = None,
) -> ArmFit:  # fmt: skip
    """Identify the geometric parameters of the arm link by link, from the outermost link inwards.

    Args:
        loop: the nominal chain.
        stages: poses of one or more links; links without poses keep their nominal parameters.
        weighted: weight each equation by its sensor noise; False for Khoshzaban's unweighted least
            squares, whose intervals are too narrow.
        parameters_by_link: parameters to identify by link, instead of those found to be identifiable.

    Returns:
        The fit, with the covariance due to sensor noise in this and all earlier stages.

    Raises:
        InputError: the poses are insufficient; the message names file, link and remedy.

    Source: Khoshzaban 1992, sections 3.6.3 and 3.6.4.

    Examples:
        The arm of Khoshzaban 1992 behind a calibrator, from readings without error: one link moves at a time.

        >>> import numpy as np
        >>> import hydrotele as ht
        >>> from hydrotele.calibrate.calibration_loop import build_loop
        >>> from hydrotele.calibrate.link_sweeps import DRIFT_FREE_SWEEPS, generate_sweep_poses
        >>> from hydrotele.experiments.calibrator_readings import find_true_parameters, perturb_loop, simulate_readings
        >>> nominal = build_loop(ht.load_machine("calibrator"))
        >>> true = perturb_loop(nominal, np.random.default_rng(11))
        >>> sweeps = [generate_sweep_poses(true, link, s._replace(poses=60)) for link, s in DRIFT_FREE_SWEEPS.items()]
        >>> found = identify_arm(nominal, [simulate_readings(true, sweep, None) for sweep in sweeps])
        >>> [stage.link for stage in found.stages]
        ['pitch', 'stick', 'boom', 'swing']
        >>> errors = found.values - find_true_parameters(true, nominal, found.names, sweeps)
        >>> len(errors), bool(abs(errors).max() < 1e-9)  # rad and m
        (28, True)
    """
    order = sort_stages(loop, stages)
    for poses in order:
        check_poses(loop, poses)
    numbers = initial_parameters(loop, order)
    start = dict(numbers)
    names: tuple[str, ...] = ()
    covariance = np.zeros((0, 0))
    found = []
    for poses in order:
        equations = StageEquations(loop, poses)
        wanted = candidate_parameters(loop, poses.link)
        told = classify_candidates(equations, start | {n: numbers[n] for n in names}, wanted)
        own = list((parameters_by_link or {}).get(poses.link, [told.names[k] for k in sorted(told.base)]))
        stage, numbers, covariance = identify_stage(equations, numbers, own, names, covariance, told, wanted, weighted)
        names = (*names, *own)
        found.append(stage)
    return assemble_fit(loop, numbers, start, names, covariance, found, "hierarchical")


def classify_candidates(
    equations: StageEquations, parameters: ParameterValues, names: Sequence[str]
) -> Identifiability:
    """Classify the candidate parameters `names` of a stage: identifiable or not.

    A parameter is identifiable alone, only in a combination with others, or not at all. The
    criterion is a standard deviation, due to sensor noise, below half of the expected error of the
    nominal value. The stage's equations are linearised at the values `parameters`, by name.
    """
    loop = equations.loop
    _, by, sensed = equations.residual_and_jacobian(parameters)
    matrix = equations.whitening_factors(sensed) @ equations.select_parameter_derivatives(by, names, own_d=True)
    sizes = [expected_parameter_error(loop, name) for name in names]
    return classify_scaled_parameters(matrix.reshape(-1, len(names)), names, sizes, sigma=1.0)


def identify_stage(
    equations: StageEquations, parameters: ParameterValues, own_names: list[str], earlier_names: tuple[str, ...],
    covariance: np.ndarray, identifiability: Identifiability, candidates: Sequence[str], weighted: bool = True,
    start_is_close: bool = False,
) -> tuple[StageFit, ParameterValues, np.ndarray]:  # fmt: skip
    """Identify the parameters of one stage by least squares on the poses of its moving link.

    Args:
        equations: equations of the stage.
        parameters: all parameters, the start of the search.
        own_names: p parameters to identify.
        earlier_names: q parameters identified by earlier stages.
        covariance: (q, q) covariance of the earlier parameters.
        identifiability: classification of the candidate parameters by `classify_candidates`; the
            result contains it.
        candidates: names of the candidate parameters; the result states why the others are held.
        weighted: weight each equation by its sensor noise; False for equal weights.
        start_is_close: whether the start is close to the solution; otherwise the first search omits
            steps in directions with small singular values.

    Returns:
        (result of the stage, values of all parameters, covariance (q + p, q + p) of earlier and own
        parameters). Errors of the earlier parameters are propagated to the own ones.

    Raises:
        InputError: there are fewer than two equations per parameter; each pose gives two.
    """
    poses, loop = equations.poses, equations.loop
    if 2 * len(poses) < _MIN_EQUATIONS_PER_PARAMETER * len(own_names):
        raise InputError(
            poses.source,
            f"{len(poses)} poses of {poses.link} are too few for {len(own_names)} parameters:"
            f" record {math.ceil(0.5 * len(own_names) * _MIN_EQUATIONS_PER_PARAMETER)} or more, preferably 200",
        )
    sizes = [expected_parameter_error(loop, name) for name in own_names]
    start = np.array([parameters[name] for name in own_names])
    iterations, fit = 0, None
    for _ in range(_MAX_REWEIGHTINGS if weighted else 1):
        now = parameters if fit is None else parameters | dict(zip(own_names, fit.values.tolist(), strict=True))
        whitening = equations.whitening_factors(equations.residual_and_jacobian(now)[2])
        if not weighted:
            level = np.sqrt(np.mean(np.linalg.inv(whitening) ** 2) * 2.0)
            whitening = np.broadcast_to(np.eye(2) / level, whitening.shape)

        def residual(x, whitening=whitening):
            error = equations.residual(parameters | dict(zip(own_names, x.tolist(), strict=True)))
            return (whitening @ error[..., None]).ravel()

        def jacobian(x, whitening=whitening):
            _, by, _ = equations.residual_and_jacobian(parameters | dict(zip(own_names, x.tolist(), strict=True)))
            return (whitening @ equations.select_parameter_derivatives(by, own_names)).reshape(-1, len(own_names))

        fit = least_squares(
            residual, start if fit is None else fit.values, own_names, sizes, sigma=1.0, jac=jacobian,
            truncation=TRUNCATION_LEVELS if iterations == 0 and not start_is_close else None, select="none",
        )  # fmt: skip
        iterations = iterations or fit.iterations
    assert fit is not None
    parameters = parameters | dict(zip(own_names, fit.values.tolist(), strict=True))
    error, by, _ = equations.residual_and_jacobian(parameters)
    inverse = np.linalg.pinv(
        (whitening @ equations.select_parameter_derivatives(by, own_names)).reshape(-1, len(own_names))
    )
    chi = float(np.sqrt(np.mean(np.einsum("mij,mj->mi", whitening, error) ** 2)
                        * 2 * len(poses) / (2 * len(poses) - len(own_names))))  # fmt: skip
    before = (whitening @ equations.select_parameter_derivatives(by, earlier_names)).reshape(
        2 * len(poses), len(earlier_names)
    )
    through = -inverse @ before
    noise = max(chi, 1.0) ** 2 * inverse @ inverse.T
    corner = through @ covariance
    covariance = np.block([[covariance, corner.T], [corner, noise + corner @ through.T]])
    columns = equations.select_parameter_derivatives(by, own_names).reshape(-1, len(own_names)) * sizes
    columns = columns / np.linalg.norm(columns, axis=0)
    fixed = {name: _hold_reason(identifiability, name, loop) for name in candidates if name not in own_names}
    stage = StageFit(
        poses.link, tuple(own_names), identifiability, fixed, iterations, len(poses),
        float(np.sqrt(np.mean(error**2))), chi, float(np.linalg.cond(columns)),
    )  # fmt: skip
    return stage, parameters, covariance


def _hold_reason(identifiability: Identifiability, name: str, loop: CalibrationLoop) -> str:
    """Return the reason why a candidate parameter keeps its nominal value, as a short text.

    It is known more accurately from the laboratory, has no effect, or is identifiable only together
    with other parameters, which the text names.
    """
    kind, _, link = name.partition(".")
    if (
        link in loop.links[loop.powered_count + 1 :]
        and expected_parameter_error(loop, name) == LABORATORY_ERRORS[unit_of(name)]
    ):
        if identifiability.status[identifiability.names.index(name)] != "unidentifiable":
            return "known more accurately from the laboratory"
    column = identifiability.combination[:, identifiability.names.index(name)]
    partners = [identifiability.names[identifiability.base[k]] for k in np.flatnonzero(column)]
    if identifiability.status[identifiability.names.index(name)] == "unidentifiable" or not partners:
        return "has no effect in any pose"
    return f"identifiable only together with {', '.join(partners)}"


def assemble_fit(loop, parameters, start, names, covariance, stages, method) -> ArmFit:
    """Build the result of an arm calibration from the values and covariance of its parameters.

    Args:
        loop: the nominal chain.
        parameters: all parameters after calibration, by name.
        start: all parameters before calibration, by name.
        names: the p identified parameters.
        covariance: (p, p) their covariance.
        stages: results of the moving links.
        method: `hierarchical` or `joint`.

    Returns:
        The result. Its calibrated chain has the identified distance and height of the ball, if
        those of the link nearest to the chassis were identified.
    """
    values = {name: parameters[name] for name in loop.parameter_names}
    calibrated = loop.with_values(values)
    first = loop.links[0]
    if f"p_xy.{first}" in names:
        flat = np.hypot(*loop.ball[:2])
        way = loop.ball[:2] / flat if flat > 0.0 else np.array([1.0, 0.0])
        ball = np.array([*(way * parameters[f"p_xy.{first}"]),
                         parameters[f"p_z.{first}"] ])  # fmt: skip
        calibrated = dataclasses.replace(calibrated, ball=ball)
    return ArmFit(
        loop, calibrated, names, np.array([parameters[n] for n in names]), covariance, parameters, start,
        tuple(stages), method,
    )  # fmt: skip


def identify_jointly(fit: ArmFit, stages: Sequence[Poses]) -> ArmFit:
    """Refit the parameters of all stages together, starting from the link-by-link fit.

    A stage is the set of poses recorded while one link moves. A parameter enters the equations of
    every stage that depends on it; each stage has a separate ball position. The Jacobian is sparse: a
    stage does not depend on the links between the chassis and its moving link.

    Args:
        fit: the link-by-link (hierarchical) fit.
        stages: the poses of that fit.

    Returns:
        The fit of the same parameters to all stages at once.

    Raises:
        InputError: the search does not converge.
    """
    loop, names = fit.nominal, fit.names
    order = sort_stages(loop, stages)
    equations = [StageEquations(loop, poses) for poses in order]
    sizes = np.array([expected_parameter_error(loop, name) for name in names])
    base = dict(fit.parameters)
    x = fit.values.copy()
    for _ in range(_MAX_REWEIGHTINGS):
        now = base | dict(zip(names, x.tolist(), strict=True))
        whitenings = [e.whitening_factors(e.residual_and_jacobian(now)[2]) for e in equations]

        def residual(u, whitenings=whitenings):
            at = base | dict(zip(names, (u * sizes).tolist(), strict=True))
            return np.concatenate([
                (w @ e.residual(at)[..., None]).ravel()
                for e, w in zip(equations, whitenings, strict=True)
            ])  # fmt: skip

        def jacobian(u, whitenings=whitenings):
            at = base | dict(zip(names, (u * sizes).tolist(), strict=True))
            return scipy.sparse.vstack([
                scipy.sparse.csr_matrix(
                    (w @ e.select_parameter_derivatives(e.residual_and_jacobian(at)[1], names))
                    .reshape(-1, len(names)) * sizes
                ) for e, w in zip(equations, whitenings, strict=True)
            ]).tocsr()  # fmt: skip

        found = scipy.optimize.least_squares(
            residual, x / sizes, jacobian,  # pyright: ignore[reportArgumentType] - a function, too
            x_scale="jac", ftol=1e-13, xtol=1e-11, gtol=1e-12,
            tr_solver="lsmr", tr_options={"atol": 1e-13, "btol": 1e-13, "maxiter": 2000},
            max_nfev=100,
        )  # fmt: skip
        if found.status <= 0:
            raise InputError("joint identification", "does not converge; check the poses' residuals")
        x = found.x * sizes
    matrix = jacobian(x / sizes).toarray() / sizes
    numbers = base | dict(zip(names, x.tolist(), strict=True))
    rows, parts, kept = residual(x / sizes), [], 0
    for poses in order:
        parts.append(rows[kept : kept + 2 * len(poses)])
        kept += 2 * len(poses)
    # residuals above sensor noise (drift of held links) enlarge the intervals stage by stage
    chi = [max(1.0, float(np.sqrt(np.mean(p**2)))) for p in parts]
    inverse = np.linalg.pinv(matrix)
    scaled = inverse * np.concatenate([np.full(len(p), c) for p, c in zip(parts, chi, strict=True)])
    updated = []
    for stage, poses, e in zip(fit.stages, order, equations, strict=True):
        error = e.residual(numbers)
        updated.append(dataclasses.replace(
            stage, rms=float(np.sqrt(np.mean(error**2))),
            chi=float(np.sqrt(np.mean(parts[order.index(poses)] ** 2))), iterations=int(found.njev),
        ))  # fmt: skip
    return assemble_fit(loop, numbers, fit.start_parameters, names, scaled @ scaled.T, updated, "joint")


def check_poses(loop: CalibrationLoop, poses: Poses) -> None:
    """Raise InputError if a calibrator reading is not finite, or all calibrator joints move by less than 2 deg."""
    bad = np.argwhere(~np.isfinite(poses.theta))
    if len(bad):
        row, column = bad[0]
        name = f"angle.{loop.links[loop.powered_count + column]}"
        raise InputError(f"{poses.source}, column {name}, row {row + 1}", "is not a number")
    spread = np.ptp(poses.theta, axis=0)
    if np.all(spread < _MIN_JOINT_RANGE):
        raise InputError(
            poses.source,
            f"contains only one pose of {poses.link}: no calibrator joint moves by more"
            f" than {np.degrees(spread.max()):.2g} deg; move the link through its range",
        )


def stage_residuals(loop: CalibrationLoop, poses: Poses, parameters: Mapping[str, float]) -> np.ndarray:
    """Compute the two errors of each pose of a stage (one moving link), whitened by the sensor noise.

    The errors are the distance of the calibrator's end (the ball) from the moving joint's axis and its
    height along it, each minus its value in the parameters.

    Args:
        loop: the nominal chain.
        poses: poses of the stage.
        parameters: parameter values by name, from a fit.

    Returns:
        (M, 2) whitened errors, uncorrelated and of unit variance if sensor noise is the only error.
    """
    equations = StageEquations(loop, poses)
    error, _, sensed = equations.residual_and_jacobian(parameters)
    return np.einsum("mij,mj->mi", equations.whitening_factors(sensed), error)
