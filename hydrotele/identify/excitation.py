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
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.identify.identifiability import identifiable_in_noise, reference_sizes
from hydrotele.identify.setup import RegressorSetup
from hydrotele.machine.machine import Machine
from hydrotele.multibody.inverse_dynamics import Projection

_ROWS = 12  # rows per period of the highest harmonic
_MARGIN = 0.05  # unused margin of a range or stroke
_FLOW, _FORCE, _VALVE = 0.95, 0.8, 0.8  # usable fractions: pump flow, relief force, valve rating
_PRESS = (1e1, 1e3, 1e5)  # increasing penalty weights, so that the result is within the limits
_READ = 0.02  # s between force readings of a typical log
_BETWEEN = 8  # factor of the row rate for the final check of the limits
_DRAWN = 12  # random motions, the best of which is the start of a search
_WHERE = "excitation"


@dataclass(frozen=True)
class Excitation:
    """A periodic motion of k axes with H harmonics.

    Attributes:
        axes: names of the k axes.
        period: period [s].
        mean: (k,) mean positions [rad] or [m].
        sin: (k, H) sine amplitudes of the positions [rad] or [m].
        cos: (k, H) cosine amplitudes of the positions [rad] or [m].
        criterion: ln det of the information, divided by the number of parameters.
        worst: largest utilisation of a limit, 1 at the limit.
        parameters: number of base parameters in the criterion.
    """

    axes: tuple[str, ...]
    period: float
    mean: np.ndarray
    sin: np.ndarray
    cos: np.ndarray
    criterion: float
    worst: float
    parameters: int

    def motion(self, time: np.ndarray) -> np.ndarray:
        """Return positions, rates and accelerations (3, n, k) at times (n,) [s]."""
        h = np.arange(1, self.sin.shape[1] + 1)
        turn = 2.0 * math.pi * h / self.period
        s, c = np.sin(np.outer(time, turn)), np.cos(np.outer(time, turn))
        return np.stack([
            self.mean + s @ self.sin.T + c @ self.cos.T,
            (c * turn) @ self.sin.T - (s * turn) @ self.cos.T,
            -(s * turn**2) @ self.sin.T - (c * turn**2) @ self.cos.T,
        ])  # fmt: skip

    def scenario(
        self, name: str, machine: Machine, cycles: float, found_at: str | None = None, **more: Any
    ) -> dict[str, Any]:
        """Return a scenario for `hydrotele run` that executes the motion.

        Args:
            name: name of the scenario.
            machine: the machine.
            cycles: number of periods after the fade-in.
            found_at: name or folder of the machine in the scenario; its name by default.
            more: further keys of the scenario, such as `sensors`.
        """
        fade = 0.25 * self.period
        axes = {
            axis: {"mean": float(m), "sin": [float(v) for v in s], "cos": [float(v) for v in c]}
            for axis, m, s, c in zip(self.axes, self.mean, self.sin, self.cos, strict=True)
        }
        start = {machine.axes[a].joint: float(m) for a, m in zip(self.axes, self.mean, strict=True)}
        return {
            "name": name, "machine": found_at or machine.name, "tool": machine.tool,
            "duration": float(fade + cycles * self.period), "control_rate": 50, "ground": False,
            "start": {"joints": start},
            "pilot": {"kind": "fourier", "period": float(self.period), "fade": fade, "axes": axes},
            "servo": {"lead": 0.06}, **more,
        }  # fmt: skip


