"""Read and write machine files (machine.yaml and its MJCF).

A user machine is a folder with `machine.yaml` and usually an MJCF file; the package needs no
change. Link data that the YAML file does not contain are taken from the MJCF body of the same name.
A number that is in both files is an error.
"""

import math
import os
import shutil
from pathlib import Path

import mujoco
import numpy as np
import yaml

from hydrotele.core.datafile import (
    read_yaml,
    scale_numbers,
    split_unit,
    suggest_valid_name,
    validate_data,
)
from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder, resolve_path
from hydrotele.core.mjcf import copy_mjcf, load_spec
from hydrotele.core.units import PSI
from hydrotele.machine.machine import Machine
from hydrotele.terms.law import LAWS

MACHINE_FILE = "machine.yaml"


def find_machine_file(name_or_path: str | Path) -> Path:
    """Return the file of a shipped machine (by name) or of a user machine (folder or YAML file).

    A plain name always means the shipped machine; write `./name` for a folder of the same name.

    Raises:
        InputError: the machine does not exist; the message lists the shipped machines.
    """
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml"):
        if path.is_file():
            return path
        raise InputError(path, "no such machine file")
    if str(name_or_path) in shipped_machines():
        return models_folder() / path / MACHINE_FILE
    if (path / MACHINE_FILE).is_file():
        return path / MACHINE_FILE
    raise InputError(
        f"machine {str(name_or_path)!r}",
        f"is neither a folder with {MACHINE_FILE} nor a shipped machine;"
        f" {suggest_valid_name(str(name_or_path), shipped_machines())}",
    )


def shipped_machines() -> list[str]:
    """Return the names of the machines in the package.

    Examples:
        >>> import hydrotele as ht
        >>> ht.shipped_machines()
        ['calibrator', 'cat215', 'cat325', 'ec20', 'eha', 'emps', 'rig']
        >>> ht.load_machine("cat325").tools
        ('none',)
    """
    return sorted(p.parent.name for p in models_folder().glob(f"*/{MACHINE_FILE}"))


def load_machine(name_or_path: str | Path, tool: str | None = None) -> Machine:
    """Read a machine with one of its tools.

    Args:
        name_or_path: name of a shipped machine, a folder, or a machine file.
        tool: name of the tool; the default is `tool` of the file, or `none`.

    Returns:
        The validated machine with complete link data.

    Raises:
        InputError: the file is invalid; the message gives file, line, key and valid values.

    Examples:
        >>> import hydrotele as ht
        >>> excavator = ht.load_machine("cat215", tool="bucket")
        >>> list(excavator.axes)
        ['swing', 'boom', 'stick', 'bucket']
        >>> cylinder = excavator.axes["boom"].cylinder
        >>> round(cylinder.stroke, 3), round(1e4 * cylinder.area_head, 1)  # m, cm^2 of both boom cylinders
        (1.05, 205.2)

        The relief pressure limits the force that the two boom cylinders can lift with [kN]:

        >>> round(1e-3 * excavator.supply.relief_pressure * cylinder.area_head)
        574
    """
    return _read_machine(find_machine_file(name_or_path), tool)


def _read_machine(path: Path, tool: str | None) -> Machine:
    data, lines = read_yaml(path)
    others: list[dict] = []
    if "extends" in data:
        data, others = _merge_extended_machine(data, path, lines)
    tools = data.pop("tools", None) or {"none": {}}
    _check_tools(tools, path, lines)
    tool = tool or data.get("tool") or "none"
    if not isinstance(tool, str) or tool not in tools:
        raise InputError(
            _format_location(path, lines, "tools"),
            f"no tool {tool!r}; {suggest_valid_name(tool, tools)}",
        )
    lines = _merge_tool(data, tool, tools[tool] or {}, path, lines)
    data |= {"tool": tool, "tools": sorted(tools), "folder": str(resolve_path(path.parent))}
    others += [fragment for name, fragment in tools.items() if name != tool and fragment]
    kept = _mjcf_body_names([data])
    if data.get("resolved") and not (path.parent / str(data.get("mjcf"))).exists():
        data["folder"] = str(resolve_path(models_folder()))
    elif not data.get("resolved"):
        data["removed_bodies"] = [name for name in _mjcf_body_names(others) if name not in kept]
    _complete_links_from_mjcf(data, path, lines)
    _convert_drive_parameters(data, path, lines)
    return validate_data(Machine, data, str(path), lines)


