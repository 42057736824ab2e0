"""Write the folder of a new machine: machine.yaml, MJCF, meshes and a scenario that moves every axis."""

import json
import math
from pathlib import Path

import numpy as np

from hydrotele.convert.arm_links import MovingLink
from hydrotele.convert.machine_design import Drive, MachineDesign, joint_poses
from hydrotele.convert.shapes import Shape, convex_solid, write_stl
from hydrotele.machine.estimate_marks import ESTIMATE_MARK

_STEEL = 7850.0  # kg/m^3
_ROD_RATIO = 0.70  # rod over bore diameter: 0.68 .. 0.72 in the shipped excavators
_TUBE_RATIO = 1.22  # outer over inner diameter
_SECONDS_PER_STROKE = 4.0  # at the rated flow of the valve
_MAX_HULL_POINTS = 200
_YELLOW, _DARK, _CHROME = (0.95, 0.66, 0.06, 1.0), (0.2, 0.2, 0.21, 1.0), (0.86, 0.88, 0.9, 1.0)
_FRICTION_PRESSURE = 0.15e6  # Pa: seal friction over head-side area, CAT 325 0.146e6, EC20 0.150e6
_VISCOUS_PRESSURE = 0.4e6  # Pa s/m: CAT 325 0.29e6, EC20 0.9e6
_MOTOR_VOLUME = 0.5  # rad, chamber volume over displacement: CAT 215 0.38, CAT 325 0.61
_PASSIVE_DAMPING = 60.0  # N m s/rad, grapple link of the CAT 215 (boom of 5.2 m)
_SCENARIO = "moves.yaml"


def _numbers(values, digits: int = 4) -> str:
    return "[" + ", ".join(_number(value, digits) for value in values) + "]"


def _number(value: float, digits: int = 4) -> str:
    text = f"{float(value):.{digits}g}"
    if "e" in text:
        mantissa, _, exponent = text.partition("e")
        return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{int(exponent):+d}"
    return "0" if text == "-0" else text


def _place(values) -> str:
    return "[" + ", ".join(f"{round(float(value), 4) + 0.0:g}" for value in values) + "]"


def write_machine_folder(folder: Path, name: str, source: str, design: MachineDesign) -> list[str]:
    """Create the folder of a machine with all files.

    Args:
        folder: folder, which must not exist.
        name: name of the machine.
        source: name of the file from which the machine was made.
        design: the machine.

    Returns:
        Names of the files, relative to the folder.
    """
    folder.mkdir()
    mjcf = _MjcfWriter(folder, name, design).write()
    (folder / f"{name}.xml").write_text(mjcf, encoding="utf-8")
    (folder / "machine.yaml").write_text(_machine_yaml(name, source, design), encoding="utf-8")
    (folder / _SCENARIO).write_text(_scenario_yaml(name, design), encoding="utf-8")
    return ["machine.yaml", f"{name}.xml", _SCENARIO]


def _machine_yaml(name: str, source: str, design: MachineDesign) -> str:
    mark = f"# {ESTIMATE_MARK}"
    scale = design.length / 5.2
    lines = [
        f"# {name}, made from {source} by `hydrotele new machine`.",
        "# SI, radians; a key may carry another unit as its suffix.",
        f'# A line marked "{ESTIMATE_MARK}" has a value typical of the machine class. Replace it and remove the mark;',
        f"# `hydrotele validate ./{name}` lists the marked lines in the order of their effect.",
        "# Frames: z up, x forward; angles of boom, stick and tool positive = outboard end up.",
        "# Changed or assumed when the file was read:",
        *(f"#   {note}" for note in design.notes),
        f"name: {name}",
        f"description: {name}, from a robot description",
        f"source: {json.dumps(source)}",
        f"mjcf: {name}.xml",
        "",
        "links:",
    ]
    for link in design.tree.links.values():
        lines += _link_lines(link, design, mark)
    for joint, drive in design.drives.items():
        if drive.four_bar:
            lines += _four_bar_link_lines(joint, drive, design, mark)
    lines += ["", "axes:"]
    for link in design.driven_links():
        drive = design.drives[link.joint]
        lines += _cylinder_lines(link, drive, mark) if drive.cylinder else _motor_lines(link, drive, scale, mark)
    closures = [joint for joint, drive in design.drives.items() if drive.four_bar]
    if closures:
        lines += ["", "closures:"]
    for joint in closures:
        four_bar = design.drives[joint].four_bar
        assert four_bar
        tool = next(link.name for link in design.tree.links.values() if link.joint == joint)
        lines += [
            f"  {joint}_coupler_pin: {{a: {{link: {joint}_coupler, "
            f"position: {_place([four_bar.coupler_length, 0, 0])}}},"
            f" b: {{link: {tool}, position: {_place(four_bar.tool_pin)}}}}}   {mark}",
        ]
    hydraulics = design.hydraulics
    lines += [
        "",
        "supply:",
        "  kind: load_sensing",
        f"  relief_pressure: {_number(hydraulics.relief_pressure)}   {mark}",
        "  tank_pressure: 0.3e+6",
        f"  pump_flow_l_min: {_number(6.0e4 * hydraulics.flow, 3)}   {mark}",
        "  bulk_modulus: 0.9e+9",
        "",
        "sensors:",
        f"  typical: {{rate: 50, angle: {{accuracy_deg: 0.2}}, pressure: {{accuracy_bar: 2}}}}   {mark}",
        "",
        "uncertainty: {flow_table: 1.0, delay: 0.05, linkage: 0.15}   # standard deviations, the delay in s",
        "",
        f"home: {{{', '.join(f'{joint}: {value:g}' for joint, value in _home(design).items())}}}",
    ]
    if arm := _arm_line(design):
        lines += [arm]
    return "\n".join(lines) + "\n"


