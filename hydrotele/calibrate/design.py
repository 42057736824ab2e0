"""Designs of a calibrator: which lengths and which place of the ball joint tell an arm best.

Khoshzaban 1992, section 5.3, asks for it. The information of a whole measurement, in which one link
sweeps and held ones drift, is that of its equations' Jacobian over the sensors' errors; what counts
is how well the tip of the calibrated arm is known over its workspace, and that the calibrator
reaches the poses at all.

Which poses to measure, and how well a calibration predicts those that it has not seen.

Poses are chosen by the information matrix of the parameters: its determinant (D) or one of the
observability indices O1 to O5 of robot calibration. The search adds poses one by one and then
exchanges them while that helps.
"""

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import scipy.optimize

from hydrotele.calibrate.arm import Equations, candidates, size_of, start_numbers, what_is_told
from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.loop import Loop, calibrator_angles, frame_of, link_chain
from hydrotele.core.errors import InputError
from hydrotele.kinematics.serial_chain import forward_and_rates


class Sweep(NamedTuple):
    """How one link is moved there and back while the others are held [deg, K's signs].

    Attributes:
        moving: range of the moving link.
        held: link -> where it stands.
        drift: link -> by how much it has drifted when the last pose is taken.
        wander: by how much the grapple is turned about the place where it points at the ball.
        poses: number of poses.
        cycles: how often the moving link goes there and back.
        phase: of the first pose within a cycle, 0 at the lower end [rad].
    """

    moving: tuple[float, float]
    held: Mapping[str, float]
    drift: Mapping[str, float]
    wander: float = 20.0
    poses: int = 300
    cycles: float = 1.0
    phase: float = 0.0


SWEEPS: Mapping[str, Sweep] = {
    "pitch": Sweep((20.0, 80.0), {"swing": 0.0, "boom": -27.5, "stick": 80.0},
                   {"boom": -0.2, "stick": 0.3}, 40.0),
    "stick": Sweep((45.0, 145.0), {"swing": 0.0, "boom": -27.5, "pitch": 42.9}, {"boom": -0.4}),
    "boom": Sweep((-48.0, -4.0), {"swing": 0.0, "stick": 80.2, "pitch": 42.9}, {"stick": 0.6}),
    "swing": Sweep((-95.0, 60.0), {"boom": -26.8, "stick": 81.0, "pitch": 42.9},
                   {"boom": -0.4, "stick": 0.8}, 10.0, 400),
}  # fmt: skip
"""Ranges, drifts and numbers of poses of Khoshzaban 1992 Figs 16 to 18, and of link 4 alike (A)."""

_HELD = {"swing": 0.0, "boom": -27.8, "stick": 80.6, "pitch": 42.9}  # K Table 2

STILL = {name: sweep._replace(drift={}, held=_HELD) for name, sweep in SWEEPS.items()}
"""The same with held links that stay where they are from the first stage to the last."""


class Clean(NamedTuple):
    """Poses of a stage without any error.

    Attributes:
        link: moving link.
        theta: (M, N) true angles with offsets [rad].
        reached: part of the asked poses that the calibrator reaches [1].
    """

    link: str
    theta: np.ndarray
    reached: float


def sweep_poses(loop: Loop, link: str, sweep: Sweep, seed: int = 0) -> Clean:
    """True poses while a link sweeps its range and held links drift.

    Args:
        loop: the true chain.
        link: moving link.
        sweep: its trajectory.
        seed: of the grapple's wandering.

    Returns:
        The poses that the calibrator reaches.
    """
    rng, count = np.random.default_rng([seed, len(link)]), 2 * sweep.poses
    u = np.linspace(0.0, 1.0, count)
    low, high = np.radians(sweep.moving)
    theta = np.tile(loop.values[:, 0], (count, 1))
    for name, angle in sweep.held.items():
        theta[:, loop.links.index(name)] = np.radians(angle + sweep.drift.get(name, 0.0) * u)
    moving = loop.links.index(link)
    turn = 2.0 * np.pi * sweep.cycles * u + sweep.phase
    theta[:, moving] = 0.5 * (low + high) - 0.5 * (high - low) * np.cos(turn)
    pointing = _pointing(loop, theta)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    wave = sum(
        np.sin(2.0 * np.pi * f * u + p) for f, p in zip((3.7, 7.3, 11.9), phases, strict=True)
    )
    theta[:, loop.moved] = pointing + np.radians(sweep.wander) * wave / 3.0 * 1.6
    theta, reached = calibrator_angles(loop, theta)
    good = theta[reached]
    rows = np.linspace(0, len(good) - 1, min(sweep.poses, len(good))).astype(int)
    return Clean(link, good[rows], float(reached.mean()))


