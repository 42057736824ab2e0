"""Simulate the hexapod for blind trials: MuJoCo, a controller, sensors and hidden effects.

    python -m tools.validation.blind.hexapod FOLDER_OF_THE_SERIES TRIAL...

Nothing of the search is imported here, and no regressor: the model's MJCF is changed, simulated and
measured. Effects that an MJCF cannot state act as forces on the struts at every step.
"""

import argparse
import copy
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pyarrow
import pyarrow.parquet

from hydrotele.core.files import models_folder
from tools.validation.blind.generate import key_hash
from tools.validation.blind.trials import Place, Series, load_series, write_json

RATE = 1000.0  # Hz, of controller and log
LEGS = range(6)
BASE, TIP = (0.45, 1.36), (0.085, 0.12)  # m: radius and height of the cardan centres and of the
# platform's joints, see the model's README
MIDDLE, HALF = (0.0, 0.0, 0.56, 0.0, 0.0, 0.0), (0.16, 0.16, 0.11, 0.26, 0.26, 0.18)  # of a pose
SPEED, ACCELERATION = 0.9, 18.0  # m/s and m/s^2 of a strut, at most
MASS, BANDWIDTH, DAMPING, INTEGRAL = 4.0, 12.0, 0.8, 3.0  # kg, Hz, 1, 1/s, of the controllers
_HARMONICS, _FADE = 4, 1.0  # of a motion; s in which it starts
_WAVES = 5

State = tuple[np.ndarray, np.ndarray, np.ndarray, float]
Added = Callable[..., np.ndarray]


class Planted(NamedTuple):
    """What is hidden: name and place as a report has them, and numbers."""

    name: str
    location: str
    parameters: dict[str, float]


class Stribeck(NamedTuple):
    """Dry friction of the struts (6,) [N] that fades with the speed, on the scale of a velocity."""

    size: np.ndarray
    velocity: float


class Sensors(NamedTuple):
    """Noise and defects of the six lengths and the six forces."""

    length_noise: float
    force_noise: np.ndarray
    correlation: float
    length_offset: np.ndarray
    length_delay: np.ndarray
    force_offset: np.ndarray
    force_scale: np.ndarray
    force_delay: np.ndarray


def draw_single(rng: np.random.Generator) -> Planted:
    """One effect, its place and its size, from ranges of what happens to such machines."""
    leg = int(rng.integers(1, 7))
    slide = f"slide_{leg}"

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    def either() -> float:
        return float(rng.choice([-1.0, 1.0]))

    kinds: dict[str, Callable[[], tuple[str, dict[str, float]]]] = {
        "coulomb_friction": lambda: (slide, {"added": between(6.0, 40.0)}),
        "viscous_friction": lambda: (slide, {"added": between(10.0, 60.0)}),
        "stribeck_friction": lambda: (slide, {"stribeck": between(10.0, 40.0),
                                              "velocity": between(0.01, 0.06)}),
        "friction_asymmetry": lambda: (slide, {"viscous_asymmetry": either() * between(12, 50)}),
        "speed_dependent_force": lambda: (slide, {"quadratic": between(30.0, 120.0)}),
        "hinge": lambda: (str(rng.choice([f"alpha_{leg}", f"beta_{leg}"])),
                          {"added": between(1.5, 6.0)}),
        "payload": lambda: ("platform", {
            "mass": between(0.8, 3.0), "x": float(rng.uniform(-0.08, 0.08)),
            "y": float(rng.uniform(-0.08, 0.08)), "z": float(rng.uniform(-0.05, 0.15))}),
        "com_offset": lambda: ("platform", dict(zip("xyz", (
            between(0.025, 0.07) * _direction(rng)).tolist(), strict=True))),
        "inertia_error": lambda: ("platform", {"ratio": between(1.4, 3.0)}),
        "force_offset": lambda: (slide, {"offset": either() * between(8.0, 60.0)}),
        "force_scale": lambda: (slide, {"scale": 1.0 + either() * between(0.05, 0.2)}),
        "force_delay": lambda: (slide, {"delay": between(0.003, 0.02)}),
        "length_offset": lambda: (slide, {"offset": either() * between(0.001, 0.008)}),
        "length_delay": lambda: (slide, {"delay": between(0.003, 0.02)}),
        "clock_offset": lambda: ("force", {"delay": between(0.003, 0.02)}),
        "base_tilt": lambda: ("base", {"x": either() * between(0.01, 0.06),
                                       "y": either() * between(0.01, 0.06)}),
        "joint_spring": lambda: (slide, {"stiffness": between(100.0, 600.0),
                                         "rest": float(rng.uniform(0.65, 0.95))}),
        "drive_inertia": lambda: (slide, {"inertia": between(0.6, 4.0)}),
    }  # fmt: skip
    kind = str(rng.choice(sorted(kinds)))
    place, numbers = kinds[kind]()
    return Planted("coulomb_friction" if kind == "hinge" else kind, place, numbers)


