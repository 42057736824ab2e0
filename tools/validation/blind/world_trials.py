"""Make the trials on the independent machine: hidden effects, logs and sealed keys.

    python -m tools.validation.blind.world_trials FOLDER_OF_THE_SERIES TRIAL

Writes `trials/TRIAL/data` (four logs and nothing else), `keys/TRIAL.json` and, over the key's
bytes, `trials/TRIAL/seal.txt`. The same series makes the same logs.
"""

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.effects.effect import with_value
from hydrotele.effects.mass import PAYLOAD
from hydrotele.estimate.hypothesis import numbers as uncertain_numbers
from hydrotele.machine.machine import Machine as Facts
from hydrotele.machine.machine_file import load_machine
from tools.validation.blind.forms import FORMS
from tools.validation.blind.generate import key_hash, write_logs
from tools.validation.blind.spreads import draw_library_effect, log_uniform, off_everywhere
from tools.validation.blind.trials import Place, write_json
from tools.validation.blind.wide import draw_unknown
from tools.validation.blind.world import Machine
from tools.validation.blind.world_runs import (
    Noise,
    WorldRun,
    nominal_world,
    record_run,
    references,
    travelled,
    visibility,
)

KINDS = ("near", "noise", "off", "outside", "clean", "library", "coloured", "drift")
_ATTEMPTS = 20
_SENSOR_KINDS = ("angle", "position", "length", "pressure")
_PLANTED_SHARE = 0.5  # of the trials with wrong noise or wrong numbers that hide an effect, too
_DOUBLE_SHARE = 0.3  # of the library's trials
_DRIFT_STD = 0.3  # of the logarithm of the oil's viscosity between days: some 10 K of oil temperature
_APART = 3.0  # standard deviations of an uncertain number beyond which it is an effect
_SEEN = 10.0  # least visibility of a planted effect; a weaker draw is replaced


@dataclasses.dataclass(frozen=True)
class WorldSeries:
    """What is tried, from which everything follows.

    Attributes:
        seed: of all random choices.
        counts: kind -> number of trials.
        machine: name of the machine.
        seconds: length of each run.
    """

    seed: int
    counts: dict[str, int]
    machine: str = "cat215"
    seconds: float = 40.0

    def kinds(self) -> list[str]:
        """Kind of every trial, shuffled, so that a number tells nothing."""
        listed = [kind for kind in KINDS for _ in range(self.counts.get(kind, 0))]
        order = np.random.default_rng([self.seed, 0]).permutation(len(listed))
        return [listed[k] for k in order]

    def names(self) -> list[str]:
        """Names of the trials."""
        return [f"{number:04d}" for number in range(sum(self.counts.values()))]


@dataclasses.dataclass(frozen=True)
class Drawn:
    """The true machine of a trial.

    Attributes:
        world: with all that was planted.
        facts: the same as facts, as far as facts can say it.
        planted: name, location, parameters and `right` (pairs that count as right), each.
        without: for each planted part, the machine without it.
        noise: of its sensors.
        numbers: path -> (the model's, the true one).
    """

    world: Machine
    facts: Facts
    planted: list[dict[str, Any]]
    without: list[Machine]
    noise: Noise
    numbers: dict[str, tuple[float, float]]

    def on_another_day(self, rng: np.random.Generator) -> tuple[Machine, float]:
        """Return the machine with oil of another viscosity, and the ratio of the viscosities.

        Viscous friction of all drives is proportional to it, leakage past all pistons inversely.
        """
        ratio, facts = float(np.exp(_DRIFT_STD * rng.standard_normal())), self.facts
        for name, axis in facts.axes.items():
            kind = "cylinder" if axis.cylinder else "motor"
            path, drive = f"axes.{name}.{kind}", axis.hydraulic_drive
            facts = with_value(facts, f"{path}.friction.viscous", ratio * drive.friction.viscous)
            facts = with_value(facts, f"{path}.leakage", drive.leakage / ratio)
        return nominal_world(facts), ratio


