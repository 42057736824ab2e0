"""How machines of one type differ: the ranges from which robustness is usually tried."""

from typing import Any

from hydrotele.machine.machine import Machine

_DEADBAND = (0.5, 2.0)  # times the nominal overlap
_FLOW = (0.8, 1.2)  # makers' ratings are good to 5 or 10 %, wear and temperature do the rest
_BANDWIDTH = (0.6, 1.4)
_FRICTION = (0.5, 2.0)
_BULK = (0.6, 1.2)  # air in the oil
_DELAY = (0.0, 0.05)  # s, of a fieldbus and its valve amplifiers
_PAYLOAD = (0.0, 0.02)  # times the mass of all links, at the tip


def usual_spread(machine: Machine) -> tuple[dict[str, Any], ...]:
    """Effects with ranges, for `Options.randomise`, of every valve, drive and the whole machine.

    Args:
        machine: the nominal machine.

    Returns:
        For every valve its overlap (0.5 to 2 times), flow (0.8 to 1.2) and bandwidth (0.6 to 1.4);
        for every drive its Coulomb friction (0.5 to 2); for the machine the oil's stiffness (0.6 to
        1.2), the commands' delay (0 to 50 ms) and a payload (0 to 2 % of its mass).
    """
    found = []
    for name, axis in machine.axes.items():
        if axis.valve is None:
            continue
        found += [
            _effect("valve_deadband", name, deadband=_times(axis.valve.deadband, _DEADBAND)),
            _effect("valve_gain", name, ratio=list(_FLOW)),
            _effect("spool_lag", name, bandwidth=_times(axis.valve.bandwidth, _BANDWIDTH)),
            _effect(
                "coulomb_friction", name,
                coulomb=_times(axis.hydraulic_drive.friction.coulomb, _FRICTION),
            ),
        ]  # fmt: skip
    if machine.supply:
        bulk = _times(machine.supply.bulk_modulus, _BULK)
        found.append(_effect("bulk_modulus", "all", bulk_modulus=bulk))
    weight = sum(link.mass for link in machine.links.values())
    found.append(_effect("command_delay", "all", delay=list(_DELAY)))
    return (*found, _effect("payload", "tool", mass=_times(weight, _PAYLOAD)))


def _effect(name: str, location: str, **ranges: list[float]) -> dict[str, Any]:
    return {"name": name, "location": location, "parameters": ranges}


def _times(nominal: float, factors: tuple[float, float]) -> list[float]:
    return [factor * nominal for factor in factors]
