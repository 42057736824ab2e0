"""Where a machine rubs: its drives as it states them, and the pins of its joints and closures."""

from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.identify.chain import Chain
from hydrotele.identify.regressor import Rubbing
from hydrotele.machine.drives import Friction
from hydrotele.machine.machine import Machine


def drive_friction(machine: Machine, chain: Chain) -> list[Rubbing]:
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
        Rubbing(joint, _numbers(f), f.smoothing_velocity, f.stribeck_velocity)
        for joint, f in zip(
            chain.drives, (machine.axes[a].drive.friction for a in actuator_order(machine)),
            strict=True,
        )
    ]  # fmt: skip


def pin_friction(chain: Chain) -> list[Rubbing]:
    """Coulomb friction of all passive hinges and closures.

    Args:
        chain: the chain.

    Returns:
        One per hinge that no actuator moves, and per closure.

    Source: Khoshzaban 1992, 4.3: joint and pin friction of the complete model.
    """
    slides = chain.tree.slides
    hinges = [j for k, j in enumerate(chain.joints) if not slides[k] and j not in chain.drives]
    return [Rubbing(place, {"coulomb": 0.0}) for place in (*hinges, *chain.closures)]


def _numbers(f: Friction) -> dict[str, float]:
    dry, wet = f.coulomb_asymmetry, f.viscous_asymmetry
    parts = {
        "coulomb": f.coulomb, "stribeck": f.stribeck_extra, "coulomb_asymmetry": f.coulomb * dry,
        "stribeck_asymmetry": f.stribeck_extra * dry, "viscous": f.viscous,
        "viscous_asymmetry": f.viscous * wet,
    }  # fmt: skip
    return {k: v for k, v in parts.items() if v != 0.0 or k in ("coulomb", "viscous")}
