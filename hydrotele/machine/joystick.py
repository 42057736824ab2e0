"""Parameters of a levitated joystick, in SI units.

They describe workspace, sensing, flotor, coils, the operator's hand and the stiffness gains.
`models/joystick/joystick.yaml` is the shipped joystick; a user joystick is a file of the same form.
"""

import math
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import Field, model_validator

from hydrotele.core.datafile import (
    Name,
    NonNegativeFloat,
    Number,
    PositiveFloat,
    StrictModel,
    Vector,
    read_yaml,
    suggest_valid_name,
    validate_data,
)
from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder, resolve_path

JOYSTICK_FILE = "joystick.yaml"
AXES = ("x", "y", "z", "rx", "ry", "rz")


class Workspace(StrictModel):
    """Largest travel of the coil centre from the middle of the gap [m] and rotation of the flotor [rad].

    A rotation about the handle is smaller, because the handle is off the coils; see
    `Joystick.handle_travel`.
    """

    translation: PositiveFloat
    rotation: PositiveFloat


class OpticalSensing(StrictModel):
    """Resolution of the measured handle pose: translation [m], rotation [rad]; 0 means ideal."""

    translation: NonNegativeFloat
    rotation: NonNegativeFloat


class Flotor(StrictModel):
    """The flotor (levitated part with handle and coils), in the coil frame.

    `mass` [kg], centre of mass `com` [m], principal moments of `inertia` about it [kg m^2],
    position of the `handle` [m].
    """

    mass: PositiveFloat
    com: Vector
    inertia: tuple[PositiveFloat, PositiveFloat, PositiveFloat]
    handle: Vector


class Coils(StrictModel):
    """Coils: three pairs on a `radius` [m], with `force_per_ampere` [N/A] and `max_current` [A].

    `continuous_current` [A] is the permissible continuous current of a coil with the thermal time
    constant `thermal_time` [s]. `edge_loss` [1] is the fraction of the force that is lost at the
    end of the gap.
    """

    radius: PositiveFloat
    force_per_ampere: PositiveFloat
    max_current: PositiveFloat
    continuous_current: PositiveFloat = 2.0
    thermal_time: PositiveFloat = 60.0
    edge_loss: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0


class Diodes(StrictModel):
    """Position-sensing diodes: distance from the coil centre [m], resolution [m]."""

    distance: PositiveFloat
    step: NonNegativeFloat


class UnheldDynamics(StrictModel):
    """Target closed-loop dynamics of the levitated handle without a hand, for x, y, z, rx, ry, rz.

    `frequency` [rad/s] is the natural frequency and `ratio` [1] the damping ratio.
    """

    frequency: Annotated[tuple[PositiveFloat, ...], Field(min_length=6, max_length=6)]
    ratio: Annotated[tuple[PositiveFloat, ...], Field(min_length=6, max_length=6)]


SymmetricMatrix = tuple[PositiveFloat, Number, PositiveFloat]


class HandImpedance(StrictModel):
    """Impedance of the operator's hand: mass [kg], damping [N s/m], stiffness [N/m].

    Rotations have `rotation_damping` [N m s/rad] and `rotation_stiffness` [N m/rad]. An arm is
    stiffer towards the shoulder than across. In the horizontal plane of the handle, the mass is
    multiplied by `mass_shape`, damping and stiffness by `stiffness_shape`: xx, xy and yy of a
    symmetric matrix [1].
    """

    mass: NonNegativeFloat
    damping: NonNegativeFloat
    stiffness: NonNegativeFloat
    rotation_damping: NonNegativeFloat = 0.0
    rotation_stiffness: NonNegativeFloat = 0.0
    mass_shape: SymmetricMatrix = (1.0, 0.0, 1.0)
    stiffness_shape: SymmetricMatrix = (1.0, 0.0, 1.0)

    @model_validator(mode="after")
    def _check(self):
        for name in ("mass_shape", "stiffness_shape"):
            xx, xy, yy = getattr(self, name)
            if not xx * yy > xy * xy:
                raise ValueError(f"{name}: xx {xx:g} times yy {yy:g} must exceed xy^2")
        return self

    @property
    def carried_mass(self) -> float:
        """Mass of the hand whose weight the handle carries [kg].

        It is the smallest of the hand's effective masses in all directions, which differ by `mass_shape`.
        """
        return self.mass * min(1.0, find_principal_values(self.mass_shape).min_value)

    def axis_impedance(self, axis: int) -> tuple[float, float, float]:
        """Return mass, damping and stiffness of one handle axis with the other axes at rest.

        Args:
            axis: index in x, y, z, rx, ry, rz.

        Returns:
            Mass [kg], damping [N s/m], stiffness [N/m]; for rotations 0, [N m s/rad], [N m/rad].
        """
        if axis > 2:
            return 0.0, self.rotation_damping, self.rotation_stiffness
        heavy, stiff = ((s[0], s[2], 1.0)[axis] for s in (self.mass_shape, self.stiffness_shape))
        return heavy * self.mass, stiff * self.damping, stiff * self.stiffness


class PrincipalValues(NamedTuple):
    """Principal values of a symmetric 2 x 2 matrix, and angle of its major axis from x [rad].

    The major axis belongs to `max_value`.
    """

    min_value: float
    max_value: float
    angle: float


