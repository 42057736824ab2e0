"""Linear analysis of a teleoperator: transparency, passivity, stability and stability margins.

A teleoperator couples a master, which the operator's hand moves, with a slave, which acts on the
task. The module describes one axis of it (impedances, controllers, channel gains, delays) and
analyses it as a two-port network. The parameters come from a YAML file that `hydrotele analyse
teleop` reads. `hydrotele/teleop/cat215_axis.yaml` is the default file; it gives
the source of every parameter.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Protocol

import numpy as np
from pydantic import Field, field_validator, model_validator

from hydrotele.core.datafile import (
    Name,
    NonNegativeFloat,
    PositiveFloat,
    StrictModel,
    read_yaml,
    suggest_valid_name,
    validate_data,
)
from hydrotele.core.errors import InputError
from hydrotele.teleop.switching import StiffnessAxis
from hydrotele.teleop.two_port import (
    STRUCTURES,
    Block,
    Impedance,
    PoleOnAxisError,
    StructureGains,
    TwoPort,
    count_unstable_poles,
    hybrid_matrix,
    is_stable,
    make_two_port,
    scattering_norm,
    transmitted_impedance,
)


@dataclass(frozen=True)
class TeleoperatorAxis:
    """One axis of a teleoperator with hand and task.

    Slave and task are scaled to the lengths and forces of the master.

    Attributes:
        master: impedance of the master, which the hand moves.
        slave: impedance of the slave, which acts on the task.
        master_control: damper and spring of the master's controller.
        slave_control: damper and spring of the slave's controller.
        hand: impedance of the operator's hand.
        task: impedance of the environment.
        gains: gains of the channels.
        delay_forward: delay from the master to the slave [s].
        delay_back: delay from the slave to the master [s].
        wave: wave impedance b, for the structure with wave variables [N s/m]; 0 selects the slave
            controller's damping.
    """

    master: Impedance
    slave: Impedance
    master_control: Impedance
    slave_control: Impedance
    hand: Impedance
    task: Impedance
    gains: StructureGains = field(default_factory=StructureGains)
    delay_forward: float = 0.0
    delay_back: float = 0.0
    wave: float = 0.0

    def __post_init__(self) -> None:
        """Raise InputError if a controller has a mass, since it would need accelerations."""
        if self.master_control.mass or self.slave_control.mass:
            raise InputError("teleoperator", "controllers are dampers and springs, without mass")

    @property
    def delay(self) -> float:
        """Mean of the forward and the return delay [s]; stability depends only on their sum."""
        return 0.5 * (self.delay_forward + self.delay_back)

    def with_delay(self, delay: float) -> "TeleoperatorAxis":
        """Return a copy of the axis with the same delay [s] in each direction."""
        return replace(self, delay_forward=delay, delay_back=delay)

    def make_port(self, structure: str, return_gain: float = 1.0) -> TwoPort:
        """Return the linear two-port of this axis with a given control structure.

        Args:
            structure: name, one of `STRUCTURES`, such as `position_force`.
            return_gain: factor on the force and the velocity that are returned from the slave to the
                master [1]; it scales the gain of the loop through hand and task.

        Returns:
            The two-port.

        Raises:
            InputError: the structure is not known, or a gain or a delay is invalid.
        """
        made = make_two_port(
            structure, self.master, self.slave, self.master_control, self.slave_control,
            self.gains, delay_forward=self.delay_forward, delay_back=self.delay_back,
        )  # fmt: skip
        if return_gain == 1.0:
            return made
        return replace(
            made,
            force_back=_scale_block(made.force_back, return_gain),
            velocity_back=_scale_block(made.velocity_back, return_gain),
        )


def _scale_block(block: Block, factor: float) -> Block:
    def evaluate_scaled(s: np.ndarray) -> np.ndarray:
        return factor * block(s)

    return evaluate_scaled


DEFAULT_CASE_FILE = Path(__file__).resolve().with_name("cat215_axis.yaml")


MAX_DELAY = 10.0  # s
Delay = Annotated[float, Field(ge=0, le=MAX_DELAY)]


class ImpedanceParameters(StrictModel):
    """Mass [kg], damping [N s/m] and stiffness [N/m] of the hand or the task."""

    mass: NonNegativeFloat = 0.0
    damping: NonNegativeFloat = 0.0
    stiffness: NonNegativeFloat = 0.0

    def impedance(self) -> Impedance:
        """Convert the data of the file to an `Impedance`, a function of complex frequency."""
        return Impedance(self.mass, self.damping, self.stiffness)


class BodyParameters(StrictModel):
    """Mass [kg], damping [N s/m] and stiffness [N/m] of the master or the slave, without control."""

    mass: PositiveFloat
    damping: NonNegativeFloat = 0.0
    stiffness: NonNegativeFloat = 0.0

    def impedance(self) -> Impedance:
        """Convert the data of the file to an `Impedance`, a function of complex frequency."""
        return Impedance(self.mass, self.damping, self.stiffness)


class ControllerParameters(StrictModel):
    """Damping [N s/m] and stiffness [N/m] of the controller of master or slave."""

    damping: NonNegativeFloat = 0.0
    stiffness: NonNegativeFloat = 0.0

    def impedance(self) -> Impedance:
        """Convert the data of the file to an `Impedance`, a function of complex frequency."""
        return Impedance(0.0, self.damping, self.stiffness)


class ChannelGains(StrictModel):
    """Gains of the channels between master and slave.

    `position` is the slave's position per master position [1], `velocity` the slave's velocity per
    master position under rate control [1/s], `force` the reflected per environment force [1].
    """

    position: PositiveFloat = 1.0
    velocity: PositiveFloat = 1.0
    force: NonNegativeFloat = 1.0


class Delays(StrictModel):
    """Delays [s] from the master to the slave and from the slave to the master."""

    forward: Delay = 0.0
    back: Delay = 0.0


class StiffnessFeedbackAxis(StrictModel):
    """Joystick axis whose stiffness follows the machine's force, without the operator's hand.

    Stiffnesses [N/m], `damping` [N s/m] and `mass` [kg]; the analysis adds the hand.
    """

    renamed = {"nominal": "nominal_stiffness", "least": "min_stiffness", "most": "max_stiffness"}

    nominal_stiffness: NonNegativeFloat
    min_stiffness: NonNegativeFloat
    max_stiffness: PositiveFloat
    damping: NonNegativeFloat
    mass: PositiveFloat

    @model_validator(mode="after")
    def _check_order(self):
        if not self.min_stiffness <= self.nominal_stiffness <= self.max_stiffness:
            raise ValueError(
                "must be ordered, min_stiffness <= nominal_stiffness <= max_stiffness:"
                f" {self.min_stiffness:g}, {self.nominal_stiffness:g}, {self.max_stiffness:g}"
            )
        return self

    def to_stiffness_axis(self) -> StiffnessAxis:
        """Convert the data of the file to a `StiffnessAxis`, which tests whether it is stable."""
        return StiffnessAxis(self.mass, self.damping, self.nominal_stiffness, self.min_stiffness, self.max_stiffness)


class MapRange(StrictModel):
    """Range of the stability map, a grid of delay and return gain with `points` values of each.

    `max_delay` is the largest delay in each direction [s]; the factors multiply the return channels.
    """

    renamed = {
        "longest_delay": "max_delay", "least_factor": "min_factor", "most_factor": "max_factor",
    }  # fmt: skip

    max_delay: Annotated[float, Field(gt=0, le=MAX_DELAY)] = 0.5
    min_factor: PositiveFloat = 0.01
    max_factor: PositiveFloat = 100.0
    points: Annotated[int, Field(ge=3, le=200)] = 25

    @model_validator(mode="after")
    def _check_order(self):
        if not self.min_factor < self.max_factor:
            raise ValueError("min_factor must be below max_factor")
        return self


class ImpedanceRange(StrictModel):
    """Range of mass, damping and stiffness for random sampling, log-uniform from `min` to `max`."""

    renamed = {"least": "min", "most": "max"}

    min: ImpedanceParameters
    max: ImpedanceParameters

    @model_validator(mode="after")
    def _check_order(self):
        for name in ("mass", "damping", "stiffness"):
            if not getattr(self.min, name) <= getattr(self.max, name):
                raise ValueError(f"{name}: min must not be above max")
        return self


class TeleopCaseFile(StrictModel):
    """Contents of a YAML file for `hydrotele analyse teleop`: one axis, and what to analyse.

    Slave and task are scaled to the lengths and forces of the master. `structures` are the control
    structures to compare, `stiffness` an optional joystick axis with stiffness feedback. `hands` and
    `tasks` are ranges for random sampling, `map` is the range of the stability map.
    """

    renamed = {"wave": "wave_impedance"}

    name: Name
    master: BodyParameters
    slave: BodyParameters
    master_control: ControllerParameters
    slave_control: ControllerParameters
    hand: ImpedanceParameters
    task: ImpedanceParameters
    gains: ChannelGains = Field(default_factory=ChannelGains)
    delays: Delays = Field(default_factory=Delays)
    structures: Annotated[tuple[str, ...], Field(min_length=1)] = STRUCTURES
    stiffness: StiffnessFeedbackAxis | None = None
    wave_impedance: NonNegativeFloat = 0.0
    hands: ImpedanceRange | None = None
    tasks: ImpedanceRange | None = None
    map: MapRange = Field(default_factory=MapRange)

    @field_validator("structures")
    @classmethod
    def _check_structures(cls, names):
        return check_structures(names)

    def to_axis(self) -> TeleoperatorAxis:
        """Convert the input file to a `TeleoperatorAxis` for the two-port."""
        gains = StructureGains(self.gains.position, self.gains.velocity, self.gains.force)
        return TeleoperatorAxis(
            self.master.impedance(), self.slave.impedance(), self.master_control.impedance(),
            self.slave_control.impedance(), self.hand.impedance(), self.task.impedance(), gains,
            self.delays.forward, self.delays.back, self.wave_impedance,
        )  # fmt: skip


def check_structures(names: tuple[str, ...], known: tuple[str, ...] = STRUCTURES) -> tuple[str, ...]:
    """Check names of control structures and return them without duplicates.

    Raises:
        ValueError: a name is not in `known`.
    """
    for name in names:
        if name not in known:
            raise ValueError(f"no structure {name!r}; {suggest_valid_name(name, known)}")
    return tuple(dict.fromkeys(names))


def load_teleop_case(path: str | Path | None = None) -> TeleopCaseFile:
    """Read and validate the YAML file that describes a teleoperator axis for the linear analysis.

    Args:
        path: YAML file, None for the default file.

    Returns:
        The validated contents.

    Raises:
        InputError: the file is invalid; the message gives file, line, key and the allowed values.
    """
    path = DEFAULT_CASE_FILE if path is None else path
    data, lines = read_yaml(path)
    return validate_data(TeleopCaseFile, data, str(path), lines)


# rad/s, from slow motions to a flotor's bandwidth; round values could hit undamped poles
FREQUENCIES = 2.0 * np.pi * np.geomspace(0.016, 160.0, 1601)
_ZERO_IMPEDANCE = Impedance()
_MAX_SCATTERING_NORM = 1.0 + 1e-6  # allows for rounding in the inverse of a lossless port's matrix
_MARGIN_POINTS = 61  # number of points that are tested before a margin is refined
_MARGIN_TOLERANCE = 1e-3  # relative tolerance of a margin
MAX_TESTED_DELAY = 10.0  # s in each direction
MAX_TESTED_FACTOR = 1e3  # factor on the loop gain
_TESTED_DELAY_RANGE = (1e-4, MAX_TESTED_DELAY)


class StabilityLoop(Protocol):
    """Interface that the stability tests need: hand, task, delays and two-port of a teleoperator.

    `TeleoperatorAxis` and `LinearCase` provide it.
    """

    @property
    def task(self) -> Block:
        """Impedance of the task."""
        ...

    @property
    def hand(self) -> Block:
        """Impedance of the hand."""
        ...

    def with_delay(self, delay: float) -> "StabilityLoop":
        """Return a copy of the loop with the same delay [s] in each direction."""
        ...

    def make_port(self, structure: str, return_gain: float = 1.0) -> TwoPort:
        """Return the linear two-port with a control structure.

        `return_gain` is a factor on the channels from the slave to the master [1].
        """
        ...


@dataclass(frozen=True)
class StructureAnalysis:
    """Results of the linear analysis of one control structure.

    Attributes:
        structure: name of the structure.
        frequencies: (n,) frequencies of the arrays below [rad/s].
        hybrid_matrices: (n, 2, 2) hybrid matrix H of `[F_h, -V_e] = H [V_h, F_e]`: force and
            velocity at hand (h) and environment (e).
        transmitted_impedance: (n,) impedance transmitted to the operator [N s/m].
        task_impedance: (n,) impedance of the task [N s/m].
        scattering_norms: (n,) largest singular value of the scattering matrix [1]; a passive
            two-port has none above 1.
        loop_gains: (n,) gain of the loop through hand and task [1].
        loop_free: (n,) loop gain without a task [1].
        unstable_poles: number of unstable poles with the task; None if poles lie on the imaginary
            axis.
        unstable_poles_free: number of unstable poles without a task.
        unstable_poles_released: number of unstable poles with the task, with the handle released.
        unstable_poles_released_free: number of unstable poles without a task, with the handle released.
        gain_margin: factor on the return channels up to which the loop stays stable. It is below 1
            if the case is unstable, 0 if no factor stabilises it, and infinite if no tested factor
            makes it unstable.
        max_delay: delay in each direction up to which the loop stays stable [s]; 0 if it is
            unstable without delay, infinite if it is stable with the largest tested delay of 10 s.
        has_passive_port: whether the two-port is passive, so that no passive hand and task destabilise it.
    """

    structure: str
    frequencies: np.ndarray
    hybrid_matrices: np.ndarray
    transmitted_impedance: np.ndarray
    task_impedance: np.ndarray
    scattering_norms: np.ndarray
    loop_gains: np.ndarray
    loop_free: np.ndarray
    unstable_poles: int | None
    unstable_poles_free: int | None
    unstable_poles_released: int | None
    unstable_poles_released_free: int | None
    gain_margin: float
    max_delay: float
    has_passive_port: bool

    @property
    def is_stable_held(self) -> bool:
        """Whether the loop is stable with and without the task, while a hand holds the handle."""
        return self.unstable_poles == 0 and self.unstable_poles_free == 0

    @property
    def is_stable_released(self) -> bool:
        """Whether the loop is stable with and without the task, while the handle is released."""
        return self.unstable_poles_released == 0 and self.unstable_poles_released_free == 0


def analyse_structure(
    case: TeleoperatorAxis, structure: str, frequencies: np.ndarray = FREQUENCIES
) -> StructureAnalysis:
    """Analyse stability, passivity and transparency of a teleoperator with one control structure.

    Args:
        case: teleoperator with hand and task.
        structure: name, one of `STRUCTURES`.
        frequencies: (n,) [rad/s].

    Returns:
        Results of the analysis.

    Raises:
        InputError: the structure is not known, or neither master nor slave has a mass.

    Source: Zhu 1994, chapter 3.
    """
    port, s = case.make_port(structure), 1j * np.asarray(frequencies, float)
    unit = scattering_reference_impedance(case)
    return StructureAnalysis(
        structure, frequencies, hybrid_matrix(port, s), transmitted_impedance(port, s, case.task), case.task(s),
        scattering_norm(port, s, unit), loop_gain(port, s, case.hand, case.task),
        loop_gain(port, s, case.hand, _ZERO_IMPEDANCE), _count_poles_or_none(port, case.hand, case.task),
        _count_poles_or_none(port, case.hand, _ZERO_IMPEDANCE), _count_poles_or_none(port, _ZERO_IMPEDANCE, case.task),
        _count_poles_or_none(port, _ZERO_IMPEDANCE, _ZERO_IMPEDANCE), find_gain_margin(case, structure),
        find_max_delay(case, structure), is_passive(port, unit),
    )  # fmt: skip


def loop_gain(port: TwoPort, s: np.ndarray | complex, hand: Block, environment: Block) -> np.ndarray:
    """Return the gain of the loop through master and slave; Nyquist's critical point is -1.

    Args:
        port: the two-port.
        s: (...) complex frequencies [rad/s].
        hand: impedance of the operator's hand.
        environment: impedance of the task.

    Returns:
        (...) `(C2 Z_e + C4)(C1 - C3 Z_h) / ((Z_m + C_m + Z_h)(Z_s + C_s + Z_e))` [1], with channels
        C1 .. C4 as in `TwoPort`, impedances Z and controllers C_m, C_s; indices m master, s slave,
        h hand, e environment.

    Source: Zhu 1994, 3.13.
    """
    s = np.asarray(s, complex)
    c1, c2, c3, c4 = port.channels(s)
    near = port.master(s) + port.master_control(s) + hand(s)
    far = port.slave(s) + port.slave_control(s) + environment(s)
    return (c2 * environment(s) + c4) * (c1 - c3 * hand(s)) / (near * far)


def scattering_reference_impedance(case: TeleoperatorAxis) -> float:
    """Return a reference impedance for scattering matrices: `sqrt(B^2 + M K)` of the hand [N s/m].

    M, B and K are the hand's mass, damping and stiffness. The result is 1 if this is zero.
    """
    hand = case.hand
    return math.hypot(hand.damping, math.sqrt(hand.mass * hand.stiffness)) or 1.0


def is_passive(port: TwoPort, unit: float = 1.0) -> bool:
    """Return whether a two-port is passive, so that no passive hand and task destabilise it.

    Args:
        port: the two-port.
        unit: reference impedance of the scattering matrix [N s/m].

    Returns:
        True if the scattering matrix has no pole in the right half-plane, and no norm above 1 on
        the imaginary axis.

    Source: Anderson and Spong 1989; Zhu 1994, 3.7.
    """
    s = 2j * np.pi * np.geomspace(1e-3, 2e3, 3000)
    if scattering_norm(port, s, unit).max() > _MAX_SCATTERING_NORM:
        return False
    wall = Impedance(damping=unit)
    try:
        return count_unstable_poles(port, wall, wall, masses=1) == 0
    except PoleOnAxisError:
        return False


def is_strictly_stable(port: TwoPort, hand: Block, environment: Block) -> bool:
    """Return whether hand, teleoperator and task have only poles in the left half-plane.

    The result is also false if a pole lies on the imaginary axis.
    """
    try:
        return is_stable(port, hand, environment)
    except PoleOnAxisError:
        return False


def _count_poles_or_none(port: TwoPort, hand: Block, environment: Block) -> int | None:
    try:
        return count_unstable_poles(port, hand, environment)
    except PoleOnAxisError:
        return None


def find_gain_margin(case: StabilityLoop, structure: str) -> float:
    """Return the factor on the return channels (from slave to master) at which stability changes [1].

    For a stable case it is the largest stable factor, infinite if all factors up to 1000 are stable.
    For an unstable case it is below 1, and 0 if no factor down to 0.001 stabilises it.
    """

    def is_stable_with(factor: float) -> bool:
        return is_strictly_stable(case.make_port(structure, factor), case.hand, case.task)

    if is_stable_with(1.0):
        found = find_first_change(is_stable_with, np.geomspace(1.0, MAX_TESTED_FACTOR, _MARGIN_POINTS))
        return math.inf if found is None else found
    found = find_first_change(is_stable_with, np.geomspace(1.0, 1.0 / MAX_TESTED_FACTOR, _MARGIN_POINTS))
    return 0.0 if found is None else found


def find_max_delay(case: StabilityLoop, structure: str) -> float:
    """Return the delay in each direction up to which the loop is stable [s].

    It is 0 if the loop is unstable without delay, and infinite if it is stable up to 10 s.
    """

    def is_stable_with(delay: float) -> bool:
        return is_strictly_stable(case.with_delay(delay).make_port(structure), case.hand, case.task)

    if not is_stable_with(0.0):
        return 0.0
    if not is_stable_with(_TESTED_DELAY_RANGE[0]):
        return 0.0
    found = find_first_change(is_stable_with, np.geomspace(*_TESTED_DELAY_RANGE, _MARGIN_POINTS))
    return math.inf if found is None else found


def find_first_change(condition: Callable[[float], bool], points: np.ndarray) -> float | None:
    """Return where a condition first differs from its value at the first point, None if nowhere.

    Args:
        condition: function of one positive number.
        points: (n,) positive values in rising or falling order. They are tested in this order; the
            interval of the first change is then bisected.

    Returns:
        The value next to the change at which the condition is true, to 0.1 %.
    """
    first, last = condition(float(points[0])), float(points[0])
    for point in map(float, points[1:]):
        if condition(point) != first:
            break
        last = point
    else:
        return None
    while abs(point / last - 1.0) > _MARGIN_TOLERANCE:
        middle = math.sqrt(last * point)
        last, point = (middle, point) if condition(middle) == first else (last, middle)
    return last if first else point


def stability_map(case: StabilityLoop, structure: str, delays: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Test the stability of a control structure on a grid of delays and gains.

    The gains are factors on the return channels, which carry force or motion from slave to master.

    Args:
        case: teleoperator with hand and task.
        structure: name of the structure.
        delays: (n,) delays in each direction [s].
        factors: (m,) factors on the return channels [1].

    Returns:
        (m, n), true where stable.
    """
    return np.array([
        [is_strictly_stable(case.with_delay(t).make_port(structure, k), case.hand, case.task) for t in delays]
        for k in map(float, factors)
    ])  # fmt: skip
