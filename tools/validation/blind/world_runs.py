"""Simulate runs of the independent machine: commands, initial state, log."""

import dataclasses

import numpy as np
from scipy.signal import lfilter

from hydrotele.core.errors import InputError
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.logs.log import Log
from hydrotele.machine import log_channels
from hydrotele.machine.machine import Machine as Facts
from hydrotele.machine.machine import get_sensor_set, reading_noise_rms
from tools.validation.blind.motions import RATE, motions
from tools.validation.blind.world import (
    PA,
    PB,
    QD,
    STATES,
    WD,
    Machine,
    Q,
    S,
    U,
    W,
    arm_equations,
    felt,
    linkage,
    simulate,
)  # fmt: skip
from tools.validation.blind.world_machine import channels, independent_machine, stated_errors

SENSORS = {"cat215": "khoshzaban1992", "rig": "laboratory"}
STEP = {"cat215": 5.0e-4, "rig": 1.0e-4}  # s, where halving it changes less than 0.03 of the noise
_RESTART = 0.5  # s, of the visibility
_RIG_RATE = 200.0  # Hz
_PRESSURE_FEEDBACK = 6.0  # 1/s, damps the boom, which rings at 2.5 Hz
_LOAD_TIME = 0.2  # s, of the slow mean force
_BEYOND = 0.15  # rad beyond a joint's range at which a run counts as failed


@dataclasses.dataclass(frozen=True)
class Reference:
    """What the controller of a run is asked for.

    Attributes:
        name: of the run.
        period: of a row [s].
        joints: (rows, n) [rad] or [m].
        ahead: (rows, n) their rates, ahead by the lead [rad/s] or [m/s].
        gain: of the position error [1/s].
    """

    name: str
    period: float
    joints: np.ndarray
    ahead: np.ndarray
    gain: float


@dataclasses.dataclass(frozen=True)
class Noise:
    """Noise of the sensors against the stated one.

    Attributes:
        factor: kind of channel (angle, position, length, pressure) -> factor of its RMS.
        gaussian: normal instead of uniform.
        coloured: share of the variance with the autocorrelation exp(-t / memory) cos(2 pi frequency t).
        memory: correlation time of that part [s].
        frequency: of its resonance [Hz], 0 for none.
    """

    factor: dict[str, float]
    gaussian: bool = False
    coloured: float = 0.0
    memory: float = 1.0
    frequency: float = 0.0

    def draw(self, facts: Facts, rows: int, rng: np.random.Generator, period: float = 0.02) -> np.ndarray:
        """Errors (rows, c) before the converter [channel's unit], of rows at a period [s]."""
        names = channels(facts)
        bound, _ = stated_errors(facts, _sensors(facts))
        kinds = ["pressure" if n.startswith("pressure") else n.partition(".")[0] for n in names]
        bound = bound * [self.factor.get(kind, 1.0) for kind in kinds]
        shape = (rows, len(names))
        if self.gaussian:
            white = rng.normal(size=shape) * bound / np.sqrt(3.0)
        else:
            white = rng.uniform(-1.0, 1.0, shape) * bound
        if not self.coloured:
            return white
        tint = self._colour(shape, rng, period) * bound / np.sqrt(3.0)
        return np.sqrt(1.0 - self.coloured) * white + np.sqrt(self.coloured) * tint

    def _colour(self, shape: tuple[int, int], rng: np.random.Generator, period: float) -> np.ndarray:
        """Coloured noise of a variance of 1: a point that turns and decays, driven by normal noise."""
        turn = np.exp((2j * np.pi * self.frequency - 1.0 / self.memory) * period)
        drive = rng.normal(size=shape) + 1j * rng.normal(size=shape)
        drive[1:] *= np.sqrt(1.0 - abs(turn) ** 2)
        return np.real(lfilter([1.0], [1.0, -turn], drive, axis=0))


@dataclasses.dataclass(frozen=True)
class WorldRun:
    """One run.

    Attributes:
        name: of the run.
        log: what the workflow gets.
        commands: (rows, n) [1].
        states: (rows, n, STATES) the truth.
        clean: (rows, c) what the sensors would read without noise and converter.
    """

    name: str
    log: Log
    commands: np.ndarray
    states: np.ndarray
    clean: np.ndarray


def _sensors(facts: Facts):
    found = get_sensor_set(facts, SENSORS[facts.name])
    assert found
    return found


def nominal_world(facts: Facts) -> Machine:
    """The independent machine of facts, with its usual sensors."""
    return independent_machine(facts, _sensors(facts))