def _direction(rng: np.random.Generator) -> np.ndarray:
    way = rng.normal(size=3)
    return way / np.linalg.norm(way)


def draw_outside(turn: int, rng: np.random.Generator) -> tuple[Planted, Added]:
    """A law that no library knows, on one strut, and the force that it makes."""
    leg = int(rng.integers(6))
    size = float(rng.uniform(25.0, 60.0))
    name = ("cogging", "hysteresis", "coupling", "random_law", "gated", "pulse")[turn % 6]
    number = rng.uniform(0.0, 1.0, 20)
    weight = rng.normal(size=(_WAVES, 3))
    memory = {"z": 0.0}
    out = np.zeros(6)

    def force(length: np.ndarray, rate: np.ndarray, drive: np.ndarray, time: float) -> np.ndarray:
        q, v, other = length[leg], rate[leg], (leg + 1 + int(5 * number[1])) % 6
        if name == "cogging":
            value = np.sin(2.0 * np.pi * q / (0.02 + 0.03 * number[2]) + 6.0 * number[3])
        elif name == "hysteresis":  # play operator on the length
            wide = 0.02 + 0.03 * number[2]
            memory["z"] = min(max(memory["z"], q - wide), q + wide)
            value = np.tanh((memory["z"] - 0.79) / 0.08) - 2.0 * (memory["z"] - q) / wide / 2.0
        elif name == "coupling":
            value = np.tanh(rate[other] / 0.2) * np.sin(12.0 * (length[other] - 0.79))
        elif name == "random_law":
            at = np.array([(q - 0.79) / 0.06, v / 0.25, (length[other] - 0.79) / 0.06])
            value = np.sin(weight @ at + 6.0 * number[5 : 5 + _WAVES]).sum() * np.sqrt(2.0 / _WAVES)
        elif name == "gated":
            value = np.sin((q - 0.79) / 0.03) if q > 0.79 + 0.03 * (number[2] - 0.5) else 0.0
        else:  # for a while only
            start = 2.0 + 6.0 * number[2]
            value = float(start < time < start + 1.0 + 2.0 * number[3])
        out[:] = 0.0
        out[leg] = size * value
        return out

    place = f"slide_{leg + 1}"
    return Planted(name, place, {"size": size, **{f"n{k}": float(x) for k, x in
                                                  enumerate(number)}}), force  # fmt: skip


def draw_sensors(rng: np.random.Generator) -> Sensors:
    """Noise of a level that is not told, and no defects."""
    none = np.zeros(6)
    level = float(np.exp(rng.uniform(np.log(3.0), np.log(25.0))))
    return Sensors(
        float(np.exp(rng.uniform(np.log(5e-6), np.log(2.5e-5)))),
        level * np.exp(0.25 * rng.normal(size=6)), float(rng.uniform(0.0, 0.7)),
        none.copy(), none.copy(), none.copy(), np.ones(6), none.copy(),
    )  # fmt: skip


