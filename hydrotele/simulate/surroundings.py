"""What stands around a machine, in MuJoCo: plates on springs, trees that can be felled.

A tree stands on stiff springs in its own joints, which are cut with it. The saw cuts while it
spins: then it passes through wood, which costs it torque and the head a little feed force. A grab
that has closed around the stem holds it by a weld, since friction of wood on steel is not the point
here; from then on the stem touches the ground only.
"""

import math

import mujoco
import numpy as np

from hydrotele.datafile import suggest
from hydrotele.errors import InputError
from hydrotele.machine import Machine
from hydrotele.surroundings import Plate, Thing, Tree

_PLATE_SOLREF = (0.01, 1.0)  # s, 1: firm steel on steel, stiffer than any plate's spring
_GAP = 0.02  # m, the kerf
_GRAVITY = 9.81
_ROOT, _ROOT_TURN = 4.0e6, 6.0e5  # N/m, N m/rad of a root
_CUTTING = 30.0  # rad/s: slower, a saw does not cut
_HIGH = 0.15  # m by which the saw may miss the height of the kerf
_NORMALS = {"x": (1, 0, 0), "-x": (-1, 0, 0), "y": (0, 1, 0), "-y": (0, -1, 0), "z": (0, 0, 1)}
_RIM = 0.3  # feed force per rim force


def write_surroundings(root, machine: Machine, things: tuple[Thing, ...]) -> None:
    """Add what stands around to an assembled MJCF.

    Args:
        root: the MJCF document of the machine.
        machine: the machine.
        things: plates and trees.

    Raises:
        InputError: a tree's machine has no such saw or grab.
    """
    degrees = 180.0 / math.pi if root.compiler.angle == "degree" else 1.0
    for number, thing in enumerate(things):
        where = f"surroundings.{number}"
        if isinstance(thing, Plate):
            _write_plate(root, f"plate_{number}", thing)
        else:
            _write_tree(root, f"tree_{number}", thing, machine, where, degrees)


def _write_plate(root, name: str, plate: Plate) -> None:
    normal, thick = np.array(_NORMALS[plate.normal], float), 0.05
    middle = np.array(plate.position) - thick * normal
    body = root.worldbody.add("body", name=name, pos=middle)
    a, b = plate.size
    sides = {2: (a, b, thick), 0: (thick, a, b), 1: (a, thick, b)}[int(np.abs(normal).argmax())]
    body.add("inertial", mass=plate.mass, pos=(0, 0, 0), diaginertia=[plate.mass] * 3)
    body.add(
        "joint", name=name, type="slide", axis=normal, stiffness=plate.stiffness,
        damping=plate.damping, limited="false",
    )  # fmt: skip
    body.gravcomp = 1.0
    body.add(
        "geom", name=name, type="box", size=sides, contype=1, conaffinity=2, mass=0,
        solref=_PLATE_SOLREF, priority=2, rgba=(0.42, 0.44, 0.47, 1),
    )  # fmt: skip


def _write_tree(root, name: str, tree: Tree, machine: Machine, where: str, degrees) -> None:
    for part in ("saw", "grab"):
        if getattr(tree, part) not in machine.axes:
            axis = getattr(tree, part)
            message = f"the machine has no axis {axis!r}; {suggest(axis, machine.axes)}"
            raise InputError(f"{where}.{part}", message)
    x, y = tree.position
    radius, half = tree.diameter / 2.0, tree.height / 2.0
    mass = tree.density * math.pi * radius**2 * tree.height
    bark = {"rgba": (0.36, 0.27, 0.18, 1), "mass": 0}
    root.worldbody.add(
        "geom", name=f"{name}_stump", type="cylinder", size=(radius * 1.05, tree.kerf / 2.0),
        pos=(x, y, tree.kerf / 2.0), contype=1, conaffinity=2, **bark,
    )  # fmt: skip
    body = root.worldbody.add("body", name=name, pos=(x, y, tree.kerf + _GAP))
    across = mass * (3.0 * radius**2 + tree.height**2) / 12.0
    body.add(
        "inertial", mass=mass, pos=(0, 0, half), diaginertia=(across, across, mass * radius**2 / 2)
    )
    for axis, way in zip("xyz", np.eye(3), strict=True):
        sag = mass * _GRAVITY / _ROOT if axis == "z" else 0.0  # its root holds it where it stands
        body.add(
            "joint", name=f"{name}_{axis}", type="slide", axis=way, stiffness=_ROOT,
            damping=0.05 * _ROOT, limited="false", springref=sag,
        )  # fmt: skip
    body.add(
        "joint", name=f"{name}_turn", type="ball", stiffness=_ROOT_TURN, damping=0.05 * _ROOT_TURN,
        limited="false",
    )  # fmt: skip
    body.add(
        "geom", name=name, type="capsule", size=(radius, half - radius), pos=(0, 0, half),
        contype=3, conaffinity=3, **bark,
    )  # fmt: skip
    body.add(
        "geom", name=f"{name}_crown", type="ellipsoid", size=(0.9, 0.9, 0.28 * tree.height),
        pos=(0, 0, 0.86 * tree.height), contype=0, conaffinity=0, mass=0,
        rgba=(0.16, 0.33, 0.15, 1),
    )  # fmt: skip
    head = machine.links[machine.link_of(machine.axes[tree.grab].joint)].parent
    root.equality.add(
        "weld", name=f"{name}_held", body1=head, body2=name, active=False,
        solref=(0.01, 1.0), solimp=(0.99, 0.999, 0.001, 0.5, 2),
    )  # fmt: skip


