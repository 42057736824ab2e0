"""Zhu 1994, chapters 4 and 5: stability of stiffness feedback, and the levitated joystick.

Motions `x'' + B x' + K(t) x = 0` are integrated for a unit mass. Only the switching of the
stiffness is random; it depends on the seed of the repetition.
"""

from collections.abc import Sequence

import numpy as np
from scipy.integrate import solve_ivp

from hydrotele.core.compiled import compiled
from hydrotele.experiments.comparison import (
    Changes,
    Evaluation,
    Experiment,
    Panel,
    Sample,
    merge_settings,
)
from hydrotele.experiments.statistical_checks import check_deterministic_value, check_mean, collect_values
from hydrotele.experiments.zhu_two_port import make_claim, make_deterministic_experiment
from hydrotele.machine.joystick import load_joystick
from hydrotele.teleop.coils import make_three_station_coils
from hydrotele.teleop.optical_sensing import pose_resolution
from hydrotele.teleop.stiffness_switching import StiffnessAxis, worst_switching_growth

_TIME_STEP = 1e-3  # s
_MIN_STIFFNESS, _MAX_STIFFNESS = (
    1.0,
    9.0,
)  # K_min and K_max of a unit mass [1/s^2]; B^2 > 4 K_max if B > 6
_DAMPING = 6.1  # 1/s


def integrate_rising_damping(changes: Changes) -> Sample:
    """Integrate the motion of a unit mass on a spring whose damping increases exponentially or slowly.

    The cases are those of Zhu 1994, (4.6) and (4.7), with the damping 2 + exp(t) and 2 + t/2. With
    exponential damping the mass stops before it reaches its rest position x = 0.

    Args:
        changes: `stiffness`: K [1/s^2].

    Returns:
        `end`: position "
                "x(t) after 12 s"
                " with exponential damping; `slow`: |x| after 100 s with slowly
        increasing damping.
    """
    given = merge_settings({"stiffness": 1.0}, changes)

    def integrate_displacement(damping, last: float) -> tuple[np.ndarray, np.ndarray]:
        def compute_state_derivative(t: float, state: np.ndarray) -> list[float]:
            return [state[1], -damping(t) * state[1] - given["stiffness"] * state[0]]

        times = np.linspace(0.0, last, 400)
        found = solve_ivp(compute_state_derivative, (0.0, last), [2.0, -1.0], "Radau", times, rtol=1e-9, atol=1e-12)
        return times, found.y[0]

    time, place = integrate_displacement(lambda t: 2.0 + np.exp(t), 12.0)
    slow_time, slow = integrate_displacement(lambda t: 2.0 + 0.5 * t, 100.0)
    return Sample({"end": float(place[-1]), "slow": float(abs(slow[-1]))}, (
        Panel("x [1]", time, {"B = 2 + exp(t)": place, "1 + exp(-t)": 1.0 + np.exp(-time)},
              errors={"difference": place - 1.0 - np.exp(-time)}, error_label="difference [1]"),
        Panel("x with B = 2 + t/2 [1]", slow_time, {"x": slow}),
    ))  # fmt: skip


def evaluate_rising_damping(samples: Sequence[Sample]) -> Evaluation:
    """Check that a mass with exponentially increasing damping stops at x = 1 instead of 0 (Zhu 1994, 4.6).

    With slowly increasing damping it must return to 0.
    """
    v = samples[0].values
    return Evaluation((
        check_deterministic_value("x(t) after 12 s", v["end"], (1.0 - 1e-4, 1.0 + 1e-4),
                    "1 + exp(-12) is 6 10^-6 above 1; the remaining tolerance is for integration",
                    published=1.0),
        check_deterministic_value("magnitude of x after 100 s with B = 2 + t/2, which satisfies (4.7)", v["slow"],
                    (0.0, 0.01), "it decays as 1/t^2, from 2 to some 10^-3"),
    ), note="K = 1, as required by the printed solution 1 + exp(-t)")  # fmt: skip


