"""Facts of a joystick: workspace, sensing, flotor, coils, the hand on it, gains. All SI, frozen.

`models/joystick/joystick.yaml` holds the shipped one; a user's is a file of the same form.
"""

import math
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import Field, model_validator

from hydrotele.core.datafile import (
    Facts,
    Name,
    NonNegative,
    Number,
    Positive,
    Vector,
    parse,
    read_yaml,
    suggest,
)
from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder

JOYSTICK_FILE = "joystick.yaml"
AXES = ("x", "y", "z", "rx", "ry", "rz")


class Workspace(Facts):
    """Way of the coils' centre in its gap, either way [m], and turning of the flotor [rad].

    The handle, which stands off the coils, turns less about itself: see `Joystick.reach`.
    """

    translation: Positive
    rotation: Positive


class OpticalSensing(Facts):
    """Resolution of the handle's pose: translation [m], rotation [rad]; 0 is ideal."""

    translation: NonNegative
    rotation: NonNegative


class FlotorFacts(Facts):
    """The moving part in the coils' frame: mass [kg], com [m], inertia [kg m^2], handle [m]."""

    mass: Positive
    com: Vector
    inertia: tuple[Positive, Positive, Positive]
    handle: Vector


class CoilFacts(Facts):
    """Three stations on a radius [m], each with two coils: [N/A], [A].

    `continuous_current` [A] is what a coil bears for ever, with the time constant `thermal_time`
    [s] of its winding; `edge_loss` [1] the share of its force that is lost at the end of its gap.
    """

    radius: Positive
    force_per_ampere: Positive
    max_current: Positive
    continuous_current: Positive = 2.0
    thermal_time: Positive = 60.0
    edge_loss: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0


class DiodeFacts(Facts):
    """The position-sensing diodes: distance from the coils' centre [m], step of a reading [m]."""

    distance: Positive
    step: NonNegative


class AloneFacts(Facts):
    """Second-order systems of the axes x, y, z, rx, ry, rz without a hand: [rad/s], ratio [1]."""

    frequency: Annotated[tuple[Positive, ...], Field(min_length=6, max_length=6)]
    ratio: Annotated[tuple[Positive, ...], Field(min_length=6, max_length=6)]


Shape = tuple[Positive, Number, Positive]


class HandFacts(Facts):
    """The hand on the handle: mass [kg], damping and stiffness [N s/m], [N/m]; rotations [N m].

    An arm is stiffer towards its shoulder than across. In the handle's horizontal plane the mass is
    multiplied by `mass_shape`, damping and stiffness by `stiffness_shape`: xx, xy and yy of a
    symmetric matrix [1].
    """

    mass: NonNegative
    damping: NonNegative
    stiffness: NonNegative
    rotation_damping: NonNegative = 0.0
    rotation_stiffness: NonNegative = 0.0
    mass_shape: Shape = (1.0, 0.0, 1.0)
    stiffness_shape: Shape = (1.0, 0.0, 1.0)

    @model_validator(mode="after")
    def _check(self):
        for name in ("mass_shape", "stiffness_shape"):
            xx, xy, yy = getattr(self, name)
            if not xx * yy > xy * xy:
                raise ValueError(f"{name}: xx {xx:g} times yy {yy:g} must be more than xy^2")
        return self

    @property
    def carried(self) -> float:
        """Mass that hangs on the handle [kg]; what is more in a direction hangs on the shoulder."""
        return self.mass * min(1.0, principal(self.mass_shape).least)

    def along(self, axis: int) -> tuple[float, float, float]:
        """Mass, damping and stiffness along or about one axis of the handle, the others at rest.

        Args:
            axis: place of x, y, z, rx, ry or rz.

        Returns:
            [kg], [N s/m], [N/m]; of rotations 0, [N m s/rad], [N m/rad].
        """
        if axis > 2:
            return 0.0, self.rotation_damping, self.rotation_stiffness
        heavy, stiff = ((s[0], s[2], 1.0)[axis] for s in (self.mass_shape, self.stiffness_shape))
        return heavy * self.mass, stiff * self.damping, stiff * self.stiffness


