"""Simulated operator: observations, estimates and decisions of one run.

The operator does not know the contact force or the machine's gains. The operator feels the handle's
motion, sees the tip and its contact, and in `track` also a display of the reference force. The
effect of a push is learnt from earlier pushes. The joystick's own springs and the scale of its
reflection are known to the operator. Decisions are made at 50 Hz; visual control follows
`teleop.manual_control`, and the parameters are in `teleop.operator_parameters`. The errors of
feeling are in `teleop.perception`, the forces of the muscles in `teleop.neuromuscular_dynamics`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from hydrotele.control.arm_kinematics import COORDINATES
from hydrotele.core.compiled import compiled
from hydrotele.core.contiguous_state import copy_to_contiguous_state
from hydrotele.core.errors import InputError
from hydrotele.core.units import si_unit_and_factor
from hydrotele.logs.table import read_table
from hydrotele.machine.joystick import AXES, Joystick
from hydrotele.scenario.teleoperation import (
    FollowPath,
    LiveOperator,
    RecordedMotion,
    RegulateForce,
    SteerToPoses,
    TeleopPilot,
    TrackForce,
)
from hydrotele.teleop.axis_table import (
    COORDINATE,
    DEADBAND,
    DETENT_DROP,
    DETENT_STIFFNESS,
    FORCE_LIMIT,
    HANDLE_RANGE,
    MIN_STIFFNESS,
    NOMINAL_STIFFNESS,
    REFLECTION_RATIO,
    SIGN,
    STIFFNESS_PER_FORCE,
)
from hydrotele.teleop.manual_control import (
    ESTIMATED_GAIN,
    GAIN,
    INTEGRATOR,
    NOTICED_ERROR,
    VisualLoop,
    decide_hand_reference,
    discretise_neuromuscular_lag,
    make_visual_loop,
)
from hydrotele.teleop.master import MasterParameters
from hydrotele.teleop.neuromuscular_dynamics import REFLEX_DELAY, NeuromuscularState
from hydrotele.teleop.operator_parameters import Operator, make_scenario_operator
from hydrotele.teleop.perception import draw_perception_errors, perceive_stiffness

DECISION_RATE = 50.0  # Hz
_REST_RATIO = 0.8  # rest position of a hand that only feels, as a fraction of the dead band
_FORCE_TOLERANCE_RATIO = 0.05  # force error that is not corrected, relative to the target
_MIN_TOLERANCE_RATIO = 0.2  # lower limit of that error, relative to its value at the largest target
_MIN_NOTICED_FORCE = 0.2  # N: noticeable force on the hand, above its tremor and the spring's variation
_PUSH_DURATION = 0.3  # s, duration of a correcting push
_PUSH_CORRECTION_RATIO = 0.45  # fraction of an error that one push corrects
_MIN_FELT_DISPLACEMENT = 3e-4  # m: minimum displacement from which a stiffness can be felt
_FORCE_BUILDUP_TIME = 0.3  # s, time constant with which a hand builds up a force
_TREMOR_BAND = 2.0 * math.pi * 8.0  # rad/s of a physiological tremor
_JUDGEMENT_BANDWIDTH = 2.0 * math.pi * 0.5  # rad/s, bandwidth of slow judgement errors
_LEVERS = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])  # m: converts hand forces to torques
_TREMOR_PERIODS = 2**14  # number of tremor periods before they repeat
_DISPLAY_PAUSE_FACTOR = 0.67  # factor on the time between pushes by feel: a display is read faster
_MAX_PUSH_GAIN_RATIO = 20.0  # limit of the learnt effect of a push over the expected effect


HandInput = Callable[[], np.ndarray]
"""Function that returns the handle reference of a live operator, (6,) [m], [rad]."""


class Observations(Protocol):
    """Recorded quantities that an operator can observe, by control tick, such as TeleoperationLog.

    `touching` (n,) is true in ticks with contact; `force` (n, k) is the estimated tip force
    [N], [N m].
    """

    touching: np.ndarray
    force: np.ndarray

    def master(self, name: str) -> np.ndarray:
        """Return the recorded history (n, ...) of a field of MasterState."""
        ...

    def slave(self, name: str) -> np.ndarray:
        """Return the recorded history (n, ...) of a field of SlaveState."""
        ...


class OperatorModel:
    """Simulated operator of one run: observes, estimates and chooses references for the handle.

    Attributes:
        muscles: neuromuscular parameters and state, with the handle's reference displacement.
        tremor: (n, 6) tremor forces [N], [N m].
        displacement_history: (d + 1, 6) ring buffer of recent handle displacements, for a reflex delay
            of d periods [m], [rad].
        ticks_per_decision: control ticks per decision.
        estimated_force: (decisions,) contact force that the operator estimates at each decision
            [N]; NaN if the operator does not control a force.
        loops: number of a task coordinate -> parameters and state of the loop that the operator
            closes by vision along this coordinate.
    """

    def __init__(
        self, pilot: TeleopPilot, joystick: Joystick, master_parameters: MasterParameters, observations: Observations,
        ticks: int,
        period: float, seed: int, hand: HandInput | None = None, folder: str = "",
    ) -> None:  # fmt: skip
        """Create the simulated operator of a run, and draw its perception errors and tremor.

        Args:
            pilot: teleoperation settings of the scenario.
            joystick: joystick with the parameters of the operator's hand.
            master_parameters: parameters of the master's control. The operator uses the joystick's springs,
                dead bands, detents and reflection, not the machine's response.
            observations: observable quantities, filled tick by tick.
            ticks: number of control periods.
            period: control period [s].
            seed: seed of the run.
            hand: function that returns the handle reference of a live operator; None for a
                simulated one.
            folder: folder of the scenario, to which file names are relative.

        Raises:
            InputError: a live operator without an input, or an invalid file.
        """
        if isinstance(pilot.operator, LiveOperator) and hand is None:
            message = "a live operator needs an input device: use hydrotele drive SCENARIO"
            raise InputError("pilot.operator", message)
        self._live = hand
        self._pilot, self._behaviour = pilot, pilot.operator
        self.parameters = him = make_scenario_operator(pilot.perception, folder)
        self._numbers, self._period = master_parameters, period
        self.ticks_per_decision = max(1, round(1.0 / (DECISION_RATE * period)))
        self._step = self.ticks_per_decision * period
        rng = np.random.default_rng([seed, 1994])
        self.muscles = _make_arm_at_rest(pilot, joystick, master_parameters, him, period)
        white = rng.standard_normal((_TREMOR_PERIODS, 6)) * _LEVERS
        self.tremor = him.tremor * _colour_noise(white, _TREMOR_BAND, period)
        self.displacement_history = np.zeros((1 + max(1, round(REFLEX_DELAY / period)), 6))
        count = ticks // self.ticks_per_decision + 1
        self._feeling = draw_perception_errors(him, rng, count, self._step)
        sight = _colour_noise(rng.standard_normal(count), 4.0 * _JUDGEMENT_BANDWIDTH, self._step)
        self._sight = him.display_noise * sight
        self._imagined_gain = math.exp(him.unfelt_gain_std * rng.standard_normal())
        self._look = max(1, round(him.visual_delay / period))
        self._touch = max(1, round(him.haptic_delay / period))
        self._reflex = max(1, round(REFLEX_DELAY / period))
        self.estimated_force = np.full(count, np.nan)
        self._imagined, self._belief = 0.0, None
        self._met = 0.0
        self._handle, self._hand = observations.master("handle"), observations.master("hand")
        self._pose, self._touching = observations.slave("measured"), observations.touching
        self._seen = observations
        self.loops: dict[int, VisualLoop] = {}
        if isinstance(pilot.operator, RegulateForce | TrackForce):
            time = self._step * np.arange(count)
            self._target = _prepare_force_target(pilot.operator, pilot, master_parameters, time, self._sight, him)
            self._prepare_visual_loop(COORDINATES.index(pilot.operator.target.coordinate), rng, count)
            self._met = self._target.axis_parameters[NOMINAL_STIFFNESS]
        self._pushing, self._until, self._errors = True, 0.0, []
        if isinstance(pilot.operator, FollowPath):
            self._path = _sample_hand_path(pilot.operator, count, self._step)
        if isinstance(pilot.operator, RecordedMotion):
            path = Path(folder, pilot.operator.recorded)
            self._path = read_recorded_hand(path, self._step * np.arange(count))
        if isinstance(pilot.operator, SteerToPoses):
            self._goals = _sample_tip_targets(pilot.operator, count, self._step)
            for c in self._goals:
                self._prepare_visual_loop(c, rng, count)

    def _prepare_visual_loop(self, c: int, rng: np.random.Generator, count: int) -> None:
        """Create the visually closed loop of task coordinate c and store it in `loops`."""
        axis = _find_joystick_axis(self._numbers, c)
        row, rate, him = self._numbers.axis[axis], self._pilot.mode == "rate", self.parameters
        turns = COORDINATES[c] not in ("r", "z")
        way = row[HANDLE_RANGE] - row[DEADBAND]
        expected = him.expected_speed * (0.5 if turns else 1.0) / way
        if not rate:
            way = row[HANDLE_RANGE]
            expected = him.expected_scale * (1.0 if not turns else 0.2 if axis < 3 else 0.1)
        self.loops[c] = make_visual_loop(
            him, self._step, expected, rng, form=INTEGRATOR if rate else GAIN,
            margin=him.positioning_margin, threshold=him.visual_threshold, max_output=(0.95 if rate else 1.0) * way,
            steps=count,
        )  # fmt: skip

    def decide_handle_reference(self, tick: int) -> None:
        """Write the handle's reference displacement until the next decision to `muscles`.

        It follows a given path or a live input, or it results from the control of the contact force
        or of the tip's position.

        Args:
            tick: number of the control tick, a multiple of `ticks_per_decision`.
        """
        if isinstance(self._behaviour, FollowPath | RecordedMotion):
            self.muscles.reference[:] = self._path[tick // self.ticks_per_decision]
        if self._live:
            self.muscles.reference[:] = self._live()
        if tick == 0:
            return  # nothing has been observed yet
        match self._behaviour:
            case RegulateForce() | TrackForce() as pressing:
                self._control_contact_force(tick, pressing.approach)
            case SteerToPoses():
                self._steer_tip(tick)

    def _control_contact_force(self, tick: int, approach: float) -> None:
        """Move the handle so that the contact force approaches its target.

        Before contact the handle moves beyond the dead band by the fraction `approach` of the
        remaining range. In contact the operator reads the force from a display, feels it at the
        handle, or imagines it from earlier pushes. A directly reflected force without a display is
        opposed by a hand force; in all other cases short pushes of the handle correct the contact
        force.
        """
        press, number = self._target, tick // self.ticks_per_decision
        axis, row, wanted = press.axis, press.axis_parameters, self.muscles.reference
        goal = press.reference[number]
        felt, looked = max(0, tick - self._touch), max(0, tick - self._look)
        touching = bool(self._touching[looked])
        if not touching:
            c = int(row[COORDINATE])
            seen = float(self._pose[tick - 1, 0, c])
            decide_hand_reference(
                self.loops[c], number - 1, seen, seen, self._displacement_beyond_deadband(axis, tick - 1)
            )
        judged = self._perceive_contact_force(tick, axis, press.push_direction, felt, looked, touching)
        belief = judged if self._belief is None else self._belief.force
        self.estimated_force[number] = press.force_sign * belief
        if not touching and judged < press.contact_threshold:
            self._belief = None
            reach = row[DEADBAND] + approach * (row[HANDLE_RANGE] - row[DEADBAND])
            wanted[axis] = press.push_direction * reach
        elif self._pilot.reflection == "direct_force" and not press.is_force_displayed:
            self._push_with_target_force(axis, press.push_direction, row, abs(goal), max(0, tick - self._reflex))
        else:
            self._correct_by_pushes(tick, axis, press.push_direction, press.force_sign * goal, judged)

    def _correct_by_pushes(
        self, tick: int, axis: int, way: float, goal: float, judged: float
    ) -> None:  # fmt: skip
        """Correct the contact force by short pushes of the handle beyond its dead band.

        Between pushes the handle rests inside the dead band and the operator observes the force.

        Args:
            tick: number of the control tick.
            axis: number of the joystick axis.
            way: direction of the handle that increases the force, +1 or -1.
            goal: target force [N].
            judged: force that the operator perceives at present [N].
        """
        row, now, wanted = self._target.axis_parameters, tick * self._period, self.muscles.reference
        if self._belief is None:
            push = self.loops[int(row[COORDINATE])].state[ESTIMATED_GAIN] * self.parameters.task_stiffness
            self._belief = _ForceEstimate(judged, math.inf, push, (self.parameters.new_gain_log_std * push) ** 2)
        self._errors.append(judged)
        pause = self.parameters.correction_interval * (
            _DISPLAY_PAUSE_FACTOR if self._target.is_force_displayed else 1.0
        )
        if now >= self._until:
            late = self._errors[len(self._errors) // 2 :]
            self._errors.clear()
            if self._pushing:
                self._pushing, self._until = False, now + pause
                rest = 0.0 if self._target.is_force_displayed else _REST_RATIO * row[DEADBAND]
                wanted[axis] = way * rest
            else:
                felt = self._pilot.reflection != "none" or self._target.is_force_displayed
                mean = sum(late) / len(late)
                self._belief.update(mean, self._force_variance(row, mean) if felt else 0.0)
                error = goal - self._belief.force
                close = max(
                    _FORCE_TOLERANCE_RATIO * abs(goal),
                    _MIN_TOLERANCE_RATIO * self._target.tolerance,
                )
                if abs(error) < close:
                    self._until = now + 0.5 * pause
                else:
                    speed = _PUSH_CORRECTION_RATIO * error / (self._belief.push_gain * _PUSH_DURATION)
                    most = 0.5 * (row[HANDLE_RANGE] - row[DEADBAND])
                    step = min(most, max(-most, speed))
                    wanted[axis] = way * (math.copysign(row[DEADBAND], step) + step)
                    self._belief.last_push = step * _PUSH_DURATION if felt else 0.0
                    self._pushing, self._until = True, now + _PUSH_DURATION
        if self._pilot.reflection in ("stiffness", "impedance"):
            stiff = self._felt_load_stiffness(axis, way, max(0, tick - self._reflex))
            self.muscles.spring[axis] = stiff if way * wanted[axis] >= 0.0 else row[MIN_STIFFNESS]

    def _felt_load_stiffness(self, axis: int, way: float, felt: int) -> float:
        """Return the stiffness of the handle that the muscles felt last [N/m].

        It is the ratio of hand force to displacement at the tick `felt`, within the joystick's range of
        stiffness. Near the centre the previous value is kept. The result is free of perception errors,
        since reflexes need no judgement.
        """
        row, x = self._target.axis_parameters, float(self._handle[felt, axis])
        if way * x > _MIN_FELT_DISPLACEMENT:
            force = float(self._hand[felt, axis])
            most = row[NOMINAL_STIFFNESS] + row[STIFFNESS_PER_FORCE] * row[FORCE_LIMIT]
            self._met = min(most, max(row[NOMINAL_STIFFNESS], force / x))
        return self._met

    def _force_variance(self, row: list[float], force: float) -> float:
        """Return the variance that the operator assumes for an observed contact force [N^2].

        It follows from the noise of the display if the contact force is displayed, otherwise from the
        relative errors (Weber fractions) of a felt stiffness or force.
        """
        him, largest = self.parameters, self._target.tolerance / _FORCE_TOLERANCE_RATIO
        if self._target.is_force_displayed:
            return (him.display_noise * largest) ** 2
        if self._pilot.reflection in ("stiffness", "impedance"):
            return (
                self._feeling.stiffness_deviation * (row[NOMINAL_STIFFNESS] / row[STIFFNESS_PER_FORCE] + force)
            ) ** 2
        return (him.force_weber * max(force, _MIN_TOLERANCE_RATIO * largest)) ** 2

    def _perceive_contact_force(
        self, tick: int, axis: int, way: float, felt: int, looked: int, touching: bool
    ) -> float:  # fmt: skip
        """Return the contact force that the operator perceives at present, at least 0 [N].

        It is read from the display, felt as stiffness or force of the handle, or, without any
        reflection, imagined from the operator's own pushes. `felt` and `looked` are the ticks of the
        delayed observations by touch and by sight.
        """
        row, reflection, number = (
            self._target.axis_parameters,
            self._pilot.reflection,
            tick // self.ticks_per_decision,
        )
        if self._target.is_force_displayed:
            shown = self._target.force_sign * float(self._seen.force[looked, int(row[COORDINATE])])
            largest = self._target.tolerance / _FORCE_TOLERANCE_RATIO
            self._imagined = max(0.0, shown + largest * self._sight[number])
            return self._imagined
        if reflection == "none":
            beyond = way * row[SIGN] * self._displacement_beyond_deadband(axis, felt)
            if touching:
                rate = self.loops[int(row[COORDINATE])].state[ESTIMATED_GAIN]
                change = beyond * rate * self.parameters.task_stiffness * self._imagined_gain
                self._imagined = max(0.0, self._imagined + self._step * change)
            return self._imagined
        x, force = float(self._handle[felt, axis]), float(self._hand[felt, axis])
        if reflection in ("stiffness", "impedance"):
            if way * x > _MIN_FELT_DISPLACEMENT:
                stiffer = max(
                    0.0,
                    perceive_stiffness(force, x, self._feeling, number) - row[NOMINAL_STIFFNESS],
                )
                self._imagined = min(row[FORCE_LIMIT], stiffer / row[STIFFNESS_PER_FORCE])
            return self._imagined
        x, force = x * self._feeling.displacement[number], force * self._feeling.force[number]
        return max(
            0.0,
            (way * force - row[NOMINAL_STIFFNESS] * way * x) / max(row[REFLECTION_RATIO], 1e-12),
        )

    def _push_with_target_force(self, axis: int, way: float, row: list[float], goal: float, reflex: int) -> None:
        """Push the handle with the hand force that balances the reflected force at the target.

        The hand force is the target contact force `goal` [N] times the reflection ratio, in the
        direction `way`, and is built up gradually. It is written to the muscles' `correction`. The
        position reference follows the handle position at the control tick `reflex`, one reflex delay
        before the present one, so that the operator controls a force and no position. `axis` is the
        joystick axis, and `row` are its parameters.
        """
        share = 1.0 - math.exp(-self._step / _FORCE_BUILDUP_TIME)
        wish = way * row[REFLECTION_RATIO] * goal
        self.muscles.correction[axis] += share * (wish - self.muscles.correction[axis])
        self.muscles.spring[axis] = 0.0
        self.muscles.reference[axis] = self._handle[reflex, axis]  # force control

    def _displacement_beyond_deadband(self, axis: int, tick: int) -> float:
        """Return the handle displacement that commands motion, in the coordinate's sign [m], [rad].

        It is that of joystick axis `axis` in the control tick `tick`. Under rate control it is the
        displacement beyond the dead band, otherwise the whole displacement.
        """
        row, x = self._numbers.axis[axis], float(self._handle[tick, axis])
        if self._pilot.mode == "rate":
            x = math.copysign(max(0.0, abs(x) - row[DEADBAND]), x)
        return float(row[SIGN]) * x

    def _steer_tip(self, tick: int) -> None:
        """Write the handle references that move the tip to its target positions, by visual control.

        Under rate control the handle is moved to the edge of the dead band plus the operator's
        action, or to 0 if no position error is noticed.
        """
        before, number = tick - 1, tick // self.ticks_per_decision
        for c, goals in self._goals.items():
            axis, loop = _find_joystick_axis(self._numbers, c), self.loops[c]
            row, wanted = self._numbers.axis[axis], self.muscles.reference
            seen, acting = (
                float(self._pose[before, 0, c]),
                self._displacement_beyond_deadband(axis, before),
            )
            step = row[SIGN] * decide_hand_reference(loop, number - 1, goals[number], seen, acting)
            if self._pilot.mode == "position":
                wanted[axis] = step
                continue
            way = row[SIGN] * loop.state[NOTICED_ERROR]
            wanted[axis] = 0.0 if way == 0.0 else math.copysign(row[DEADBAND], way) + step


@dataclass
class _ForceEstimate:
    """Operator's estimate of a contact force and of the effect of a push on it (Kalman filter).

    Attributes:
        force: mean of the force [N].
        variance: variance of the force [N^2].
        push_gain: change of the force per displacement and time of a push [N/(m s)].
        push_gain_variance: variance of `push_gain`.
        last_push: displacement times time of the last push [m s].
        previous_force: force that was perceived at the previous update [N].
    """

    force: float
    variance: float
    push_gain: float
    push_gain_variance: float
    last_push: float = 0.0
    previous_force: float = math.nan

    def __post_init__(self) -> None:
        self._expected = self.push_gain

    def update(self, judged: float, variance: float) -> None:
        """Update the estimates of force and push gain with a perceived force and its variance.

        `judged` is the perceived force [N], `variance` that of its error [N^2]. Its change since
        the previous update is attributed to the last push and corrects the push gain. The force is
        then predicted with the push and corrected by the perceived force.
        """
        if self.last_push and math.isfinite(self.previous_force):
            own = self.last_push**2 * self.push_gain_variance
            share = self.last_push * self.push_gain_variance / (own + 2.0 * variance)
            self.push_gain += share * (judged - self.previous_force - self.last_push * self.push_gain)
            self.push_gain_variance *= 1.0 - share * self.last_push
            low, high = self._expected / _MAX_PUSH_GAIN_RATIO, self._expected * _MAX_PUSH_GAIN_RATIO
            self.push_gain = min(high, max(low, self.push_gain))
        change = self.last_push * self.push_gain
        self.force = max(0.0, self.force + change)
        self.variance += self.last_push**2 * self.push_gain_variance + (_FORCE_DRIFT_RATIO * self.force) ** 2
        share = 1.0 if math.isinf(self.variance) or not variance else (
            self.variance / (self.variance + variance)
        )  # fmt: skip
        self.force += share * (judged - self.force)
        self.variance = variance if share == 1.0 else (1.0 - share) * self.variance
        self.previous_force, self.last_push = judged, 0.0


_FORCE_DRIFT_RATIO = 0.05  # relative change of a force between two estimates without operator action


class _ForceTarget(NamedTuple):
    """Target contact force of a run and how the operator reaches it, fixed before the run.

    Attributes:
        axis: number of the joystick axis.
        axis_parameters: parameters of the axis, columns as in `axis_table`.
        force_sign: sign of the target force, +1 or -1.
        push_direction: direction of the handle that increases the force.
        reference: (decisions,) reference with visual delay and noise [N].
        displayed: (decisions,) displayed reference [N]; NaN without a display.
        tolerance: uncorrected error at the largest target [N].
        contact_threshold: force above which the operator assumes a contact that is not visible [N].
        is_force_displayed: whether the contact force is displayed as well.
    """

    axis: int
    axis_parameters: list[float]
    force_sign: float
    push_direction: float
    reference: list[float]
    displayed: np.ndarray
    tolerance: float
    contact_threshold: float
    is_force_displayed: bool


def _prepare_force_target(
    pressing: RegulateForce | TrackForce, pilot: TeleopPilot, numbers: MasterParameters, time: np.ndarray,
    sight: np.ndarray, operator: Operator,
) -> _ForceTarget:  # fmt: skip
    target, shown, late = pressing.target, isinstance(pressing, TrackForce), operator.visual_delay
    axis = _find_joystick_axis(numbers, COORDINATES.index(target.coordinate))
    largest = max(abs(f) for f in target.force) or 1.0
    side = math.copysign(1.0, next((f for f in target.force if f), 1.0))
    goal = np.interp(np.maximum(time - late * shown, 0.0), target.time, target.force)
    displayed = np.interp(time, target.time, target.force) if shown else np.full(len(time), np.nan)
    goal = goal + shown * largest * sight
    row, close = numbers.axis[axis].tolist(), _FORCE_TOLERANCE_RATIO * largest
    direct = pilot.reflection == "direct_force"
    noticed = max(close, _MIN_NOTICED_FORCE / max(row[REFLECTION_RATIO], 1e-12)) if direct else close
    way = -side * row[SIGN]
    both = isinstance(pressing, TrackForce) and pressing.display == "both"
    return _ForceTarget(axis, row, side, way, goal.tolist(), displayed, close, noticed, both)


def _find_joystick_axis(numbers: MasterParameters, coordinate: int) -> int:
    return int(np.flatnonzero(numbers.axis[:, COORDINATE] == coordinate)[0])


def _make_arm_at_rest(
    pilot: TeleopPilot,
    joystick: Joystick,
    numbers: MasterParameters,
    operator: Operator,
    period: float,
) -> NeuromuscularState:
    """Create parameters and initial state of the operator's arm and muscles, at rest.

    The neuromuscular lag is set only for an operator who chooses the handle's position from a goal. A
    given path already is that of the hand. An operator who pushes against a directly reflected force
    has no lag either, since the arm's compliance lets the hand follow the handle.
    """
    hand, lagging = (
        joystick.hand,
        isinstance(pilot.operator, RegulateForce | TrackForce | SteerToPoses),
    )
    if not isinstance(pilot.operator, SteerToPoses) and pilot.reflection == "direct_force":
        lagging = False
    frequency = operator.neuromuscular_frequency if lagging else 0.0
    tracking = isinstance(pilot.operator, SteerToPoses)
    damping = operator.neuromuscular_damping if tracking else 1.0  # single pushes do not overshoot
    free = pilot.mode == "position" and pilot.reflection not in ("none", "stiffness", "impedance")
    at_rest = NeuromuscularState(
        reference=np.zeros(6),
        spring=np.zeros(6) if free else numbers.axis[:, NOMINAL_STIFFNESS].copy(),
        detent=numbers.axis[:, [DEADBAND, DETENT_DROP, DETENT_STIFFNESS]].T.copy(),
        correction=np.zeros(6),
        force=np.zeros(6),
        arm=np.array([hand.axis_impedance(axis)[2] for axis in range(6)]),
        cross=np.array([hand.stiffness_shape[1] * hand.stiffness]),
        max_force=operator.max_force * _LEVERS,
        weight=np.array([0.0, 0.0, 9.81 * hand.carried_mass, 0.0, 0.0, 0.0]),
        gain=np.array([operator.handle_position_gain]),
        rest=np.zeros(6),
        rate=np.zeros(6),
        lag=discretise_neuromuscular_lag(frequency, damping, period),
    )
    return copy_to_contiguous_state(at_rest)


def _colour_noise(white: np.ndarray, band: float, period: float) -> np.ndarray:
    """Filter white noise (n, ...) with a first-order low-pass of bandwidth `band` [rad/s].

    The result is scaled so that unit white noise gives unit standard deviation. `period` is the
    time between two samples [s].
    """
    share = 1.0 - math.exp(-band * period)
    scale = math.sqrt((2.0 - share) / share)
    return scale * _filter_low_pass(white.reshape(len(white), -1), share).reshape(white.shape)


@compiled
def _filter_low_pass(rows, share):
    """Filter each column of `rows` (n, c) with a first-order low-pass, `y += share (x - y)`.

    `share` is the fraction 0 to 1 of the input in one step. scipy.signal is avoided, since its import
    takes 2 s.
    """
    out, state = np.empty_like(rows), np.zeros(rows.shape[1])
    for n in range(len(rows)):
        for c in range(len(state)):
            out[n, c] = share * rows[n, c] + state[c]
            state[c] = -(share - 1.0) * out[n, c]
    return out


def _sample_hand_path(behaviour: FollowPath, count: int, step: float) -> np.ndarray:
    """Sample a path of the scenario at the decisions: displacements (n, 6) of the handle [m], [rad]."""
    time, path = step * np.arange(count), np.zeros((count, 6))
    for name, values in behaviour.path.items():
        path[:, AXES.index(name)] = _sample_signal(time, behaviour.time, values, behaviour.interpolate)
    return path


def read_recorded_hand(path: Path, time: np.ndarray) -> np.ndarray:
    """Read recorded displacements of a handle from a file, interpolated at given times.

    Args:
        path: CSV or Parquet file with `time` and columns `handle.<axis>` or `<axis>`.
        time: (n,) output times since the record's first row [s].

    Returns:
        (n, 6) displacements [m], [rad]; the end values are held outside the record.

    Raises:
        InputError: the file cannot be read or has no such column.
    """
    table = read_table(path)
    columns, names = {}, {}
    for name, values, unit in zip(table.names, table.values, table.units, strict=True):
        if name == "time" or name.removeprefix("handle.") in AXES:
            columns[name.removeprefix("handle.")] = values * (si_unit_and_factor(unit)[1] if unit else 1.0)
            names[name.removeprefix("handle.")] = name
    if len(columns) < 2 or "time" not in columns:
        wanted = ", ".join(f"handle.{axis}" for axis in AXES)
        has = ", ".join(table.names)
        raise InputError(path, f"needs time and a displacement ({wanted}); columns: {has}")
    record = columns.pop("time")
    for axis, values in columns.items():
        if len(bad := np.flatnonzero(~np.isfinite(values))):
            raise InputError(table.location(names[axis], int(bad[0])), "is not a finite number")
    if not len(record):
        raise InputError(path, "has no rows: give at least one position of the handle")
    if len(bad := np.flatnonzero(~(np.diff(record) > 0.0))):
        message = "does not increase here: sort the rows and keep each time once"
        raise InputError(table.location("time", int(bad[0]) + 1), message)
    made = np.zeros((len(time), 6))
    for axis, values in columns.items():
        made[:, AXES.index(axis)] = np.interp(time, record - record[0], values)
    return made


def _sample_tip_targets(behaviour: SteerToPoses, count: int, step: float) -> dict[int, np.ndarray]:
    """Sample the tip targets of a scenario at the decisions.

    Return number of the coordinate -> (n,) target [m], [rad].
    """
    time = step * np.arange(count)
    return {
        COORDINATES.index(name): _sample_signal(time, behaviour.time, values, "hold")
        for name, values in behaviour.points.items()
    }


def _sample_signal(time: np.ndarray, times, values, how: str) -> np.ndarray:
    if how == "linear":
        return np.interp(time, times, values)
    row = np.searchsorted(times, time + 1e-9, side="right") - 1
    return np.asarray(values, float)[np.clip(row, 0, len(values) - 1)]
