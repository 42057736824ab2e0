"""Simulated operator: perception, decisions and neuromuscular dynamics in one run.

The operator does not know the contact force or the machine's gains. The operator feels the handle's
motion, sees the tip and its contact, and in `track` also a display of the reference force. The
effect of a push is learnt from earlier pushes. The joystick's own springs and the scale of its
reflection are known. The operator decides at 50 Hz; visual control follows
`teleop.manual_control`, and the parameters are in `teleop.operator_parameters`.

The neuromuscular dynamics convert a reference displacement to forces on the handle.

A force or a displacement is felt with an error in proportion to its size (Weber's law). Combining
both to a stiffness adds another error: people resolve compliance by 22 % when they cannot use work
or terminal force (Tan, Durlach, Beauregard and Srinivasan 1995, Perception & Psychophysics 57),
though force alone by some 7 % (Pang, Tan and Durlach 1991, ibid. 49) and limb movement by 8 %
(Jones, Hunter and Irwin 1992, ibid. 52). One exploration gives one impression.
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
    """Perception errors of a hand in n decisions.

    Attributes:
        force: (n,) factor on the perceived force.
        displacement: (n,) factor on the perceived displacement.
        stiffness: (n,) factor due to the combination of both.
        share: relative standard deviation of a perceived stiffness, known to the operator [1].
    """

    force: np.ndarray
    displacement: np.ndarray
    stiffness: np.ndarray
    share: float


def feeling(him: Operator, rng: np.random.Generator, count: int, step: float) -> Feeling:
    """Draw the perception errors of a run, one set per exploration.

    Args:
        him: operator with Weber fractions; an exploration lasts `dwell`.
        rng: random generator of the errors.
        count: number of decisions.
        step: time between two decisions [s].

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
    """Return the stiffness of a spring as perceived by a hand.

    Args:
        force: force on the hand [N].
        displacement: displacement of the hand [m], not 0.
        errors: perception errors.
        number: number of the decision.

    Returns:
        The perceived stiffness [N/m].
    """
    felt = force * errors.force[number] / (displacement * errors.displacement[number])
    return float(felt * errors.stiffness[number])


_THROUGH = 1.15  # factor on the force at a notch's edge, to overcome it
_FINE, _FINE_TURN = 4e-4, 4e-3  # m, rad: limit on the position error that is integrated


