"""Design of periodic excitation motions that are most informative within a machine's limits.

`design_motion` maximises the determinant of the information about the base parameters over Fourier
series of the joint positions. `MachineLimits` and `DriveLimits` evaluate the limits of stroke,
flow, force, speed and acceleration.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from scipy.optimize import minimize

from hydrotele.core.errors import InputError
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.identify.identifiability import classify_noisy_parameters, reference_sizes
from hydrotele.identify.regressor_setup import RegressorSetup
from hydrotele.machine.machine import Machine
from hydrotele.multibody.inverse_dynamics import Projection

_ROWS_PER_PERIOD = 12  # rows per period of the highest harmonic
_RANGE_MARGIN = 0.05  # unused margin of a range or stroke
_MAX_FLOW_FRACTION, _MAX_FORCE_FRACTION, _MAX_VALVE_FRACTION = (
    0.95,
    0.8,
    0.8,
)  # usable fractions: pump flow, relief force, valve rating
_PENALTY_WEIGHTS = (
    1e1,
    1e3,
    1e5,
)  # increasing penalty weights, so that the result is within the limits
_READING_PERIOD_S = 0.02  # s between force readings of a typical log
_CHECK_RATE_FACTOR = 8  # factor of the row rate for the final check of the limits
_START_CANDIDATES = 12  # random motions, the best of which is the start of a search
_ERROR_CONTEXT = "excitation"


@dataclass(frozen=True)
class Excitation:
    """A periodic excitation motion of k axes, a Fourier series with H harmonics.

    Attributes:
        axes: names of the k axes.
        period: period [s].
        mean: (k,) mean positions [rad] or [m].
        sin: (k, H) sine amplitudes of the positions [rad] or [m].
        cos: (k, H) cosine amplitudes of the positions [rad] or [m].
        criterion: ln det of the information, divided by the number of parameters.
        max_utilisation: largest utilisation of a limit, 1 at the limit.
        parameters: number of base parameters in the criterion.
    """

    axes: tuple[str, ...]
    period: float
    mean: np.ndarray
    sin: np.ndarray
    cos: np.ndarray
    criterion: float
    max_utilisation: float
    parameters: int

    def evaluate(self, time: np.ndarray) -> np.ndarray:
        """Compute positions, rates and accelerations (3, n, k) of the motion at times (n,) [s]."""
        h = np.arange(1, self.sin.shape[1] + 1)
        turn = 2.0 * math.pi * h / self.period
        s, c = np.sin(np.outer(time, turn)), np.cos(np.outer(time, turn))
        return np.stack([
            self.mean + s @ self.sin.T + c @ self.cos.T,
            (c * turn) @ self.sin.T - (s * turn) @ self.cos.T,
            -(s * turn**2) @ self.sin.T - (c * turn**2) @ self.cos.T,
        ])  # fmt: skip

    def to_scenario(
        self,
        name: str,
        machine: Machine,
        cycles: float,
        machine_source: str | None = None,
        **more: Any,
    ) -> dict[str, Any]:
        """Return a scenario for `hydrotele run` that executes the motion.

        Args:
            name: name of the scenario.
            machine: the machine.
            cycles: number of periods after the fade-in.
            machine_source: name or folder of the machine in the scenario; its name by default.
            more: further keys of the scenario, such as `sensors`.
        """
        fade = 0.25 * self.period
        axes = {
            axis: {"mean": float(m), "sin": [float(v) for v in s], "cos": [float(v) for v in c]}
            for axis, m, s, c in zip(self.axes, self.mean, self.sin, self.cos, strict=True)
        }
        start = {machine.axes[a].joint: float(m) for a, m in zip(self.axes, self.mean, strict=True)}
        return {
            "name": name, "machine": machine_source or machine.name, "tool": machine.tool,
            "duration": float(fade + cycles * self.period), "control_rate": 50, "ground": False,
            "start": {"joints": start},
            "pilot": {"kind": "fourier", "period": float(self.period), "fade": fade, "axes": axes},
            "servo": {"lead": 0.06}, **more,
        }  # fmt: skip


def compute_information(
    setup: RegressorSetup, motions: np.ndarray, noise: np.ndarray, base: Sequence[int] | np.ndarray,
    sizes: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Compute the Fisher information (p, p) that a motion gives about the base parameters, per row.

    Args:
        setup: definition of the regressor.
        motions: (3, n, k) positions, rates and accelerations.
        noise: force errors of the drives: (k,) standard deviations [N] or [N m], or (k, k)
            covariance.
        base: indices of the p base parameters.
        sizes: (p,) units in which the parameters are expressed; 1 by default.

    Returns:
        (p, p) information, the sum over all rows and drives divided by the number of rows.
    """
    found = setup.project_motion_on_drives(*motions)
    table = setup.compute_regressor(found)
    noise = np.asarray(noise, float)
    if noise.ndim == 1:
        scaled = table.matrix[:, :, base] / noise[:, None]
    else:
        scaled = np.linalg.solve(np.linalg.cholesky(noise), table.matrix[:, :, base])
    if sizes is not None:
        scaled = scaled * sizes
    flat = scaled.reshape(-1, len(base))
    return flat.T @ flat / len(found.rate)


