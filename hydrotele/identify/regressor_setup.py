"""Definition of the regressor: bodies, friction, offsets and drive inertias with parameters.

`machine_setup` defines it for a machine, `mechanism_setup` for any mechanism. `RegressorSetup`
projects the mechanism along a motion and computes its regressor.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.machine.drives import Friction
from hydrotele.machine.machine import Machine
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.inverse_dynamics import Projection, project_on_drives
from hydrotele.multibody.regressor import FrictionTerm, Regressor, make_regressor, passive_friction_terms


def drive_friction_terms(machine: Machine, chain: Chain) -> list[FrictionTerm]:
    """Build the friction terms of all drives, with the machine's friction parameters as given values.

    Coulomb and viscous friction are always included. Stribeck friction and the differences between the
    two directions are included if they are not 0. Each asymmetry is a force or coefficient: the friction
    times the relative asymmetry in the machine file. The smoothing velocity and the Stribeck velocity,
    on which the force does not depend linearly, are constants of the term.

    Args:
        machine: the machine.
        chain: its kinematic chain with drives in actuator order.

    Returns:
        One friction term per drive.
    """
    return [
        FrictionTerm(joint, _friction_parameters(f), f.smoothing_velocity, f.stribeck_velocity)
        for joint, f in zip(
            chain.drives, (machine.axes[a].drive.friction for a in actuator_order(machine)),
            strict=True,
        )
    ]  # fmt: skip


def _friction_parameters(f: Friction) -> dict[str, float]:
    dry, wet = f.coulomb_asymmetry, f.viscous_asymmetry
    parts = {
        "coulomb": f.coulomb, "stribeck": f.stribeck_extra, "coulomb_asymmetry": f.coulomb * dry,
        "stribeck_asymmetry": f.stribeck_extra * dry, "viscous": f.viscous,
        "viscous_asymmetry": f.viscous * wet,
    }  # fmt: skip
    return {k: v for k, v in parts.items() if v != 0.0 or k in ("coulomb", "viscous")}


DynamicModel = Literal["complete", "reduced"]
_BAR_AXIS = (1.0, 0.0, 0.0)  # of a tube and of a rod, in their frames: from pin to pin


@dataclass(frozen=True)
class RegressorSetup:
    """Definition of a regressor.

    Attributes:
        chain: kinematic chain of the mechanism.
        given_joints: the k joints whose motion is measured.
        bodies: bodies with inertial parameters.
        friction_terms: friction terms of joints, closures and drives.
        offsets: drive -> given constant force [N] or [N m]; None for a regressor without offsets.
        drive_inertia: joints whose drive has an inertia.
        equal_groups: groups of bodies, joints or closures with the same parameters; one column, named
            after the first member, represents a group.
        zero_parameters: parameters known to be 0, such as `moment_x.stator`.
        moment_free: body -> unit axis in its frame about which neighbours transmit no moment to it;
            see `project_on_drives`.
    """

    chain: Chain
    given_joints: tuple[str, ...]
    bodies: tuple[str, ...]
    friction_terms: tuple[FrictionTerm, ...]
    offsets: Mapping[str, float] | None = field(default_factory=dict)
    drive_inertia: tuple[str, ...] = ()
    equal_groups: tuple[tuple[str, ...], ...] = ()
    zero_parameters: tuple[str, ...] = ()
    moment_free: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)

    def project_motion_on_drives(
        self, position: np.ndarray, rate: np.ndarray, acceleration: np.ndarray,
        start: np.ndarray | None = None,
    ) -> Projection:  # fmt: skip
        """Compute the motion of all joints, and how inertia and friction map to drive forces along it.

        Args:
            position: (n, k) positions of the given joints [rad] or [m].
            rate: (n, k) rates [rad/s] or [m/s].
            acceleration: (n, k) accelerations [rad/s^2] or [m/s^2].
            start: (v,) initial guess of all joint positions; by default that of the chain.

        Returns:
            The projection of the mechanism on its drives.

        Raises:
            InputError: a shape is wrong, a value is missing, or closed loops cannot follow the motion.
        """
        return project_on_drives(
            self.chain, self.given_joints, position, rate, acceleration, start=start,
            moment_free=self.moment_free,
        )  # fmt: skip

    def compute_regressor(self, projection: Projection, rate_std: np.ndarray | None = None) -> Regressor:
        """Compute the regressor, the matrix of drive forces per unit of each parameter, along a motion.

        Args:
            projection: matrices that map body wrenches to drive forces, for every row of the motion.
            rate_std: (n, v) standard deviations of the rates [rad/s] or [m/s]; None if exact.

        Returns:
            The regressor, with one column per group of equal parameters and none for the parameters
            in `zero_parameters`.

        Raises:
            InputError: a body, joint or parameter is unknown.
        """
        whole = make_regressor(
            self.chain, projection, bodies=self.bodies, friction=self.friction_terms,
            offsets=False if self.offsets is None else self.offsets,
            drive_inertia=self.drive_inertia, rate_std=rate_std,
        )  # fmt: skip
        return (
            _merge_columns(whole, self.equal_groups, self.zero_parameters)
            if self.equal_groups or self.zero_parameters
            else whole
        )


def _merge_columns(whole: Regressor, alike: Sequence[Sequence[str]], absent: Sequence[str]) -> Regressor:
    """Return a regressor with summed columns for equal parameters, without those of parameters known to be 0.

    Args:
        whole: regressor with one column per parameter.
        alike: groups of bodies, joints or closures with the same parameters. The sum has the name of
            the group's first member, and its nominal value is the mean of the group.
        absent: names of the parameters known to be 0.

    Returns:
        The regressor with fewer columns.

    Raises:
        InputError: a group member has no parameters, or a name in `absent` is not a parameter.
    """
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
        raise InputError("setup", f"equal_parameters: {strange[0]} has no parameters; remove it")
    if strange := [name for name in absent if name not in members]:
        raise InputError("setup", f"zero_parameters: {strange[0]} is not a parameter; remove it")
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
    machine: Machine, chain: Chain, model: DynamicModel = "complete", *, pins: bool = False,
    asymmetry: bool = False, ball_joints: bool = False,
) -> RegressorSetup:  # fmt: skip
    """Define which parameters of a machine (bodies, friction, offsets) enter its regressor.

    Args:
        machine: the machine.
        chain: its kinematic chain with drives in actuator order.
        model: `complete`, or `reduced` to the links, without tubes and rods.
        pins: whether joints and closures without drive have Coulomb friction.
        asymmetry: whether viscous friction of the drives may depend on the direction. Asymmetric
            dry friction cannot be distinguished from a force offset.
        ball_joints: whether cylinders have ball joints instead of pins at their ends and transmit
            no moment about their own axes. Tube and rod still rotate as with pins, which is exact if
            their inertia about that axis is negligible.

    Returns:
        The setup. Bodies that no joint moves have no parameters.

    Source: Khoshzaban 1992, 4.3 (complete and reduced model) and p. 92, Eq. 4.23 (ball joints).

    Examples:
        The complete model has the inertia of tubes and rods, the reduced model that of the links only.

        >>> import hydrotele as ht
        >>> from hydrotele.simulate.closed_loops import load_closed_chain
        >>> machine = ht.load_machine("cat215", "bucket")
        >>> chain = load_closed_chain(machine)
        >>> for model in "complete", "reduced":
        ...     setup = machine_setup(machine, chain, model)
        ...     print(model, len(setup.bodies), sum(map(len, (term.nominal for term in setup.friction_terms))))
        complete 12 11
        reduced 6 11
    """
    moved = [b for k, b in enumerate(chain.bodies) if chain.tree.is_moved[k + 1].any()]
    bodies = tuple(b for b in moved if model == "complete" or b not in map_cylinder_bodies(machine))
    rubbing = drive_friction_terms(machine, chain)
    if asymmetry:
        rubbing = [replace(r, nominal={"viscous_asymmetry": 0.0, **r.nominal}) for r in rubbing]
    order = actuator_order(machine)
    offsets = {
        drive: facts.force.offset
        for drive, facts in zip(chain.drives, (machine.axes[a] for a in order), strict=True)
        if facts.force
    }
    return RegressorSetup(
        chain=chain, given_joints=tuple(machine.axes[a].joint for a in order), bodies=bodies,
        friction_terms=(*rubbing, *(passive_friction_terms(chain) if pins else ())), offsets=offsets,
        moment_free=dict.fromkeys(map_cylinder_bodies(machine), _BAR_AXIS) if ball_joints else {},
    )  # fmt: skip


def map_cylinder_bodies(machine: Machine) -> dict[str, tuple[str, str]]:
    """Return body name -> (axis, `tube` or `rod`) for the tubes and rods of all cylinders."""
    return {
        f"{name}_{part}": (name, part)
        for name, axis in machine.axes.items()
        if axis.cylinder
        for part in ("tube", "rod")
    }


def mechanism_setup(
    chain: Chain, given_joints: Sequence[str] | None = None, *, passive: Sequence[str] = (),
    offsets: bool = True, equal_groups: Sequence[Sequence[str]] = (), zero_parameters: Sequence[str] = (),
    friction: Mapping[str, Mapping[str, float]] | None = None,
) -> RegressorSetup:  # fmt: skip
    """Define which parameters enter the regressor of any mechanism, without a machine file.

    Drives and the named passive joints have dry and viscous friction, with `damping` and
    `frictionloss` of the MJCF file as given values.

    Args:
        chain: kinematic chain of the mechanism.
        given_joints: joints whose motion is measured; the drives by default.
        passive: joints and closures without drive that have friction.
        offsets: whether the drives may have constant forces.
        equal_groups: groups of bodies, joints or closures with the same parameters.
        zero_parameters: parameters known to be 0, such as `moment_x.stator`.
        friction: joint -> further friction parameters, which an MJCF cannot state; see
            `FRICTION_TERMS`, and `stribeck_velocity`.

    Returns:
        The setup. Bodies that no joint moves have no parameters; joints with an `armature` have a
        drive inertia.
    """
    moved = tuple(b for k, b in enumerate(chain.bodies) if chain.tree.is_moved[k + 1].any())
    rubbing, damping = [], chain.damping.copy()
    for place in (*passive, *chain.drives):
        numbers = {"coulomb": 0.0, "viscous": 0.0}
        if place not in chain.closures:
            j = chain.index(place)
            numbers = {"coulomb": float(chain.frictionloss[j]), "viscous": float(damping[j])}
            damping[j] = 0.0  # it is a parameter of the regressor
        more = dict((friction or {}).get(place, {}))
        slow = more.pop("stribeck_velocity", FrictionTerm.stribeck)
        rubbing.append(FrictionTerm(place, numbers | more, stribeck=slow))
    return RegressorSetup(
        chain=replace(chain, damping=damping),
        given_joints=tuple(chain.drives if given_joints is None else given_joints),
        bodies=moved, friction_terms=tuple(rubbing), offsets={} if offsets else None,
        drive_inertia=tuple(j for j, a in zip(chain.joints, chain.armature, strict=True) if a),
        equal_groups=tuple(tuple(group) for group in equal_groups), zero_parameters=tuple(zero_parameters),
    )  # fmt: skip