def _link_lines(link: MovingLink, design: MachineDesign, mark: str) -> list[str]:
    body = design.bodies[link.name]
    reason = f"   {mark}: {body.reason}" if body.reason else ""
    angle = f"{link.joint}" if link.sign > 0 else f"-{link.joint}"
    offset = math.degrees(link.offset)
    relation = angle if abs(offset) < 1e-3 else f"{offset:.4f} deg {'+' if link.sign > 0 else '-'} {link.joint}"
    lines = [
        f"  {link.name}:   # {link.source_joint} of the file = {relation}",
        f"    position: {_place(link.position)}",
    ]
    values = []
    if link.range:
        hinge = link.kind == "hinge"
        limits = [math.degrees(value) if hinge else value for value in link.range]
        values += [f"range{'_deg' if hinge else ''}: {_place(limits)}"]
    if link.role == "passive":
        values += [f"damping: {_number(_PASSIVE_DAMPING * (design.length / 5.2) ** 3, 2)}"]
    if values:
        lines += [f"    joint: {{{', '.join(values)}}}{f'   {mark}' if link.role == 'passive' else ''}"]
    return [
        *lines,
        f"    mass: {_number(body.mass)}{reason}",
        f"    com: {_place(body.centre)}{f'   {mark}' if reason else ''}",
        f"    inertia: {_numbers(body.inertia)}{f'   {mark}' if reason else ''}",
    ]


def _four_bar_link_lines(joint: str, drive: Drive, design: MachineDesign, mark: str) -> list[str]:
    four_bar = drive.four_bar
    assert four_bar
    lines = []
    per_metre = 85.0 * (design.length / 5.2) ** 2  # kg/m: links of the CAT 215's bucket
    for part, position, length in (
        ("rocker", four_bar.rocker_pivot, four_bar.coupler_pin[0]),
        ("coupler", four_bar.coupler_pin, four_bar.coupler_length),
    ):
        mass = per_metre * length
        lines += [
            f"  {joint}_{part}:   # four-bar linkage of the tool",
            f"    position: {_place(position)}   {mark}",
            f"    mass: {_number(mass)}   {mark}",
            f"    com: {_place([0.5 * length, 0, 0])}",
            f"    inertia: {_numbers([mass * length**2 / 40, mass * length**2 / 12, mass * length**2 / 12])}   {mark}",
        ]
    return lines


def bore_diameter(drive: Drive) -> float:
    """Return the bore of each of a drive's cylinders, rounded to 5 mm [m]."""
    return max(0.02, 0.005 * round(math.sqrt(4.0 * drive.area / (math.pi * drive.count)) / 0.005))