def select_determinable_parameters(
    machine: Machine, setup: RegressorSetup, noise: np.ndarray, period: float = 20.0, seed: int = 0
) -> np.ndarray:
    """Select the base parameters that a random motion of the machine determines despite force noise.

    Their standard deviation, with force readings every 0.02 s over one period, is at most half of
    their reference size.

    Args:
        machine: the machine.
        setup: definition of the regressor.
        noise: (k,) standard deviation of a force reading [N] or [N m].
        period: period of that motion [s].
        seed: seed of its random harmonics.

    Returns:
        (p,) indices of the regressor's parameters for which a motion should be designed.
    """
    limits, rng = MachineLimits(machine, setup), np.random.default_rng(seed)
    time = np.arange(0.0, period, _READING_PERIOD_S)
    phase = rng.uniform(0.0, 2.0 * math.pi, (len(limits.axes), 5))
    wide = 0.15 * limits.half_range[:, None] / np.arange(1, 6) * 5.0 / np.sqrt(5.0)
    motion = Excitation(
        limits.axes, period, limits.centre, wide * np.cos(phase), wide * np.sin(phase), 0, 0, 0
    ).evaluate(time)
    motion[0] = np.clip(motion[0], limits.lower, limits.upper)
    found = setup.project_motion_on_drives(*motion)
    table = setup.compute_regressor(found)
    forces = np.sqrt(np.mean((table.matrix @ table.nominal) ** 2, axis=0))
    flat = (table.matrix / noise[:, None]).reshape(-1, len(table.names))
    asked = np.ones(len(table.names), bool)
    return classify_noisy_parameters(flat, table.names, reference_sizes(table, setup, forces), asked).base


class MotionLimits(Protocol):
    """Interface of the limits of a motion that is described by the positions of k joints.

    Attributes:
        axes: names of the k joints or of their axes.
        lower: (k,) lowest positions [rad] or [m].
        upper: (k,) highest positions [rad] or [m].
        centre: (k,) centres of the ranges.
        half_range: (k,) half widths of the ranges.
    """

    axes: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    centre: np.ndarray
    half_range: np.ndarray

    def compute_utilisation(self, motions: np.ndarray, clipped: np.ndarray) -> np.ndarray:
        """Compute how far each of l limits is used at each row of a motion, 1 at the limit.

        Args:
            motions: (3, n, k) positions, rates and accelerations.
            clipped: the same with positions clipped to `lower` and `upper`.

        Returns:
            (n, l) utilisation, above 1 where a limit is exceeded.
        """
        ...