def plant(
    spec: mujoco.MjSpec, sensors: Sensors, one: Planted
) -> tuple[Sensors, Added | Stribeck | None]:  # fmt: skip
    """Put an effect into the MJCF, the sensors, or the forces of every step."""
    numbers = one.parameters
    legs = np.array([one.location == f"slide_{k + 1}" for k in LEGS], float)
    match one.name:
        case "coulomb_friction":
            spec.joint(one.location).frictionloss += numbers["added"]
        case "viscous_friction":
            spec.joint(one.location).damping[0] += numbers["added"]
        case "drive_inertia":
            spec.joint(one.location).armature += numbers["inertia"]
        case "joint_spring":
            spec.joint(one.location).stiffness[0] = numbers["stiffness"]
            spec.joint(one.location).springref = numbers["rest"]
        case "payload":
            body = spec.body(one.location).add_body(name="load", pos=[numbers["x"], numbers["y"], numbers["z"]])
            body.mass, body.inertia, body.ipos = numbers["mass"], [1e-6] * 3, [0.0] * 3
            body.explicitinertial = True
        case "com_offset":
            spec.body(one.location).ipos += [numbers[k] for k in "xyz"]
        case "inertia_error":
            body = spec.body(one.location)
            if np.isfinite(body.fullinertia[0]):
                body.fullinertia *= numbers["ratio"]
            else:
                body.inertia *= numbers["ratio"]
        case "base_tilt":
            turn = np.array([numbers["x"], numbers["y"], 0.0])
            quaternion, down = np.empty(4), np.empty(3)
            mujoco.mju_axisAngle2Quat(quaternion, turn / np.linalg.norm(turn),
                                      -float(np.linalg.norm(turn)))  # fmt: skip
            mujoco.mju_rotVecQuat(down, spec.option.gravity, quaternion)
            spec.option.gravity = down
        case "force_offset":
            return sensors._replace(force_offset=legs * numbers["offset"]), None
        case "force_scale":
            return sensors._replace(force_scale=1.0 + legs * (numbers["scale"] - 1.0)), None
        case "force_delay":
            return sensors._replace(force_delay=legs * numbers["delay"]), None
        case "length_offset":
            return sensors._replace(length_offset=legs * numbers["offset"]), None
        case "length_delay":
            return sensors._replace(length_delay=legs * numbers["delay"]), None
        case "clock_offset":
            return sensors._replace(force_delay=np.full(6, numbers["delay"])), None
        case "stribeck_friction":
            return (
                sensors,
                lambda q, v, f, t: (
                    -legs * numbers["stribeck"] * np.exp(-((v / numbers["velocity"]) ** 2)) * np.tanh(v / 0.001)
                ),
            )
        case "friction_asymmetry":
            return sensors, lambda q, v, f, t: -legs * numbers["viscous_asymmetry"] * abs(v)
        case "speed_dependent_force":
            return sensors, lambda q, v, f, t: -legs * numbers["quadratic"] * v * abs(v)
        case _:
            raise ValueError(one.name)
    return sensors, None


def disturb(spec: mujoco.MjSpec, share: float, rng: np.random.Generator) -> None:
    """Masses, centres of mass, inertias and friction off by a few per cent everywhere."""

    def times(values):
        return np.asarray(values) * (1.0 + share * rng.normal(size=np.shape(values)))

    for body in spec.bodies[1:]:
        factor = float(times(1.0))
        body.mass *= factor
        body.ipos = times(body.ipos)
        if np.isfinite(body.fullinertia[0]):
            body.fullinertia = factor * body.fullinertia * float(times(1.0))
        else:
            body.inertia = factor * body.inertia * float(times(1.0))
    for joint in spec.joints:
        joint.frictionloss = float(times(joint.frictionloss))
        joint.damping = times(joint.damping)


def hexapod() -> mujoco.MjSpec:
    """The model as it is given."""
    return mujoco.MjSpec.from_file(str(models_folder() / "palida" / "palida.xml"))


def lengths(pose: np.ndarray) -> np.ndarray:
    """Strut lengths (n, 6) of poses (n, 6), by plain geometry."""
    corner = np.deg2rad([10.0, 110.0, 130.0, 230.0, 250.0, 350.0])
    joint = np.deg2rad([50.0, 70.0, 170.0, 190.0, 290.0, 310.0])
    centre = np.column_stack([BASE[0] * np.cos(corner), BASE[0] * np.sin(corner),
                              np.full(6, BASE[1])])  # fmt: skip
    tip = np.column_stack([TIP[0] * np.cos(joint), TIP[0] * np.sin(joint), np.full(6, TIP[1])])
    turn = np.array([_rotation(angles) for angles in pose[:, 3:]])
    ends = pose[:, None, :3] + np.einsum("nij,kj->nki", turn, tip)
    return np.linalg.norm(ends - centre, axis=2)