def _cylinder_lines(link: MovingLink, drive: Drive, mark: str) -> list[str]:
    cylinder = drive.cylinder
    assert cylinder
    bore = bore_diameter(drive)
    rod = 0.005 * round(_ROD_RATIO * bore / 0.005)
    area = 0.25 * math.pi * bore**2 * drive.count
    tube_mass = _STEEL * area * (_TUBE_RATIO**2 - 1.0 + 0.1) * cylinder.closed_length
    rod_mass = _STEEL * area * (rod / bore) ** 2 * 1.15 * cylinder.closed_length
    pins = "" if cylinder.source == "stated" else f"   {mark}"
    rod_link = f"{link.joint}_rocker" if drive.four_bar else cylinder.rod_link
    number = f"    # {drive.count} cylinders as one with the summed areas" if drive.count > 1 else ""
    closed = cylinder.closed_length

    def part(mass: float) -> str:
        across = mass * (closed**2 / 12.0 + bore**2 / 6.0)
        inertia = _numbers([mass * bore**2 / 3.0, across, across], 3)
        return f"{{mass: {_number(mass, 3)}, com: {_number(0.48 * closed, 3)}, inertia: {inertia}}}"

    lines = [f"  {link.joint}:{number}", f"    joint: {link.joint}"]
    if drive.four_bar:
        lines += [f"    four_bar: {{rocker: {link.joint}_rocker, coupler: {link.joint}_coupler}}"]
    return [
        *lines,
        "    cylinder:",
        f"      base_pin: {{link: {cylinder.base_link}, position: {_place(cylinder.base_pin)}}}{pins}",
        f"      rod_pin: {{link: {rod_link}, position: {_place(cylinder.rod_pin)}}}{pins}",
        f"      closed_length: {math.floor(1e4 * closed) / 1e4:g}{pins}",
        f"      stroke: {math.ceil(1e4 * cylinder.stroke) / 1e4:g}{pins}",
        f"      bore_mm: {1e3 * bore:.0f}   {mark}",
        f"      rod_diameter_mm: {1e3 * rod:.0f}   {mark}",
        *([f"      count: {drive.count}"] if drive.count > 1 else []),
        f"      dead_volume: {_number(0.15 * area * cylinder.stroke, 3)}   {mark}",
        f"      leakage: {_number(5.0e-11 * area, 3)}   {mark}",
        f"      friction: {{coulomb: {_number(_FRICTION_PRESSURE * area, 3)}, stribeck_extra:"
        f" {_number(0.5 * _FRICTION_PRESSURE * area, 3)}, stribeck_velocity: 0.02, viscous:"
        f" {_number(_VISCOUS_PRESSURE * area, 3)}}}   {mark}",
        f"      tube: {part(tube_mass)}   {mark}",
        f"      rod: {part(rod_mass)}   {mark}",
        _valve_line(area * cylinder.stroke / _SECONDS_PER_STROKE, mark),
    ]


def _motor_lines(link: MovingLink, drive: Drive, scale: float, mark: str) -> list[str]:
    size = drive.displacement / 1.6e-3  # relative to a 16 t excavator
    rate = 0.7 if link.role == "swing" else 2.0  # rad/s
    return [
        f"  {link.joint}:",
        f"    joint: {link.joint}",
        "    motor:",
        f"      displacement: {_number(drive.displacement, 3)}   {mark}",
        f"      dead_volume: {_number(_MOTOR_VOLUME * drive.displacement, 3)}   {mark}",
        f"      leakage: {_number(1.0e-12 * max(scale, 0.1), 3)}   {mark}",
        f"      friction: {{coulomb: {_number(3000 * size, 3)}, viscous: {_number(2000 * size, 3)},"
        f" stribeck_velocity: 0.05}}   {mark}",
        _valve_line(drive.displacement * rate, mark),
    ]


def _valve_line(flow: float, mark: str) -> str:
    return (
        f"    valve: {{rated_flow_l_min: {_number(6.0e4 * flow, 3)}, deadband: 0.04, bandwidth_hz: 8.0, damping: 0.9,"
        f" port_relief: 35.0e+6}}   {mark}"
    )


def _home(design: MachineDesign) -> dict[str, float]:
    home = dict(design.home)
    for joint, drive in design.drives.items():
        if drive.four_bar:
            pose = drive.four_bar.linkage.pose(home[joint])
            home[f"{joint}_rocker"] = round(float(pose.rocker_angle), 4)
            coupler = float(pose.coupler_angle) + math.pi - float(pose.rocker_angle)
            home[f"{joint}_coupler"] = round(math.remainder(coupler, 2.0 * math.pi), 4)
    return home