def draw_trial(model: Facts, kind: str, turn: int, rng: np.random.Generator) -> Drawn:
    """Draw the true machine of a trial.

    Args:
        model: the nominal machine.
        kind: one of `KINDS`.
        turn: how many trials of its kind come before it; forms take turns, and so does whether an
            effect is planted besides wrong noise or wrong numbers.
        rng: source of all else.

    Returns:
        What was drawn, but for an unknown term, which needs a run first.
    """
    noise, facts, numbers = Noise({}), model, {}
    if kind == "noise":
        factors = {name: log_uniform(rng, 0.7, 2.0) for name in _SENSOR_KINDS}
        noise = Noise(factors, gaussian=bool(rng.random() < 0.5))
    if kind == "coloured":
        noise = Noise({}, True, rng.uniform(0.5, 1.0), log_uniform(rng, 0.05, 0.5),
                      float(rng.uniform(5.0, 20.0)) if rng.random() < 0.5 else 0.0)  # fmt: skip
    if kind == "off":
        facts, numbers = off_everywhere(model, rng)
    if kind == "near":
        return _draw_form(model, turn, rng, noise)
    planted: list[dict[str, Any]] = []
    count = {"library": 2 if turn % 10 < 10 * _DOUBLE_SHARE else 1}.get(kind, 0)
    if kind in ("noise", "off", "coloured", "drift") and turn % 2 < 2 * _PLANTED_SHARE:
        count = 1
    bare, alone = facts, []
    for _ in range(count):
        name, place, values = draw_library_effect(facts, rng, tuple(p["name"] for p in planted))
        facts = apply_effect(facts, name, place, values)
        planted.append(
            {
                "name": name, "location": place, "parameters": values,
                "right": [[one, place] for one in _same_effects(model, name, place)],
            }
        )  # fmt: skip
    for part in planted:
        rest = bare
        for other in planted:
            if other is not part:
                rest = apply_effect(rest, other["name"], other["location"], other["parameters"])
        alone.append(nominal_world(rest))
    return Drawn(nominal_world(facts), facts, planted, alone, noise, numbers)


def _draw_form(model: Facts, turn: int, rng: np.random.Generator, noise: Noise) -> Drawn:
    names = list(FORMS)
    usable = [name for name in names if FORMS[name].places(model)]
    first = usable[turn % len(usable)]
    chosen = [first]
    if first == "swelling_hose" and turn % 2:  # both at once, as one line with its transducers
        chosen.append("slow_transducers")
    place = str(rng.choice(FORMS[first].places(model)))
    steps, planted = [nominal_world(model)], []
    for name in chosen:
        world, values = FORMS[name].change(steps[-1], model, place, rng)
        steps.append(world)
        planted.append({
            "name": name, "location": place, "parameters": {k: float(v) for k, v in values.items()},
            "right": [list(pair) for pair in FORMS[name].right(place)],
        })  # fmt: skip
    without = [steps[0]]
    if len(chosen) == 2:  # the transducers alone, then the hose alone
        without = [steps[0]._replace(sensors=steps[2].sensors), steps[1]]
    return Drawn(steps[-1], model, planted, without, noise, {})


