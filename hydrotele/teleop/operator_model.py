"""The simulated operator: what he sees and feels, and what he wants the handle to do.

He never knows the contact force: he feels what the handle does, sees the tip and whether it
touches, and in `track` a graph of the force that he is to make, beside it the estimated force where
the screen shows it. He decides fifty times a second;
`teleop.operator_model` does the rest.

Muscles of the simulated operator: from a wanted displacement to forces on the handle.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from hydrotele.control.resolved_motion import COORDINATES
from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.machine.joystick import AXES, Joystick
from hydrotele.scenario.teleoperation import Follow, Live, Regulate, Steer, TeleopPilot, Track
from hydrotele.teleop.axis_table import (
    COORDINATE,
    DEADBAND,
    DROP,
    GAIN,
    LEAST,
    LIMIT,
    NOMINAL,
    OUTSIDE,
    RATIO,
    REACH,
    SIGN,
    SLOPE,
    flattened,
    split,
)
from hydrotele.teleop.master import Master

_THROUGH = 1.15  # times the force at a notch's edge, to get over it
_FINE, _FINE_TURN = 4e-4, 4e-3  # m, rad: a larger gap is a way to go, nothing to learn from


class Muscles(NamedTuple):
    """Numbers and state of the muscles.

    Attributes:
        wanted: (6,) displacement of the handle [m], [rad].
        spring: (6,) what the joystick is expected to push back with [N/m], [N m/rad].
        notch: (3, 6) of its detents: edge [m], [rad], drop [N], [N m], slope outside [N/m], < 0
            without a detent.
        correction: (6,) what was learnt to be missing [N], [N m].
        force: (6,) on the handle [N], [N m].
        arm: (6,) stiffness of arm and hand [N/m], [N m/rad].
        most: (6,) largest force [N], [N m].
        weight: (6,) of the hand, which they carry [N], [N m].
        gain: (1,) of the correction [1/s].
    """

    wanted: np.ndarray
    spring: np.ndarray
    notch: np.ndarray
    correction: np.ndarray
    force: np.ndarray
    arm: np.ndarray
    most: np.ndarray
    weight: np.ndarray
    gain: np.ndarray


@compiled
def unpack_muscles(flat):
    """The parts of `flat_view(Muscles)`.

    Args:
        flat: (61,) array.

    Returns:
        Muscles, views of it.

    Source: order and shapes of Muscles.
    """
    wanted, rest = split(flat, 6)
    spring, rest = split(rest, 6)
    notch, rest = split(rest, 18)
    correction, rest = split(rest, 6)
    force, rest = split(rest, 6)
    arm, rest = split(rest, 6)
    most, rest = split(rest, 6)
    weight, gain = split(rest, 6)
    return Muscles(
        wanted, spring, notch.reshape(3, 6), correction, force, arm, most, weight, gain
    )  # fmt: skip


@compiled
def pull(muscles, past, tremor, handle, tick, period):
    """Forces of one period: the arm's rest moves with what is wanted, the rest is corrected late.

    Args:
        muscles: Muscles; `correction` and `force` are written.
        past: (reflex + 1, 6) displacements of the last periods, written [m], [rad].
        tremor: (n, 6) of the run [N], [N m].
        handle: (6,) displacement of now [m], [rad].
        tick: number of the period, scalar.
        period: scalar [s].

    Returns:
        Nothing.

    Source: equilibrium-point control with a late integral; Feldman 1986.
    """
    rows = len(past)
    noise = tick % len(tremor)
    for i in range(6):
        past[tick % rows, i] = handle[i]
        late = past[(tick + 1) % rows, i]
        wanted, spring, most = muscles.wanted[i], muscles.spring[i], muscles.most[i]
        firm = muscles.arm[i] + spring
        known = firm * wanted
        beyond = abs(wanted) - muscles.notch[0, i]
        if muscles.notch[2, i] >= 0.0 and beyond > 0.0:
            firm = muscles.arm[i] + muscles.notch[2, i]
            back = spring * muscles.notch[0, i] - muscles.notch[1, i] + muscles.notch[2, i] * beyond
            if (late if wanted > 0.0 else -late) < muscles.notch[0, i]:
                back = _THROUGH * spring * muscles.notch[0, i]  # first over the notch's edge
            known = muscles.arm[i] * wanted + (back if wanted > 0.0 else -back)
        fine = _FINE if i < 3 else _FINE_TURN
        gap = min(fine, max(-fine, wanted - late))
        more = muscles.gain[0] * period * firm * gap
        muscles.correction[i] = min(most, max(-most, muscles.correction[i] + more))
        force = known + muscles.correction[i] + tremor[noise, i]
        muscles.force[i] = min(most, max(-most, force)) + muscles.weight[i]


DECISIONS = 50.0  # Hz
REFLEX = 0.05  # s, from where the hand is to what the muscles do: stretch reflex and cortex
_HOLD = 0.8  # of the dead band: where a hand rests that feels without moving
_CLOSE = 0.05  # of the target: a force error that a person leaves alone
_LEAST_CLOSE = 0.2  # of the largest target's: for targets near nothing
_NOTICED = 0.2  # N: a force on the hand that stands out from its own tremor and the spring's
_PUSH = 0.3  # s of a correcting push
_LEAST_WAY = 3e-4  # m: a stiffness cannot be felt from a smaller displacement
_LEANING = 0.3  # s in which a hand builds up a force
_TREMOR_BAND = 2.0 * math.pi * 8.0  # rad/s of a physiological tremor
_SLOW = 2.0 * math.pi * 0.5  # rad/s of drifting judgement
_LEVERS = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])  # m: forces of the hand into torques
_ROUND = 2**14  # periods of tremor before it comes again


Hand = Callable[[], np.ndarray]
"""Where a live operator wants the handle now, (6,) [m], [rad]."""


class Perceived(Protocol):
    """What there was to see and feel, by tick (`StationLog`)."""

    touching: np.ndarray
    force: np.ndarray

    def master(self, name: str) -> np.ndarray:
        """(n, ...) of a field of MasterState."""
        ...

    def slave(self, name: str) -> np.ndarray:
        """(n, ...) of a field of SlaveState."""
        ...


class OperatorModel:
    """An operator in one run.

    Attributes:
        muscles: what he wants, and his arm.
        tremor: (n, 6) of his forces [N], [N m].
        past: (reflex + 1, 6) where the handle has just been [m], [rad].
        every: control ticks per decision.
        believed: (decisions,) contact force that he believes to have [N]; NaN where he does not
            care.
    """

    def __init__(
        self, pilot: TeleopPilot, joystick: Joystick, numbers: Master, seen: Perceived, ticks: int,
        period: float, seed: int, hand: Hand | None = None,
    ) -> None:  # fmt: skip
        """Sit down.

        Args:
            pilot: the scenario's.
            joystick: the joystick, with the hand's numbers.
            numbers: of the master's control, which he has learnt.
            seen: what there will be to see and feel, filled tick by tick.
            ticks: number of control periods.
            period: of the control [s].
            seed: of the run.
            hand: of a live operator.

        Raises:
            InputError: a live operator without a hand.
        """
        if isinstance(pilot.operator, Live) and hand is None:
            message = "a live operator has to be there: hydrotele drive SCENARIO"
            raise InputError("pilot.operator", message)
        self._live = hand
        self._pilot, self._behaviour, self._habits = pilot, pilot.operator, pilot.perception
        self._numbers, self._period = numbers, period
        self.every = max(1, round(1.0 / (DECISIONS * period)))
        self._step = self.every * period
        p, rng = pilot.perception, np.random.default_rng([seed, 1994])
        self.muscles = _muscles(pilot, joystick, numbers)
        white = rng.standard_normal((_ROUND, 6)) * _LEVERS
        self.tremor = p.tremor * _coloured(white, _TREMOR_BAND, period)
        self.past = np.zeros((1 + max(1, round(REFLEX / period)), 6))
        count = ticks // self.every + 1
        self._judgement = p.force_noise * _coloured(rng.standard_normal(count), _SLOW, self._step)
        sight = _coloured(rng.standard_normal(count), 4.0 * _SLOW, self._step)
        self._sight = p.sight_noise * sight
        self._imagined_gain = math.exp(p.imagination * rng.standard_normal())
        self._look = max(1, round(p.reaction / period))
        self._touch = max(1, round(p.touch / period))
        self._reflex = max(1, round(REFLEX / period))
        self.believed = np.full(count, np.nan)
        self._imagined, self._errors = 0.0, []
        self._handle, self._hand = seen.master("handle"), seen.master("hand")
        self._pose, self._touching = seen.slave("measured"), seen.touching
        self._screen = seen.force
        if isinstance(pilot.operator, Regulate | Track):
            time = self._step * np.arange(count)
            self._target = _prepared(pilot.operator, pilot, numbers, time, self._sight)
        self._pushing, self._until = True, 0.0
        if isinstance(pilot.operator, Follow):
            self._path = _followed(pilot.operator, count, self._step)
        if isinstance(pilot.operator, Steer):
            self._goals = _steered(pilot.operator, count, self._step)

    def decide(self, tick: int) -> None:
        """Choose what the handle should do until the next decision; `muscles` is written.

        Args:
            tick: the control tick, a multiple of `every`.
        """
        if isinstance(self._behaviour, Follow):
            self.muscles.wanted[:] = self._path[tick // self.every]
        if self._live:
            self.muscles.wanted[:] = self._live()
        if tick == 0:
            return  # nothing seen yet
        match self._behaviour:
            case Regulate() | Track() as pressing:
                self._press(tick, pressing.approach)
            case Steer():
                self._steer(tick)

    def _press(self, tick: int, approach: float) -> None:
        """Bring a contact force to its target, by feel if there is any, else by imagination."""
        press, number = self._target, tick // self.every
        axis, row, wanted = press.axis, press.row, self.muscles.wanted
        goal = press.goal[number]
        felt, looked = max(0, tick - self._touch), max(0, tick - self._look)
        touching = bool(self._touching[looked])
        believed = self._judge(tick, axis, press.way, felt, touching)
        if press.force_shown:
            shown = press.side * self._screen[looked, int(press.row[COORDINATE])]
            believed = max(0.0, self._seen_and_felt(believed, shown, tick))
        self.believed[number] = press.side * believed
        if not touching and believed < press.noticed:
            reach = row[DEADBAND] + approach * (row[REACH] - row[DEADBAND])
            wanted[axis] = press.way * reach
        elif self._pilot.reflection == "direct_force":
            self._lean(axis, press.way, row, abs(goal), max(0, tick - self._reflex))
        else:
            error = press.side * goal - believed
            close = max(_CLOSE * abs(goal), _LEAST_CLOSE * press.close)
            self._pulse_or_feel(tick, axis, press.way, error, close)

    def _pulse_or_feel(self, tick: int, axis: int, way: float, error: float, close: float) -> None:
        """Rest inside the dead band where contact is felt; correct by short pushes beyond it."""
        row, now, wanted = self._target.row, tick * self._period, self.muscles.wanted
        self._errors.append(error)
        if now >= self._until:
            late = self._errors[len(self._errors) // 2 :]
            mean = sum(late) / len(late)
            self._errors.clear()
            if self._pushing:
                self._pushing, self._until = False, now + self._habits.dwell
                wanted[axis] = way * _HOLD * row[DEADBAND]
            elif abs(mean) < close:
                self._until = now + 0.5 * self._habits.dwell
            else:
                speed = self._habits.skill * mean / (self._habits.task_stiffness * row[GAIN])
                most = 0.5 * (row[REACH] - row[DEADBAND])
                step = min(most, max(-most, speed))
                wanted[axis] = way * (math.copysign(row[DEADBAND], step) + step)
                self._pushing, self._until = True, now + _PUSH
        if self._pilot.reflection == "stiffness":
            stiff = row[NOMINAL] + row[SLOPE] * self._imagined
            self.muscles.spring[axis] = stiff if way * wanted[axis] >= 0.0 else row[LEAST]

    def _judge(self, tick: int, axis: int, way: float, felt: int, touching: bool) -> float:
        """Contact force that he believes to have, at least 0 [N]."""
        row, reflection = self._target.row, self._pilot.reflection
        if reflection == "none":
            wanted = self.muscles.wanted[axis]
            beyond = math.copysign(max(0.0, abs(wanted) - row[DEADBAND]), way * wanted)
            if touching:
                change = beyond * row[GAIN] * self._habits.task_stiffness * self._imagined_gain
                self._imagined = max(0.0, self._imagined + self._step * change)
            return self._imagined
        x = float(self._handle[felt, axis])
        force = float(self._hand[felt, axis]) * (1.0 + self._judgement[tick // self.every])
        if reflection in ("stiffness", "impedance"):
            if way * x > _LEAST_WAY:
                stiffer = max(0.0, force / x - row[NOMINAL])
                self._imagined = min(row[LIMIT], stiffer / row[SLOPE])
            return self._imagined
        return max(0.0, (way * force - row[NOMINAL] * way * x) / max(row[RATIO], 1e-12))

    def _seen_and_felt(self, felt: float, shown: float, tick: int) -> float:
        """Contact force from screen and hand, each by its variance; Ernst and Banks 2002 [N]."""
        seen = shown + self._target.largest * self._sight[tick // self.every]
        if self._pilot.reflection == "none":
            return seen
        by_eye = (self._habits.sight_noise * self._target.largest) ** 2
        by_hand = (self._habits.force_noise * max(felt, self._target.close)) ** 2
        return seen if by_eye <= 0.0 else (seen * by_hand + felt * by_eye) / (by_hand + by_eye)

    def _lean(self, axis: int, way: float, row: list[float], goal: float, reflex: int) -> None:
        """Push with the force that the target would push back with, and let the handle go."""
        share = 1.0 - math.exp(-self._step / _LEANING)
        wish = way * row[RATIO] * goal
        self.muscles.correction[axis] += share * (wish - self.muscles.correction[axis])
        self.muscles.spring[axis] = 0.0
        self.muscles.wanted[axis] = self._handle[reflex, axis]  # a force, not a place

    def _steer(self, tick: int) -> None:
        """Move the tip to where it should be, by sight."""
        pose = self._pose[max(0, tick - self._look), 0]
        for c, goals in self._goals.items():
            axis = _axis_of(self._numbers, c)
            row, wanted = self._numbers.axis[axis], self.muscles.wanted
            error = row[SIGN] * (goals[tick // self.every] - pose[c])
            close = abs(error) < self._habits.sight
            if self._pilot.mode == "position":
                step = 0.0 if close else self._habits.skill * self._step * error / row[GAIN]
                wanted[axis] = min(row[REACH], max(-row[REACH], wanted[axis] + step))
                continue
            most = 0.95 * (row[REACH] - row[DEADBAND])
            step = min(most, max(-most, self._habits.skill * error / row[GAIN]))
            wanted[axis] = 0.0 if close else math.copysign(row[DEADBAND], step) + step


class _Target(NamedTuple):
    """A force to make, as he has prepared for it.

    Attributes:
        axis: of the joystick.
        row: its numbers.
        side: sign of the force.
        way: of the handle, to press harder.
        goal: (decisions,) what he aims at, as late and as rough as he sees it [N].
        displayed: (decisions,) what he is shown [N]; NaN without.
        close: error that he leaves alone at the largest target [N].
        noticed: force from which he believes in a contact that he does not see [N].
        largest: of the targets [N].
        force_shown: whether the screen shows the contact force, too.
    """

    axis: int
    row: list[float]
    side: float
    way: float
    goal: list[float]
    displayed: np.ndarray
    close: float
    noticed: float
    largest: float
    force_shown: bool


def _prepared(
    pressing: Regulate | Track, pilot: TeleopPilot, numbers: Master, time: np.ndarray,
    sight: np.ndarray,
) -> _Target:  # fmt: skip
    target, shown, late = pressing.target, isinstance(pressing, Track), pilot.perception.reaction
    axis = _axis_of(numbers, COORDINATES.index(target.coordinate))
    largest = max(abs(f) for f in target.force) or 1.0
    side = math.copysign(1.0, next((f for f in target.force if f), 1.0))
    goal = np.interp(np.maximum(time - late * shown, 0.0), target.time, target.force)
    displayed = np.interp(time, target.time, target.force) if shown else np.full(len(time), np.nan)
    goal = goal + shown * largest * sight
    row, close = numbers.axis[axis].tolist(), _CLOSE * largest
    direct = pilot.reflection == "direct_force"
    noticed = max(close, _NOTICED / max(row[RATIO], 1e-12)) if direct else close
    way = -side * row[SIGN]
    force_shown = isinstance(pressing, Track) and pressing.shown == "target_and_force"
    return _Target(
        axis, row, side, way, goal.tolist(), displayed, close, noticed, largest, force_shown
    )


def _axis_of(numbers: Master, coordinate: int) -> int:
    return int(np.flatnonzero(numbers.axis[:, COORDINATE] == coordinate)[0])


def _muscles(pilot: TeleopPilot, joystick: Joystick, numbers: Master) -> Muscles:
    """His arm at rest."""
    hand, p = joystick.hand, pilot.perception
    free = pilot.mode == "position" and pilot.reflection not in ("none", "stiffness", "impedance")
    at_rest = Muscles(
        wanted=np.zeros(6),
        spring=np.zeros(6) if free else numbers.axis[:, NOMINAL].copy(),
        notch=numbers.axis[:, [DEADBAND, DROP, OUTSIDE]].T.copy(),
        correction=np.zeros(6),
        force=np.zeros(6),
        arm=np.array([hand.stiffness] * 3 + [hand.rotation_stiffness] * 3),
        most=p.largest_force * _LEVERS,
        weight=np.array([0.0, 0.0, 9.81 * hand.mass, 0.0, 0.0, 0.0]),
        gain=np.array([p.muscle]),
    )
    return flattened(at_rest)


def _coloured(white: np.ndarray, band: float, period: float) -> np.ndarray:
    """White noise (n, ...) through a first-order low-pass, of unit standard deviation."""
    from scipy.signal import lfilter

    share = 1.0 - math.exp(-band * period)
    scale = math.sqrt((2.0 - share) / share)
    return scale * np.asarray(lfilter([share], [1.0, share - 1.0], white, axis=0))


def _followed(behaviour: Follow, count: int, step: float) -> np.ndarray:
    """Wanted displacements (n, 6) [m], [rad]."""
    time, path = step * np.arange(count), np.zeros((count, 6))
    for name, values in behaviour.path.items():
        path[:, AXES.index(name)] = _at(time, behaviour.time, values, behaviour.interpolate)
    return path


def _steered(behaviour: Steer, count: int, step: float) -> dict[int, np.ndarray]:
    """Coordinate -> (n,) where the tip should be [m], [rad]."""
    time = step * np.arange(count)
    return {
        COORDINATES.index(name): _at(time, behaviour.time, values, "hold")
        for name, values in behaviour.points.items()
    }


def _at(time: np.ndarray, times, values, how: str) -> np.ndarray:
    if how == "linear":
        return np.interp(time, times, values)
    row = np.searchsorted(times, time + 1e-9, side="right") - 1
    return np.asarray(values, float)[np.clip(row, 0, len(values) - 1)]