def _arm_line(design: MachineDesign) -> str:
    """Return the section `arm`, empty for machines whose arm is not swing, boom, stick and a fixed or hinged tool."""
    tree = design.tree
    swing, boom, stick, tool = (tree.with_role(role) for role in ("swing", "boom", "stick", "tool"))
    if not (swing and boom and stick) or any(link.role in ("telescope", "plane") for link in tree.links.values()):
        return ""
    if boom.parent != swing.name or stick.parent != boom.name or (tool and tool.parent != stick.name):
        return ""
    last = tool or stick
    text = f"arm: {{swing: {swing.joint}, boom: {boom.joint}, stick: {stick.joint}, "
    text += f"tool: {tool.joint}, " if tool else ""
    return text + f"tip: {{link: {last.name}, position: {_place([last.end[0], 0.0, last.end[2]])}}}}}"


def _scenario_yaml(name: str, design: MachineDesign) -> str:
    """Return a scenario that moves each axis to and fro by a fifth of its range, one after the other."""
    points = []
    for link in design.driven_links():
        home = design.home[link.joint]
        low, high = link.range or (home - 1.5, home + 1.5)
        away = min(0.2 * (high - low), 0.6)  # rad or m in 4 s
        target = home + away if home + away < high - 0.05 * (high - low) else home - away
        duration = 4.0
        points += [
            f"    - {{duration: {duration:g}, joints: {{{link.joint}: {value:.4g}}}}}" for value in (target, home)
        ]
    total = 2.0 + 4.0 * len(points)
    swing = design.tree.with_role("swing")
    slow = (
        [f"servo: {{axis_gains: {{{swing.joint}: 1.0}}}}   # at the usual 4 1/s a heavy upper structure swings"]
        if swing
        else []
    )
    return "\n".join([
        "name: moves",
        f"description: Each axis of {name} moved to and fro by a fifth of its range",
        f"machine: ../{name}",
        "seed: 1",
        f"duration: {total:g}",
        "sensors: typical",
        *slow,
        "pilot:",
        "  kind: waypoints",
        "  settle: 1.0",
        "  points:",
        *points,
        "",
    ])  # fmt: skip