def references(facts: Facts, rng: np.random.Generator, duration: float) -> list[Reference]:
    """Three runs to learn from and one of another kind to judge on."""
    if facts.arm is None:
        return _rig_references(facts, rng, duration)
    found = []
    for scenario in motions(facts, rng, duration):
        servo, columns = scenario.servo, scenario.pilot.columns  # type: ignore[union-attr]
        joints = np.column_stack([columns[axis] for axis in facts.axes])
        found.append(_reference(scenario.name, 1.0 / RATE, joints, servo.lead, servo.position_gain))
    return found


def _reference(name: str, period: float, joints: np.ndarray, lead: float, gain: float) -> Reference:
    time = period * np.arange(len(joints))
    rates = np.gradient(joints, period, axis=0)
    ahead = np.column_stack([np.interp(time + lead, time, r) for r in rates.T])
    return Reference(name, period, joints, ahead, gain)


def _rig_references(facts: Facts, rng: np.random.Generator, duration: float) -> list[Reference]:
    """Sums of sines of three speeds; point to point with pauses in the held-out run."""
    time = np.arange(round(duration * _RIG_RATE)) / _RIG_RATE
    (low, high), found = next(iter(facts.joints.values())).range or (0.0, 1.0), []
    middle, half = 0.5 * (low + high), 0.35 * (high - low)
    start = np.clip(time, 0.0, 1.0) ** 2
    for name, speed in (("fit_1", 0.05), ("fit_2", 0.12), ("fit_3", 0.25)):
        tones, phases = rng.uniform(0.1, 1.0, 4), rng.uniform(0.0, 2.0 * np.pi, 4)
        waves = np.sin(2.0 * np.pi * np.outer(time, tones) + phases) @ (1.0 / tones)
        path = waves - waves[0]
        path *= speed / np.sqrt(np.mean(np.gradient(path, time) ** 2))
        path = start * path
        joints = middle + path * min(1.0, half / np.abs(path).max())
        found.append(_reference(name, 1 / _RIG_RATE, joints[:, None], 0.005, 15.0))
    joints, now, here = np.full(len(time), middle), 0.5, middle
    while now < time[-1] - 1.5:
        there, length = middle + half * rng.uniform(-1, 1), rng.uniform(0.7, 1.5)
        part = np.clip((time - now) / length, 0.0, 1.0)
        joints += (there - here) * part**3 * (10 - 15 * part + 6 * part**2)
        here, now = there, now + length + rng.uniform(0.2, 0.8)
    found.append(_reference("test_1", 1 / _RIG_RATE, joints[:, None], 0.005, 15.0))
    return found


def rest_state(machine: Machine, q: np.ndarray) -> np.ndarray:
    """State (n, STATES) at rest with closed valves, pressures that carry the weight.

    Args:
        machine: the machine.
        q: (n,) joint positions [rad] or [m].

    Returns:
        The state after 2 s of standing.
    """
    n, d = len(q), machine.drives
    needed = np.zeros(n)
    if not machine.mechanism.rig:
        mass, bias = np.zeros((3, 3)), np.zeros(3)
        arm_equations(machine.mechanism, q, np.zeros(3), mass, bias)
        needed = bias
    y = np.zeros((n, STATES))
    for i in range(n):
        force = needed[i] / linkage(machine.mechanism, i, q[i])[1]
        base = 2.0e6
        rod = max(base, (d.area_head[i] * base - force) / d.area_rod[i])
        y[i, Q] = y[i, QD] = q[i]
        y[i, PB], y[i, PA] = rod, (force + d.area_rod[i] * rod) / d.area_head[i]
    quiet = machine._replace(added=machine.added._replace(target=-1))
    rows, zeros, steps = 100, np.zeros((100, n)), 100 if machine.mechanism.rig else 40
    states = np.zeros((rows, n, STATES))
    c = len(machine.sensors.scale)
    simulate(quiet, y, zeros.copy(), False, zeros, zeros, zeros, np.ones((7, n)),
             np.zeros((rows, c)), 0.02, steps, 0, states)  # fmt: skip
    return states[-1]