def save_machine(machine: Machine, path: str | Path) -> None:
    """Write a machine with its tool to one YAML file in SI units that `load_machine` can read.

    Args:
        machine: the machine.
        path: file to write. A shipped MJCF is referenced relative to the shipped models, so that
            the file works with any installation. A user MJCF is copied to `<stem>.tree.xml`, with
            meshes, textures and height fields in `<stem>_assets`. User files that define laws of
            terms are copied as well.

    Examples:
        A changed machine is written to a file and read again.

        >>> import tempfile
        >>> from pathlib import Path
        >>> import hydrotele as ht
        >>> worn = ht.load_machine("rig").replace("axes.slide.cylinder.leakage", 2.0e-12)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ht.save_machine(worn, Path(folder, "worn.yaml"))
        ...     read = ht.load_machine(Path(folder, "worn.yaml"))
        >>> read.axes["slide"].cylinder.leakage, read.axes["slide"].cylinder.stroke
        (2e-12, 0.5)
    """
    machine = _copy_law_files(machine, Path(path).parent)
    data = machine.model_dump(mode="json", exclude_defaults=True)
    tool = data.pop("tool", "none")
    for key in ("folder", "tools"):
        data.pop(key, None)
    data |= {"tool": tool, "tools": {tool: {}}, "resolved": True}
    shipped = resolve_path(models_folder())
    attached = {b: resolve_path(Path(machine.folder, f)) for b, f in machine.attached.items()}
    if attached:
        data["attached"] = {
            body: str(file.relative_to(shipped) if file.is_relative_to(shipped) else file)
            for body, file in attached.items()
        }
    if machine.mjcf:
        mjcf = resolve_path(Path(machine.folder, machine.mjcf))
        copy = Path(path).with_suffix(".tree.xml")
        if mjcf.is_relative_to(shipped):
            data["mjcf"] = str(mjcf.relative_to(shipped))
        else:
            copy_mjcf(mjcf, copy, f"{Path(path).stem}_assets")
            data["mjcf"] = copy.name
    Path(path).write_text(yaml.safe_dump(data, sort_keys=False, default_flow_style=None))


def _copy_law_files(machine: Machine, folder: Path) -> Machine:
    """Copy the user files that define laws of terms into a folder.

    Return the machine with the names of the copies as sources of its terms. Raise InputError if two
    different files have the same name.
    """
    terms, copied = [], {}
    for term in machine.terms:
        source = LAWS[term.law].source
        file = Path(source)
        if source and file.is_file():
            source = file.name
            if not file.samefile(other := copied.setdefault(source, file)):
                raise InputError(file, f"must not have the same name as {other}: both are copied to one folder")
            if not (folder / source).exists() or not file.samefile(folder / source):
                shutil.copyfile(file, folder / source)
        terms.append(term.model_copy(update={"source": source}))
    return machine.model_copy(update={"terms": tuple(terms)})