class _MjcfWriter:
    """Writes tree, shapes and mesh files of one machine."""

    def __init__(self, folder: Path, name: str, design: MachineDesign) -> None:
        self.folder, self.name, self.design = folder, name, design
        self.assets: list[str] = []

    def write(self) -> str:
        """Write the mesh files and return the text of the MJCF."""
        tree = self.design.tree
        body: list[str] = ['  <body name="chassis" childclass="visual">']
        visuals = tree.base_visuals or self._drawn_base()
        body += self._shape_lines("chassis", visuals, _DARK, "   ")
        body += self._hull_lines("chassis", tree.base_collisions or visuals, "   ")
        body += self._pin_lines("world", "   ")
        body += ["  </body>"]
        for link in tree.links.values():
            if link.parent == "world":
                body += self._body_lines(link, "  ")
        body += self._cylinder_bodies("world", "  ")
        centre, reach = self._view()
        x, y, z = centre
        return "\n".join([
            f"<!-- {self.name}: shapes, tree and joint axes; positions, inertias and ranges are in machine.yaml. -->",
            f'<mujoco model="{self.name}">',
            '  <compiler angle="radian" boundmass="0.001" boundinertia="0.000001"/>',
            "  <default>",
            '    <default class="visual">',
            '      <geom contype="0" conaffinity="0" group="2" mass="0"/>',
            "    </default>",
            '    <default class="collision">',
            '      <geom contype="2" conaffinity="1" group="3" mass="0" rgba="0.9 0.1 0.1 0.4"/>',
            "    </default>",
            "  </default>",
            "  <asset>",
            *self.assets,
            "  </asset>",
            "  <worldbody>",
            f'  <camera name="overview" pos="{x + 1.1 * reach:.3g} {y + 1.0 * reach:.3g} {z + 0.45 * reach:.3g}"'
            ' xyaxes="-0.673 0.740 0 -0.214 -0.195 0.957" fovy="42"/>',
            f'  <camera name="side" pos="{x:.3g} {y + 1.75 * reach:.3g} {z:.3g}" xyaxes="-1 0 0 0 0 1" fovy="36"/>',
            *body,
            "  </worldbody>",
            "</mujoco>",
            "",
        ])  # fmt: skip

    def _view(self) -> tuple[np.ndarray, float]:
        poses = joint_poses(self.design.tree, self.design.home)
        places = [origin for _, origin in poses.values()]
        places += [poses[link.name][1] + poses[link.name][0] @ link.end for link in self.design.tree.links.values()]
        places += [place + [0, 0, self.design.length * 0.2] for place in places] + [
            np.array([-self.design.length * 0.4, 0, 0])
        ]
        cloud = np.array(places)
        low, high = cloud.min(axis=0), cloud.max(axis=0)
        return 0.5 * (low + high), max(1.15 * float((high - low).max()), 0.5)

    def _body_lines(self, link: MovingLink, indent: str) -> list[str]:
        inner = indent + " "
        axis = " ".join(f"{round(float(value), 6) + 0.0:g}" for value in link.axis)
        lines = [f'{indent}<body name="{link.name}" childclass="visual">']
        lines += [f'{inner}<joint name="{link.joint}" type="{link.kind}" axis="{axis}"/>']
        visuals = link.visuals or self._drawn_link(link)
        lines += self._shape_lines(link.name, visuals, _YELLOW, inner)
        lines += self._hull_lines(link.name, link.collisions or visuals, inner)
        lines += self._pin_lines(link.name, inner)
        for other in self.design.tree.links.values():
            if other.parent == link.name:
                lines += self._body_lines(other, inner)
        lines += self._cylinder_bodies(link.name, inner)
        return [*lines, f"{indent}</body>"]

    def _shape_lines(self, name: str, shapes: list[Shape], colour, indent: str) -> list[str]:
        lines = []
        for number, shape in enumerate(shapes):
            rgba = " ".join(f"{value:.3g}" for value in (shape.rgba or colour))
            if shape.kind == "mesh":
                mesh = f"{name}_{number}"
                self._write_mesh(mesh, shape.points(), shape.faces, ' inertia="shell"')
                lines.append(f'{indent}<geom type="mesh" mesh="{mesh}" rgba="{rgba}"/>')
            else:
                count = {"box": 3, "sphere": 1}.get(shape.kind, 2)
                size = " ".join(f"{max(value, 1e-4):.5g}" for value in shape.size[:count])
                lines.append(
                    f'{indent}<geom type="{shape.kind}" size="{size}" pos="{_join_numbers(shape.position)}"'
                    f' quat="{_quaternion(shape.rotation)}" rgba="{rgba}"/>'
                )
        return lines

    def _hull_lines(self, name: str, shapes: list[Shape], indent: str) -> list[str]:
        """Return one collision geom for each shape, a mesh by its convex hull."""
        lines, points = [], []
        for shape in shapes:
            points.append(shape.points())
        solid = convex_solid(np.vstack(points)) if points else None
        if solid is not None:
            vertices, faces = solid.vertices, solid.faces
            if len(vertices) > _MAX_HULL_POINTS:
                vertices = vertices[:: math.ceil(len(vertices) / _MAX_HULL_POINTS)]
                smaller = convex_solid(vertices)
                vertices, faces = (smaller.vertices, smaller.faces) if smaller else (solid.vertices, solid.faces)
            self._write_mesh(f"{name}_hull", vertices, faces, "")
            lines.append(f'{indent}<geom name="{name}_hull" class="collision" type="mesh" mesh="{name}_hull"/>')
        return lines

    def _write_mesh(self, mesh: str, vertices: np.ndarray, faces: np.ndarray, extra: str) -> None:
        (self.folder / "meshes").mkdir(exist_ok=True)
        write_stl(self.folder / "meshes" / f"{mesh}.stl", vertices, faces)
        self.assets.append(f'    <mesh name="{mesh}" file="meshes/{mesh}.stl"{extra}/>')

    def _drawn_base(self) -> list[Shape]:
        """Return a block from the ground to the first joint, for a base without shapes."""
        first = next(link for link in self.design.tree.links.values() if link.parent == "world")
        top, size = max(float(first.position[2]), 0.05), 0.22 * self.design.length
        half = (1.2 * size, size, 0.5 * top)
        return [Shape("box", half, position=np.array([first.position[0], first.position[1], 0.5 * top]), rgba=())]

    def _drawn_link(self, link: MovingLink) -> list[Shape]:
        """Return bars from a link's joint to its end, to the next joints and to the pins on it."""
        length = self.design.length
        ends = [link.end] if link.length > 0.02 * length else []
        for other in self.design.tree.links.values():
            if other.parent == link.name:
                ends.append(other.position)
        pins = self._pins(link.name)
        shapes = [_bar(np.zeros(3), end, 0.035 * length) for end in ends if np.linalg.norm(end) > 0.02 * length]
        shapes += [_bar(np.zeros(3), pin, 0.02 * length) for pin, _ in pins if np.linalg.norm(pin) > 0.04 * length]
        if link.kind == "slide" and link.range:
            back = -(link.range[1] - link.range[0] + 0.1 * length) * link.axis
            shapes.append(_bar(back, np.zeros(3), 0.025 * length))
        if link.role == "swing":
            half = (0.3 * length, 0.2 * length, 0.08 * length)
            shapes.append(Shape("box", half, position=np.array([-0.15 * length, 0.0, 0.09 * length]), rgba=()))
        if not shapes:
            shapes = [Shape("sphere", (0.04 * length, 0.0, 0.0), rgba=())]
        return shapes

    def _pins(self, name: str) -> list[tuple[np.ndarray, float]]:
        """Return the pins of cylinders on a link with half the width over all of the cylinders there."""
        found = []
        for link in self.design.driven_links():
            drive = self.design.drives[link.joint]
            if drive.cylinder is None:
                continue
            wide = self._side_offset(link, drive) + 0.7 * bore_diameter(drive)
            if drive.cylinder.base_link == name:
                found.append((drive.cylinder.base_pin, wide))
            if drive.cylinder.rod_link == name:
                found.append((drive.cylinder.rod_pin, wide))
            if drive.four_bar and drive.cylinder.base_link == name:
                found.append((drive.four_bar.rocker_pivot, wide))
            if drive.four_bar and link.name == name:
                found.append((drive.four_bar.tool_pin, wide))
        return found

    def _pin_lines(self, name: str, indent: str) -> list[str]:
        """Return pins, and lugs from a pin to the nearest shape of the link if the pin is outside it."""
        lines = []
        links = self.design.tree.links
        shapes = links[name].visuals if name in links else self.design.tree.base_visuals
        for pin, wide in self._pins(name):
            radius = 0.012 * self.design.length
            side = np.array([0.0, wide, 0.0])
            lines.append(_capsule(pin - side, pin + side, 0.6 * radius, _DARK, indent))
            cloud = np.vstack([shape.points() for shape in shapes]) if shapes else np.zeros((0, 3))
            if not len(cloud):
                continue
            solid = convex_solid(cloud)
            near = cloud[np.argmin(np.linalg.norm((cloud - pin) * [1.0, 0.5, 1.0], axis=1))]
            gap = float(np.linalg.norm((near - pin)[[0, 2]]))
            if solid is not None and gap > 1.5 * radius:
                inward = near + 0.1 * (solid.centre - near)
                lines.append(_capsule(pin, np.array([inward[0], pin[1], inward[2]]), 1.6 * radius, _YELLOW, indent))
        return lines

    def _side_offset(self, link: MovingLink, drive: Drive) -> float:
        """Return the distance of a pair of cylinders from the middle plane: just outside the link's sides."""
        if drive.count == 1 or drive.cylinder is None:
            return 0.0
        radius = 0.5 * _TUBE_RATIO * bore_diameter(drive)
        points = [shape.points() for shape in link.visuals]
        if not points:
            return 0.035 * self.design.length + 1.3 * radius
        cloud = np.vstack(points)
        near = cloud[np.linalg.norm((cloud - drive.cylinder.rod_pin)[:, [0, 2]], axis=1) < 0.12 * self.design.length]
        wide = float(np.abs(near[:, 1]).max()) if len(near) else 0.035 * self.design.length
        return min(wide, 0.1 * self.design.length) + 1.3 * radius

    def _cylinder_bodies(self, name: str, indent: str) -> list[str]:
        """Return tube and rod bodies of the cylinders with their base pin on a link, and four-bars."""
        lines = []
        for link in self.design.driven_links():
            drive = self.design.drives[link.joint]
            cylinder = drive.cylinder
            if cylinder is None or cylinder.base_link != name:
                continue
            radius = 0.5 * _TUBE_RATIO * bore_diameter(drive)
            rod, offset = 0.5 * _ROD_RATIO * bore_diameter(drive), self._side_offset(link, drive)
            sides = (-offset, offset) if drive.count > 1 else (0.0,)
            joint, inner = link.joint, indent + " "
            axis = "0 -1 0" if link.kind == "slide" else " ".join(f"{round(float(v), 6) + 0.0:g}" for v in link.axis)
            closed = cylinder.closed_length
            lines += [f'{indent}<body name="{joint}_tube" childclass="visual">']
            lines += [f'{inner}<joint name="{joint}_tube" type="hinge" axis="{axis}"/>']
            for y in sides:
                start, stop = np.array([0.0, y, 0.0]), np.array([0.92 * closed, y, 0.0])
                lines += [_cylinder(start, stop, radius, _YELLOW, inner)]
                lines += [_cylinder(stop - [0.06 * closed, 0, 0], stop, 1.12 * radius, _DARK, inner)]
                lines += [
                    _cylinder(start - [0, 1.1 * radius, 0], start + [0, 1.1 * radius, 0], 1.15 * radius, _DARK, inner)
                ]
            lines += [
                f'{inner}<body name="{joint}_rod">',
                f'{inner} <joint name="{joint}_rod" type="slide" axis="1 0 0"/>',
            ]
            for y in sides:
                eye = np.array([0.0, y, 0.0])
                lines += [_cylinder(eye - [cylinder.stroke + 0.05 * closed, 0, 0], eye, rod, _CHROME, inner + " ")]
                lines += [_cylinder(eye - [0, 1.1 * radius, 0], eye + [0, 1.1 * radius, 0], radius, _DARK, inner + " ")]
            lines += [f"{inner}</body>", f"{indent}</body>"]
            if drive.four_bar:
                lines += self._four_bar_bodies(joint, drive, axis, indent)
        return lines

    def _four_bar_bodies(self, joint: str, drive: Drive, axis: str, indent: str) -> list[str]:
        four_bar = drive.four_bar
        assert four_bar
        wide, inner, thick = 0.9 * bore_diameter(drive), indent + " ", 0.4 * bore_diameter(drive)
        lines = [f'{indent}<body name="{joint}_rocker" childclass="visual">']
        lines += [f'{inner}<joint name="{joint}_rocker" type="hinge" axis="{axis}"/>']
        for y in (-wide, wide):
            lines += [_capsule(np.array([0, y, 0]), four_bar.coupler_pin + [0, y, 0], thick, _YELLOW, inner)]
        lines += [
            f'{inner}<body name="{joint}_coupler">',
            f'{inner} <joint name="{joint}_coupler" type="hinge" axis="{axis}"/>',
        ]
        end = np.array([four_bar.coupler_length, 0.0, 0.0])
        lines += [
            _capsule(np.array([0, y, 0.0]), end + [0, y, 0], 0.9 * thick, _DARK, inner + " ")
            for y in (-0.5 * wide, 0.5 * wide)
        ]
        return [*lines, f"{inner}</body>", f"{indent}</body>"]


