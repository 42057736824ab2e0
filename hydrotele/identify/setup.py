"""Which parameters the regressor of a machine has: its bodies, and the friction of its drives."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.machine.drives import Friction
from hydrotele.machine.machine import Machine
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.regressor import FrictionTerm, pin_friction


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
    """

    chain: Chain
    given: tuple[str, ...]
    bodies: tuple[str, ...]
    rubbing: tuple[FrictionTerm, ...]
    offsets: Mapping[str, float] | None = field(default_factory=dict)
    drive_inertia: tuple[str, ...] = ()


def machine_setup(
    machine: Machine, chain: Chain, model: Model = "complete", *, pins: bool = False,
    asymmetry: bool = False,
) -> RegressorSetup:  # fmt: skip
    """Setup for a machine.

    Args:
        machine: the machine.
        chain: its chain, with drives in actuator order.
        model: `complete`, or `reduced` to the links, without tubes and rods.
        pins: whether joints and closures without drive have Coulomb friction.
        asymmetry: whether viscous friction of the drives may depend on the direction. Dry friction
            that does cannot be told from a force offset.

    Returns:
        The setup. Bodies that no joint moves have no columns.

    Source: Khoshzaban 1992, 4.3 (complete and reduced model).
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
    )  # fmt: skip


def cylinder_bars(machine: Machine) -> dict[str, tuple[str, str]]:
    """Body of a cylinder's tube or rod -> (axis, `tube` or `rod`)."""
    return {
        f"{name}_{part}": (name, part)
        for name, axis in machine.axes.items()
        if axis.cylinder
        for part in ("tube", "rod")
    }
