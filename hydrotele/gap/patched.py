"""The patched machine as a folder: `machine.yaml` with the effects in it, `effects.yaml`.

Of a mechanism without hydraulics, its MJCF and its mapping with what was found in them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from hydrotele.core.mjcf import read_mjcf
from hydrotele.gap.description import effect_title, learned_title, number_title
from hydrotele.gap.force_columns import ForceEffect
from hydrotele.gap.mechanism_columns import STRIBECK, tilted
from hydrotele.gap.result import (
    Estimate,
    Gap,
    effect_document,
    finite,
    gap_document,
    in_customary_units,
)
from hydrotele.identify.mechanism import ColumnMapping
from hydrotele.machine.machine_file import MACHINE_FILE, save_machine
from hydrotele.machine.sensors import SensorError
from hydrotele.multibody.chain import Chain, body_inertial_parameters
from hydrotele.multibody.regressor import BODY_PARAMETERS

EFFECTS_FILE = "effects.yaml"


def has_patch(gap: Gap) -> bool:
    """Whether anything was changed: effects named, numbers calibrated, laws learned."""
    return bool(gap.effects or gap.calibration or gap.learned)


def write_patch(gap: Gap, folder: Path) -> None:
    """Write the patched machine, which `load_machine(folder)` reads, and a list of its changes.

    `machine.yaml` is the complete machine; comments at its start name the effects. `effects.yaml`
    contains the effects, calibrated parameters and learned laws, with values, units, 95 % intervals
    and the values of the given model.

    Args:
        gap: result of the search.
        folder: an existing folder.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import hydrotele as ht
        >>> effect = "[{name: coulomb_friction, location: slide, parameters: {coulomb: 600}}]"
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for seed in "1", "2":
        ...         overrides = {"duration": "2", "log_rate": "100", "control_rate": "100", "seed": seed}
        ...         scenario = ht.load_scenario("rig_steps", {**overrides, "effects": effect})
        ...         run = ht.run_scenario(scenario)
        ...         ht.save_log(run.measured, Path(folder, f"run_{seed}.parquet"))
        ...     data = ht.load_dataset(folder, ht.load_machine("rig"))
        >>> gap = ht.find_gap(data, effects=["coulomb_friction"], jobs=1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ht.write_patch(gap, Path(folder))
        ...     files = sorted(path.name for path in Path(folder).iterdir())
        ...     patched = ht.load_machine(folder)
        >>> files
        ['effects.yaml', 'machine.yaml']
        >>> round(patched.axes["slide"].cylinder.friction.coulomb, -1)  # N; 150 in the given model
        590.0
    """
    file = folder / MACHINE_FILE
    save_machine(gap.patched, file)
    add_head(gap, file)
    write_effects(gap, folder)


def add_head(gap: Gap, file: Path) -> None:
    """Say in comments at the head of a YAML file what the effects are.

    Args:
        gap: what the search yields.
        file: of the patched model.
    """
    head = "".join(f"# {line}\n" for line in _head(gap))
    file.write_text(head + file.read_text(encoding="utf-8"), encoding="utf-8")


def write_effects(gap: Gap, folder: Path) -> None:
    """Write `effects.yaml`: effects, calibrated numbers and learned laws, with the given values.

    Args:
        gap: what the search yields.
        folder: an existing folder.
    """
    record = {
        "machine": gap.machine.name,
        "tool": gap.machine.tool,
        "verdict": gap.verdict,
        "effects": [],
    }
    for effect in gap.effects:
        document = effect_document(effect)
        for name, estimate in effect.parameters.items():
            document["parameters"][name]["nominal"] = estimate.nominal
        record["effects"].append(document)
    document = gap_document(gap)
    record |= {key: document[key] for key in ("calibration", "learned", "jitter")}
    text = yaml.safe_dump(finite(record), sort_keys=False, default_flow_style=None)
    (folder / EFFECTS_FILE).write_text(text, encoding="utf-8")


def _head(gap: Gap) -> list[str]:
    lines = [f"{gap.machine.name} with the result of `hydrotele gap` (verdict: {gap.verdict}):"]
    for effect in gap.effects:
        lines.append(f"- {effect_title(effect)}, probability {effect.probability:.3f}")
        for name, estimate in effect.parameters.items():
            lines.append(f"    {name}: {_found(estimate, name)}")
    for key, estimate in gap.calibration.items():
        lines.append(f"- calibrated {number_title(key)}: {_found(estimate, key)}")
    for law in gap.learned:
        lines.append(f"- learned {learned_title(law)} (see terms): {law.formula} [{law.unit}]")
    found, stated = gap.jitter
    if found != stated:
        lines.append(f"- jitter of the sensors: {1e3 * found:.3g} ms, was {1e3 * stated:.3g} ms")
    return [*lines, f"{EFFECTS_FILE} contains values, units and intervals for programs."]


def _found(estimate: Estimate, name: str) -> str:
    s = in_customary_units(estimate, name)
    return f"{s.value} {s.unit} (95 %: {s.low} .. {s.high}), was {s.nominal}"


MJCF_FILE, COLUMNS_FILE = "robot.xml", "columns.yaml"
_THIN = 1e-4  # of its second moments, that a body has at least along every axis
_SENSORS = {"offset": "offset", "scale": "scale", "delay": "delay"}
_FRICTION = {
    "coulomb_friction": "frictionloss", "viscous_friction": "damping",
    "drive_inertia": "armature",
}  # fmt: skip
_BODIES = ("payload", "com_offset", "inertia_error")
_STATED = {
    "stribeck_friction": "stribeck", "friction_asymmetry": "viscous_asymmetry",
    "speed_dependent_force": "quadratic",
}  # fmt: skip


@dataclass(frozen=True)
class Patch:
    """What is changed in a model.

    Attributes:
        parameters: regressor's parameter, such as `mass.link` -> its new value.
        friction: joint -> friction that an MJCF cannot state.
        errors: `position.JOINT` or `force.DRIVE` -> defect of a sensor.
        tilt: (3,) small rotation of the base [rad].
        springs: joint -> (stiffness, rest).
    """

    parameters: Mapping[str, float] = field(default_factory=dict)
    friction: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    errors: Mapping[str, SensorError] = field(default_factory=dict)
    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)
    springs: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def sensor_errors(
    found: Sequence[tuple[ForceEffect, np.ndarray]], chain: Chain, joints: Sequence[str]
) -> dict[str, SensorError]:
    """Defects of sensors among some effects.

    Args:
        found: effects and their parameters.
        chain: the mechanism.
        joints: that are measured.

    Returns:
        `position.JOINT` or `force.DRIVE` -> defect.
    """
    out: dict[str, dict[str, float]] = {}

    def add(channel: str, kind: str, value: float) -> None:
        known = out.setdefault(channel, {})
        known[kind] = known.get(kind, 0.0) + value if kind == "delay" else value

    for effect, value in found:
        kind, _, what = effect.name.rpartition("_")
        if effect.name == "clock_offset":
            late = float(value[0])
            names = (f"force.{d}" for d in chain.drives) if late > 0 else (
                f"position.{j}" for j in joints)  # fmt: skip
            for channel in names:
                add(channel, "delay", abs(late))
        elif kind in ("force", "angle", "length") and what in _SENSORS:
            place = "force" if kind == "force" else "position"
            add(f"{place}.{effect.location}", what, float(value[0]))
    return {channel: SensorError(**numbers) for channel, numbers in out.items()}


def patch_of(
    found: Sequence[tuple[ForceEffect, np.ndarray]], chain: Chain, joints: Sequence[str],
    calibrated: Mapping[str, float], nominal: Mapping[str, float],
    speeds: Mapping[str, float],
) -> Patch:  # fmt: skip
    """The patch that some effects and calibrated numbers make.

    Args:
        found: effects and their parameters.
        chain: the mechanism.
        joints: that are measured.
        calibrated: regressor's parameter -> by how much it differs.
        nominal: regressor's parameter -> its given value.
        speeds: joint -> RMS rate, to which the Stribeck effect's velocity relates.

    Returns:
        The patch.
    """
    changed: dict[str, float] = {}
    friction: dict[str, dict[str, float]] = {}
    springs: dict[str, tuple[float, float]] = {}
    tilt = (0.0, 0.0, 0.0)
    for name, deviation in calibrated.items():
        changed[name] = changed.get(name, nominal.get(name, 0.0)) + deviation
    for effect, value in found:
        place = effect.location
        if effect.name in _BODIES or effect.name in _FRICTION:
            for name, more in zip(effect.columns, effect.coefficients(value), strict=True):
                changed[name] = changed.get(name, nominal.get(name, 0.0)) + float(more)
        elif effect.name in _STATED:
            known = friction.setdefault(place, {})
            known[_STATED[effect.name]] = float(value[0])
            if effect.name == "stribeck_friction":
                known["stribeck_velocity"] = STRIBECK[effect.variant] * speeds[place]
        elif effect.name == "joint_spring":
            springs[place] = float(value[0]), float(value[1])
        elif effect.name == "base_tilt":
            tilt = float(value[0]), float(value[1]), 0.0
    return Patch(changed, friction, sensor_errors(found, chain, joints), tilt, springs)


def patched_mjcf(mjcf: str | Path, patch: Patch) -> str:
    """The MJCF with a patch.

    Args:
        mjcf: file of the given model.
        patch: what is changed.

    Returns:
        The XML. Bodies that cannot exist are made so: every moment of inertia at least positive and
        at most the sum of the others.
    """
    document = read_mjcf(mjcf)
    spec = document.load_spec()
    model = document.compile(spec)
    by_body: dict[str, dict[str, float]] = {}
    for name, value in patch.parameters.items():
        kind, _, place = name.partition(".")
        if kind in BODY_PARAMETERS:
            by_body.setdefault(place, {})[kind] = value
        elif kind in ("coulomb", "viscous", "drive_inertia") and _has_joint(spec, place):
            joint = spec.joint(place)
            if kind == "coulomb":
                joint.frictionloss = max(value, 0.0)
            elif kind == "viscous":
                _set_first(joint, "damping", max(value, 0.0))
            else:
                joint.armature = value
    for body, numbers in by_body.items():
        _set_body(spec.body(body), model, numbers)
    for place, (stiffness, rest) in patch.springs.items():
        _set_first(spec.joint(place), "stiffness", stiffness)
        spec.joint(place).springref = rest
    if any(patch.tilt):
        spec.option.gravity = tilted(np.array(spec.option.gravity), np.array(patch.tilt))
    document.compile(spec)
    return spec.to_xml()


def _has_joint(spec: Any, name: str) -> bool:
    return any(joint.name == name for joint in spec.joints)


def _set_first(joint: Any, field_name: str, value: float) -> None:
    """Set a number that newer versions of MuJoCo hold as a polynomial."""
    now = getattr(joint, field_name)
    if np.ndim(now):
        now[0] = value
    else:
        setattr(joint, field_name, value)


def _set_body(body: Any, model: mujoco.MjModel, numbers: Mapping[str, float]) -> None:
    """Mass, centre of mass and inertia from parameters about the body's origin."""
    given = dict(zip(BODY_PARAMETERS, body_inertial_parameters(model, model.body(body.name).id), strict=True))
    ten = np.array([(given | dict(numbers))[kind] for kind in BODY_PARAMETERS])
    mass = max(ten[0], 1e-6)
    centre = ten[1:4] / mass
    xx, xy, xz, yy, yz, zz = ten[4:]
    about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    about -= mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    size, turn = np.linalg.eigh(about)
    # second moments along the axes: none may be negative
    second = 0.5 * size.sum() - size
    second = np.maximum(second, max(_THIN * second.max(), 1e-12))
    size = second.sum() - second
    if np.linalg.det(turn) < 0.0:
        turn[:, 0] = -turn[:, 0]
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, turn.ravel())
    body.explicitinertial, body.mass, body.ipos = True, mass, centre
    body.fullinertia = np.full(6, np.nan)
    body.inertia, body.iquat = size, quaternion


