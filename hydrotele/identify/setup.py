"""Which parameters the regressor of a machine has: its bodies, and the friction of its drives."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.machine.drives import Friction
from hydrotele.machine.machine import Machine
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.inverse_dynamics import (
    FrictionTerm,
    Projection,
    Regressor,
    pin_friction,
    project,
    regressor,
)


def drive_friction(machine: Machine, chain: Chain) -> list[FrictionTerm]:
    """Friction of all drives, with the machine's numbers.

    Coulomb and viscous parts are always there; the Stribeck part and the asymmetries
    `coulomb_asymmetry` (F_c a_c), `stribeck_asymmetry` (F_s a_c) and `viscous_asymmetry` (b a_v)
    where they are not 0.

    Args:
        machine: the machine.
        chain: its chain, whose drives are in actuator order.

    Returns:
        One per drive.

    Source: nominal model, "Piston force", without the speeds that make it nonlinear.
    """
    return [
        FrictionTerm(joint, _numbers(f), f.smoothing_velocity, f.stribeck_velocity)
        for joint, f in zip(
            chain.drives, (machine.axes[a].drive.friction for a in actuator_order(machine)),
            strict=True,
        )
    ]  # fmt: skip


def _numbers(f: Friction) -> dict[str, float]:
    dry, wet = f.coulomb_asymmetry, f.viscous_asymmetry
    parts = {
        "coulomb": f.coulomb, "stribeck": f.stribeck_extra, "coulomb_asymmetry": f.coulomb * dry,
        "stribeck_asymmetry": f.stribeck_extra * dry, "viscous": f.viscous,
        "viscous_asymmetry": f.viscous * wet,
    }  # fmt: skip
    return {k: v for k, v in parts.items() if v != 0.0 or k in ("coulomb", "viscous")}


Model = Literal["complete", "reduced"]
_BAR_AXIS = (1.0, 0.0, 0.0)  # of a tube and of a rod, in their frames: from pin to pin


@dataclass(frozen=True)
class RegressorSetup:
    """What a regressor is built of.

    Attributes:
        chain: the mechanism.
        given: the k joints whose motion is measured.
        bodies: those with columns.
        rubbing: friction, place by place.
        offsets: constant forces of the drives as given [N] or [N m]; None for no such columns.
        drive_inertia: joints whose drive has an inertia of its own.
        alike: bodies, joints or closures that have the same parameters; one column, named after
            the first, stands for all of a group.
        absent: parameters that are known to be 0, such as `moment_x.stator`.
        moment_free: body -> unit axis in its frame about which it takes no moment from its
            neighbours; see `project`.
    """

    chain: Chain
    given: tuple[str, ...]
    bodies: tuple[str, ...]
    rubbing: tuple[FrictionTerm, ...]
    offsets: Mapping[str, float] | None = field(default_factory=dict)
    drive_inertia: tuple[str, ...] = ()
    alike: tuple[tuple[str, ...], ...] = ()
    absent: tuple[str, ...] = ()
    moment_free: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)

    def project(
        self, position: np.ndarray, rate: np.ndarray, acceleration: np.ndarray,
        start: np.ndarray | None = None,
    ) -> Projection:  # fmt: skip
        """Project the chain on its drives along a motion of the given joints.

        Args:
            position: (n, k) of the given joints [rad] or [m].
            rate: (n, k) [rad/s] or [m/s].
            acceleration: (n, k) [rad/s^2] or [m/s^2].
            start: (v,) positions from which to go to the first row; the chain's by default.

        Returns:
            The projection.

        Raises:
            InputError: as of `hydrotele.multibody.inverse_dynamics.project`.
        """
        return project(
            self.chain, self.given, position, rate, acceleration, start=start,
            moment_free=self.moment_free,
        )  # fmt: skip

    def table(self, found: Projection, rate_std: np.ndarray | None = None) -> Regressor:
        """Regressor along a motion.

        Args:
            found: projection of the chain along it.
            rate_std: (n, v) of the rates [rad/s] or [m/s]; None if they are certain.

        Returns:
            The regressor, with one column for what is alike and none for what is absent.

        Raises:
            InputError: a body, joint or parameter is not known.
        """
        whole = regressor(
            self.chain, found, bodies=self.bodies, rubbing=self.rubbing,
            offsets=False if self.offsets is None else self.offsets,
            drive_inertia=self.drive_inertia, rate_std=rate_std,
        )  # fmt: skip
        return _merged(whole, self.alike, self.absent) if self.alike or self.absent else whole


def _merged(whole: Regressor, alike: Sequence[Sequence[str]], absent: Sequence[str]) -> Regressor:
    """A regressor with summed columns for places that are alike, without those absent."""
    first = {place: group[0] for group in alike for place in group}
    names, members = [], {}
    for k, name in enumerate(whole.names):
        kind, _, place = name.partition(".")
        stands = f"{kind}.{first.get(place, place)}"
        if stands not in members:
            names.append(stands)
        members.setdefault(stands, []).append(k)
    places = {name.partition(".")[2] for name in whole.names}
    if strange := [place for place in first if place not in places]:
        raise InputError("setup", f"no parameters belong to {strange[0]}, which is stated alike")
    if strange := [name for name in absent if name not in members]:
        raise InputError("setup", f"{strange[0]} is stated absent but is no parameter")
    kept = [name for name in names if name not in absent]
    groups = [members[name] for name in kept]
    sums = np.zeros((len(whole.names), len(kept)))
    for k, group in enumerate(groups):
        sums[group, k] = 1.0
    return Regressor(
        whole.matrix @ sums, whole.drives, tuple(kept),
        tuple(whole.units[group[0]] for group in groups),
        np.array([whole.nominal[group].mean() for group in groups]),
    )  # fmt: skip


def machine_setup(
    machine: Machine, chain: Chain, model: Model = "complete", *, pins: bool = False,
    asymmetry: bool = False, ball_joints: bool = False,
) -> RegressorSetup:  # fmt: skip
    """Setup for a machine.

    Args:
        machine: the machine.
        chain: its chain, with drives in actuator order.
        model: `complete`, or `reduced` to the links, without tubes and rods.
        pins: whether joints and closures without drive have Coulomb friction.
        asymmetry: whether viscous friction of the drives may depend on the direction. Dry friction
            that does cannot be told from a force offset.
        ball_joints: whether cylinders end in ball joints instead of pins: they then carry no
            moment about their own axes. Tube and rod still turn about it as pins would turn them,
            which is exact where their inertia about it is negligible.

    Returns:
        The setup. Bodies that no joint moves have no columns.

    Source: Khoshzaban 1992, 4.3 (complete and reduced model) and p. 92, Eq. 4.23 (ball joints).
    """
    moved = [b for k, b in enumerate(chain.bodies) if chain.tree.above[k + 1].any()]
    bodies = tuple(b for b in moved if model == "complete" or b not in cylinder_bars(machine))
    rubbing = drive_friction(machine, chain)
    if asymmetry:
        rubbing = [replace(r, nominal={"viscous_asymmetry": 0.0, **r.nominal}) for r in rubbing]
    order = actuator_order(machine)
    offsets = {
        drive: facts.force.offset
        for drive, facts in zip(chain.drives, (machine.axes[a] for a in order), strict=True)
        if facts.force
    }
    return RegressorSetup(
        chain=chain, given=tuple(machine.axes[a].joint for a in order), bodies=bodies,
        rubbing=(*rubbing, *(pin_friction(chain) if pins else ())), offsets=offsets,
        moment_free=dict.fromkeys(cylinder_bars(machine), _BAR_AXIS) if ball_joints else {},
    )  # fmt: skip


def cylinder_bars(machine: Machine) -> dict[str, tuple[str, str]]:
    """Body of a cylinder's tube or rod -> (axis, `tube` or `rod`)."""
    return {
        f"{name}_{part}": (name, part)
        for name, axis in machine.axes.items()
        if axis.cylinder
        for part in ("tube", "rod")
    }