def _merge_extended_machine(data: dict, path: Path, lines) -> tuple[dict, list[dict]]:
    """Merge the data of a machine file with those of the machine that it extends (key `extends`).

    `lines` maps key paths to line numbers, for messages. Raise InputError if the other machine or
    its tool does not exist, or if it extends a machine itself.

    Returns:
        The complete data, and the sections of the unused tools of the other machine.
    """
    base = data.pop("extends")
    where = _format_location(path, lines, "extends")
    if not isinstance(base, dict) or not base.keys() <= {"machine", "tool"} or "machine" not in base:
        raise InputError(where, "must be {machine: NAME or FOLDER, tool: NAME}")
    name = str(base["machine"])
    beside = path.parent / name
    file = find_machine_file(beside if (beside / MACHINE_FILE).is_file() else name)
    whole, base_lines = read_yaml(file)
    if "extends" in whole:
        raise InputError(where, f"{name} itself extends a machine; extend that machine directly")
    tools = whole.pop("tools", None) or {"none": {}}
    _check_tools(tools, file, base_lines)
    tool = base.get("tool", "none")
    if tool not in tools:
        raise InputError(where, f"{name} has no tool {tool!r}; {suggest_valid_name(str(tool), tools)}")
    _merge_tool(whole, tool, tools[tool] or {}, file, base_lines)
    if whole.get("mjcf"):
        whole["mjcf"] = os.path.relpath(file.parent / str(whole["mjcf"]), path.parent)
    unused = [fragment for other, fragment in tools.items() if other != tool and fragment]
    whole = _merge_sections(whole, data)
    home = _section_entries(whole, "home")
    return whole | {"home": {k: v for k, v in home.items() if v is not None}}, unused


def _merge_sections(base, new):
    """Return `base` updated by `new`; mappings are merged recursively."""
    if not (isinstance(base, dict) and isinstance(new, dict)):
        return new
    return base | {key: _merge_sections(base.get(key), value) for key, value in new.items()}


def _format_location(path: Path, lines, *keys: str) -> str:
    """Return file, line and key path as text for messages.

    The line is that of the longest leading part of the key path that `lines` contains.
    """
    line = next((lines[keys[:k]] for k in range(len(keys), 0, -1) if keys[:k] in lines), 0)
    return f"{path}{f':{line}' if line else ''}: {'.'.join(keys)}"


def _check_tools(tools, path: Path, lines) -> None:
    if not isinstance(tools, dict) or not all(isinstance(name, str) for name in tools):
        raise InputError(_format_location(path, lines, "tools"), "must map tool names to their sections")
    for name, fragment in tools.items():
        if not isinstance(fragment, (dict, type(None))):
            message = "must map sections (links, axes, home, ...) to the entries of the tool"
            raise InputError(_format_location(path, lines, "tools", name), message)


def _merge_tool(data: dict, tool: str, fragment: dict, path: Path, lines) -> dict:
    """Add the sections `fragment` of a tool to the machine data `data`, in place.

    Raise InputError if a link, axis or closure of the tool already exists. Return `lines`, the line
    number of every key path, with the lines of the added keys.
    """
    for section, entries in fragment.items():
        old, new = ("tools", tool, str(section)), (str(section),)
        lines = lines | {new + p[len(old) :]: n for p, n in lines.items() if p[: len(old)] == old}
        if isinstance(entries, dict) and isinstance(data.get(section), dict):
            if section in ("links", "axes", "closures"):
                for twice in entries.keys() & data[section]:
                    message = "already exists in the machine; use another name in the tool"
                    raise InputError(_format_location(path, lines, *old, str(twice)), message)
            entries = {**data[section], **entries}
        data[section] = entries
    return lines


def _section_entries(data: dict, section: str) -> dict:
    """Return the entries of a section of a machine file by name; empty if the section is not a mapping."""
    entries = data.get(section)
    if not isinstance(entries, dict):
        return {}
    return {name: facts for name, facts in entries.items() if isinstance(name, str)}


def _mjcf_body_names(fragments) -> tuple[str, ...]:
    names = []
    for fragment in fragments:
        names += _section_entries(fragment, "links")
        for axis, facts in _section_entries(fragment, "axes").items():
            if isinstance(facts, dict) and "cylinder" in facts:
                names += [f"{axis}_tube", f"{axis}_rod"]
    return tuple(dict.fromkeys(names))