def design_motion(
    limits: MotionLimits, setup: RegressorSetup, noise: np.ndarray,
    base: Sequence[int] | np.ndarray, *,
    period: float = 20.0, harmonics: int = 8, starts: int = 2, iterations: int = 150,
    seed: int = 0, progress: Callable[[str, float], None] | None = None,
) -> Excitation:  # fmt: skip
    """Design a D-optimal Fourier motion of the given joints within limits.

    It maximises ln det of the Fisher information about the base parameters, divided by their number.

    Args:
        limits: limits of the motion; `MachineLimits` evaluates those of a machine.
        setup: definition of the regressor.
        noise: force errors of the drives, as in `compute_information`.
        base: indices of the base parameters in the criterion.
        period: period of the motion [s].
        harmonics: number H of harmonics.
        starts: number of searches, each from random motions.
        iterations: iterations of each search for each of several increasing weights of the penalty for
            exceeded limits.
        seed: seed of the random motions.
        progress: called with a description of the step and the finished fraction, 0 .. 1.

    Returns:
        The best motion found.

    Raises:
        InputError: no search ends within the limits.

    Source: Abdellatif 2008, section 4 and (22)-(26); Swevers et al. 1997.
    """
    rows = max(60, _ROWS_PER_PERIOD * harmonics)
    time = np.arange(rows) * period / rows
    k, rng, best = len(setup.given_joints), np.random.default_rng(seed), None
    sizes = _parameter_scales(setup, base, limits.centre)

    def build_excitation(x: np.ndarray) -> Excitation:
        parts = x.reshape(k, 1 + 2 * harmonics)
        turn = np.arange(1, harmonics + 1)
        mean = limits.centre + limits.half_range * np.tanh(parts[:, 0])
        wide = limits.half_range[:, None] * parts[:, 1:] / np.tile(turn, 2)
        return Excitation(limits.axes, period, mean, wide[:, :harmonics], wide[:, harmonics:], 0.0, 0.0, len(base))

    def evaluate_criterion_and_limits(x: np.ndarray, time: np.ndarray = time) -> tuple[float, np.ndarray]:
        motions = build_excitation(x).evaluate(time)
        inside = np.clip(motions[0], limits.lower, limits.upper)
        held = np.stack([inside, motions[1], motions[2]])
        info = compute_information(setup, held, noise, base, sizes)
        value = np.linalg.slogdet(info + 1e-12 * np.eye(len(base)))[1] / len(base)
        return float(value), limits.compute_utilisation(motions, held)

    def cost(x: np.ndarray, press: float) -> float:
        try:
            value, use = evaluate_criterion_and_limits(x)
        except InputError:
            return 1e6
        return -value + press * float(np.mean(np.maximum(use - 1.0, 0.0) ** 2))

    for start in range(starts):
        drawn = [
            _scale_into_limits(rng.normal(0.0, 0.3, (k, 1 + 2 * harmonics)).ravel(), evaluate_criterion_and_limits)
            for _ in range(_START_CANDIDATES)
        ]
        x = max(drawn, key=lambda one: evaluate_criterion_and_limits(one)[0])
        for step, press in enumerate(_PENALTY_WEIGHTS):
            if progress:
                progress(f"start {start + 1}", (start + step / len(_PENALTY_WEIGHTS)) / starts)
            x = minimize(cost, x, (press,), method="L-BFGS-B", options={"maxiter": iterations}).x
        x = _scale_into_limits(x, evaluate_criterion_and_limits)
        value, use = evaluate_criterion_and_limits(x)
        if use.max() <= 1.0 and (best is None or value > best[0]):
            best = (value, x, float(use.max()))
    if best is None:
        raise InputError(_ERROR_CONTEXT, "no motion within the limits was found: increase starts")
    between = np.arange(_CHECK_RATE_FACTOR * rows) * period / (_CHECK_RATE_FACTOR * rows)
    x = _scale_into_limits(best[1], lambda x: evaluate_criterion_and_limits(x, between), 0.998)
    value, use = evaluate_criterion_and_limits(x, between)
    made, worst = build_excitation(x), float(use.max())
    return Excitation(made.axes, period, made.mean, made.sin, made.cos, value, worst, len(base))


def _scale_into_limits(x: np.ndarray, measure: Callable, step: float = 0.97) -> np.ndarray:
    """Multiply the parameters of a motion by `step` < 1, up to 60 times, until it is within all limits.

    `measure` returns (criterion, utilisation of the limits) of a motion. The last parameters are
    returned, even if they exceed a limit.
    """
    for _ in range(60):
        if measure(x)[1].max() <= 1.0:
            return x
        x = step * x
    return x