def measure_worst_switching(changes: Changes) -> Sample:
    """Compute how much the speed grows per half swing if the stiffness switches in the worst way.

    The stiffness is K_max towards the equilibrium and K_min away from it.

    Args:
        changes: `ratio`: damping ratio with K_max.

    Returns:
        `growth`: speed at the equilibrium after half a swing over that before it [1].
    """
    given = merge_settings({"ratio": 0.02}, changes)
    ratios = np.geomspace(0.01, 1.5, 25)
    growth = [worst_switching_growth(1.0, 2.0 * ratio * 3.0, _MIN_STIFFNESS, _MAX_STIFFNESS) for ratio in ratios]
    return Sample(
        {"growth": worst_switching_growth(1.0, 2.0 * given["ratio"] * 3.0, _MIN_STIFFNESS, _MAX_STIFFNESS)},
        (Panel("speed over that half a swing before [1]", ratios, {"worst switching":
               np.array(growth)}, "damping ratio with K_max [1]"),),
    )  # fmt: skip


def evaluate_worst_switching(samples: Sequence[Sample]) -> Evaluation:
    """Check that the motion of a slightly damped mass grows under the worst switching of its stiffness.

    The speed after half a swing must exceed that before it, with a damping ratio of 0.02 and K_max 9
    times K_min.
    """
    return Evaluation((
        check_deterministic_value("speed after half a swing over that before, damping ratio 0.02, K_max 9 times"
                    " K_min", samples[0].values["growth"], (1.0 + 1e-9, np.inf),
                    "the motion grows, so that the system is unstable"),
    ))  # fmt: skip


@compiled
def integrate_varying_stiffness(damping, stiffness, position, speed, step, path):
    """Integrate `x'' = -B x' - K(t) x` of a unit mass by the Runge-Kutta method, with constant K in each step.

    Args:
        damping: B, scalar [1/s].
        stiffness: (n,) K [1/s^2].
        position: x at the start, scalar.
        speed: x' at the start, scalar.
        step: length of a time step, scalar [s].
        path: (n + 1, 2) x and x' at the start and after each step, written.

    Returns:
        Nothing.

    Source: Zhu 1994, Eq. 4.11.
    """
    x, v = position, speed
    path[0, 0], path[0, 1] = x, v
    for i in range(len(stiffness)):
        k = stiffness[i]
        a1 = -damping * v - k * x
        a2 = -damping * (v + 0.5 * step * a1) - k * (x + 0.5 * step * v)
        x3 = x + 0.5 * step * (v + 0.5 * step * a1)
        a3 = -damping * (v + 0.5 * step * a2) - k * x3
        a4 = -damping * (v + step * a3) - k * (x + step * (v + 0.5 * step * a2))
        x += step * v + step * step / 6.0 * (a1 + a2 + a3)
        v += step / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        path[i + 1, 0], path[i + 1, 1] = x, v