def make_trial(place: Place, series: WorldSeries) -> None:
    """Draw, run, and write logs, key and seal of a trial.

    Raises:
        InputError: nothing drawn for it could be run, or be seen.
    """
    model = load_machine(series.machine)
    number, kinds = series.names().index(place.trial), series.kinds()
    kind = kinds[number]
    turn, redrawn = kinds[:number].count(kind), []
    if kind == "near":  # few trials of a series, but over many series all forms
        order = np.random.default_rng([series.seed, 2]).permutation(len(FORMS))
        turn = int(order[turn % len(order)]) + len(order) * (turn // len(order))
    while True:
        rng = np.random.default_rng([series.seed, 1, number, len(redrawn)])
        try:
            drawn, runs, seen = _attempt(model, kind, turn, rng, series.seconds)
            break
        except InputError as error:
            redrawn.append(str(error))
            if len(redrawn) == _ATTEMPTS:
                raise InputError(f"trial {place.trial}", "; ".join(redrawn)) from None
    planted = [{**p, "visibility": v} for p, v in zip(drawn.planted, seen, strict=True)]
    write_json(place.key, {
        "trial": place.trial, "kind": kind, "planted": planted, "numbers": drawn.numbers,
        "truth": true_parameters(model, drawn.facts) if kind not in ("near", "outside", "drift") else {},
        "noise": dataclasses.asdict(drawn.noise), "redrawn": redrawn,
        "nonce": rng.bytes(16).hex(),
    })  # fmt: skip
    place.key.chmod(0o600)
    place.folder.mkdir(parents=True, exist_ok=True)
    place.seal.write_text(key_hash(place) + "\n")
    write_logs(place, {run.name: run.log for run in runs})


def _attempt(
    model: Facts, kind: str, turn: int, rng: np.random.Generator, seconds: float
) -> tuple[Drawn, list[WorldRun], list[float]]:
    drawn = draw_trial(model, kind, turn, rng)
    if kind == "off":
        refuse_uncertain(model, drawn)
    asked = references(model, rng, seconds)
    if kind == "outside":
        plain = drawn.world
        first = record_run(plain, model, asked[1], drawn.noise, rng)
        world, told = draw_unknown(plain, model, travelled(plain, first), rng)
        told["right"] = []
        drawn = dataclasses.replace(drawn, world=world, planted=[told], without=[plain])
    runs = [record_run(drawn.world, model, one, drawn.noise, rng) for one in asked]
    shown = runs
    if kind == "drift":
        days = [drawn.on_another_day(rng) for _ in asked]
        shown = [record_run(w, model, one, drawn.noise, rng) for (w, _), one in zip(days, asked, strict=True)]
        ratios = {f"viscosity in {run.name}": (1.0, ratio) for run, (_, ratio) in zip(shown, days, strict=True)}
        drawn = dataclasses.replace(drawn, numbers=ratios)
    seen = [visibility(without, model, runs) for without in drawn.without]
    if any(size < _SEEN for size in seen):
        names = ", ".join(p["name"] for p in drawn.planted)
        raise InputError("trial", f"{names} shows no more than {min(seen):.3g}")
    return drawn, shown, [float(f"{size:.4g}") for size in seen]


def refuse_uncertain(model: Facts, drawn: Drawn) -> None:
    """Refuse planted effects that are no more than what the model says its numbers may be off by.

    Args:
        model: the nominal machine.
        drawn: the true one.

    Raises:
        InputError: all numbers of one are uncertain, and within `_APART` of their deviations.
    """
    uncertain = {n.effect: n.parameter for n in uncertain_numbers(model).values() if n.effect}
    truth = true_parameters(model, drawn.facts)
    for part in drawn.planted:
        name, place = part["name"], part["location"]
        values = truth.get(f"{name}({place})", {})
        known = [uncertain.get((name, place, key)) for key in part["parameters"]]
        if all(p and key in values and abs(values[key] - p.nominal) < _APART * p.prior_std
               for key, p in zip(part["parameters"], known, strict=True)):  # fmt: skip
            raise InputError("trial", f"{name} of {place} is within what its numbers may be off by")


def _same_effects(model: Facts, name: str, place: str) -> tuple[str, ...]:
    """Names under which an effect changes the same: about a vertical axis a mass has no weight.

    Where the mass of a link that turns about such an axis, fixed in the ground, sits shows in its
    moment of inertia alone.
    """
    pair = ("com_offset", "inertia_error")
    if name not in pair or place not in model.axes:
        return (name,)
    joint = model.joints[model.axes[place].joint]
    link = model.links[model.link_of(model.axes[place].joint)]
    upright = joint.type == "hinge" and not np.cross(joint.axis, model.gravity).any()
    same = upright and link.parent == "world"
    return (name, *(p for p in pair if same and p != name))


def true_parameters(model: Facts, truth: Facts) -> dict[str, dict[str, float]]:
    """What every effect of the library would have to say of a true machine.

    Args:
        model: the nominal machine.
        truth: the true one.

    Returns:
        `name(location)` -> parameter -> its true value relative to the model, for the effects
        whose parameters both machines tell.
    """
    table: dict[str, dict[str, float]] = {}
    for name, effect in EFFECTS.items():
        for place in effect.locations(model):
            if place not in effect.locations(truth):
                continue
            known = {
                key: p for key, p in effect.parameters(truth, place).items()
                if (name, key) not in _OTHER_FORM
            }  # fmt: skip
            values = {key: _relative(name, key, place, model, truth) for key in known}
            table[f"{name}({place})"] = {
                key: known[key].nominal if value is None else value
                for key, value in values.items()
                if value is not None or name in _ABSOLUTE
            }
    return {label: values for label, values in table.items() if values}


_OTHER_FORM = {("backlash", "damping_ratio")}  # of the independent machine: Hunt and Crossley's
_ABSOLUTE = (  # effects whose parameters are the machine's own numbers
    "valve_deadband", "spool_lag", "pump_flow_limit", "relief_pressure", "internal_leakage",
    "hose_compliance", "bulk_modulus", "coulomb_friction", "viscous_friction", "stribeck_friction",
    "friction_asymmetry", "command_delay", "angle_offset", "angle_scale", "angle_delay",
    "length_offset", "pressure_offset", "pressure_delay", "backlash", "joint_flexibility",
)  # fmt: skip


def _relative(name: str, key: str, place: str, model: Facts, truth: Facts) -> float | None:
    """True value of a parameter that counts from the model; None for others."""
    axis, there = model.axes.get(place), truth.axes.get(place)
    link = model.link_of(axis.joint) if axis else ""
    match name:
        case "valve_gain":
            flows = [a.valve.rated_flow for a in (axis, there) if a and a.valve]
            return flows[1] / flows[0]
        case "inertia_error":
            k = 2 if place == "swing" else 1
            return truth.links[link].inertia[k] / model.links[link].inertia[k]
        case "com_offset":
            k = "xyz".index(key)
            return truth.links[link].com[k] - model.links[link].com[k]
        case "payload":
            return truth.links[PAYLOAD].mass if PAYLOAD in truth.links else 0.0
        case "pin_offset":
            k = "xyz".index(key)
            pins = [a.cylinder.base_pin.position[k] for a in (axis, there) if a and a.cylinder]
            return pins[1] - pins[0]
        case "link_length" if place == "boom":
            return truth.links["stick"].position[0] - model.links["stick"].position[0]
        case "base_tilt":
            g = np.array(truth.gravity) / np.linalg.norm(truth.gravity)
            return float({"pitch": np.arcsin(g[0]), "roll": np.arctan2(-g[1], -g[2])}[key])
    return None


def load_world_series(out: Path) -> WorldSeries:
    """The series that a folder holds.

    Raises:
        InputError: it holds none.
    """
    path = out / "settings.json"
    if not path.is_file():
        raise InputError(out, "holds no series of trials: give --kinds and --count to start one")
    return WorldSeries(**json.loads(path.read_text()))


def begin_world_series(out: Path, series: WorldSeries) -> None:
    """Start a series in a folder, or go on with the same one.

    Raises:
        InputError: the folder holds another series.
    """
    if (out / "settings.json").is_file() and (there := load_world_series(out)) != series:
        raise InputError(out, f"holds another series ({there}); choose another --out")
    write_json(out / "settings.json", dataclasses.asdict(series))


def main() -> None:
    """Parse the arguments and make the trial."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("trial")
    args = parser.parse_args()
    make_trial(Place(args.out, args.trial), load_world_series(args.out))


if __name__ == "__main__":
    main()