def record_run(
    machine: Machine, model: Facts, reference: Reference, noise: Noise, rng: np.random.Generator
) -> WorldRun:
    """One run of a machine under a controller that knows the model.

    Args:
        machine: the true machine.
        model: the machine that the controller, and later the search, knows.
        reference: what is asked of it.
        noise: of its sensors.
        rng: source of the noise.

    Returns:
        The run.

    Raises:
        InputError: the machine left its range or the finite numbers.
    """
    n, rows = len(model.axes), len(reference.joints)
    arm = np.ones((rows, n))
    for i, axis in enumerate(model.axes):
        arm[:, i] = axis_linkage(model, axis).rate(reference.joints[:, i])
    known = nominal_world(model).drives
    full = np.full(n, 1.0)
    volume = known.dead_volume + 0.5 * known.area_head * known.stroke
    stiffness = 2.0 * known.bulk_modulus * known.area_head**2 / volume
    gains = np.array([
        reference.gain * full, known.flow_gain * np.sqrt(7.0e6), known.deadband, known.area_head,
        known.area_rod, _PRESSURE_FEEDBACK / stiffness, reference.period / _LOAD_TIME * full,
    ])  # fmt: skip
    commands, states = np.zeros((rows, n)), np.zeros((rows, n, STATES))
    start = rest_state(machine, reference.joints[0])
    steps = round(reference.period / STEP[model.name])
    readings, clean = simulate(
        machine, start, commands, True, reference.joints, reference.ahead, arm, gains,
        noise.draw(model, rows, rng, reference.period), reference.period, steps, 0, states,
    )  # fmt: skip
    _check(model, states)
    return WorldRun(reference.name, _log(model, reference, commands, readings), commands, states,
                    clean)  # fmt: skip


def _check(model: Facts, states: np.ndarray) -> None:
    if not np.isfinite(states).all():
        raise InputError("trial", "its machine left the finite numbers")
    for i, axis in enumerate(model.axes):
        low, high = model.joints[model.axes[axis].joint].range or (-np.inf, np.inf)
        margin = _BEYOND if model.arm else 0.0
        if states[:, i, Q].min() < low - margin or states[:, i, Q].max() > high + margin:
            raise InputError("trial", f"its {axis} left its range")


def _log(model: Facts, reference: Reference, commands, readings) -> Log:
    names = [f"command.{axis}" for axis in model.axes] + channels(model)
    values = [*commands.T, *readings.T]
    metadata = {
        "machine": model.name, "tool": model.tool, "sample_rate_hz": f"{1 / reference.period:g}",
        "sensors": SENSORS[model.name], "run": reference.name,
    }  # fmt: skip
    return Log(
        time=reference.period * np.arange(len(commands)),
        columns=dict(zip(names, values, strict=True)),
        units={name: log_channels.default_channel_unit(name, names) for name in names},
        metadata=metadata,
    )


def travelled(machine: Machine, run: WorldRun) -> dict[str, np.ndarray]:
    """Physical variables (rows, n) of a run, by the names of `world.VARIABLES`."""
    s, d, n = run.states, machine.drives, run.commands.shape[1]
    places = np.array([
        [linkage(machine.mechanism, i, q) for i, q in enumerate(row)] for row in s[:, :, Q]
    ])  # fmt: skip
    time = np.repeat(run.log.time[:, None], n, axis=1)
    head, rod = (np.vectorize(lambda p: felt(p, d))(s[:, :, side]) for side in (PA, PB))
    return {
        "position": places[:, :, 0], "velocity": places[:, :, 1] * s[:, :, W],
        "pressure_head": head, "pressure_rod": rod, "spool": s[:, :, S],
        "command": run.commands,
        "load_pressure": head - rod * d.area_rod / d.area_head,
        "supply": np.repeat(run.clean[:, -1:], n, axis=1), "time": time,
    }  # fmt: skip


def visibility(without: Machine, model: Facts, runs: list[WorldRun]) -> float:
    """How much of what was planted shows in the fit runs.

    The machine without it starts every half second from the true state of the machine that has it,
    and is fed with its commands.

    Args:
        without: the machine without what was planted.
        model: facts for the stated noise.
        runs: of the machine that has it.

    Returns:
        Root of the summed squares of the differences over all samples and channels of the fit runs
        [standard deviations of one reading].
    """
    names, sensors, total = channels(model), _sensors(model), 0.0
    size = np.array([reading_noise_rms(model, sensors, name) for name in names])
    for run in runs:
        if not run.name.startswith("fit"):
            continue
        rows, n = run.commands.shape
        period = float(run.log.time[1])
        zeros, states = np.zeros((rows, n)), run.states.copy()
        states[:, :, U] = 0.0
        states[:, :, QD], states[:, :, WD] = states[:, :, Q], states[:, :, W]
        _, expected = simulate(
            without, states[0], run.commands.copy(), False, zeros, zeros, zeros, np.ones((7, n)),
            np.zeros((rows, len(names))), period, round(period / STEP[model.name]),
            round(_RESTART / period), states,
        )  # fmt: skip
        difference = (run.clean - expected) / size
        difference[:, 0] -= difference[:, 0].mean() if model.arm else 0.0  # where swing is zero
        total += float(np.sum(difference**2))
    return float(np.sqrt(total))