def find_principal_values(shape: SymmetricMatrix) -> PrincipalValues:
    """Return the principal values and the major axis of a symmetric 2 x 2 matrix.

    Args:
        shape: xx, xy, yy.

    Returns:
        The principal values and the angle of the major axis from x [rad].

    >>> [round(v, 6) for v in find_principal_values((2.5, 0.5, 2.5))]
    [2.0, 3.0, 0.785398]
    """
    xx, xy, yy = shape
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    return PrincipalValues(mean - half, mean + half, 0.5 * math.atan2(2.0 * xy, xx - yy))


class Detent(StrictModel):
    """Perceptible edge of a joystick axis' dead band.

    At the edge, the spring force decreases by `drop` [N] or [N m]. Outside, the stiffness is
    `slope` [N/m] or [N m/rad].
    """

    renamed = {"outside": "slope"}

    drop: NonNegativeFloat
    slope: NonNegativeFloat


class AxisGains(StrictModel):
    """Stiffness feedback of one joystick axis.

    The units below are those of translations; rotations have N m and rad. The spring stiffness
    towards the centre is `nominal_stiffness` without force of the machine, and always between
    `min_stiffness` and `max_stiffness` [N/m]. `force_limit` [N] is the force of the machine at
    which the stiffness reaches `max_stiffness`. `damping` [N s/m] acts in parallel. Under rate
    control, the machine does not move while the handle is within `deadband` [m] of the centre.
    """

    renamed = {"nominal": "nominal_stiffness", "least": "min_stiffness", "most": "max_stiffness"}

    nominal_stiffness: PositiveFloat
    min_stiffness: NonNegativeFloat
    max_stiffness: PositiveFloat
    damping: NonNegativeFloat
    deadband: NonNegativeFloat
    force_limit: PositiveFloat
    detent: Detent | None = None

    @model_validator(mode="after")
    def _check(self):
        if not self.min_stiffness <= self.nominal_stiffness <= self.max_stiffness:
            raise ValueError(
                "must be ordered, min_stiffness <= nominal_stiffness <= max_stiffness:"
                f" {self.min_stiffness:g}, {self.nominal_stiffness:g}, {self.max_stiffness:g}"
            )
        if self.detent and self.detent.drop > self.nominal_stiffness * self.deadband:
            raise ValueError(
                f"detent.drop {self.detent.drop:g} exceeds the spring force"
                f" {self.nominal_stiffness * self.deadband:g} at the edge of the dead band"
            )
        return self


class Joystick(StrictModel):
    """A six-DOF levitated joystick; `mount` [m] is its position in the cab, `control_rate` [Hz].

    `gains` maps the name of a set of gains to those of every axis x, y, z, rx, ry, rz.
    `closed_loop` is the dynamics of the handle without a hand.
    """

    renamed = {"alone": "closed_loop"}

    name: Name
    description: str = ""
    source: str = ""
    mjcf: str
    folder: str = ""
    workspace: Workspace
    sensing: OpticalSensing
    diodes: Diodes
    control_rate: Annotated[PositiveFloat, Field(ge=1.0, le=1.0e5)]
    flotor: Flotor
    coils: Coils
    closed_loop: UnheldDynamics
    hand: HandImpedance
    mount: Vector
    gains: dict[Name, dict[Name, AxisGains]] = Field(min_length=1)

    @property
    def handle_travel(self) -> tuple[float, ...]:
        """Largest displacement [m] or rotation [rad] of the handle for each axis separately, (6,).

        A rotation about the centre of the handle also moves the coils, which are at a distance from
        the handle. The rotation is limited by the gap of the coils and by `workspace.rotation`.
        """
        far, most, handle = self.workspace.translation, self.workspace.rotation, self.flotor.handle
        turns = []
        for i in range(3):
            lever = math.hypot(*(handle[k] for k in range(3) if k != i))
            turns.append(2.0 * math.asin(min(1.0, 0.5 * far / lever)) if lever > 0.0 else most)
        return (far,) * 3 + tuple(min(most, turn) for turn in turns)

    @model_validator(mode="after")
    def _check(self):
        for name, axes in self.gains.items():
            if set(axes) != set(AXES):
                raise ValueError(f"gains.{name} needs {', '.join(AXES)}; has {', '.join(axes)}")
        return self


def shipped_joysticks() -> list[str]:
    """Return the names of the joysticks in the package."""
    return sorted(p.parent.name for p in models_folder().glob(f"*/{JOYSTICK_FILE}"))


def load_joystick(name_or_path: str | Path = "joystick") -> Joystick:
    """Read a joystick file.

    Args:
        name_or_path: `joystick` for the shipped one, a YAML file, or a folder with joystick.yaml.

    Returns:
        The validated joystick.

    Raises:
        InputError: the file is missing or invalid; the message gives file, line and key.
    """
    path = Path(name_or_path)
    if str(name_or_path) in shipped_joysticks():
        path = models_folder() / path / JOYSTICK_FILE
    elif path.is_dir():
        path = path / JOYSTICK_FILE
    if not path.is_file():
        known = suggest_valid_name(str(name_or_path), shipped_joysticks())
        raise InputError(f"joystick {str(name_or_path)!r}", f"no such file; {known}")
    data, lines = read_yaml(path)
    return validate_data(Joystick, data | {"folder": str(resolve_path(path.parent))}, str(path), lines)
