"""Machine files: `load_machine` reads machine.yaml and its MJCF tree, `save_machine` writes one back.

A user's machine is a folder with `machine.yaml` (and usually an MJCF beside it); nothing in the
package has to change for it. What the YAML does not say of a link is taken from the MJCF body of
the same name; saying the same number twice is refused.
"""

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import yaml

from hydrotele.datafile import PSI, parse, read_yaml, suggest
from hydrotele.errors import InputError
from hydrotele.machine import Machine
from hydrotele.resources import models_folder

MACHINE_FILE = "machine.yaml"


def machine_path(name_or_path: str | Path) -> Path:
    """File of a shipped machine (by name) or of a user's (folder or YAML file).

    Raises:
        InputError: there is no such machine; lists those that are shipped.
    """
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml"):
        if path.is_file():
            return path
        raise InputError(path, "no such machine file")
    if (path / MACHINE_FILE).is_file():
        return path / MACHINE_FILE
    shipped = models_folder() / str(name_or_path) / MACHINE_FILE
    if shipped.is_file():
        return shipped
    raise InputError(
        f"machine {str(name_or_path)!r}",
        f"is neither a folder with {MACHINE_FILE} nor a shipped machine;"
        f" {suggest(str(name_or_path), shipped_machines())}",
    )


def shipped_machines() -> list[str]:
    """Names of the machines that come with the package."""
    return sorted(p.parent.name for p in models_folder().glob(f"*/{MACHINE_FILE}"))


def load_machine(name_or_path: str | Path, tool: str | None = None) -> Machine:
    """Read a machine and one of its tools.

    Args:
        name_or_path: name of a shipped machine, a folder, or a machine file.
        tool: name of the tool; default is the file's `tool`, or `none`.

    Returns:
        The frozen, validated machine, every link complete.

    Raises:
        InputError: names file, line, key path, and what is allowed.
    """
    path = machine_path(name_or_path)
    data, lines = read_yaml(path)
    tools = data.pop("tools", None) or {"none": {}}
    tool = tool or data.get("tool") or "none"
    if not isinstance(tools, dict) or tool not in tools:
        raise InputError(f"{path}: tools", f"no tool {tool!r}; {suggest(tool, tools)}")
    for section, entries in (tools[tool] or {}).items():
        if isinstance(entries, dict) and isinstance(data.get(section), dict):
            if section in ("links", "axes", "closures") and (twice := entries.keys() & data[section]):
                raise InputError(f"{path}: tools.{tool}.{section}", f"{sorted(twice)} stand twice")
            data[section] = {**data[section], **entries}
            lines = _move_lines(lines, ("tools", tool, section), (section,))
        else:
            data[section] = entries
    data |= {"tool": tool, "tools": sorted(tools), "folder": str(path.parent.resolve())}
    others = [fragment for name, fragment in tools.items() if name != tool and fragment]
    kept = _bodies_of([data])
    data["removed_bodies"] = [name for name in _bodies_of(others) if name not in kept]
    _complete_links(data, path)
    _resolve_drives(data, path)
    return parse(Machine, data, str(path), lines)


def save_machine(machine: Machine, path: str | Path) -> None:
    """Write a machine as one YAML file in SI, complete with its tool, readable by `load_machine`.

    Args:
        machine: the machine.
        path: file to write; its MJCF, if any, is referred to by absolute path.
    """
    data = machine.model_dump(mode="json", exclude_defaults=True)
    tool = data.pop("tool", "none")
    for key in ("folder", "tools"):
        data.pop(key, None)
    data |= {"tool": tool, "tools": {tool: {}}, "resolved": True}
    if machine.mjcf:
        data["mjcf"] = str(Path(machine.folder, machine.mjcf).resolve())
    Path(path).write_text(yaml.safe_dump(data, sort_keys=False, default_flow_style=None))


def _move_lines(lines, old, new):
    moved = {new + p[len(old) :]: n for p, n in lines.items() if p[: len(old)] == old}
    return {**lines, **moved}


def _bodies_of(fragments) -> tuple[str, ...]:
    names = []
    for fragment in fragments:
        names += list(fragment.get("links") or {})
        for axis, facts in (fragment.get("axes") or {}).items():
            if isinstance(facts, dict) and "cylinder" in facts:
                names += [f"{axis}_tube", f"{axis}_rod"]
    return tuple(names)


