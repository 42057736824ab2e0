"""Draw the motions of a trial: three runs to fit and one of another kind to judge."""

import numpy as np

from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.machine.machine import Machine
from hydrotele.scenario.pilots import TablePilot
from hydrotele.scenario.scenario import Scenario, Servo, StartState

RATE = 50.0  # Hz, of controller, sensors and log
SENSORS = "khoshzaban1992"

# Per axis the middle of the motion and its half width [rad], each drawn from low .. high.
_PLACES = {
    "fit_1": {
        "swing": ((-0.5, 0.5), (0.15, 0.25)),
        "boom": ((0.35, 0.55), (0.11, 0.17)),
        "stick": ((-1.50, -1.25), (0.14, 0.22)),
    },
    "fit_2": {
        "swing": ((-0.7, 0.7), (0.45, 0.70)),
        "boom": ((0.00, 0.12), (0.22, 0.30)),
        "stick": ((-2.00, -1.75), (0.32, 0.42)),
    },
    "fit_3": {
        "swing": ((-0.6, 0.6), (0.35, 0.55)),
        "boom": ((0.58, 0.66), (0.11, 0.17)),
        "stick": ((-1.10, -0.98), (0.30, 0.38)),
    },
}
# Share of the time in which the motion asks for more oil than the pump gives.
_STARVED = {"fit_2": (0.03, 0.12), "fit_3": (0.25, 0.45)}
_EASY = (0.60, 0.85)  # largest demand of fit_1 as a share of the pump's flow
_CYCLES = {"fit_1": (2.0, 7.0), "fit_2": (1.0, 6.0), "fit_3": (1.0, 5.0)}  # per 20 s at speed 1
_SLOW = {"swing": 0.5, "boom": 0.7, "stick": 1.0}  # the more an axis carries, the slower its waves
_STEPS = {  # middle, half width [rad] and speed of the steps [rad/s] in the held-out run
    "swing": ((-0.4, 0.4), 0.6, (0.15, 0.60)),
    "boom": ((0.35, 0.45), 0.28, (0.08, 0.30)),
    "stick": ((-1.60, -1.40), 0.48, (0.12, 0.45)),
}


def motions(machine: Machine, rng: np.random.Generator, duration: float = 40.0) -> list[Scenario]:
    """The four runs of a trial.

    Args:
        machine: a machine with the axes swing, boom and stick, without any effect.
        rng: source of all choices, among them the noise of every run.
        duration: of each run [s].

    Returns:
        `fit_1` slow with reversals and rests, `fit_2` medium, low and folded, `fit_3` fast, high
        and long, `test_1` from point to point, then steps. The controller is that of every run.
    """
    time = np.arange(round(duration * RATE)) / RATE
    servo = Servo(position_gain=rng.uniform(3.0, 5.0), lead=rng.uniform(0.05, 0.07))
    runs = []
    for name in ("fit_1", "fit_2", "fit_3", "test_1"):
        path = _steps(rng, time) if name == "test_1" else _waves(machine, rng, time, name)
        runs.append(_scenario(machine, name, time, path, servo, int(rng.integers(2**31))))
    return runs


def _scenario(machine, name, time, path, servo, seed) -> Scenario:
    joints = {machine.axes[axis].joint: float(q[0]) for axis, q in path.items()}
    columns = {axis: q.tolist() for axis, q in path.items()}
    pilot = TablePilot(kind="table", quantity="joint", interpolate="linear", time=time.tolist(), columns=columns)
    return Scenario(
        name=name, machine=machine.name, tool=machine.tool, seed=seed,
        duration=len(time) / RATE, control_rate=RATE, log_rate=RATE, sensors=SENSORS,
        ground=False, start=StartState(joints=joints), pilot=pilot, servo=servo,
    )  # fmt: skip