def _complete_links_from_mjcf(data: dict, path: Path, lines) -> None:
    """Add link data from the MJCF file to the machine data, in place.

    A value that both files contain raises InputError. Data that `save_machine` wrote (`resolved`)
    are already complete and are not changed.
    """
    if data.pop("resolved", False):
        return
    if not data.get("mjcf"):
        return
    mjcf = path.parent / str(data["mjcf"])
    try:
        spec = load_spec(mjcf)
    except InputError as error:
        raise InputError(_format_location(path, lines, "mjcf"), str(error)) from None
    for name, link in _section_entries(data, "links").items():
        body = spec.body(name)
        if body is None or name == "world" or not isinstance(link, dict):
            continue
        where = _format_location(path, lines, "links", name)
        known = _read_mjcf_body(body, spec.compiler.degree, f"{where}: body {name!r} of {mjcf.name}")
        data["links"][name] = _merge_link(link, known, where, mjcf.name)


def _merge_link(link: dict, known: dict, where: str, mjcf: str) -> dict:
    """Return the merged YAML data `link` and MJCF data `known` of a link.

    Raise InputError for a value that is in both.
    """
    joint, known_joint = link.get("joint"), known.get("joint")
    twice = {key for key in link if split_unit(str(key))[0] in known} - {"joint"}
    if isinstance(joint, dict) and known_joint:
        twice |= {f"joint.{key}" for key in joint if split_unit(str(key))[0] in known_joint}
        known = known | {"joint": known_joint | joint}
        link = {key: value for key, value in link.items() if key != "joint"}
    if twice:
        message = f"{', '.join(sorted(twice))} is also given in {mjcf}; keep it in one file"
        raise InputError(where, message)
    return known | link


def _read_mjcf_body(body, degrees: bool, where: str) -> dict:
    """Return the link data of an MJCF body: parent, position, inertia and joint.

    Default classes are applied. Raise InputError if the inertia is not diagonal in the body's axes,
    or for more than one joint.
    """
    facts: dict = {"parent": body.parent.name}
    if np.any(body.pos):
        facts["position"] = body.pos.tolist()
    if body.explicitinertial:
        turned = np.any(body.iquat[1:]) or body.ialt.type != mujoco.mjtOrientation.mjORIENTATION_QUAT
        if turned or np.all(np.isfinite(body.fullinertia)):
            raise InputError(where, "the inertia must be a diaginertia in the axes of the body")
        facts |= {"mass": body.mass, "com": body.ipos.tolist(), "inertia": body.inertia.tolist()}
    if not body.joints:
        return facts
    if len(body.joints) > 1 or not body.joints[0].name:
        raise InputError(where, f"needs exactly one named joint, has {len(body.joints)} joints")
    joint = body.joints[0]
    kind = mujoco.mjtJoint(joint.type).name.removeprefix("mjJNT_").lower()
    facts["joint"] = {"name": joint.name, "type": kind, "axis": joint.axis.tolist()}
    if np.any(joint.range):
        factor = math.pi / 180.0 if degrees and kind == "hinge" else 1.0
        facts["joint"]["range"] = (factor * joint.range).tolist()
    if damping := float(np.ravel(joint.damping)[0]):
        facts["joint"]["damping"] = damping
    return facts


def _convert_drive_parameters(data: dict, path: Path, lines) -> None:
    """Convert drive parameters in other forms to those of `Axis`, in place.

    `bore` and `rod_diameter` [m] of `count` equal cylinders become their areas. Pins in polar
    coordinates become points. `torque_per_psi` [N m/psi] times `gear_ratio` of a motor becomes its
    displacement [m^3/rad].
    """
    for name, axis in _section_entries(data, "axes").items():
        if not isinstance(axis, dict):
            continue
        cylinder, motor = axis.get("cylinder"), axis.get("motor")
        if isinstance(cylinder, dict):
            where = _format_location(path, lines, "axes", name, "cylinder")
            cylinder = axis["cylinder"] = _convert_diameters(cylinder, where)
        for part in ("base_pin", "rod_pin"):
            if isinstance(cylinder, dict) and isinstance(cylinder.get(part), dict):
                where = _format_location(path, lines, "axes", name, "cylinder", part)
                cylinder[part] = _convert_polar_pin(cylinder[part], data, where)
        if isinstance(motor, dict) and "torque_per_psi" in motor:
            motor = dict(motor)
            where = _format_location(path, lines, "axes", name, "motor", "torque_per_psi")
            torque = _parse_finite_number(motor.pop("torque_per_psi"), where)
            ratio = _parse_finite_number(motor.pop("gear_ratio", 1.0), where)
            axis["motor"] = motor | {"displacement": torque * ratio / PSI}