def information(
    setup: RegressorSetup, motions: np.ndarray, noise: np.ndarray, base: Sequence[int] | np.ndarray,
    sizes: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Compute the Fisher information (p, p) per row of a motion about the base parameters.

    Args:
        setup: definition of the regressor.
        motions: (3, n, k) positions, rates and accelerations.
        noise: force errors of the drives: (k,) standard deviations [N] or [N m], or (k, k)
            covariance.
        base: indices of the p base parameters.
        sizes: (p,) units in which the parameters are expressed; 1 by default.
    """
    found = setup.project(*motions)
    table = setup.table(found)
    noise = np.asarray(noise, float)
    if noise.ndim == 1:
        scaled = table.matrix[:, :, base] / noise[:, None]
    else:
        scaled = np.linalg.solve(np.linalg.cholesky(noise), table.matrix[:, :, base])
    if sizes is not None:
        scaled = scaled * sizes
    flat = scaled.reshape(-1, len(base))
    return flat.T @ flat / len(found.rate)


def informative_base(
    machine: Machine, setup: RegressorSetup, noise: np.ndarray, period: float = 20.0, seed: int = 0
) -> np.ndarray:
    """Select the base parameters that a random, not optimised motion determines despite noise.

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
    time = np.arange(0.0, period, _READ)
    phase = rng.uniform(0.0, 2.0 * math.pi, (len(limits.axes), 5))
    wide = 0.15 * limits.half[:, None] / np.arange(1, 6) * 5.0 / np.sqrt(5.0)
    motion = Excitation(
        limits.axes, period, limits.middle, wide * np.cos(phase), wide * np.sin(phase), 0, 0, 0
    ).motion(time)
    motion[0] = np.clip(motion[0], limits.low, limits.high)
    found = setup.project(*motion)
    table = setup.table(found)
    forces = np.sqrt(np.mean((table.matrix @ table.nominal) ** 2, axis=0))
    flat = (table.matrix / noise[:, None]).reshape(-1, len(table.names))
    asked = np.ones(len(table.names), bool)
    return identifiable_in_noise(
        flat, table.names, reference_sizes(table, setup, forces), asked
    ).base


class MotionLimits(Protocol):
    """Motion limits of k given joints and of the drives.

    Attributes:
        axes: names of the k joints or of their axes.
        low: (k,) lowest positions [rad] or [m].
        high: (k,) highest positions [rad] or [m].
        middle: (k,) centres of the ranges.
        half: (k,) half widths of the ranges.
    """

    axes: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    middle: np.ndarray
    half: np.ndarray

    def use(self, motions: np.ndarray, held: np.ndarray) -> np.ndarray:
        """Compute the utilisation of every limit at every row.

        Args:
            motions: (3, n, k) positions, rates and accelerations.
            held: the same with positions clipped to `low` and `high`.

        Returns:
            (n, l) utilisation, 1 at the limit.
        """
        ...


def design_motion(
    limits: MotionLimits, setup: RegressorSetup, noise: np.ndarray,
    base: Sequence[int] | np.ndarray, *,
    period: float = 20.0, harmonics: int = 8, starts: int = 2, iterations: int = 150,
    seed: int = 0, progress: Callable[[str, float], None] | None = None,
) -> Excitation:  # fmt: skip
    """Design a D-optimal Fourier motion of the given joints within limits.

    Maximises ln det of the information about the base parameters.

    Args:
        limits: limits of the motion; `MachineLimits` evaluates those of a machine.
        setup: definition of the regressor.
        noise: force errors of the drives, as in `information`.
        base: indices of the base parameters in the criterion.
        period: period of the motion [s].
        harmonics: number H of harmonics.
        starts: number of searches, each from random motions.
        iterations: iterations of each search per penalty weight.
        seed: seed of the random motions.
        progress: called with a description of the step and the finished fraction, 0 .. 1.

    Returns:
        The best motion found.

    Raises:
        InputError: no search ends within the limits.

    Source: Abdellatif 2008, section 4 and (22)-(26); Swevers et al. 1997.
    """
    rows = max(60, _ROWS * harmonics)
    time = np.arange(rows) * period / rows
    k, rng, best = len(setup.given), np.random.default_rng(seed), None
    sizes = _sizes(setup, base, limits.middle)

    def excitation(x: np.ndarray) -> Excitation:
        parts = x.reshape(k, 1 + 2 * harmonics)
        turn = np.arange(1, harmonics + 1)
        mean = limits.middle + limits.half * np.tanh(parts[:, 0])
        wide = limits.half[:, None] * parts[:, 1:] / np.tile(turn, 2)
        return Excitation(
            limits.axes, period, mean, wide[:, :harmonics], wide[:, harmonics:], 0.0, 0.0, len(base)
        )

    def measure(x: np.ndarray, time: np.ndarray = time) -> tuple[float, np.ndarray]:
        motions = excitation(x).motion(time)
        inside = np.clip(motions[0], limits.low, limits.high)
        held = np.stack([inside, motions[1], motions[2]])
        info = information(setup, held, noise, base, sizes)
        value = np.linalg.slogdet(info + 1e-12 * np.eye(len(base)))[1] / len(base)
        return float(value), limits.use(motions, held)

    def cost(x: np.ndarray, press: float) -> float:
        try:
            value, use = measure(x)
        except InputError:
            return 1e6
        return -value + press * float(np.mean(np.maximum(use - 1.0, 0.0) ** 2))

    for start in range(starts):
        drawn = [
            _inside(rng.normal(0.0, 0.3, (k, 1 + 2 * harmonics)).ravel(), measure)
            for _ in range(_DRAWN)
        ]
        x = max(drawn, key=lambda one: measure(one)[0])
        for step, press in enumerate(_PRESS):
            if progress:
                progress(f"start {start + 1}", (start + step / len(_PRESS)) / starts)
            x = minimize(cost, x, (press,), method="L-BFGS-B", options={"maxiter": iterations}).x
        x = _inside(x, measure)
        value, use = measure(x)
        if use.max() <= 1.0 and (best is None or value > best[0]):
            best = (value, x, float(use.max()))
    if best is None:
        raise InputError(_WHERE, "no motion within the limits was found: increase starts")
    between = np.arange(_BETWEEN * rows) * period / (_BETWEEN * rows)
    x = _inside(best[1], lambda x: measure(x, between), 0.998)
    value, use = measure(x, between)
    made, worst = excitation(x), float(use.max())
    return Excitation(made.axes, period, made.mean, made.sin, made.cos, value, worst, len(base))


def _inside(x: np.ndarray, measure: Callable, step: float = 0.97) -> np.ndarray:
    """Scale the parameters of a motion down until it satisfies all limits."""
    for _ in range(60):
        if measure(x)[1].max() <= 1.0:
            return x
        x = step * x
    return x


def _sizes(
    setup: RegressorSetup, base: Sequence[int] | np.ndarray, middle: np.ndarray
) -> np.ndarray:
    """Return scales of the base parameters that make the determinant independent of units.

    They are the magnitudes of the given values, at least 1.
    """
    still = np.zeros((1, len(middle)))
    found = setup.project(middle[None], still, still)
    table = setup.table(found)
    return np.maximum(np.abs(table.nominal[np.asarray(base)]), 1.0)


class DriveLimits:
    """Motion limits of the drives, for given joints that may be any coordinates, such as a pose."""

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
        self.setup, self.axes = setup, setup.given
        self.low, self.high = np.asarray(low, float), np.asarray(high, float)
        self.middle, self.half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        stroke = np.asarray(stroke, float)
        self.drive_middle, self.drive_half = stroke.mean(axis=1), 0.5 * np.ptp(stroke, axis=1)
        self.speed, self.acceleration = speed, acceleration
        self.drives = [setup.chain.index(d) for d in setup.chain.drives]

    def use(self, motions: np.ndarray, held: np.ndarray) -> np.ndarray:
        """Return the utilisation of every limit at every row (n, l), 1 at the limit."""
        found = self.setup.project(*held)
        return np.concatenate(
            [
                1.0 + (motions[0] - self.high) / self.half,
                1.0 + (self.low - motions[0]) / self.half,
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
        InputError: the machine has force drives, for which there are no default servo gains.
    """

    def __init__(self, machine: Machine, setup: RegressorSetup):
        if plain := [name for name, axis in machine.axes.items() if axis.force]:
            raise InputError(
                _WHERE, f"{', '.join(plain)} has a force drive without default servo gains:"
                " write a scenario with a `fourier` pilot and your own `servo` gains",
            )  # fmt: skip
        self.machine, self.setup = machine, setup
        self.axes = tuple(actuator_order(machine))
        ranges = []
        for axis in self.axes:
            joint = machine.joints[machine.axes[axis].joint]
            ranges.append(joint.range or (-0.5 * math.pi, 0.5 * math.pi))
        low, high = np.array(ranges).T
        self.low, self.high = low + _MARGIN * (high - low), high - _MARGIN * (high - low)
        self.middle, self.half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        self.drives = [setup.chain.index(d) for d in setup.chain.drives]

    def use(self, motions: np.ndarray, held: np.ndarray) -> np.ndarray:
        """Return the utilisation of every limit at every row (n, l), 1 at the limit."""
        parts = [
            1.0 + (motions[0] - self.high) / self.half,
            1.0 + (self.low - motions[0]) / self.half,
        ]
        found = self.setup.project(*held)
        table = replace(self.setup, offsets=None).table(found)
        forces = table.matrix @ table.nominal
        flow = np.zeros(len(forces))
        for i, axis in enumerate(self.axes):
            parts.append(self._drive_use(axis, i, found, forces[:, i], flow)[:, None])
        supply = self.machine.supply
        if supply is not None:
            parts.append(flow[:, None] / (_FLOW * supply.pump_flow))
        return np.concatenate(parts, axis=1)

    def _drive_use(
        self, axis: str, i: int, found: Projection, force: np.ndarray, flow: np.ndarray
    ) -> np.ndarray:
        """Return the utilisation (n,) of a drive's limits; add its flow to `flow` (n,) [m^3/s]."""
        facts, supply = self.machine.axes[axis], self.machine.supply
        j = self.drives[i]
        if facts.force:
            limit = abs(facts.force.gain) * facts.force.command_limit
            return np.abs(force) / (_FORCE * limit)
        assert supply is not None and facts.valve is not None
        head, rod = facts.hydraulic_drive.areas
        speed = found.rate[:, j]
        taken = np.where(speed > 0.0, head * speed, -rod * speed)
        flow += taken
        reach = np.where(force > 0.0, head, rod) * (supply.relief_pressure - supply.tank_pressure)
        used = np.maximum(
            np.abs(force) / (_FORCE * reach), taken / (_VALVE * facts.valve.rated_flow)
        )
        if facts.cylinder:
            x, half = found.position[:, j], 0.5 * facts.cylinder.stroke
            used = np.maximum(used, np.abs(x - half) / ((1.0 - _MARGIN) * half))
        return used
