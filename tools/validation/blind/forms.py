"""Define effects that the library has in another form, and the names accepted as right.

Each form changes the independent machine where no fact of a machine file could. `accepted` was
fixed before any trial was run: the names that a hydraulics engineer would call right, with the
place. Names that the library does not have yet do no harm.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from hydrotele.machine.machine import Machine as Facts
from tools.validation.blind.spreads import either, log_uniform
from tools.validation.blind.world import Machine
from tools.validation.blind.world_machine import channels

Rng = np.random.Generator
Change = Callable[[Machine, Facts, str, Rng], tuple[Machine, dict[str, float]]]


@dataclasses.dataclass(frozen=True)
class Form:
    """A law in another form.

    Attributes:
        name: what the key calls it.
        sentence: what it is, with its source.
        kind: what it sits at: `axis`, `link`, `motor`, `port`, `supply`, `all` or `axis or all`.
        accepted: names that are right at the place; `name@all` or `name@supply` at that place.
        change: (independent machine, facts, place, rng) -> (changed machine, its numbers).
        tie: further names that count only for a swing, where nothing tells them apart.
    """

    name: str
    sentence: str
    kind: str
    accepted: tuple[str, ...]
    change: Change
    tie: tuple[str, ...] = ()

    def places(self, facts: Facts) -> list[str]:
        """Where a machine can have it."""
        names = list(facts.axes)
        match self.kind:
            case "port":
                return [f"{axis}.{side}" for axis in names for side in ("head", "rod")]
            case "motor":
                return [axis for axis in names if facts.axes[axis].motor]
            case "link":
                return names if facts.arm else []
            case "axis" | "axis or all":
                return names + (["all"] if self.kind != "axis" and len(names) > 1 else [])
            case _:
                return [self.kind]

    def right(self, place: str) -> list[tuple[str, str]]:
        """(name, place) pairs that count as right."""
        names = self.accepted + (self.tie if place == "swing" else ())
        return [(n.partition("@")[0], n.partition("@")[2] or place) for n in names]


def _at(facts: Facts, place: str) -> int:
    return list(facts.axes).index(place.partition(".")[0])


def _put(array: np.ndarray, i: int, value: float) -> np.ndarray:
    return np.array([value if k == i else v for k, v in enumerate(array)], dtype=float)


def _forms(machine: Machine, i: int, **values: float) -> Machine:
    changed = {k: _put(getattr(machine.forms, k), i, v) for k, v in values.items()}
    return machine._replace(forms=machine.forms._replace(**changed))


def _drives(machine: Machine, i: int, **values: float) -> Machine:
    changed = {k: _put(getattr(machine.drives, k), i, v) for k, v in values.items()}
    return machine._replace(drives=machine.drives._replace(**changed))


def _piston_force(machine: Machine, i: int) -> float:
    return machine.drives.relief * machine.drives.area_head[i]


def _swelling_hose(machine, facts, place, rng):
    i, d = _at(facts, place), machine.drives
    oil = (d.dead_volume[i] + 0.5 * d.area_head[i] * d.stroke[i]) / d.bulk_modulus
    p = {"soft": oil * log_uniform(rng, 0.3, 2.0), "pressure": log_uniform(rng, 3e6, 15e6),
         "stiff": oil * log_uniform(rng, 0.1, 0.4)}  # fmt: skip
    machine = _drives(machine, i, hose=d.hose[i] + p["stiff"])
    return _forms(machine, i, hose_soft=p["soft"], hose_pressure=p["pressure"]), p


def _transducers(machine, facts, place, rng):
    names, axis = channels(facts), place
    lag, p = machine.sensors.lag.copy(), {"time_constant": log_uniform(rng, 0.006, 0.05)}
    for side in ("head", "rod"):
        lag[names.index(f"pressure_{side}.{axis}")] = p["time_constant"]
    return machine._replace(sensors=machine.sensors._replace(lag=lag)), p


def _slow_angle(machine, facts, place, rng):
    names, lag = channels(facts), machine.sensors.lag.copy()
    p = {"time_constant": log_uniform(rng, 0.008, 0.05)}
    lag[names.index(f"{facts.position_kind(place)}.{place}")] = p["time_constant"]
    return machine._replace(sensors=machine.sensors._replace(lag=lag)), p


def _drifting_zero(machine, facts, place, rng):
    axis, _, side = place.partition(".")
    k = channels(facts).index(f"pressure_{side}.{axis}")
    offset, drift = machine.sensors.offset.copy(), machine.sensors.drift.copy()
    p = {"offset": either(rng, 1e5, 5e5)}
    p["drift"] = 0.3 * p["offset"] / 40.0 * float(rng.choice([-1.0, 1.0]))
    offset[k] += p["offset"]
    drift[k] = p["drift"]
    return machine._replace(sensors=machine.sensors._replace(offset=offset, drift=drift)), p


def _geared(machine, i, rng, gap: float, stiffness: float, **more: float) -> Machine:
    """Move 2 to 5 % of the swing's inertia to the motor's side of a tooth or a shaft."""
    m = machine.mechanism
    own = float(rng.uniform(0.02, 0.05)) * m.swing_inertia
    machine = machine._replace(mechanism=m._replace(swing_inertia=m.swing_inertia - own))
    return _forms(machine, i, drive_inertia=own, gap=gap, contact=stiffness, **more)


def _contact_backlash(machine, facts, place, rng):
    p = {"gap": log_uniform(rng, 0.003, 0.025), "contact": log_uniform(rng, 3e7, 1.5e8),
         "contact_damping": log_uniform(rng, 1.0, 10.0)}  # fmt: skip
    return _geared(machine, _at(facts, place), rng, p["gap"], p["contact"],
                   contact_damping=p["contact_damping"]), p  # fmt: skip


def _hardening_shaft(machine, facts, place, rng):
    p = {"stiffness": log_uniform(rng, 2.5e6, 2e7), "hardening": log_uniform(rng, 300.0, 3000.0)}
    return _geared(machine, _at(facts, place), rng, 0.0, p["stiffness"], hardening=p["hardening"],
                   shaft_damping=0.01 * p["stiffness"]), p  # fmt: skip


def _heavy(machine, facts, place, rng):
    p, m = {"ratio": log_uniform(rng, 3.0, 10.0)}, machine.mechanism
    if place == "swing":
        own = facts.links[facts.link_of(facts.axes["swing"].joint)].inertia[2]
        m = m._replace(swing_inertia=m.swing_inertia + (p["ratio"] - 1.0) * own)
    else:
        inertia = m.inertia.copy()
        inertia[0 if place == "boom" else 1] *= p["ratio"]
        m = m._replace(inertia=inertia)
    return machine._replace(mechanism=m), p


def _soft_deadband(machine, facts, place, rng):
    i, p = (
        _at(facts, place),
        {"deadband": rng.uniform(0.07, 0.17), "edge": rng.uniform(0.005, 0.03)},
    )
    return _forms(_drives(machine, i, deadband=p["deadband"]), i, soft_edge=p["edge"]), p


def _tustin(machine, facts, place, rng):
    i, d = _at(facts, place), machine.drives
    p = {
        "extra": d.coulomb[i] * log_uniform(rng, 1.0, 4.0),
        "velocity": log_uniform(rng, 0.01, 0.08),
    }
    machine = _drives(machine, i, stribeck=d.stribeck[i] + p["extra"], stribeck_velocity=p["velocity"])
    return _forms(machine, i, exponential=1.0), p


def _bristles(machine, facts, place, rng):
    i, d = _at(facts, place), machine.drives
    ends = (5e-5, 1e-3) if d.cylinder[i] else (2e-4, 2e-3)
    p = {"coulomb": d.coulomb[i] + _piston_force(machine, i) * log_uniform(rng, 0.01, 0.06),
         "presliding": log_uniform(rng, *ends)}  # fmt: skip
    return _forms(_drives(machine, i, coulomb=p["coulomb"]), i, presliding=p["presliding"]), p


def _turbulent_leak(machine, facts, place, rng):
    i = _at(facts, place)
    p = {"flow_at_10_MPa": machine.drives.leakage[i] * 1e7 * log_uniform(rng, 4.0, 25.0)}
    return _forms(machine, i, leak_orifice=p["flow_at_10_MPa"] / math.sqrt(1e7)), p


def _late_and_slow(machine, facts, place, rng):
    p = {"delay": log_uniform(rng, 0.01, 0.1), "time_constant": log_uniform(rng, 0.005, 0.04)}
    for i in range(len(facts.axes)) if place == "all" else [_at(facts, place)]:
        machine = _drives(machine, i, delay=machine.drives.delay[i] + p["delay"])
        machine = _forms(machine, i, command_lag=p["time_constant"])
    return machine, p


def _rubs_under_load(machine, facts, place, rng):
    p = {"share": log_uniform(rng, 0.02, 0.15)}
    return _forms(machine, _at(facts, place), load_friction=p["share"]), p


def _thick_oil(machine, facts, place, rng):
    i, d = _at(facts, place), machine.drives
    speed = d.flow_gain[i] * math.sqrt(7e6) / d.area_head[i]
    p = {"quadratic": _piston_force(machine, i) * log_uniform(rng, 0.03, 0.2) / speed**2}
    return _forms(machine, i, quadratic=p["quadratic"]), p


def _drooping_relief(machine, facts, place, rng):
    d = machine.drives
    setting, drop = d.relief * rng.uniform(0.85, 0.98), d.relief * rng.uniform(0.05, 0.2)
    forms = machine.forms._replace(relief_droop=drop / d.pump)
    return machine._replace(drives=d._replace(relief=setting), forms=forms), {
        "relief_pressure": setting, "override": drop}  # fmt: skip


def _worn_pump(machine, facts, place, rng):
    lost = rng.uniform(0.08, 0.35)
    leak = lost * machine.drives.pump / machine.drives.relief
    return machine._replace(forms=machine.forms._replace(pump_leak=leak)), {"lost_at_relief": lost}


def _air(machine, facts, place, rng):
    p = {"fraction": log_uniform(rng, 0.005, 0.05)}
    return machine._replace(forms=machine.forms._replace(air=p["fraction"])), p


def _notches(machine, facts, place, rng):
    p = {"gain_extend": math.exp(either(rng, 0.1, 0.35))}
    p["gain_retract"] = p["gain_extend"] * rng.uniform(0.85, 1.15)
    p["shape"] = rng.uniform(0.9, 1.2)
    return _forms(machine, _at(facts, place), **p), p


def _slewing_spool(machine, facts, place, rng):
    i, p = _at(facts, place), {"slew": log_uniform(rng, 1.0, 3.0), "ratio": rng.uniform(0.4, 0.8)}
    machine = _drives(machine, i, bandwidth=p["ratio"] * machine.drives.bandwidth[i])
    return _forms(machine, i, slew=p["slew"]), p


_DRY = ("coulomb_friction", "stribeck_friction", "presliding", "presliding_friction",
        "lugre_friction", "dahl_friction")  # fmt: skip
FORMS: dict[str, Form] = {
    form.name: form
    for form in (
        Form("swelling_hose", "a hose that swells more at low pressure than at high (braided hoses:"
             " static moduli well below the dynamic ones, Johnston et al. 2010)", "axis",
             ("hose_compliance",), _swelling_hose),
        Form("slow_transducers", "pressure transducers of an axis with a first-order lag", "axis",
             ("pressure_delay", "pressure_lag"), _transducers),
        Form("slow_resolver", "a position sensor with a first-order lag", "axis",
             ("angle_delay", "angle_lag"), _slow_angle),
        Form("drifting_zero", "a pressure transducer whose zero is off and creeps by a third of it",
             "port", ("pressure_offset",), _drifting_zero),
        Form("contact_backlash", "teeth with play whose contact is damped as Hunt and Crossley 1975"
             " say", "motor", ("backlash",), _contact_backlash),
        Form("hardening_shaft", "a shaft that stiffens as it winds", "motor",
             ("joint_flexibility",), _hardening_shaft),
        Form("heavy_inertia", "a link's moment of inertia 3 to 10 times the model's", "link",
             ("inertia_error",), _heavy, ("com_offset",)),
        Form("soft_deadband", "a larger overlap whose edges let a little pass", "axis",
             ("valve_deadband", "valve_deadband_direction", "flow_curve"), _soft_deadband),
        Form("tustin_stribeck", "more friction at rest that falls with exp(-|v|/v_s)", "axis", _DRY,
             _tustin),
        Form("bristle_friction", "more dry friction with presliding (LuGre, Canudas de Wit et al."
             " 1995)", "axis", _DRY, _bristles),
        Form("turbulent_leakage", "leakage through a gap as through an orifice", "axis",
             ("internal_leakage", "orifice_leakage"), _turbulent_leak),
        Form("late_slow_command", "commands that come late and through a first-order lag",
             "axis or all", ("command_delay", "spool_lag"), _late_and_slow),
        Form("load_friction", "friction that is a share of the load", "axis",
             ("load_dependent_friction", "coulomb_friction"), _rubs_under_load),
        Form("quadratic_friction", "friction with the square of the speed", "axis",
             ("viscous_friction", "speed_dependent_force"), _thick_oil),
        Form("drooping_relief", "a lower main relief valve whose pressure rises with its flow",
             "supply", ("relief_pressure",), _drooping_relief),
        Form("worn_pump", "a pump that loses flow with pressure", "supply",
             ("pump_flow_limit", "pump_droop"), _worn_pump),
        Form("aerated_oil", "oil with air in it, soft at low pressure", "all",
             ("bulk_modulus", "entrained_air"), _air),
        Form("worn_notches", "another flow gain, not quite the same both ways, slightly bent",
             "axis", ("valve_gain", "valve_gain_direction", "flow_curve", "metering_edges"),
             _notches),
        Form("slewing_spool", "a slower spool whose speed is limited, too", "axis",
             ("spool_lag", "spool_slew"), _slewing_spool),
    )
}  # fmt: skip
"""Forms by name."""