def _rotation(angles: np.ndarray) -> np.ndarray:
    quaternion, matrix = np.empty(4), np.empty(9)
    mujoco.mju_euler2Quat(quaternion, angles, "xyz")
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def motion(seconds: float, rng: np.random.Generator) -> np.ndarray:
    """Poses (n, 6) of a random smooth motion from rest, within the struts' speeds."""
    time = np.arange(round(seconds * RATE)) / RATE
    period = rng.uniform(3.0, 6.0)
    wave = np.zeros((len(time), 6))
    for k in range(1, _HARMONICS + 1):
        angle = 2.0 * np.pi * k * time / period
        wave += np.cos(angle[:, None] + rng.uniform(0, 2 * np.pi, 6)) * rng.normal(size=6) / k
    wave *= rng.uniform(0.6, 1.0, 6) / np.abs(wave).max(axis=0)
    fade = np.clip(time / _FADE, 0.0, 1.0)
    fade = fade**3 * (10.0 - 15.0 * fade + 6.0 * fade**2)
    while True:
        pose = np.array(MIDDLE) + fade[:, None] * wave * HALF
        length = lengths(pose)
        rate = np.gradient(length, 1.0 / RATE, axis=0)
        fast = np.abs(rate).max() / SPEED
        hard = np.abs(np.gradient(rate, 1.0 / RATE, axis=0)).max() / ACCELERATION
        if max(fast, hard) <= 1.0 and 0.58 < length.min() and length.max() < 1.08:
            return pose
        wave *= 0.93


