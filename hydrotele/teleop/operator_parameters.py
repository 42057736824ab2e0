"""Parameters of the simulated human operator: files and random operators.

`hydrotele/teleop/operator.yaml` is the default file. A scenario can name another file
(`perception: {file: my_operator.yaml}`, as `hydrotele identify-operator` writes it), which needs
only the parameters that differ. It can also sample an operator from the parameter ranges
(`sample: 3`), and set single parameters.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from hydrotele.core.datafile import (
    Name,
    Number,
    PositiveFloat,
    StrictModel,
    describe_unknown_key,
    read_yaml,
    validate_data,
)
from hydrotele.core.errors import InputError
from hydrotele.core.files import resolve_path
from hydrotele.machine.joystick import HandImpedance, SymmetricMatrix
from hydrotele.scenario.teleoperation import RENAMED_OPERATOR_PARAMETERS, OperatorSettings

DEFAULT_OPERATOR_FILE = Path(__file__).resolve().with_name("operator.yaml")


class OperatorParameter(StrictModel):
    """Parameter of the simulated operator: nominal value, range `low` to `high`, and source.

    `basis` is the kind of source: measured in a study (`published`), a published value quoted from
    memory (`recalled`), fitted to a record (`identified`), or assumed (`assumption`).
    """

    value: Number
    low: Number
    high: Number
    unit: str = "1"
    basis: Literal["published", "recalled", "identified", "assumption"]
    source: str

    @model_validator(mode="after")
    def _check_order(self):
        if not 0.0 <= self.low <= self.value <= self.high:
            raise ValueError(f"must be ordered, 0 <= low {self.low:g} <= value {self.value:g} <= high {self.high:g}")
        return self


Pair = tuple[PositiveFloat, PositiveFloat]


class ArmParameters(StrictModel):
    """Right arm with two links, upper arm and forearm, in a horizontal plane.

    `length` [m], `mass` [kg] and `inertia` [kg m^2] about the links' centres; `joint_stiffness`
    [N m/rad] of the shoulder, between both joints, and of the elbow. `reference_posture` is the
    posture in which the parameters of the grips hold.
    """

    renamed = {"usual": "reference_posture"}

    length: Pair
    mass: Pair
    inertia: Pair
    joint_stiffness: SymmetricMatrix
    reference_posture: Name


class OperatorFile(StrictModel):
    """Contents of an operator file (YAML): `parameters`, `grips`, `arm` and its `postures`.

    A grip is the impedance of a hand on the handle. A posture is the position of the hand relative to
    the shoulder: ahead and to the left [m].
    """

    name: Name
    description: str = ""
    parameters: dict[Name, OperatorParameter] = Field(min_length=1)
    grips: dict[Name, HandImpedance] = {}
    arm: ArmParameters | None = None
    postures: dict[Name, tuple[Number, Number]] = {}

    @model_validator(mode="after")
    def _check_names(self):
        if strange := set(self.parameters) - set(_PARAMETER_NAMES):
            message = describe_unknown_key(min(strange), _PARAMETER_NAMES, RENAMED_OPERATOR_PARAMETERS)
            raise ValueError(f"parameters: {message}")
        return self


@dataclasses.dataclass(frozen=True)
class Operator:
    """Parameters of one simulated operator: vision, touch, muscles and expectations.

    Attributes:
        visual_delay: delay from visual stimulus to motion, without the neuromuscular lag [s].
        lead_delay: additional delay while generating lead [s].
        max_crossover_frequency: maximum crossover frequency [rad/s].
        tracking_margin: phase margin in tracking [rad].
        positioning_margin: phase margin in positioning the tip [rad].
        gain_margin: maximum loop gain where the phase is -180 degrees [1].
        neuromuscular_frequency: natural frequency of limb and reflexes [rad/s].
        neuromuscular_damping: damping ratio of limb and reflexes [1].
        remnant: power density of the observation noise over pi times the variance of the observed
            quantity.
        visual_threshold: position error below which the operator does not act [m] or [rad].
        display_noise: standard deviation of the reading of a display, relative to its largest
            value.
        haptic_delay: delay from touch to motion [s].
        force_weber: relative standard deviation of a felt force.
        position_weber: relative standard deviation of a felt displacement.
        integration_weber: additional relative standard deviation of a felt stiffness.
        tremor: standard deviation of the muscles' force [N].
        handle_position_gain: integral gain of the handle's position control [1/s].
        max_force: maximum muscle force on the handle [N].
        cocontraction: simultaneous contraction of antagonist muscles, relative to its maximum.
        cocontraction_stiffness_factor: factor on the arm stiffness at full co-contraction.
        expected_speed: machine speed that the operator expects with the handle at its stop [m/s],
            [rad/s].
        expected_scale: machine displacement per handle displacement that the operator expects under
            position control [m/m], [rad/rad].
        task_stiffness: expected ground stiffness [N/m].
        new_gain_log_std: standard deviation of the logarithm of an unknown gain.
        memory_time: time constant with which experience fades [s].
        unfelt_gain_std: standard deviation of the logarithm of the imagined effect of a push that
            is not felt.
        correction_interval: time between correcting pushes by feel [s].
    """

    visual_delay: float
    lead_delay: float
    max_crossover_frequency: float
    tracking_margin: float
    positioning_margin: float
    gain_margin: float
    neuromuscular_frequency: float
    neuromuscular_damping: float
    remnant: float
    visual_threshold: float
    display_noise: float
    haptic_delay: float
    force_weber: float
    position_weber: float
    integration_weber: float
    tremor: float
    handle_position_gain: float
    max_force: float
    cocontraction: float
    cocontraction_stiffness_factor: float
    expected_speed: float
    expected_scale: float
    task_stiffness: float
    new_gain_log_std: float
    memory_time: float
    unfelt_gain_std: float
    correction_interval: float

    @property
    def neuromuscular_delay(self) -> float:
        """Equivalent delay of the neuromuscular lag at low frequencies [s].

        It is `2 zeta / omega`, with damping ratio zeta and natural frequency omega of the lag.
        """
        return 2.0 * self.neuromuscular_damping / self.neuromuscular_frequency


_PARAMETER_NAMES = tuple(field.name for field in dataclasses.fields(Operator))


@functools.cache
def load_operator_file(path: Path = DEFAULT_OPERATOR_FILE) -> OperatorFile:
    """Read and validate a YAML file of operator parameters.

    Args:
        path: path of the file; the default file if omitted.

    Returns:
        The validated file, completed with the entries of the default file.

    Raises:
        InputError: the file is invalid; the message gives file, line and key.
    """
    data, lines = read_yaml(path)
    found = validate_data(OperatorFile, data, str(path), lines)
    if path == DEFAULT_OPERATOR_FILE:
        if lacking := [name for name in _PARAMETER_NAMES if name not in found.parameters]:
            raise InputError(path, f"has no parameters {', '.join(lacking)}")
        return found
    usual = load_operator_file()
    return found.model_copy(update={
        "parameters": usual.parameters | found.parameters,
        "grips": usual.grips | found.grips, "postures": usual.postures | found.postures,
        "arm": found.arm or usual.arm,
    })  # fmt: skip


def make_operator(file: OperatorFile, number: int | None, **fixed_parameters: float) -> Operator:
    """Create an operator from a file: the nominal one, or a random one within the ranges.

    Each parameter of a random operator has a triangular distribution with its mode at the nominal
    value.

    Args:
        file: result of `load_operator_file`.
        number: number of the sampled operator, used as seed; None for the nominal operator.
        fixed_parameters: parameters with given values, which are not sampled.

    Returns:
        The operator.
    """
    values = {}
    for place, name in enumerate(_PARAMETER_NAMES):
        p = file.parameters[name]
        values[name] = p.value
        if number is not None and p.low < p.high:
            rng = np.random.default_rng([number, place, 1967])
            values[name] = float(rng.triangular(p.low, p.value, p.high))
    return Operator(**values | fixed_parameters)


def make_scenario_operator(perception: OperatorSettings, folder: str = "") -> Operator:
    """Create the simulated operator that a scenario specifies.

    Args:
        perception: operator settings of the scenario (key `perception`).
        folder: folder of the scenario, to which the path of the operator file is relative.

    Returns:
        The operator.

    Raises:
        InputError: the file is invalid.
    """
    known = {name: getattr(perception, name) for name in _PARAMETER_NAMES if hasattr(perception, name)}
    known = {name: value for name, value in known.items() if value is not None}
    return make_operator(load_perception_file(perception, folder), perception.sample, **known)


def load_perception_file(perception: OperatorSettings, folder: str) -> OperatorFile:
    """Load the operator file that a scenario names, or the default file if it names none.

    The path is relative to `folder`, the folder of the scenario.
    """
    if perception.file is None:
        return load_operator_file()
    return load_operator_file(resolve_path(Path(folder, perception.file)))