class Principal(NamedTuple):
    """Principal values of a shape, and the angle of the greater one's axis from x [rad]."""

    least: float
    greatest: float
    angle: float


def principal(shape: Shape) -> Principal:
    """Principal values of a symmetric 2 x 2 matrix, and where its long axis points.

    Args:
        shape: xx, xy, yy.

    Returns:
        Its principal values and the long axis' angle from x [rad].

    >>> [round(v, 6) for v in principal((2.5, 0.5, 2.5))]
    [2.0, 3.0, 0.785398]
    """
    xx, xy, yy = shape
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    return Principal(mean - half, mean + half, 0.5 * math.atan2(2.0 * xy, xx - yy))


class DetentFacts(Facts):
    """Edge of the dead band that can be felt: drop [N] or [N m], slope outside [N/m]."""

    drop: NonNegative
    outside: NonNegative


class AxisGains(Facts):
    """Stiffness feedback of one joystick axis, [N, m] or [N m, rad].

    `force_limit` [N] or [N m] is the machine's force at which the stiffness reaches `most`.
    """

    nominal: Positive
    least: NonNegative
    most: Positive
    damping: NonNegative
    deadband: NonNegative
    force_limit: Positive
    detent: DetentFacts | None = None

    @model_validator(mode="after")
    def _check(self):
        if not self.least <= self.nominal <= self.most:
            raise ValueError(
                f"stiffnesses must be ordered, least {self.least:g} <= nominal {self.nominal:g}"
                f" <= most {self.most:g}"
            )
        if self.detent and self.detent.drop > self.nominal * self.deadband:
            raise ValueError(
                f"a drop of {self.detent.drop:g} is more than the {self.nominal * self.deadband:g}"
                " that the spring has at the edge of the dead band"
            )
        return self


class Joystick(Facts):
    """A six-DOF levitated joystick. `mount` [m] is its place in the cab, `control_rate` [Hz]."""

    name: Name
    description: str = ""
    source: str = ""
    mjcf: str
    folder: str = ""
    workspace: Workspace
    sensing: OpticalSensing
    diodes: DiodeFacts
    control_rate: Annotated[Positive, Field(ge=1.0, le=1.0e5)]
    flotor: FlotorFacts
    coils: CoilFacts
    alone: AloneFacts
    hand: HandFacts
    mount: Vector
    gains: dict[Name, dict[Name, AxisGains]] = Field(min_length=1)

    @property
    def reach(self) -> tuple[float, ...]:
        """How far the handle alone goes along and about each axis, (6,) [m], [rad].

        Turned about the handle's centre, the coils move aside by the handle's distance from the
        axis through it, until they are at the end of their gap.
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
    """Names of the joysticks that come with the package."""
    return sorted(p.parent.name for p in models_folder().glob(f"*/{JOYSTICK_FILE}"))


def load_joystick(name_or_path: str | Path = "joystick") -> Joystick:
    """Read a joystick.

    Args:
        name_or_path: `joystick` for the shipped one, a YAML file, or a folder with joystick.yaml.

    Returns:
        The validated facts.

    Raises:
        InputError: there is no such file, or names file, line and key of what is wrong.
    """
    path = Path(name_or_path)
    if str(name_or_path) in shipped_joysticks():
        path = models_folder() / path / JOYSTICK_FILE
    elif path.is_dir():
        path = path / JOYSTICK_FILE
    if not path.is_file():
        known = suggest(str(name_or_path), shipped_joysticks())
        raise InputError(f"joystick {str(name_or_path)!r}", f"no such file; {known}")
    data, lines = read_yaml(path)
    return parse(Joystick, data | {"folder": str(path.parent.resolve())}, str(path), lines)