def simulate(
    model: mujoco.MjModel, pose: np.ndarray, sensors: Sensors, added: Added | Stribeck | None,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Drive a motion by a linear controller per strut; time (n,), lengths and forces (n, 6)."""
    data = mujoco.MjData(model)
    reference = lengths(pose)
    rate = np.gradient(reference, 1.0 / RATE, axis=0)
    stiff = MASS * (2.0 * np.pi * BANDWIDTH) ** 2
    damp = 2.0 * DAMPING * MASS * 2.0 * np.pi * BANDWIDTH
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    slides = [model.joint(f"slide_{k + 1}").qposadr[0] for k in LEGS]
    dofs = [model.joint(f"slide_{k + 1}").dofadr[0] for k in LEGS]
    dry = model.dof_frictionloss[dofs].copy()
    steps = round(1.0 / RATE / model.opt.timestep)
    settle = round(1.5 * RATE)  # from the model's home to where the motion starts
    home = data.qpos[slides].copy()
    mix = np.linspace(0.0, 1.0, settle)
    mix = (mix**3 * (10 - 15 * mix + 6 * mix**2))[:, None]
    whole = np.concatenate([home + mix * (reference[0] - home), reference])
    rates = np.concatenate([np.zeros_like(mix) * rate[0], rate])
    n = len(whole)
    length, force = np.empty((n, 6)), np.empty((n, 6))
    held, speed, last, before = np.full(6, 15.0), np.zeros(6), None, None
    for row in range(n):
        true = data.qpos[slides].copy()
        reading = true + sensors.length_offset + sensors.length_noise * rng.standard_normal(6)
        if last is not None:
            speed += (1.0 - np.exp(-2.0 * np.pi * 60.0 / RATE)) * ((reading - last) * RATE - speed)
        last = reading
        away = whole[row] - reading
        held = held + stiff * INTEGRAL * away / RATE
        drive = stiff * away + damp * (rates[row] - speed) + held
        length[row] = reading
        force[row] = drive if before is None else 0.5 * (drive + before)
        before = drive
        data.ctrl[:] = drive
        for _ in range(steps):
            if isinstance(added, Stribeck):  # the solver's own dry friction, so that it can stick
                fades = np.exp(-((data.qvel[dofs] / added.velocity) ** 2))
                model.dof_frictionloss[dofs] = dry + added.size * fades
            elif added is not None:
                data.qfrc_applied[dofs] = added(data.qpos[slides], data.qvel[dofs], drive,
                                                (row - settle) / RATE)  # fmt: skip
            mujoco.mj_step(model, data)
    model.dof_frictionloss[dofs] = dry
    if any(w.number for w in data.warning) or not np.isfinite(length).all():
        raise ValueError("the simulation failed")
    mixed = sensors.correlation * np.ones((6, 6)) + (1.0 - sensors.correlation) * np.eye(6)
    noise = rng.standard_normal((n, 6)) @ np.linalg.cholesky(mixed).T * sensors.force_noise
    force = sensors.force_scale * _late(force, sensors.force_delay) + sensors.force_offset + noise
    length = _late(length, sensors.length_delay)
    rows = slice(settle, None)
    return np.arange(n - settle) / RATE, length[rows], force[rows]


def _late(values: np.ndarray, delay: np.ndarray) -> np.ndarray:
    rows = np.arange(len(values), dtype=float)
    return np.column_stack([
        np.interp(rows - late * RATE, rows, column)
        for column, late in zip(values.T, delay, strict=True)
    ])  # fmt: skip


def make(
    kind: str, turn: int, rng: np.random.Generator, seconds: float = 12.0
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """One trial: its key, and run -> table (n, 13) of time, lengths and forces.

    Visibility is what the effect changes in the measured forces of the fitted runs, in units of
    their noise: a robot without it follows the same motions, both with noiseless lengths.
    """
    spec, sensors, added, planted = hexapod(), draw_sensors(rng), None, None
    off = float(rng.choice([0.0, 0.005, 0.01, 0.02]))
    disturb(spec, off, rng)
    plain, good = spec.copy(), sensors
    if kind == "single":
        planted = draw_single(rng)
        sensors, added = plant(spec, sensors, planted)
    elif kind == "outside":
        planted, added = draw_outside(turn, rng)
    model, runs, changed = spec.compile(), {}, 0.0
    for name in ("run_1", "run_2", "run_3", "test"):
        pose, same = motion(seconds, rng), copy.deepcopy(rng)
        time, length, force = simulate(model, pose, sensors, added, rng)
        runs[name] = np.column_stack([time, length, force])
        if planted and name != "test":
            one, other = (
                simulate(spec.compile(), pose, s._replace(length_noise=0.0), a, copy.deepcopy(same))
                for spec, s, a in ((spec, sensors, added), (plain, good, None))
            )
            changed += float(np.sum(((one[2] - other[2]) / sensors.force_noise) ** 2))
    key = {
        "class": kind,
        "effects": [_told(planted, spec, changed**0.5)] if planted else [],
        "off": off,
        "noise": {"length": sensors.length_noise, "force": sensors.force_noise.tolist(),
                  "correlation": sensors.correlation},
    }  # fmt: skip
    return key, runs


def _told(planted: Planted, spec: mujoco.MjSpec, visible: float) -> dict[str, Any]:
    """An effect as the key has it, with the numbers that the robot has in all."""
    numbers = dict(planted.parameters)
    if "added" in numbers:
        joint = spec.joint(planted.location)
        del numbers["added"]
        if planted.name == "coulomb_friction":
            numbers["coulomb"] = joint.frictionloss
        else:
            numbers["viscous"] = float(np.ravel(joint.damping)[0])
    if planted.name == "drive_inertia":
        numbers = {"drive_inertia": numbers["inertia"]}
    numbers.pop("velocity", None)
    return {
        "name": planted.name, "location": planted.location,
        "parameters": {k: {"value": float(v)} for k, v in numbers.items()},
        "visibility": {"total_fit_runs": round(visible, 2)},
    }  # fmt: skip


def make_trial(place: Place, series: Series) -> None:
    """Write logs, key and seal of a trial.

    Args:
        place: where its files lie.
        series: the series that it is part of.
    """
    classes, number = series.classes(), series.names().index(place.trial)
    rng = np.random.default_rng([series.seed, 20, number])
    turn = series.seed + classes[:number].count("outside")
    key, runs = make(classes[number], turn, rng, series.duration)
    key |= {"trial": place.trial, "nonce": rng.bytes(16).hex()}
    write_json(place.key, key)
    place.key.chmod(0o600)
    place.folder.mkdir(parents=True, exist_ok=True)
    place.seal.write_text(key_hash(place) + "\n")
    part = place.folder / f".data.{os.getpid()}.part"
    part.mkdir()
    names = ["time", *(f"position.slide_{k + 1}" for k in LEGS),
             *(f"force.slide_{k + 1}" for k in LEGS)]  # fmt: skip
    for name, table in runs.items():
        columns = dict(zip(names, table.T.copy(), strict=True))
        pyarrow.parquet.write_table(pyarrow.table(columns), part / f"{name}.parquet")
    part.rename(place.data)


def main() -> None:
    """Parse the arguments and make the trials."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("trial", nargs="+")
    args = parser.parse_args()
    for trial in args.trial:
        make_trial(Place(args.out, trial), load_series(args.out))


if __name__ == "__main__":
    main()