def _pointing(loop: Loop, theta: np.ndarray) -> np.ndarray:
    """Grapple's angle at which its yoke's axis is square to the line towards the ball."""
    place, turn = frame_of(loop, loop.moved, theta)
    x, y, _ = np.einsum("mji,mj->im", turn, loop.ball - place)
    return np.arctan2(y, x)


ARMS = np.linspace(2.0, 4.8, 8)
"""Lengths of the calibrator's arm that are looked at [m]."""

FOREARMS = np.linspace(2.4, 4.8, 7)
"""Lengths of its forearm that are looked at [m]."""

_POSES = 60  # per link
_REACH = 0.98  # of the poses that a design has to reach
_TIP = ((-0.8, 0.9), (-0.5, 1.4), (-0.1, 1.9), (-0.1, 0.7), (-0.8, 2.2))  # boom, stick [rad, K]
_OUT = 1.0e3  # m: what stands for the tip's error of a design that does not reach


class Design(NamedTuple):
    """A calibrator and what it tells.

    Attributes:
        arm: length from yoke to elbow, d of the twist joint [m].
        forearm: length from elbow to ball, a of the elbow [m].
        ball_x: place of the ball joint in front of the swing axis [m].
        ball_z: its height above the boom's pin [m].
        tip_error: RMS standard deviation of the calibrated arm's tip over its workspace [m].
        information: log of the determinant of the information about the arm's parameters, each
            over its expected size.
        reached: part of the measurement's poses that the calibrator reaches [1].
    """

    arm: float
    forearm: float
    ball_x: float
    ball_z: float
    tip_error: float
    information: float
    reached: float


class Survey(NamedTuple):
    """Designs over the lengths of both arms, and the present one."""

    designs: tuple[Design, ...]
    present: Design


def design_of(
    loop: Loop, arm: float, forearm: float, ball_x: float, ball_z: float, accuracy: float
) -> Design:
    """What a calibrator of these dimensions would tell.

    Args:
        loop: the nominal chain.
        arm: length from yoke to elbow [m].
        forearm: length from elbow to ball [m].
        ball_x: of the ball joint in front of the swing axis [m].
        ball_z: above the boom's pin [m].
        accuracy: bound of a sensor's uniform error [rad].

    Returns:
        The design with its figures.
    """
    values = loop.values.copy()
    values[-2, 3], values[-1, 2] = arm, forearm
    loop = replace(loop, values=values, ball=np.array([ball_x, loop.ball[1], ball_z]))
    sigma = np.full(len(loop) - loop.moved, accuracy / np.sqrt(3.0))
    stages, reached = [], []
    for link, sweep in STILL.items():
        clean = sweep_poses(loop, link, sweep._replace(poses=_POSES))
        reached.append(clean.reached)
        if len(clean.theta) < _POSES // 2:
            return Design(arm, forearm, ball_x, ball_z, _OUT, -np.inf, float(np.mean(reached)))
        shown = clean.theta - loop.values[:, 0]
        own = {n: shown[:, k] for k, n in enumerate(loop.links[: loop.moved])}
        stages.append(Poses(link, shown[:, loop.moved :], sigma, own))
    names, matrix = _whole_jacobian(loop, stages)
    sizes = np.array([size_of(loop, name) for name in names])
    scaled = matrix * sizes
    covariance = np.linalg.pinv(scaled.T @ scaled, rcond=1e-14) * np.outer(sizes, sizes)
    own = [k for k, n in enumerate(names) if not n.startswith("p_")
           and n.partition(".")[2] in loop.links[: loop.moved]]  # fmt: skip
    part = covariance[np.ix_(own, own)] / np.outer(sizes[own], sizes[own])
    information = -float(np.linalg.slogdet(part)[1])
    tip = _tip_error(loop, names, covariance)
    return Design(arm, forearm, ball_x, ball_z, tip, information, float(np.mean(reached)))


def _whole_jacobian(loop: Loop, stages: list[Poses]) -> tuple[list[str], np.ndarray]:
    """Identifiable parameters of all stages, and the weighted Jacobian of all equations."""
    numbers = start_numbers(loop, stages)
    names: list[str] = []
    parts = []
    for poses in stages:
        equations = Equations(loop, poses)
        told = what_is_told(equations, numbers, candidates(loop, poses.link))
        names += [told.names[k] for k in sorted(told.base)]
    for poses in stages:
        equations = Equations(loop, poses)
        _, by, sensed = equations.at(numbers)
        rows = equations.whitening(sensed) @ equations.columns(by, names)
        parts.append(rows.reshape(-1, len(names)))
    return names, np.vstack(parts)