def _bar(start: np.ndarray, stop: np.ndarray, half: float) -> Shape:
    """Return a square bar between two points, of a half width [m]."""
    way = stop - start
    length = float(np.linalg.norm(way))
    x = way / length
    y = np.cross([0.0, 0.0, 1.0] if abs(x[2]) < 0.9 else [1.0, 0.0, 0.0], x)
    y /= np.linalg.norm(y)
    rotation = np.column_stack([x, y, np.cross(x, y)])
    return Shape("box", (0.5 * length, half, half), rotation, 0.5 * (start + stop), ())


def _geom(kind: str, start, stop, radius: float, rgba, indent: str) -> str:
    colour = " ".join(f"{value:.3g}" for value in rgba)
    ends = f"{_join_numbers(start)} {_join_numbers(stop)}"
    return f'{indent}<geom type="{kind}" size="{radius:.4g}" fromto="{ends}" rgba="{colour}"/>'


def _capsule(start, stop, radius: float, rgba, indent: str) -> str:
    return _geom("capsule", start, stop, radius, rgba, indent)


def _cylinder(start, stop, radius: float, rgba, indent: str) -> str:
    return _geom("cylinder", start, stop, radius, rgba, indent)


def _join_numbers(values) -> str:
    return " ".join(f"{round(float(value), 5) + 0.0:g}" for value in values)


def _quaternion(rotation: np.ndarray) -> str:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return f"{w:.6g} {x:.6g} {y:.6g} {z:.6g}"
