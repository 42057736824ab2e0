"""The simulated operator: what he sees and feels, and what he wants the handle to do.

He never knows the contact force nor the machine's gains: he feels what the handle does, sees the
tip and whether it touches, in `track` a graph of the force that he is to make, and learns from his
own pushes what they do. The joystick's own springs and the scale of what it reflects are told to
him. He decides fifty times a second; by sight he steers as `teleop.manual_control` says, who he is
stands in `teleop.operator_parameters`.

Muscles of the simulated operator: from a wanted displacement to forces on the handle.

What a hand feels: force, displacement and stiffness, each as well as a person can tell it.

A force or a displacement is felt with an error in proportion to its size (Weber's law). Putting
both together to a stiffness adds an error of its own: people resolve compliance by 22 % when they
cannot use work or terminal force (Tan, Durlach, Beauregard and Srinivasan 1995, Perception &
Psychophysics 57), though force alone by some 7 % (Pang, Tan and Durlach 1991, ibid. 49) and limb
movement by 8 % (Jones, Hunter and Irwin 1992, ibid. 52). One exploration gives one impression.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from hydrotele.control.resolved_motion import COORDINATES
from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.core.units import to_si
from hydrotele.logs.log import read_table
from hydrotele.machine.joystick import AXES, Joystick
from hydrotele.scenario.teleoperation import (
    Follow,
    Live,
    Recorded,
    Regulate,
    Steer,
    TeleopPilot,
    Track,
)
from hydrotele.teleop.axis_table import (
    COORDINATE,
    DEADBAND,
    DROP,
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
from hydrotele.teleop.manual_control import (
    BELIEVED_GAIN,
    GAIN,
    INTEGRATOR,
    NOTICED,
    Loop,
    look_and_act,
    neuromuscular_matrix,
    visual_loop,
)
from hydrotele.teleop.master import Master
from hydrotele.teleop.operator_parameters import Operator, perceiving


class Feeling(NamedTuple):
    """Errors of what a hand feels, by decision; n decisions.

    Attributes:
        force: (n,) factor on a felt force.
        displacement: (n,) factor on a felt displacement.
        stiffness: (n,) factor of putting both together.
        share: standard deviation of a felt stiffness, of which he knows [1].
    """

    force: np.ndarray
    displacement: np.ndarray
    stiffness: np.ndarray
    share: float


def feeling(him: Operator, rng: np.random.Generator, count: int, step: float) -> Feeling:
    """Impressions of a run, one per exploration.

    Args:
        him: the operator, with his Weber fractions; an exploration lasts his `dwell`.
        rng: of the impressions.
        count: number of decisions.
        step: between them [s].

    Returns:
        The errors.
    """
    exploration = (step * np.arange(count) / him.dwell).astype(int)
    drawn = rng.standard_normal((exploration[-1] + 1, 3))[exploration]
    weber = np.array([him.force_weber, him.position_weber, him.integration_weber])
    errors = np.exp(weber * drawn)
    return Feeling(*errors.T, share=math.hypot(*weber))


def felt_stiffness(
    force: float, displacement: float, errors: Feeling, number: int
) -> float:  # fmt: skip
    """Stiffness that a hand feels in a spring.

    Args:
        force: on the hand [N].
        displacement: of the hand [m], not 0.
        errors: of what he feels.
        number: of the decision.

    Returns:
        The felt stiffness [N/m].
    """
    felt = force * errors.force[number] / (displacement * errors.displacement[number])
    return float(felt * errors.stiffness[number])


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
        cross: (1,) the same between x and y [N/m].
        most: (6,) largest force [N], [N m].
        weight: (6,) of the hand, which they carry [N], [N m].
        gain: (1,) of the correction [1/s].
        rest: (6,) where the neuromuscular lag has moved the arm's rest [m], [rad].
        rate: (6,) its rate.
        lag: (6,) of `neuromuscular_matrix`, for one control period.
    """

    wanted: np.ndarray
    spring: np.ndarray
    notch: np.ndarray
    correction: np.ndarray
    force: np.ndarray
    arm: np.ndarray
    cross: np.ndarray
    most: np.ndarray
    weight: np.ndarray
    gain: np.ndarray
    rest: np.ndarray
    rate: np.ndarray
    lag: np.ndarray