def _tip_error(loop: Loop, names: list[str], covariance: np.ndarray) -> float:
    """RMS standard deviation of the last moved link's inner pin over some arm poses [m]."""
    count = loop.moved - 1
    chain = link_chain(loop.values[:count])
    total = 0.0
    for boom, stick in _TIP:
        rates = forward_and_rates(chain, np.array([[0.0, boom, stick][:count]]))
        by = rates.position_by_parameter[0].reshape(3, count, 5)
        slope = np.zeros((3, len(names)))
        for column, name in enumerate(names):
            kind, _, link = name.partition(".")
            if link in loop.links[:count] and kind in ("held", "d", "a", "alpha", "beta"):
                at = ("held", "d", "a", "alpha", "beta").index(kind)
                slope[:, column] = by[:, loop.links.index(link), at]
        total += float(np.trace(slope @ covariance @ slope.T))
    return float(np.sqrt(total / len(_TIP)))


def look_over_designs(loop: Loop, accuracy: float) -> Survey:
    """Designs over a grid of both arms' lengths, with the ball joint where it is.

    Args:
        loop: the nominal chain.
        accuracy: bound of a sensor's uniform error [rad].

    Returns:
        The designs, forearm by forearm, and the present one.
    """
    x, z = float(loop.ball[0]), float(loop.ball[2])
    grid = [design_of(loop, float(a), float(f), x, z, accuracy) for f in FOREARMS for a in ARMS]
    arm, forearm = float(loop.values[-2, 3]), float(loop.values[-1, 2])
    present = design_of(loop, arm, forearm, x, z, accuracy)
    return Survey(tuple(grid), present)


def best_design(loop: Loop, survey: Survey, accuracy: float) -> Design:
    """The design with the best-known tip that reaches its poses, lengths and ball joint free.

    Args:
        loop: the nominal chain.
        survey: where the search starts.
        accuracy: bound of a sensor's uniform error [rad].

    Returns:
        The design; the ball joint stays on the chassis, 1.0 to 2.6 m in front of the swing axis
        and 1.3 to 0.6 m below the boom's pin.
    """
    reaching = [d for d in (*survey.designs, survey.present) if d.reached >= _REACH]
    start = min(reaching or [survey.present], key=lambda d: d.tip_error)

    def cost(x):
        found = design_of(loop, x[0], x[1], x[2], x[3], accuracy)
        return np.log(found.tip_error) + 50.0 * max(0.0, _REACH - found.reached)

    bounds = [(1.5, 4.8), (1.5, 5.2), (1.0, 2.6), (-1.3, -0.6)]
    first = np.clip(start[:4], *np.array(bounds).T)
    found = scipy.optimize.minimize(
        cost, first, method="Nelder-Mead", bounds=bounds,
        options={"maxfev": 120, "xatol": 0.02, "fatol": 1e-3},
    )  # fmt: skip
    arm, forearm, ball_x, ball_z = found.x.tolist()
    return design_of(loop, arm, forearm, ball_x, ball_z, accuracy)


Criterion = Literal["D", "O1", "O2", "O3", "O4", "O5"]
_RIDGE = 1e-9  # of the mean information, so that the first poses have a determinant

Key = TypeVar("Key", bound=Hashable)
Fitted = TypeVar("Fitted")


@dataclass(frozen=True)
class Selection:
    """Chosen poses.

    Attributes:
        chosen: places of the poses among the candidates.
        index: the criterion's value, larger is better.
        exchanges: that the second part of the search made.
    """

    chosen: tuple[int, ...]
    index: float
    exchanges: int


def observability(information: np.ndarray, criterion: Criterion, equations: int) -> float:
    """How well a set of equations tells scaled parameters; larger is better.

    With singular values s1 >= ... >= sp of the scaled identification Jacobian of m equations:
    D = O1 = (s1 ... sp)^(1/p) / sqrt(m), O2 = sp / s1, O3 = sp, O4 = sp^2 / s1,
    O5 = 1 / (1/s1 + ... + 1/sp).

    Args:
        information: (p, p) J'J of parameters in units of their sizes.
        criterion: which.
        equations: m, number of equations.

    Returns:
        The index; 0 where a direction is not told.

    Source: Borm and Menq 1991 (O1); Driels and Pathre 1990 (O2); Nahvi, Hollerbach and Hayward 1994
    (O3); Nahvi and Hollerbach 1996 (O4); Sun and Hollerbach 2008 (O5, comparison).

    >>> observability(np.diag([4.0, 1.0]), "O2", 10)
    0.5
    """
    s = np.sqrt(np.maximum(np.linalg.eigvalsh(information), 0.0))[::-1]
    if s[-1] <= 0.0:
        return 0.0
    if criterion in ("D", "O1"):
        return float(np.exp(np.mean(np.log(s))) / np.sqrt(equations))
    if criterion == "O2":
        return float(s[-1] / s[0])
    if criterion == "O3":
        return float(s[-1])
    if criterion == "O4":
        return float(s[-1] ** 2 / s[0])
    return float(1.0 / np.sum(1.0 / s))