def thing_joints(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """(joint, its place in `qpos`) of plates and trees."""
    return [
        (j, int(model.jnt_qposadr[j]))
        for j in range(model.njnt)
        if model.joint(j).name.startswith(("plate_", "tree_"))
    ]


class Surroundings:
    """Trees of a run while they are cut, held and laid down; plates need nothing.

    Attributes:
        events: (time [s], what happened).
    """

    def __init__(self, machine: Machine, model: mujoco.MjModel, things: tuple[Thing, ...]) -> None:
        """Look up what is where.

        Args:
            machine: the machine.
            model: its MuJoCo model, with these surroundings.
            things: the scenario's.
        """
        self.events: list[tuple[float, str]] = []
        self._model = model
        self._trees = [
            _Standing(machine, model, f"tree_{n}", thing)
            for n, thing in enumerate(things)
            if isinstance(thing, Tree)
        ]

    def update(self, time: float, data: mujoco.MjData, period: float) -> None:
        """Saw and hold, once per control period.

        Args:
            time: now [s].
            data: the plant's state; applied forces and the welds are written.
            period: since the last time [s].
        """
        for tree in self._trees:
            self.events += [(time, said) for said in tree.update(data, period)]

    def restore(self) -> None:
        """Plant felled trees again: the model is as it was before the run."""
        for tree in self._trees:
            tree.plant()


class _Standing:
    """One tree of a run."""

    def __init__(self, machine: Machine, model: mujoco.MjModel, name: str, tree: Tree) -> None:
        self._model, self._tree, self.name = model, tree, name
        saw = machine.link_of(machine.axes[tree.saw].joint)
        head = machine.links[machine.link_of(machine.axes[tree.grab].joint)].parent
        self._saw, self._head = model.body(saw).id, model.body(head).id
        self._spin = model.joint(machine.axes[tree.saw].joint).dofadr[0]
        self._close = model.joint(machine.axes[tree.grab].joint).qposadr[0]
        self._body, self._weld = model.body(name).id, model.equality(f"{name}_held").id
        self._stem = model.geom(name).id
        disc = [g for g in range(model.ngeom) if model.geom_bodyid[g] == self._saw
                and model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CYLINDER]  # fmt: skip
        solid = [g for g in disc if model.geom_contype[g]] or disc
        if not solid:
            raise InputError(f"axis {tree.saw}", "its link has no disc (a cylinder) to cut with")
        self._disc, self._radius = solid[0], float(model.geom_size[solid[0], 0])
        joints = [model.joint(f"{name}_{part}") for part in ("x", "y", "z", "turn")]
        self._joints = np.array([j.id for j in joints])
        self._dofs = np.arange(joints[0].dofadr[0], joints[0].dofadr[0] + 6)
        self._solid = (model.geom_contype[self._disc], model.geom_conaffinity[self._disc])
        self._stiffness = model.jnt_stiffness[self._joints].copy()
        self._damping = model.dof_damping[self._dofs].copy()
        self.depth, self.cut, self.held = 0.0, False, False

    def plant(self) -> None:
        """Undo what cutting did to the model."""
        self._model.jnt_stiffness[self._joints] = self._stiffness
        self._model.dof_damping[self._dofs] = self._damping
        self._touch(True)
        self._model.geom_contype[self._stem] = self._model.geom_conaffinity[self._stem] = 3

    def _touch(self, on: bool) -> None:
        model = self._model
        model.geom_contype[self._disc], model.geom_conaffinity[self._disc] = (
            self._solid if on else (0, 0)
        )

    def update(self, data: mujoco.MjData, period: float) -> list[str]:
        """Go on with sawing and holding; what has just happened."""
        said: list[str] = []
        spin = abs(float(data.qvel[self._spin]))
        data.xfrc_applied[self._saw] = 0.0
        self._touch(spin < _CUTTING)
        if not self.cut and spin >= _CUTTING:
            self._saw_on(data, period, spin)
            if self.depth >= 0.98 * self._tree.diameter:
                self._fell()
                said.append("the tree is cut")
        closed = float(data.qpos[self._close]) >= self._tree.closed
        if not self.held and closed and self._in_pocket(data):
            self._hold(data)
            said.append("the grab holds the tree")
        if self.held and not closed:
            data.eq_active[self._weld] = 0
            self.held = False
            said.append("the grab lets the tree go")
        return said

    def _saw_on(self, data: mujoco.MjData, period: float, spin: float) -> None:
        """Deepen the cut to where the disc's edge is; wood costs torque and feed force."""
        stem, saw = data.xpos[self._body], data.xpos[self._saw]
        axis = data.xmat[self._saw].reshape(3, 3)[:, 2]
        height = saw[2] - (axis[:2] @ (stem[:2] - saw[:2])) / max(abs(axis[2]), 0.3)
        if abs(height - self._tree.kerf) > _HIGH:
            return
        way = stem[:2] - saw[:2]
        far = float(np.hypot(*way))
        if abs(float(saw[2]) - self._tree.kerf) > 2.0 * _HIGH + self._radius:
            return
        reach = self._radius - (far - self._tree.diameter / 2.0)
        fresh = min(reach, self._tree.diameter) - self.depth
        if fresh <= 0.0:
            return
        self.depth += fresh
        radius = self._tree.diameter / 2.0
        chord = 2.0 * math.sqrt(max(radius**2 - (radius - self.depth) ** 2, 0.0))
        power = self._tree.energy * _GAP * chord * fresh / period
        torque = power / spin
        direction = -math.copysign(1.0, float(data.qvel[self._spin]))
        feed = _RIM * torque / self._radius
        data.xfrc_applied[self._saw, :2] = -feed * way / max(far, 1e-9)
        data.xfrc_applied[self._saw, 3:] = direction * torque * axis

    def _fell(self) -> None:
        self._model.jnt_stiffness[self._joints] = 0.0
        self._model.dof_damping[self._dofs] = (5.0, 5.0, 5.0, 50.0, 50.0, 50.0)
        self.cut = True

    def _in_pocket(self, data: mujoco.MjData) -> bool:
        """Whether the stem stands in front of the head, between its arms."""
        turn = data.xmat[self._head].reshape(3, 3)
        stem = data.xmat[self._body].reshape(3, 3)[:, 2]
        foot = turn.T @ (data.xpos[self._body] - data.xpos[self._head])
        way = turn.T @ stem
        if abs(way[2]) < 0.9:
            return False
        level = foot + way * (-0.62 - foot[2]) / way[2]
        return bool(0.0 < level[0] < 0.65 and abs(level[1]) < 0.35)

    def _hold(self, data: mujoco.MjData) -> None:
        """Weld the stem to the head as it stands."""
        head, stem = self._head, self._body
        turn = data.xmat[head].reshape(3, 3)
        inverse, relative = np.zeros(4), np.zeros(4)
        mujoco.mju_negQuat(inverse, data.xquat[head])
        mujoco.mju_mulQuat(relative, inverse, data.xquat[stem])
        row = self._model.eq_data[self._weld]
        row[:3] = 0.0
        row[3:6] = turn.T @ (data.xpos[stem] - data.xpos[head])
        row[6:10] = relative
        row[10] = 1.0
        data.eq_active[self._weld] = 1
        self._model.geom_contype[self._stem] = 2  # the ground only: head and stem are one
        self._model.geom_conaffinity[self._stem] = 1
        self.held = True