def _waves(machine: Machine, rng, time, name: str) -> dict[str, np.ndarray]:
    """Sums of sines on a clock that starts and rests smoothly, at the speed the pump allows."""
    shape = {}
    for axis, (middle, half) in _PLACES[name].items():
        orders = rng.uniform(*_CYCLES[name], 4) * _SLOW[axis]
        size = rng.uniform(0.5, 1.0, 4) / orders**0.8
        shape[axis] = (rng.uniform(*middle), rng.uniform(*half), orders, size,
                       rng.uniform(0, 2 * np.pi, 4))  # fmt: skip
    clock = _clock(rng, time, rests=2 if name == "fit_1" else 0)
    speed = 1.0
    for _ in range(3):  # the stretch of the waves that is passed depends on the speed itself
        demand = _demand(machine, {a: _wave(speed * clock, *s) for a, s in shape.items()}, time)
        if name in _STARVED:
            level = np.quantile(demand, 1.0 - np.mean(_STARVED[name]))
            speed *= _pump(machine) / level
        else:
            speed *= np.mean(_EASY) * _pump(machine) / demand.max()
    speed *= rng.uniform(0.85, 1.15)
    return {axis: _wave(speed * clock, *s) for axis, s in shape.items()}


def _wave(clock, middle, half, orders, size, phase) -> np.ndarray:
    period = 20.0  # s at speed 1
    angle = 2 * np.pi * orders / period * clock[:, None] + phase
    return middle + half * (np.sin(angle) @ size) / np.sqrt(np.sum(size**2)) / 1.6


def _clock(rng, time, rests: int) -> np.ndarray:
    """Time of the waves [s]: starts from standstill and stands still in every rest."""
    rate = np.clip(time / 1.5, 0.0, 1.0)
    for k in range(rests):
        begin = time[-1] * (k + rng.uniform(0.45, 0.75)) / rests
        end = begin + rng.uniform(2.0, 4.0)
        rate *= np.clip(np.maximum(begin - time, time - end) / 0.8, 0.0, 1.0)
    smooth = rate * rate * (3.0 - 2.0 * rate)
    return np.concatenate([[0.0], np.cumsum(0.5 * (smooth[1:] + smooth[:-1]) * np.diff(time))])


def _pump(machine: Machine) -> float:
    assert machine.supply
    return machine.supply.pump_flow


def _demand(machine: Machine, path: dict[str, np.ndarray], time) -> np.ndarray:
    """Oil that the motion takes from the pump (n,) [m^3/s]."""
    total = np.zeros(len(time))
    for axis in actuator_order(machine):
        head, rod = machine.axes[axis].hydraulic_drive.effective_areas
        speed = axis_linkage(machine, axis).rate(path[axis]) * np.gradient(path[axis], time)
        total += np.where(speed > 0.0, head, rod) * np.abs(speed)
    return total


def _steps(rng, time) -> dict[str, np.ndarray]:
    """Moves from point to point with pauses, then ramped steps of the speed between standstills."""
    half = time[-1] * rng.uniform(0.42, 0.52)
    middle = {axis: rng.uniform(*m) for axis, (m, _, _) in _STEPS.items()}
    here = {axis: middle[axis] + w * rng.uniform(-0.5, 0.5) for axis, (_, w, _) in _STEPS.items()}
    rate = {axis: np.zeros(len(time)) for axis in here}
    begin_all, now = dict(here), 0.6
    while now < half - 2.0:
        length = rng.uniform(1.6, 3.0)
        part = np.clip((time - now) / length, 0.0, 1.0)
        for axis, (_, width, _) in _STEPS.items():
            there = middle[axis] + width * rng.uniform(-1.0, 1.0)
            rate[axis] += (there - here[axis]) * 30 * part**2 * (1 - part) ** 2 / length
            here[axis] = there
        now += length + rng.uniform(0.6, 1.6)
    while now < time[-1] - 2.5:
        hold = rng.uniform(0.5, 1.1)
        for axis in rng.choice(list(_STEPS), size=rng.integers(1, 3), replace=False):
            speed, ramp = rng.uniform(*_STEPS[axis][2]), rng.uniform(0.15, 0.4)
            way = np.copysign(speed, middle[axis] - here[axis])
            pulse = np.minimum((time - now) / ramp, (now + 2 * ramp + hold - time) / ramp)
            rate[axis] += way * np.clip(pulse, 0.0, 1.0)
            here[axis] += way * (ramp + hold)
        now += hold + rng.uniform(1.2, 1.8)
    dt = np.diff(time)
    return {
        axis: begin_all[axis]
        + np.concatenate([[0.0], np.cumsum(0.5 * (r[1:] + r[:-1]) * dt)])
        for axis, r in rate.items()
    }  # fmt: skip