@compiled
def unpack_muscles(flat):
    """The parts of `flat_view(Muscles)`.

    Args:
        flat: (80,) array.

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
    cross, rest = split(rest, 1)
    most, rest = split(rest, 6)
    weight, rest = split(rest, 6)
    gain, rest = split(rest, 1)
    place, rest = split(rest, 6)
    rate, lag = split(rest, 6)
    return Muscles(
        wanted, spring, notch.reshape(3, 6), correction, force, arm, cross, most, weight, gain,
        place, rate, lag,
    )  # fmt: skip


@compiled
def pull(muscles, past, tremor, handle, tick, period):
    """Forces of one period: the arm's rest moves with what is wanted, the rest is corrected late.

    Args:
        muscles: Muscles; `correction`, `force`, `rest` and `rate` are written.
        past: (reflex + 1, 6) displacements of the last periods, written [m], [rad].
        tremor: (n, 6) of the run [N], [N m].
        handle: (6,) displacement of now [m], [rad].
        tick: number of the period, scalar.
        period: scalar [s].

    Returns:
        Nothing.

    Source: equilibrium-point control with a late integral; Feldman 1986. The rest follows what is
        wanted through the neuromuscular lag; McRuer and Jex 1967.
    """
    rows, lag = len(past), muscles.lag
    noise = tick % len(tremor)
    for i in range(6):
        place, rate = muscles.rest[i], muscles.rate[i]
        muscles.rest[i] = lag[0] * place + lag[1] * rate + lag[2] * muscles.wanted[i]
        muscles.rate[i] = lag[3] * place + lag[4] * rate + lag[5] * muscles.wanted[i]
    for i in range(6):
        past[tick % rows, i] = handle[i]
        late = past[(tick + 1) % rows, i]
        spring, most, wanted = muscles.spring[i], muscles.most[i], muscles.rest[i]
        firm = muscles.arm[i] + spring
        known = firm * wanted
        beyond = abs(wanted) - muscles.notch[0, i]
        if muscles.notch[2, i] >= 0.0 and beyond > 0.0:
            firm = muscles.arm[i] + muscles.notch[2, i]
            back = spring * muscles.notch[0, i] - muscles.notch[1, i] + muscles.notch[2, i] * beyond
            if (late if wanted > 0.0 else -late) < muscles.notch[0, i]:
                back = _THROUGH * spring * muscles.notch[0, i]  # first over the notch's edge
            known = muscles.arm[i] * wanted + (back if wanted > 0.0 else -back)
        if i < 2:
            known += muscles.cross[0] * muscles.rest[1 - i]
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
_CORRECTED = 0.45  # of an error, by one push
_LEAST_WAY = 3e-4  # m: a stiffness cannot be felt from a smaller displacement
_LEANING = 0.3  # s in which a hand builds up a force
_TREMOR_BAND = 2.0 * math.pi * 8.0  # rad/s of a physiological tremor
_SLOW = 2.0 * math.pi * 0.5  # rad/s of drifting judgement
_LEVERS = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])  # m: forces of the hand into torques
_ROUND = 2**14  # periods of tremor before it comes again
_LOOKING = 0.67  # of the time between pushes by feel: a display is read sooner
_FURTHEST = 20.0  # times what he expected of a push: more or less is not learnt


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
        loops: coordinate -> what he closes by sight, and has learnt of it.
    """

    def __init__(
        self, pilot: TeleopPilot, joystick: Joystick, numbers: Master, seen: Perceived, ticks: int,
        period: float, seed: int, hand: Hand | None = None, folder: str = "",
    ) -> None:  # fmt: skip
        """Sit down.

        Args:
            pilot: the scenario's.
            joystick: the joystick, with his hand's numbers.
            numbers: of the master's control; of them he knows the joystick's springs, dead bands,
                detents and what it reflects, not how the machine answers.
            seen: what there will be to see and feel, filled tick by tick.
            ticks: number of control periods.
            period: of the control [s].
            seed: of the run.
            hand: of a live operator.
            folder: of the scenario, from which files are counted.

        Raises:
            InputError: a live operator without a hand, a file that is not usable.
        """
        if isinstance(pilot.operator, Live) and hand is None:
            message = "a live operator has to be there: hydrotele drive SCENARIO"
            raise InputError("pilot.operator", message)
        self._live = hand
        self._pilot, self._behaviour = pilot, pilot.operator
        self.him = him = perceiving(pilot.perception, folder)
        self._numbers, self._period = numbers, period
        self.every = max(1, round(1.0 / (DECISIONS * period)))
        self._step = self.every * period
        rng = np.random.default_rng([seed, 1994])
        self.muscles = _muscles(pilot, joystick, numbers, him, period)
        white = rng.standard_normal((_ROUND, 6)) * _LEVERS
        self.tremor = him.tremor * _coloured(white, _TREMOR_BAND, period)
        self.past = np.zeros((1 + max(1, round(REFLEX / period)), 6))
        count = ticks // self.every + 1
        self._feeling = feeling(him, rng, count, self._step)
        sight = _coloured(rng.standard_normal(count), 4.0 * _SLOW, self._step)
        self._sight = him.sight_noise * sight
        self._imagined_gain = math.exp(him.imagination * rng.standard_normal())
        self._look = max(1, round(him.visual_delay / period))
        self._touch = max(1, round(him.touch / period))
        self._reflex = max(1, round(REFLEX / period))
        self.believed = np.full(count, np.nan)
        self._imagined, self._belief = 0.0, None
        self._met = 0.0
        self._handle, self._hand = seen.master("handle"), seen.master("hand")
        self._pose, self._touching = seen.slave("measured"), seen.touching
        self._seen = seen
        self.loops: dict[int, Loop] = {}
        if isinstance(pilot.operator, Regulate | Track):
            time = self._step * np.arange(count)
            self._target = _prepared(pilot.operator, pilot, numbers, time, self._sight, him)
            self._look_at(COORDINATES.index(pilot.operator.target.coordinate), rng, count)
            self._met = self._target.row[NOMINAL]
        self._pushing, self._until, self._errors = True, 0.0, []
        if isinstance(pilot.operator, Follow):
            self._path = _followed(pilot.operator, count, self._step)
        if isinstance(pilot.operator, Recorded):
            path = Path(folder, pilot.operator.recorded)
            self._path = recorded_hand(path, self._step * np.arange(count))
        if isinstance(pilot.operator, Steer):
            self._goals = _steered(pilot.operator, count, self._step)
            for c in self._goals:
                self._look_at(c, rng, count)

    def _look_at(self, c: int, rng: np.random.Generator, count: int) -> None:
        """Prepare to move a coordinate by sight."""
        axis = _axis_of(self._numbers, c)
        row, rate, him = self._numbers.axis[axis], self._pilot.mode == "rate", self.him
        turns = COORDINATES[c] not in ("r", "z")
        way = row[REACH] - row[DEADBAND]
        expected = him.usual_speed * (0.5 if turns else 1.0) / way
        if not rate:
            way = row[REACH]
            expected = him.usual_scale * (1.0 if not turns else 0.2 if axis < 3 else 0.1)
        self.loops[c] = visual_loop(
            him, self._step, expected, rng, form=INTEGRATOR if rate else GAIN,
            margin=him.placing_margin, threshold=him.sight, most=(0.95 if rate else 1.0) * way,
            steps=count,
        )  # fmt: skip

    def decide(self, tick: int) -> None:
        """Choose what the handle should do until the next decision; `muscles` is written.

        Args:
            tick: the control tick, a multiple of `every`.
        """
        if isinstance(self._behaviour, Follow | Recorded):
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
        """Bring a contact force to its target, by display or by feel, else by imagination."""
        press, number = self._target, tick // self.every
        axis, row, wanted = press.axis, press.row, self.muscles.wanted
        goal = press.goal[number]
        felt, looked = max(0, tick - self._touch), max(0, tick - self._look)
        touching = bool(self._touching[looked])
        if not touching:
            c = int(row[COORDINATE])
            seen = float(self._pose[tick - 1, 0, c])
            look_and_act(self.loops[c], number - 1, seen, seen, self._acting(axis, tick - 1))
        judged = self._judge(tick, axis, press.way, felt, looked, touching)
        belief = judged if self._belief is None else self._belief.force
        self.believed[number] = press.side * belief
        if not touching and judged < press.noticed:
            self._belief = None
            reach = row[DEADBAND] + approach * (row[REACH] - row[DEADBAND])
            wanted[axis] = press.way * reach
        elif self._pilot.reflection == "direct_force" and not press.shown:
            self._lean(axis, press.way, row, abs(goal), max(0, tick - self._reflex))
        else:
            self._pulse_or_feel(tick, axis, press.way, press.side * goal, judged)

    def _pulse_or_feel(
        self, tick: int, axis: int, way: float, goal: float, judged: float
    ) -> None:  # fmt: skip
        """Rest inside the dead band where contact is felt; correct by short pushes beyond it."""
        row, now, wanted = self._target.row, tick * self._period, self.muscles.wanted
        if self._belief is None:
            push = self.loops[int(row[COORDINATE])].state[BELIEVED_GAIN] * self.him.task_stiffness
            self._belief = _Belief(judged, math.inf, push, (self.him.surprise * push) ** 2)
        self._errors.append(judged)
        pause = self.him.dwell * (_LOOKING if self._target.shown else 1.0)
        if now >= self._until:
            late = self._errors[len(self._errors) // 2 :]
            self._errors.clear()
            if self._pushing:
                self._pushing, self._until = False, now + pause
                rest = 0.0 if self._target.shown else _HOLD * row[DEADBAND]
                wanted[axis] = way * rest
            else:
                felt = self._pilot.reflection != "none" or self._target.shown
                mean = sum(late) / len(late)
                self._belief.judge(mean, self._doubt(row, mean) if felt else 0.0)
                error = goal - self._belief.force
                close = max(_CLOSE * abs(goal), _LEAST_CLOSE * self._target.close)
                if abs(error) < close:
                    self._until = now + 0.5 * pause
                else:
                    speed = _CORRECTED * error / (self._belief.push * _PUSH)
                    most = 0.5 * (row[REACH] - row[DEADBAND])
                    step = min(most, max(-most, speed))
                    wanted[axis] = way * (math.copysign(row[DEADBAND], step) + step)
                    self._belief.pushed = step * _PUSH if felt else 0.0
                    self._pushing, self._until = True, now + _PUSH
        if self._pilot.reflection in ("stiffness", "impedance"):
            stiff = self._load(axis, way, max(0, tick - self._reflex))
            self.muscles.spring[axis] = stiff if way * wanted[axis] >= 0.0 else row[LEAST]

    def _load(self, axis: int, way: float, felt: int) -> float:
        """Stiffness that his muscles work against, as they last met it [N/m].

        Reflexes need no judgement; how muscles scatter is in the tremor.
        """
        row, x = self._target.row, float(self._handle[felt, axis])
        if way * x > _LEAST_WAY:
            force = float(self._hand[felt, axis])
            most = row[NOMINAL] + row[SLOPE] * row[LIMIT]
            self._met = min(most, max(row[NOMINAL], force / x))
        return self._met

    def _doubt(self, row: list[float], force: float) -> float:
        """Variance of a judged contact force as he knows it from himself [N^2]."""
        him, largest = self.him, self._target.close / _CLOSE
        if self._target.shown:
            return (him.sight_noise * largest) ** 2
        if self._pilot.reflection in ("stiffness", "impedance"):
            return (self._feeling.share * (row[NOMINAL] / row[SLOPE] + force)) ** 2
        return (him.force_weber * max(force, _LEAST_CLOSE * largest)) ** 2

    def _judge(
        self, tick: int, axis: int, way: float, felt: int, looked: int, touching: bool
    ) -> float:  # fmt: skip
        """Contact force that he now judges to have, at least 0 [N]."""
        row, reflection, number = self._target.row, self._pilot.reflection, tick // self.every
        if self._target.shown:
            shown = self._target.side * float(self._seen.force[looked, int(row[COORDINATE])])
            largest = self._target.close / _CLOSE
            self._imagined = max(0.0, shown + largest * self._sight[number])
            return self._imagined
        if reflection == "none":
            beyond = way * row[SIGN] * self._acting(axis, felt)
            if touching:
                rate = self.loops[int(row[COORDINATE])].state[BELIEVED_GAIN]
                change = beyond * rate * self.him.task_stiffness * self._imagined_gain
                self._imagined = max(0.0, self._imagined + self._step * change)
            return self._imagined
        x, force = float(self._handle[felt, axis]), float(self._hand[felt, axis])
        if reflection in ("stiffness", "impedance"):
            if way * x > _LEAST_WAY:
                stiffer = max(0.0, felt_stiffness(force, x, self._feeling, number) - row[NOMINAL])
                self._imagined = min(row[LIMIT], stiffer / row[SLOPE])
            return self._imagined
        x, force = x * self._feeling.displacement[number], force * self._feeling.force[number]
        return max(0.0, (way * force - row[NOMINAL] * way * x) / max(row[RATIO], 1e-12))

    def _lean(self, axis: int, way: float, row: list[float], goal: float, reflex: int) -> None:
        """Push with the force that the target would push back with, and let the handle go."""
        share = 1.0 - math.exp(-self._step / _LEANING)
        wish = way * row[RATIO] * goal
        self.muscles.correction[axis] += share * (wish - self.muscles.correction[axis])
        self.muscles.spring[axis] = 0.0
        self.muscles.wanted[axis] = self._handle[reflex, axis]  # a force, not a place

    def _acting(self, axis: int, tick: int) -> float:
        """Displacement of the handle that moves the machine, along the coordinate."""
        row, x = self._numbers.axis[axis], float(self._handle[tick, axis])
        if self._pilot.mode == "rate":
            x = math.copysign(max(0.0, abs(x) - row[DEADBAND]), x)
        return float(row[SIGN]) * x

    def _steer(self, tick: int) -> None:
        """Move the tip to where it should be, by sight."""
        before, number = tick - 1, tick // self.every
        for c, goals in self._goals.items():
            axis, loop = _axis_of(self._numbers, c), self.loops[c]
            row, wanted = self._numbers.axis[axis], self.muscles.wanted
            seen, acting = float(self._pose[before, 0, c]), self._acting(axis, before)
            step = row[SIGN] * look_and_act(loop, number - 1, goals[number], seen, acting)
            if self._pilot.mode == "position":
                wanted[axis] = step
                continue
            way = row[SIGN] * loop.state[NOTICED]
            wanted[axis] = 0.0 if way == 0.0 else math.copysign(row[DEADBAND], way) + step


@dataclass
class _Belief:
    """A contact force and what a push does to it, as he believes.

    Attributes:
        force: mean [N].
        variance: of the force [N^2].
        push: change of the force by a push, per displacement and time [N/(m s)].
        doubt: variance of the same.
        pushed: displacement times time of the last push [m s].
        before: what was judged before it [N].
    """

    force: float
    variance: float
    push: float
    doubt: float
    pushed: float = 0.0
    before: float = math.nan

    def __post_init__(self) -> None:
        self._expected = self.push

    def judge(self, judged: float, variance: float) -> None:
        """Take in a judgement [N] and its variance [N^2], and what the last push did."""
        if self.pushed and math.isfinite(self.before):
            own = self.pushed**2 * self.doubt
            share = self.pushed * self.doubt / (own + 2.0 * variance)
            self.push += share * (judged - self.before - self.pushed * self.push)
            self.doubt *= 1.0 - share * self.pushed
            low, high = self._expected / _FURTHEST, self._expected * _FURTHEST
            self.push = min(high, max(low, self.push))
        change = self.pushed * self.push
        self.force = max(0.0, self.force + change)
        self.variance += self.pushed**2 * self.doubt + (_FADES * self.force) ** 2
        share = 1.0 if math.isinf(self.variance) or not variance else (
            self.variance / (self.variance + variance)
        )  # fmt: skip
        self.force += share * (judged - self.force)
        self.variance = variance if share == 1.0 else (1.0 - share) * self.variance
        self.before, self.pushed = judged, 0.0


_FADES = 0.05  # of a force, by which it may change between two judgements without him


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
        shown: whether the contact force is displayed beside it.
    """

    axis: int
    row: list[float]
    side: float
    way: float
    goal: list[float]
    displayed: np.ndarray
    close: float
    noticed: float
    shown: bool


def _prepared(
    pressing: Regulate | Track, pilot: TeleopPilot, numbers: Master, time: np.ndarray,
    sight: np.ndarray, him: Operator,
) -> _Target:  # fmt: skip
    target, shown, late = pressing.target, isinstance(pressing, Track), him.visual_delay
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
    both = isinstance(pressing, Track) and pressing.display == "both"
    return _Target(axis, row, side, way, goal.tolist(), displayed, close, noticed, both)


def _axis_of(numbers: Master, coordinate: int) -> int:
    return int(np.flatnonzero(numbers.axis[:, COORDINATE] == coordinate)[0])


def _muscles(
    pilot: TeleopPilot, joystick: Joystick, numbers: Master, him: Operator, period: float
) -> Muscles:
    """His arm at rest.

    A path that is given is that of the hand, behind the neuromuscular lag. A hand that leans on the
    handle with a force follows it by its compliance, which is part of the arm.
    """
    hand, lagging = joystick.hand, isinstance(pilot.operator, Regulate | Track | Steer)
    if not isinstance(pilot.operator, Steer) and pilot.reflection == "direct_force":
        lagging = False
    frequency = him.neuromuscular_frequency if lagging else 0.0
    tracking = isinstance(pilot.operator, Steer)
    damping = him.neuromuscular_damping if tracking else 1.0  # single pushes do not overshoot
    free = pilot.mode == "position" and pilot.reflection not in ("none", "stiffness", "impedance")
    at_rest = Muscles(
        wanted=np.zeros(6),
        spring=np.zeros(6) if free else numbers.axis[:, NOMINAL].copy(),
        notch=numbers.axis[:, [DEADBAND, DROP, OUTSIDE]].T.copy(),
        correction=np.zeros(6),
        force=np.zeros(6),
        arm=np.array([hand.along(axis)[2] for axis in range(6)]),
        cross=np.array([hand.stiffness_shape[1] * hand.stiffness]),
        most=him.largest_force * _LEVERS,
        weight=np.array([0.0, 0.0, 9.81 * hand.carried, 0.0, 0.0, 0.0]),
        gain=np.array([him.muscle]),
        rest=np.zeros(6),
        rate=np.zeros(6),
        lag=neuromuscular_matrix(frequency, damping, period),
    )
    return flattened(at_rest)


def _coloured(white: np.ndarray, band: float, period: float) -> np.ndarray:
    """White noise (n, ...) through a first-order low-pass, of unit standard deviation."""
    share = 1.0 - math.exp(-band * period)
    scale = math.sqrt((2.0 - share) / share)
    return scale * _low_pass(white.reshape(len(white), -1), share).reshape(white.shape)


@compiled
def _low_pass(rows, share):
    """Each column (n, c) through `y' = y + share (x - y)`; scipy.signal takes 2 s to import."""
    out, state = np.empty_like(rows), np.zeros(rows.shape[1])
    for n in range(len(rows)):
        for c in range(len(state)):
            out[n, c] = share * rows[n, c] + state[c]
            state[c] = -(share - 1.0) * out[n, c]
    return out


def _followed(behaviour: Follow, count: int, step: float) -> np.ndarray:
    """Wanted displacements (n, 6) [m], [rad]."""
    time, path = step * np.arange(count), np.zeros((count, 6))
    for name, values in behaviour.path.items():
        path[:, AXES.index(name)] = _at(time, behaviour.time, values, behaviour.interpolate)
    return path


def recorded_hand(path: Path, time: np.ndarray) -> np.ndarray:
    """Displacements of a handle that a person has moved.

    Args:
        path: CSV or Parquet file with `time` and columns `handle.<axis>` or `<axis>`.
        time: (n,) since the record's first row, at which they are asked for [s].

    Returns:
        (n, 6) displacements [m], [rad]; what the record does not reach is held.

    Raises:
        InputError: the file cannot be read or has no such column.
    """
    table = read_table(path)
    columns = {}
    for name, values, unit in zip(table.names, table.values, table.units, strict=True):
        if name == "time" or name.removeprefix("handle.") in AXES:
            columns[name.removeprefix("handle.")] = values * (to_si(unit)[1] if unit else 1.0)
    if len(columns) < 2 or "time" not in columns:
        wanted = ", ".join(f"handle.{axis}" for axis in AXES)
        has = ", ".join(table.names)
        raise InputError(path, f"needs time and a displacement ({wanted}); it has {has}")
    record = columns.pop("time")
    if len(bad := np.flatnonzero(~(np.diff(record) > 0.0))):
        message = "does not rise here: sort the rows, and keep each time once"
        raise InputError(table.where("time", int(bad[0]) + 1), message)
    made = np.zeros((len(time), 6))
    for axis, values in columns.items():
        made[:, AXES.index(axis)] = np.interp(time, record - record[0], values)
    return made


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