class Muscles(NamedTuple):
    """Parameters and state of the neuromuscular dynamics.

    Attributes:
        wanted: (6,) reference displacement of the handle [m], [rad].
        spring: (6,) expected stiffness of the joystick [N/m], [N m/rad].
        notch: (3, 6) detents: edge [m], [rad], force drop [N], [N m], stiffness outside [N/m], < 0
            without a detent.
        correction: (6,) learnt additional force [N], [N m].
        force: (6,) force on the handle [N], [N m].
        arm: (6,) stiffness of arm and hand [N/m], [N m/rad].
        cross: (1,) stiffness between x and y [N/m].
        most: (6,) maximum force [N], [N m].
        weight: (6,) weight of the hand, which the muscles carry [N], [N m].
        gain: (1,) integral gain of the correction [1/s].
        rest: (6,) rest position of the arm after the neuromuscular lag [m], [rad].
        rate: (6,) its rate.
        lag: (6,) discrete lag of `neuromuscular_matrix`, for one control period.
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
    """Return the parts of `flat_view(Muscles)`.

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
    """Compute the muscle forces of one period from the reference displacement.

    Args:
        muscles: Muscles; `correction`, `force`, `rest` and `rate` are written.
        past: (reflex + 1, 6) ring buffer of displacements, written [m], [rad].
        tremor: (n, 6) tremor forces [N], [N m].
        handle: (6,) present displacement [m], [rad].
        tick: number of the period, scalar.
        period: scalar [s].

    Returns:
        Nothing.

    Source: equilibrium-point control with a delayed integral; Feldman 1986. The rest position
        follows the reference through the neuromuscular lag; McRuer and Jex 1967.
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
                back = _THROUGH * spring * muscles.notch[0, i]  # force to overcome the notch's edge
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
REFLEX = 0.05  # s, delay from hand position to muscle force: stretch reflex and cortex
_HOLD = 0.8  # rest position of a hand that only feels, as a fraction of the dead band
_CLOSE = 0.05  # force error that is not corrected, relative to the target
_LEAST_CLOSE = 0.2  # lower limit of that error, relative to its value at the largest target
_NOTICED = 0.2  # N: noticeable force on the hand, above its tremor and the spring's variation
_PUSH = 0.3  # s, duration of a correcting push
_CORRECTED = 0.45  # fraction of an error that one push corrects
_LEAST_WAY = 3e-4  # m: minimum displacement from which a stiffness can be felt
_LEANING = 0.3  # s, time constant with which a hand builds up a force
_TREMOR_BAND = 2.0 * math.pi * 8.0  # rad/s of a physiological tremor
_SLOW = 2.0 * math.pi * 0.5  # rad/s, bandwidth of slow judgement errors
_LEVERS = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])  # m: converts hand forces to torques
_ROUND = 2**14  # number of tremor periods before they repeat
_LOOKING = 0.67  # factor on the time between pushes by feel: a display is read faster
_FURTHEST = 20.0  # limit of the learnt effect of a push over the expected effect


Hand = Callable[[], np.ndarray]
"""Function that returns the handle reference of a live operator, (6,) [m], [rad]."""


class Perceived(Protocol):
    """Observable quantities by tick (`StationLog`)."""

    touching: np.ndarray
    force: np.ndarray

    def master(self, name: str) -> np.ndarray:
        """Return a field of MasterState, (n, ...)."""
        ...

    def slave(self, name: str) -> np.ndarray:
        """Return a field of SlaveState, (n, ...)."""
        ...


class OperatorModel:
    """Simulate the decisions of an operator in one run.

    Attributes:
        muscles: reference displacement and arm.
        tremor: (n, 6) tremor forces [N], [N m].
        past: (reflex + 1, 6) recent displacements of the handle [m], [rad].
        every: control ticks per decision.
        believed: (decisions,) contact force that the operator estimates [N]; NaN if it is not
            relevant.
        loops: coordinate -> visually closed loop with the learnt element.
    """

    def __init__(
        self, pilot: TeleopPilot, joystick: Joystick, numbers: Master, seen: Perceived, ticks: int,
        period: float, seed: int, hand: Hand | None = None, folder: str = "",
    ) -> None:  # fmt: skip
        """Prepare the operator for a run.

        Args:
            pilot: teleoperation settings of the scenario.
            joystick: joystick with the parameters of the operator's hand.
            numbers: parameters of the master's control. The operator uses the joystick's springs,
                dead bands, detents and reflection, not the machine's response.
            seen: observable quantities, filled tick by tick.
            ticks: number of control periods.
            period: control period [s].
            seed: seed of the run.
            hand: input of a live operator.
            folder: folder of the scenario, to which file names are relative.

        Raises:
            InputError: a live operator without a hand, or an invalid file.
        """
        if isinstance(pilot.operator, Live) and hand is None:
            message = "a live operator needs an input device: use hydrotele drive SCENARIO"
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
        """Prepare the visual control of a coordinate."""
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
        """Choose the handle's reference until the next decision; `muscles` is written.

        Args:
            tick: number of the control tick, a multiple of `every`.
        """
        if isinstance(self._behaviour, Follow | Recorded):
            self.muscles.wanted[:] = self._path[tick // self.every]
        if self._live:
            self.muscles.wanted[:] = self._live()
        if tick == 0:
            return  # nothing has been observed yet
        match self._behaviour:
            case Regulate() | Track() as pressing:
                self._press(tick, pressing.approach)
            case Steer():
                self._steer(tick)

    def _press(self, tick: int, approach: float) -> None:
        """Control a contact force to its target by display, by feel or by imagination."""
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
        """Return the stiffness that the muscles last worked against [N/m].

        It is free of perception errors, since reflexes need no judgement; muscle noise is in the
        tremor.
        """
        row, x = self._target.row, float(self._handle[felt, axis])
        if way * x > _LEAST_WAY:
            force = float(self._hand[felt, axis])
            most = row[NOMINAL] + row[SLOPE] * row[LIMIT]
            self._met = min(most, max(row[NOMINAL], force / x))
        return self._met

    def _doubt(self, row: list[float], force: float) -> float:
        """Return the variance of an estimated contact force as known to the operator [N^2]."""
        him, largest = self.him, self._target.close / _CLOSE
        if self._target.shown:
            return (him.sight_noise * largest) ** 2
        if self._pilot.reflection in ("stiffness", "impedance"):
            return (self._feeling.share * (row[NOMINAL] / row[SLOPE] + force)) ** 2
        return (him.force_weber * max(force, _LEAST_CLOSE * largest)) ** 2

    def _judge(
        self, tick: int, axis: int, way: float, felt: int, looked: int, touching: bool
    ) -> float:  # fmt: skip
        """Return the contact force that the operator estimates now, at least 0 [N]."""
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
        """Push with the expected reaction force of the target, and let the handle move freely."""
        share = 1.0 - math.exp(-self._step / _LEANING)
        wish = way * row[RATIO] * goal
        self.muscles.correction[axis] += share * (wish - self.muscles.correction[axis])
        self.muscles.spring[axis] = 0.0
        self.muscles.wanted[axis] = self._handle[reflex, axis]  # force control

    def _acting(self, axis: int, tick: int) -> float:
        """Return the handle displacement beyond the dead band, along the coordinate."""
        row, x = self._numbers.axis[axis], float(self._handle[tick, axis])
        if self._pilot.mode == "rate":
            x = math.copysign(max(0.0, abs(x) - row[DEADBAND]), x)
        return float(row[SIGN]) * x

    def _steer(self, tick: int) -> None:
        """Move the tip to its target by visual control."""
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
    """Operator's estimate of a contact force and of the effect of a push.

    Attributes:
        force: mean of the force [N].
        variance: variance of the force [N^2].
        push: change of the force per displacement and time of a push [N/(m s)].
        doubt: variance of `push`.
        pushed: displacement times time of the last push [m s].
        before: estimated force before the last push [N].
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
        """Update with an observed force [N], its variance [N^2] and the effect of the last push."""
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