def _complete_links(data: dict, path: Path) -> None:
    """Fill in what the MJCF says of each link; refuse what stands in both."""
    if data.pop("resolved", False):
        return
    if not data.get("mjcf") or not isinstance(data.get("links"), dict):
        return
    mjcf = path.parent / str(data["mjcf"])
    try:
        root = ElementTree.parse(mjcf).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise InputError(f"{path}: mjcf", f"{mjcf} cannot be read: {error}") from None
    compiler = root.find("compiler")
    degrees = compiler is None or compiler.get("angle", "degree") == "degree"
    bodies = _mjcf_bodies(root.find("worldbody"), "world", degrees)
    for name, link in data["links"].items():
        if not isinstance(link, dict) or name not in bodies:
            continue
        known = bodies[name]
        joint, known_joint = link.get("joint"), known.get("joint")
        twice = link.keys() & known.keys() - {"joint"}
        if isinstance(joint, dict) and known_joint:
            twice |= joint.keys() & known_joint.keys()
            known = {**known, "joint": {**known_joint, **joint}}
            link = {key: value for key, value in link.items() if key != "joint"}
        if twice:
            raise InputError(
                f"{path}: links.{name}",
                f"{', '.join(sorted(twice))} also stands in {mjcf.name}; keep it in one place",
            )
        data["links"][name] = {**known, **link}


def _mjcf_bodies(element, parent: str, degrees: bool) -> dict[str, dict]:
    bodies: dict[str, dict] = {}
    if element is None:
        return bodies
    for body in element.findall("body"):
        name = body.get("name", "")
        facts: dict = {"parent": parent}
        if body.get("pos"):
            facts["position"] = _numbers(body.get("pos"))
        inertial = body.find("inertial")
        if inertial is not None:
            facts["mass"] = float(inertial.get("mass", "nan"))
            facts["com"] = _numbers(inertial.get("pos", "0 0 0"))
            facts["inertia"] = _numbers(inertial.get("diaginertia", ""))
        joint = body.find("joint")
        if joint is not None:
            kind = joint.get("type", "hinge")
            facts["joint"] = {"name": joint.get("name", name), "type": kind}
            facts["joint"]["axis"] = _numbers(joint.get("axis", "0 0 1"))
            if joint.get("range"):
                factor = math.pi / 180.0 if degrees and kind == "hinge" else 1.0
                facts["joint"]["range"] = [factor * v for v in _numbers(joint.get("range"))]
            if joint.get("damping"):
                facts["joint"]["damping"] = float(joint.get("damping", "0"))
        bodies[name] = facts
        bodies |= _mjcf_bodies(body, name, degrees)
    return bodies


def _numbers(text: str | None) -> list[float]:
    return [float(part) for part in (text or "").split()]


def _resolve_drives(data: dict, path: Path) -> None:
    """Turn polar pins into points and motor torque per psi into displacement."""
    axes = data.get("axes")
    if not isinstance(axes, dict):
        return
    for name, axis in axes.items():
        if not isinstance(axis, dict):
            continue
        for part in ("base_pin", "rod_pin"):
            cylinder = axis.get("cylinder")
            if isinstance(cylinder, dict) and isinstance(cylinder.get(part), dict):
                where = f"{path}: axes.{name}.cylinder.{part}"
                cylinder[part] = _resolve_pin(cylinder[part], data, where)
        motor = axis.get("motor")
        if isinstance(motor, dict) and "torque_per_psi" in motor:
            try:
                torque = float(motor.pop("torque_per_psi")) * float(motor.pop("gear_ratio", 1.0))
            except (TypeError, ValueError):
                raise InputError(f"{path}: axes.{name}.motor", "must hold numbers") from None
            motor["displacement"] = torque / PSI


def _resolve_pin(pin: dict, data: dict, where: str) -> dict:
    if "distance" not in pin:
        return pin
    pin = dict(pin)
    try:
        origin = [0.0, 0.0, 0.0]
        if "from" in pin:
            child = pin.pop("from")
            links = data.get("links") or {}
            if child not in links:
                raise InputError(where, f"from: {child!r} is no link; {suggest(child, links)}")
            origin = [float(v) for v in links[child].get("position", origin)]
        distance = float(pin.pop("distance"))
        angle = math.radians(float(pin.pop("angle_deg", 0.0)))
    except (TypeError, ValueError, AttributeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(where, "distance, angle_deg and the link's position are numbers") from None
    x, y, z = origin
    pin["position"] = [x + distance * math.cos(angle), y, z + distance * math.sin(angle)]
    return pin