def select_poses(
    jacobians: np.ndarray, count: int, criterion: Criterion = "D",
    prior: np.ndarray | None = None,
) -> Selection:  # fmt: skip
    """Poses whose measurements tell the parameters best.

    Args:
        jacobians: (n, k, p) derivatives of the k equations of every candidate by identifiable
            parameters in units of their sizes, over the equations' standard deviations.
        count: number of poses to choose.
        criterion: `D` or an observability index.
        prior: (p, p) information that is there already, such as that of poses measured before.

    Returns:
        The poses, found by adding and exchanging; no exchange of one pose improves them.

    Raises:
        InputError: fewer candidates than poses, or too few equations for the parameters.

    Source: Fedorov 1972 (exchange); Daney, Papegay and Madeline 2005 (robot calibration).
    """
    rows = np.asarray(jacobians, float)
    n, k, p = rows.shape
    if not 0 < count <= n:
        raise InputError("poses", f"{count} of {n} candidates cannot be chosen")
    if prior is None and count * k < p:
        raise InputError(
            "poses", f"{count} poses give {count * k} equations for {p} parameters: choose more"
        )
    each = np.einsum("nki,nkj->nij", rows, rows)
    small = _RIDGE * max(float(np.trace(each.mean(axis=0))) / p, 1e-300) * np.eye(p)
    base = small if prior is None else np.asarray(prior, float) + small

    def best(total: np.ndarray, open_: np.ndarray, size: int) -> tuple[int, float]:
        if criterion in ("D", "O1"):
            gains = _gains(total, rows[open_])
            place = int(np.argmax(gains))
        else:
            values = [observability(total + each[c], criterion, size * k) for c in open_]
            place = int(np.argmax(values))
        chosen = int(open_[place])
        return chosen, observability(total + each[chosen], criterion, size * k)

    chosen: list[int] = []
    total = base.copy()
    for size in range(1, count + 1):
        open_ = np.setdiff1d(np.arange(n), chosen)
        new, _ = best(total, open_, size)
        chosen.append(new)
        total = total + each[new]
    value, exchanges, improved = observability(total, criterion, count * k), 0, True
    while improved and count < n:
        improved = False
        for place in range(count):
            without = total - each[chosen[place]]
            open_ = np.setdiff1d(np.arange(n), chosen)
            new, better = best(without, open_, count)
            if better > value * (1.0 + 1e-9):
                chosen[place], total, value = new, without + each[new], better
                exchanges, improved = exchanges + 1, True
    return Selection(tuple(chosen), value, exchanges)


def _gains(total: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Growth of log det by every candidate's (n, k, p) rows: log det(I + J P J')."""
    factor = np.linalg.cholesky(total)
    half = np.linalg.solve(
        factor, np.swapaxes(rows, 1, 2).transpose(1, 0, 2).reshape(len(total), -1)
    )
    half = half.reshape(len(total), len(rows), -1)
    grown = np.einsum("pnk,pnl->nkl", half, half) + np.eye(rows.shape[1])
    return np.linalg.slogdet(grown)[1]


def leave_one_out(
    groups: Iterable[Key], fit: Callable[[Sequence[Key]], Fitted],
    judge: Callable[[Fitted, Key], float],
) -> dict[Key, float]:  # fmt: skip
    """Errors of predictions of every group by a fit to all others.

    Args:
        groups: names of poses or groups of poses that are left out together.
        fit: of groups to what is fitted.
        judge: error of a fit on a group.

    Returns:
        Group -> error.

    >>> data = {"a": 1.0, "b": 2.0, "c": 6.0}
    >>> mean = lambda names: sum(data[name] for name in names) / len(names)
    >>> leave_one_out(data, mean, lambda fitted, name: abs(fitted - data[name]))
    {'a': 3.0, 'b': 1.5, 'c': 4.5}
    """
    named = list(groups)
    return {name: judge(fit([other for other in named if other != name]), name) for name in named}