def _convert_diameters(cylinder: dict, where: str) -> dict:
    """Return a cylinder with its areas computed from `bore`, `rod_diameter` and `count`, if it has them.

    Raise InputError for a diameter together with an area, one diameter alone, or a rod that is not
    thinner than the bore.
    """
    stems = {split_unit(str(key))[0]: str(key) for key in cylinder}
    given = {stem: stems[stem] for stem in ("bore", "rod_diameter", "count") if stem in stems}
    if not given:
        return cylinder
    if both := [stems[stem] for stem in ("area_head", "area_rod") if stem in stems]:
        raise InputError(where, f"has {both[0]} and {next(iter(given.values()))}; give diameters or areas, not both")
    if missing := [stem for stem in ("bore", "rod_diameter") if stem not in given]:
        raise InputError(where, f"{missing[0]} is missing; the areas need bore and rod_diameter")
    values = {}
    for stem, key in given.items():
        value = _parse_finite_number(cylinder[key], f"{where}.{key}")
        values[stem] = value * (split_unit(key)[1] or 1.0) if key != stem else value
    count = values.get("count", 1.0)
    if not 0.0 <= values["rod_diameter"] < values["bore"]:
        raise InputError(where, "rod_diameter must be smaller than bore")
    if count < 1.0 or count != round(count):
        raise InputError(where, f"count must be a number of cylinders, 1 or more, not {count:g}")
    head = count * math.pi / 4.0 * values["bore"] ** 2
    rod = count * math.pi / 4.0 * values["rod_diameter"] ** 2
    kept = {key: value for key, value in cylinder.items() if key not in given.values()}
    return kept | {"area_head": head, "area_rod": head - rod}


def _convert_polar_pin(pin: dict, data: dict, where: str) -> dict:
    """Return a pin with its position computed from polar coordinates in the x-z plane.

    `distance` and `angle_deg` of the pin are measured from the position of the link `from`, or
    without `from` from the origin of the frame. A pin without `distance` is returned unchanged.
    """
    if "distance" not in pin:
        return pin
    pin = dict(pin)
    origin = [0.0, 0.0, 0.0]
    if "from" in pin:
        child, links = pin.pop("from"), _section_entries(data, "links")
        if child not in list(links):
            raise InputError(where, f"from: {child!r} is not a link; {suggest_valid_name(child, links)}")
        link = links[child] if isinstance(links[child], dict) else {}
        origin = link.get("position") or scale_numbers(link.get("position_mm"), 1.0e-3) or origin
        if not isinstance(origin, list) or len(origin) != 3:
            raise InputError(where, f"links.{child}.position must be three numbers")
    x, y, z = (_parse_finite_number(value, f"{where}: links.position") for value in origin)
    distance = _parse_finite_number(pin.pop("distance"), f"{where}.distance")
    angle = math.radians(_parse_finite_number(pin.pop("angle_deg", 0.0), f"{where}.angle_deg"))
    pin["position"] = [x + distance * math.cos(angle), y, z + distance * math.sin(angle)]
    return pin


def _parse_finite_number(value, where: str) -> float:
    try:
        number = float("nan" if isinstance(value, (str, bool)) else value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(where, f"must be a finite number, not {value!r}")
    return number