def _parameter_scales(setup: RegressorSetup, base: Sequence[int] | np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Return scales (p,) of the base parameters, so that the information's determinant is free of units.

    They are the magnitudes of the given values, at least 1.
    """
    still = np.zeros((1, len(middle)))
    found = setup.project_motion_on_drives(middle[None], still, still)
    table = setup.compute_regressor(found)
    return np.maximum(np.abs(table.nominal[np.asarray(base)]), 1.0)


class DriveLimits:
    """Limits of stroke, speed and acceleration of the drives, for a motion given in other coordinates.

    These coordinates, the given joints, are for example those of a platform's pose. Their ranges are
    limited as well.
    """

    def __init__(
        self, setup: RegressorSetup, low: np.ndarray, high: np.ndarray, stroke: np.ndarray,
        speed: float, acceleration: float,
    ):  # fmt: skip
        """Set the limits.

        Args:
            setup: definition of the regressor.
            low: (k,) lowest positions of the given joints [rad] or [m].
            high: (k,) highest positions of the given joints [rad] or [m].
            stroke: (d, 2) lowest and highest positions of the d drives [rad] or [m].
            speed: largest speed of a drive [rad/s] or [m/s].
            acceleration: largest acceleration of a drive [rad/s^2] or [m/s^2].

        Source: Abdellatif 2008, (25).
        """
        self.setup, self.axes = setup, setup.given_joints
        self.lower, self.upper = np.asarray(low, float), np.asarray(high, float)
        self.centre, self.half_range = (
            0.5 * (self.lower + self.upper),
            0.5 * (self.upper - self.lower),
        )
        stroke = np.asarray(stroke, float)
        self.drive_middle, self.drive_half = stroke.mean(axis=1), 0.5 * np.ptp(stroke, axis=1)
        self.speed, self.acceleration = speed, acceleration
        self.drives = [setup.chain.index(d) for d in setup.chain.drives]

    def compute_utilisation(self, motions: np.ndarray, clipped: np.ndarray) -> np.ndarray:
        """Return the utilisation (n, l) of joint ranges, strokes, speeds and accelerations, 1 at the limit."""
        found = self.setup.project_motion_on_drives(*clipped)
        return np.concatenate(
            [
                1.0 + (motions[0] - self.upper) / self.half_range,
                1.0 + (self.lower - motions[0]) / self.half_range,
                np.abs(found.position[:, self.drives] - self.drive_middle) / self.drive_half,
                np.abs(found.rate[:, self.drives]) / self.speed,
                np.abs(found.acceleration[:, self.drives]) / self.acceleration,
            ],
            axis=1,
        )


class MachineLimits:
    """Motion limits of a machine: joint ranges, strokes, flows, and forces at relief pressure.

    All axes share the pump flow. Forces follow from the nominal parameters of the setup.

    Args:
        machine: the machine.
        setup: definition of the regressor.

    Raises:
        InputError: an axis has a force drive, for which there are no default servo gains, or a separate
            pump.
    """

    def __init__(self, machine: Machine, setup: RegressorSetup):
        if plain := [name for name, axis in machine.axes.items() if axis.force]:
            raise InputError(
                _ERROR_CONTEXT, f"{', '.join(plain)} has a force drive without default servo gains:"
                " write a scenario with a `fourier` pilot and your own `servo` gains",
            )  # fmt: skip
        if pumped := [name for name, axis in machine.axes.items() if axis.pump]:
            raise InputError(
                _ERROR_CONTEXT, f"{', '.join(pumped)} has a separate pump, whose flow and pressure limits are not"
                " known here: write a scenario with a `fourier` pilot and suitable amplitudes",
            )  # fmt: skip
        self.machine, self.setup = machine, setup
        self.axes = tuple(actuator_order(machine))
        ranges = []
        for axis in self.axes:
            joint = machine.joints[machine.axes[axis].joint]
            ranges.append(joint.range or (-0.5 * math.pi, 0.5 * math.pi))
        low, high = np.array(ranges).T
        self.lower, self.upper = (
            low + _RANGE_MARGIN * (high - low),
            high - _RANGE_MARGIN * (high - low),
        )
        self.centre, self.half_range = (
            0.5 * (self.lower + self.upper),
            0.5 * (self.upper - self.lower),
        )
        self.drives = [setup.chain.index(d) for d in setup.chain.drives]

    def compute_utilisation(self, motions: np.ndarray, clipped: np.ndarray) -> np.ndarray:
        """Return the utilisation (n, l) of joint ranges, drives and pump flow at each row, 1 at the limit.

        Limits are reduced by margins: 5 % of ranges and strokes, 80 % of the force at relief pressure
        and of the valve's rated flow, and 95 % of the pump flow. Args as in `MotionLimits`.
        """
        parts = [
            1.0 + (motions[0] - self.upper) / self.half_range,
            1.0 + (self.lower - motions[0]) / self.half_range,
        ]
        found = self.setup.project_motion_on_drives(*clipped)
        table = replace(self.setup, offsets=None).compute_regressor(found)
        forces = table.matrix @ table.nominal
        flow = {pump: np.zeros(len(forces)) for pump in self.machine.pumps}
        for i, axis in enumerate(self.axes):
            parts.append(self._drive_utilisation(axis, i, found, forces[:, i], flow)[:, None])
        for pump, drawn in flow.items():
            parts.append(drawn[:, None] / (_MAX_FLOW_FRACTION * self.machine.pumps[pump].pump_flow))
        return np.concatenate(parts, axis=1)

    def _drive_utilisation(
        self, axis: str, i: int, projection: Projection, force: np.ndarray, flow: dict[str, np.ndarray]
    ) -> np.ndarray:
        """Return the largest utilisation (n,) of a drive's force, valve flow and stroke limits at each row.

        It is 1 at the limit. The drive's flow is added to that of its pump in `flow`, name ->
        (n,) [m^3/s], in place.
        """
        facts, pump, j = self.machine.axes[axis], self.machine.pump_of(axis), self.drives[i]
        supply = self.machine.pumps[pump]
        assert facts.valve is not None
        head, rod = facts.hydraulic_drive.effective_areas
        speed = projection.rate[:, j]
        taken = np.where(speed > 0.0, head * speed, -rod * speed)
        flow[pump] += taken
        reach = np.where(force > 0.0, head, rod) * (supply.relief_pressure - supply.tank_pressure)
        used = np.maximum(
            np.abs(force) / (_MAX_FORCE_FRACTION * reach),
            taken / (_MAX_VALVE_FRACTION * facts.valve.rated_flow),
        )
        if facts.cylinder:
            x, half = projection.position[:, j], 0.5 * facts.cylinder.stroke
            used = np.maximum(used, np.abs(x - half) / ((1.0 - _RANGE_MARGIN) * half))
        return used