def sample_switched_stiffness(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw (count,) random stiffness values [1/s^2], constant between jumps at random times.

    Values are K_min (1 1/s^2), K_max (9 1/s^2), or one random value in between. One entry is for each
    time step of 1 ms.
    """
    jumps = rng.random(count) < _TIME_STEP / 10.0 ** rng.uniform(-1.5, 0.5)
    jumps[0] = True
    values = rng.choice(
        [_MIN_STIFFNESS, _MAX_STIFFNESS, rng.uniform(_MIN_STIFFNESS, _MAX_STIFFNESS)],
        size=count,
        p=[0.4, 0.4, 0.2],
    )
    return values[np.maximum.accumulate(np.where(jumps, np.arange(count), 0))]


def _integrate_path(damping: float, stiffness: np.ndarray, start: tuple[float, float]) -> np.ndarray:
    path = np.empty((len(stiffness) + 1, 2))
    integrate_varying_stiffness(damping, stiffness, *start, _TIME_STEP, path)
    return path


def simulate_switched_stiffness(seed: int, changes: Changes) -> Sample:
    """Integrate motions with randomly switched stiffness, to test the stability theorem 4-2 of Zhu 1994.

    Args:
        seed: seed of the start states and stiffnesses of 20 motions.
        changes: `damping`: B [1/s].

    Returns:
        `crossings`: largest number of crossings of the x axis (x' = 0) after the start. `left`: largest
        distance from the origin of the plane (x, x') after 40 s over that at the start. `outside`:
        largest distance by which paths that start on the x axis lie outside the region between the paths
        of constant K_min and K_max.
    """
    given = merge_settings({"damping": _DAMPING}, changes)
    damping, rng, count = given["damping"], np.random.default_rng([seed, 42]), 40_000
    crossings, left, outside, panels = 0, 0.0, 0.0, ()
    from_axis = {
        "K_min": _integrate_path(damping, np.full(count, _MIN_STIFFNESS), (1.0, 0.0)),
        "K_max": _integrate_path(damping, np.full(count, _MAX_STIFFNESS), (1.0, 0.0)),
    }
    for trial in range(20):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        stiffness = sample_switched_stiffness(rng, count)
        path = _integrate_path(damping, stiffness, (float(np.cos(angle)), float(np.sin(angle))))
        away = np.hypot(*path.T) > 1e-6
        speed = path[away, 1]
        crossings = max(crossings, int(np.count_nonzero(np.diff(np.sign(speed[speed != 0.0])))))
        left = max(left, float(np.hypot(*path[-1])))
        bounded = _integrate_path(damping, stiffness, (1.0, 0.0))
        outside = max(outside, _measure_bound_violation(bounded, from_axis))
        if trial == 0:
            grid = np.linspace(0.01, 1.0, 300)
            curves = {name: _interpolate_speed(path, grid) for name, path in from_axis.items()}
            curves["K(t)"] = _interpolate_speed(bounded, grid)
            panels = (
                Panel("speed dx/dt, start on the x axis [1/s]", grid, curves, "displacement x [1]"),
                Panel("displacement, start anywhere [1]", _TIME_STEP * np.arange(5000),
                      {"x": path[:5000, 0]}),
            )  # fmt: skip
    values = {"crossings": float(crossings), "left": left, "outside": outside}
    return Sample(values, panels)


def _interpolate_speed(path: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return the speed x' at given displacements x during a path's first motion towards the origin.

    `path` is (n, 2) with x and x'; it starts at x > 0. `grid` holds the displacements.
    """
    turn = np.flatnonzero(np.diff(path[:, 0]) >= 0.0)
    end = int(turn[1]) if len(turn) > 1 and turn[0] == 0 else int(turn[0]) if len(turn) else None
    way = path[: end or len(path)]
    return np.interp(grid, way[::-1, 0], way[::-1, 1])


def _measure_bound_violation(path: np.ndarray, bounds: dict[str, np.ndarray]) -> float:
    """Return how far a path in the (x, x') plane lies outside the paths of constant K_min and K_max.

    `bounds` holds these two paths as `K_min` and `K_max`. All paths are in quadrant IV (x > 0, x' < 0). A
    path that reaches x < 0 counts with its largest |x| there.
    """
    grid = np.linspace(0.02, 0.98, 200)
    speed = _interpolate_speed(path, grid)
    upper, lower = (
        _interpolate_speed(bounds["K_min"], grid),
        _interpolate_speed(bounds["K_max"], grid),
    )
    return float(max(np.max(speed - upper), np.max(lower - speed), 0.0, np.max(-path[:, 0])))


def evaluate_stability(samples: Sequence[Sample]) -> Evaluation:
    """Check that motions with randomly switched stiffness decay, and that the speed changes sign at most once.

    At a change of sign, the path in the plane of position x and speed crosses the x axis. The distance
    from the origin of this plane must decay to at most 1 % in 40 s.
    """
    return Evaluation((
        check_mean("largest distance from the origin after 40 s over that at the start",
                   collect_values(samples, "left"), (-np.inf, 1e-2), "asymptotically stable: the slowest"
                   " rate with K_min is 0.17 1/s, which gives 10^-3"),
        check_deterministic_value("largest number of crossings of the x axis",
                    float(collect_values(samples, "crossings").max()), (0.0, 1.0), "at most once"),
    ))  # fmt: skip


def evaluate_path_bounds(samples: Sequence[Sample]) -> Evaluation:
    """Check that paths in the (x, x') plane stay between those of constant K_min and K_max.

    The stiffness of the paths switches at random between these bounds (Zhu 1994, Figs 4.28, 4.29).
    """
    return Evaluation((
        check_deterministic_value("largest distance by which a path leaves the region between curves 1 and 2",
                    float(collect_values(samples, "outside").max()), (0.0, 1e-3),
                    "error of the interpolation between steps of 1 ms"),
    ))  # fmt: skip


_PUBLISHED_GAINS = {
    "excavator x y z": (0.06e3, 0.6e3, 0.3e3, 4.0e3),
    "feller-buncher x": (0.06e3, 4.0e3, 3.0e3, 8.0e3),
    "feller-buncher y": (0.06e3, 3.0e3, 2.0e3, 4.0e3),
    "feller-buncher z": (0.06e3, 4.0e3, 3.0e3, 9.0e3),
}
"""Tables 6.7 and 6.9: K_d [N s/m], K_p nominal, minimum, maximum [N/m]."""


def measure_published_gains(changes: Changes) -> Sample:
    """Evaluate a stability condition and the worst stiffness switching for the published joystick gains.

    The condition is Zhu 1994, (4.14); the gains are those of Tables 6.7 and 6.9. The worst
    switching is K_max towards the equilibrium and K_min away from it.

    Args:
        changes: `damping`: factor of the damping.

    Returns:
        `margin`: largest B^2 - 4 M K_max [(N s/m)^2]; positive values satisfy the condition. `growth`:
        largest speed after half a swing over that before it. Both are over all translational axes, with
        and without the operator's hand.
    """
    given = merge_settings({"damping": 1.0}, changes)
    joystick = load_joystick()
    mass, hand = joystick.flotor.mass, joystick.hand.axis_impedance(0)
    margins, growths = [], []
    for damping, nominal, least, most in _PUBLISHED_GAINS.values():
        alone = StiffnessAxis(mass, given["damping"] * damping, nominal, least, most)
        for spring in (alone, StiffnessAxis(mass + hand[0], alone.damping + given["damping"] * hand[1],
                       nominal + hand[2], least + hand[2], most + hand[2])):  # fmt: skip
            margins.append(spring.stability_theorem_margin)
            growths.append(spring.half_swing_growth)
    return Sample({"margin": max(margins), "growth": max(growths)})


def evaluate_published_gains(samples: Sequence[Sample]) -> Evaluation:
    """Check that no translational joystick axis satisfies a sufficient condition of stability, but all are stable.

    The condition is B^2 > 4 M K_max (Zhu 1994, (4.14)), for the published gains. Stable means that the
    motion decays under the worst switching of the stiffness.
    """
    v = samples[0].values
    return Evaluation((
        check_deterministic_value("largest B^2 - 4 M K_max of all axes, with and without hand", v["margin"],
                    (-np.inf, -1e-9), "no translational axis satisfies (4.14)", unit="(N s/m)^2"),
        check_deterministic_value("largest growth per half swing with the worst switching", v["growth"],
                    (0.0, 1.0 - 1e-9), "below 1 the motion decays for any change of stiffness"),
    ), "the rotations are not examined", "masses of joystick and hand are assumptions of models/joystick")  # fmt: skip


def compute_joystick_resolution(changes: Changes) -> Sample:
    """Compute the condition number of the levitated joystick's coil matrix and its pose resolution.

    Args:
        changes: `step`: factor of the photodiodes' step; `radius`: factor of the torques, which are
            divided by the radius of the coils.

    Returns:
        `condition`: condition number of the matrix from coil currents to forces and scaled torques.
        Largest standard deviations of position (`translation`) [um] and `rotation` [deg].
    """
    given = merge_settings({"step": 1.0, "radius": 1.0}, changes)
    joystick = load_joystick()
    facts = joystick.coils
    coils = make_three_station_coils(facts.radius, facts.force_per_ampere, facts.max_current)
    sizes = np.array([1.0, 1.0, 1.0, *[given["radius"] / facts.radius] * 3])
    pose = pose_resolution(joystick.diodes.distance, given["step"] * joystick.diodes.step)
    return Sample({
        "condition": float(np.linalg.cond(sizes[:, None] * coils.wrench_map)),
        "translation": 1e6 * float(pose[:3].max()),
        "rotation": float(np.degrees(pose[3:].max())),
    })  # fmt: skip


def evaluate_coil_condition_number(samples: Sequence[Sample]) -> Evaluation:
    """Check that the condition number of the matrix from coil currents to forces and torques is below 10.

    Torques are divided by the radius of the coils.
    """
    return Evaluation((
        check_deterministic_value("condition number of M, torques divided by the coils' radius",
                    samples[0].values["condition"], (1.0, 10.0),
                    "well-conditioned: within a factor of ten"),
    ))  # fmt: skip


def evaluate_pose_resolution(samples: Sequence[Sample]) -> Evaluation:
    """Check that the standard deviations of the joystick's measured pose are at most 1 um and 0.001 deg.

    The photodiodes have steps of 1 um.
    """
    v, reason = samples[0].values, "approximately: up to the printed figure"
    return Evaluation((
        check_deterministic_value("standard deviation of the position", v["translation"], (0.0, 1.0), reason,
                    unit="um", published=1.0),
        check_deterministic_value("standard deviation of the rotation", v["rotation"], (0.0, 1e-3), reason, unit="deg",
                    published=1e-3),
    ), note="three beams on photodiodes with steps of 1 um")  # fmt: skip


EXPERIMENTS: tuple[Experiment, ...] = (
    make_deterministic_experiment("damping that rises", integrate_rising_damping, make_claim(
        "counter-example of rising damping",
        '"the above system has solution x(t)" = 1 + e^-t "which goes to x(oo)" = 1 "instead" of 0',
        "p. 53, Eq. 4.6", evaluate_rising_damping, {"stiffness": 2.0}, "a spring of K = 2",
    )),
    make_deterministic_experiment("worst switching", measure_worst_switching, make_claim(
        "stiffness that switches: unstable",
        '"a slightly damped mass-damper-spring system goes unstable if we set the spring constant'
        " to a large value whenever the mass moves towards the equihbrium point and a small value"
        ' whenever the mass moves away from it"', "p. 54", evaluate_worst_switching, {"ratio": 1.0},
        "critical damping",
    )),
    Experiment("theorem 4-2", simulate_switched_stiffness, (make_claim(
        "theorem 4-2: stable, one crossing at most",
        '"Under these conditions, the system is uniformly asymptotically stable"; the trajectory'
        ' "can cross the x axis at most once"',
        "p. 55, Figs 4.26, 4.27", evaluate_stability, {"damping": 0.3},
        "damping that is too small for the condition",
    ), make_claim(
        "theorem 4-2: paths between those of K_min and K_max",
        '"the trajectory of this time-variant system must be bounded by curve 1 and curve 2"',
        "p. 61, Figs 4.28, 4.29", evaluate_path_bounds, {"damping": 0.3},
        "damping that is too small for the condition",
    ))),
    make_deterministic_experiment("published gains", measure_published_gains, make_claim(
        "published gains: worst switching dies out",
        "no translational axis (x, y, z) of Tables 6.7 and 6.9 satisfies the condition of theorem 4-2,"
        " but the motion with the worst switching between their bounds decays",
        "additional to p. 55, Tables 6.7, 6.9", evaluate_published_gains,
        {"damping": 0.1}, "a tenth of the damping", "additional",
    )),
    make_deterministic_experiment("levitated joystick", compute_joystick_resolution, make_claim(
        "joystick: condition of the coils' map",
        '"M is a well-conditioned 6 x 6 constant matrix"', "p. 66, Eq. 5.1", evaluate_coil_condition_number,
        {"radius": 100.0}, "torques scaled with a lever a hundred times as long", "input",
    ), make_claim(
        "joystick: resolution of the pose",
        '"approximately 1" um "for translation and 0.001" deg "for rotation"',
        "p. 65, Figs 5.31, 5.32", evaluate_pose_resolution, {"step": 10.0},
        "photodiodes with steps of 10 um", "input",
    )),
)  # fmt: skip