_FADES = 0.05  # relative change of a force between two estimates without operator action


class _Target(NamedTuple):
    """Reference force, as prepared by the operator.

    Attributes:
        axis: number of the joystick axis.
        row: parameters of the axis.
        side: sign of the force.
        way: direction of the handle that increases the force.
        goal: (decisions,) reference with visual delay and noise [N].
        displayed: (decisions,) displayed reference [N]; NaN without a display.
        close: uncorrected error at the largest target [N].
        noticed: force above which the operator assumes a contact that is not visible [N].
        shown: whether the contact force is displayed as well.
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
    """Return the operator's arm at rest.

    A given path is the path of the hand itself, after the neuromuscular lag. A hand that applies a
    force to the handle follows it by its compliance, which is part of the arm.
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
    """Filter white noise (n, ...) with a first-order low-pass, to unit standard deviation."""
    share = 1.0 - math.exp(-band * period)
    scale = math.sqrt((2.0 - share) / share)
    return scale * _low_pass(white.reshape(len(white), -1), share).reshape(white.shape)


@compiled
def _low_pass(rows, share):
    """Filter each column (n, c) by `y' = y + share (x - y)`; scipy.signal takes 2 s to import."""
    out, state = np.empty_like(rows), np.zeros(rows.shape[1])
    for n in range(len(rows)):
        for c in range(len(state)):
            out[n, c] = share * rows[n, c] + state[c]
            state[c] = -(share - 1.0) * out[n, c]
    return out


def _followed(behaviour: Follow, count: int, step: float) -> np.ndarray:
    """Return the reference displacements (n, 6) of a given path [m], [rad]."""
    time, path = step * np.arange(count), np.zeros((count, 6))
    for name, values in behaviour.path.items():
        path[:, AXES.index(name)] = _at(time, behaviour.time, values, behaviour.interpolate)
    return path


def recorded_hand(path: Path, time: np.ndarray) -> np.ndarray:
    """Read the recorded displacements of a handle.

    Args:
        path: CSV or Parquet file with `time` and columns `handle.<axis>` or `<axis>`.
        time: (n,) output times since the record's first row [s].

    Returns:
        (n, 6) displacements [m], [rad]; the end values are held outside the record.

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
        raise InputError(path, f"needs time and a displacement ({wanted}); columns: {has}")
    record = columns.pop("time")
    if len(bad := np.flatnonzero(~(np.diff(record) > 0.0))):
        message = "does not increase here: sort the rows and keep each time once"
        raise InputError(table.where("time", int(bad[0]) + 1), message)
    made = np.zeros((len(time), 6))
    for axis, values in columns.items():
        made[:, AXES.index(axis)] = np.interp(time, record - record[0], values)
    return made


def _steered(behaviour: Steer, count: int, step: float) -> dict[int, np.ndarray]:
    """Return coordinate -> (n,) target of the tip [m], [rad]."""
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