def patched_mapping(given: ColumnMapping, patch: Patch) -> ColumnMapping:
    """The mapping with a patch.

    Args:
        given: the mapping.
        patch: what is changed.

    Returns:
        The mapping, in which what has become different is no longer alike or absent.
    """
    touched = {name.partition(".")[2] for name in patch.parameters}
    friction = {place: dict(numbers) for place, numbers in given.friction.items()}
    for place, numbers in patch.friction.items():
        friction.setdefault(place, {}).update(numbers)
    errors = dict(given.sensor_errors)
    for channel, one in patch.errors.items():
        old = errors.get(channel, SensorError())
        errors[channel] = SensorError(
            offset=old.offset + old.scale * one.offset, scale=old.scale * one.scale,
            delay=old.delay + one.delay, time_constant=old.time_constant, drift=old.drift,
            drift_time_constant=old.drift_time_constant,
        )  # fmt: skip
    keep = () if touched else given.equal_parameters
    return given.model_copy(update={
        "friction": friction, "sensor_errors": errors, "equal_parameters": keep,
        "zero_parameters": () if touched else given.zero_parameters,
    })  # fmt: skip


def write_mechanism(folder: Path, mjcf: str, mapping: ColumnMapping) -> None:
    """Write `robot.xml` and `columns.yaml`, which every command with --mjcf reads.

    Args:
        folder: that is there.
        mjcf: the XML.
        mapping: the columns.
    """
    (folder / MJCF_FILE).write_text(mjcf, encoding="utf-8")
    document = mapping.model_dump(mode="json", exclude_defaults=True)
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None)
    (folder / COLUMNS_FILE).write_text(text, encoding="utf-8")