def mechanism_setup(
    chain: Chain, given: Sequence[str] | None = None, *, passive: Sequence[str] = (),
    offsets: bool = True, alike: Sequence[Sequence[str]] = (), absent: Sequence[str] = (),
    friction: Mapping[str, Mapping[str, float]] | None = None,
) -> RegressorSetup:  # fmt: skip
    """Setup for any mechanism, without a machine.

    Drives, and the passive joints that are named, have dry and viscous friction; the file's
    `damping` and `frictionloss` are the given numbers.

    Args:
        chain: the mechanism.
        given: joints whose motion is measured; the drives by default.
        passive: joints and closures without drive that have friction.
        offsets: whether the drives may have constant forces.
        alike: as of `Setup`.
        absent: as of `Setup`.
        friction: joint -> further parameters of its friction, which an MJCF cannot state; see
            `FRICTION_TERMS`, and `stribeck_velocity`.

    Returns:
        The setup. Bodies that no joint moves have no columns; joints with an `armature` have one.
    """
    moved = tuple(b for k, b in enumerate(chain.bodies) if chain.tree.above[k + 1].any())
    rubbing, damping = [], chain.damping.copy()
    for place in (*passive, *chain.drives):
        numbers = {"coulomb": 0.0, "viscous": 0.0}
        if place not in chain.closures:
            j = chain.index(place)
            numbers = {"coulomb": float(chain.frictionloss[j]), "viscous": float(damping[j])}
            damping[j] = 0.0  # it has a column
        more = dict((friction or {}).get(place, {}))
        slow = more.pop("stribeck_velocity", FrictionTerm.stribeck)
        rubbing.append(FrictionTerm(place, numbers | more, stribeck=slow))
    return RegressorSetup(
        chain=replace(chain, damping=damping),
        given=tuple(chain.drives if given is None else given),
        bodies=moved, rubbing=tuple(rubbing), offsets={} if offsets else None,
        drive_inertia=tuple(j for j, a in zip(chain.joints, chain.armature, strict=True) if a),
        alike=tuple(tuple(group) for group in alike), absent=tuple(absent),
    )  # fmt: skip
