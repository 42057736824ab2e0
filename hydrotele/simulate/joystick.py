"""The joystick's flotor in MuJoCo: coils push it, stops hold it, a hand or a cab may shake it.

The cab's frame is not inertial: its acceleration counts against gravity, and its turning acts on
the flotor as force and torque. Coils are warmed by their currents, and push less where the field of
their magnets falls off towards the ends of the gap.

Steps are those of a leapfrog: places at the steps, velocities half a step before, and what changes
between two control periods acts at the mean of before and after in the step between them; damping
counts half by the velocity before a step and half by that after it. Places are then exact to the
second order of the step, and a held force moves a free body exactly. The same steps without that
mean run half a step ahead, as if the control sampled faster than it does.
"""

import math
from pathlib import Path

import mujoco
import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_xml
from hydrotele.machine.joystick import Joystick, principal

GRAVITY = -9.81
_COOL = 0.9  # heat below which hot coils may have their largest current again
_STEPS = 2  # physics steps per control period of 5 ms: its stiffest spring turns over in 30 ms
_HALVES = 15  # currents, applied forces and gravity, which change between periods


class SimulatedFlotor:
    """The simulated joystick.

    Attributes:
        model: its MuJoCo model; coils are its actuators [A].
        data: its state; `qpos` (7,) handle [m] and quaternion, `qvel` (6,) [m/s] in the stator's
            axes and [rad/s] in the flotor's: of now before the first step, then of half a step
            earlier.
        hand: whether a hand holds the handle.
        heat: (6,) of the coils, see `heat_step`.
        hottest: the most that any of them has had.
        allowed: current that the coils may have now [A]: the largest, or, once one of them is hot
            and until it has cooled down, the one that they bear for ever.
    """

    def __init__(
        self, facts: Joystick, *, hand: bool = True, period: float | None = None, fine: int = 1,
        runge_kutta: bool = False,
    ) -> None:  # fmt: skip
        """Compile the joystick.

        Args:
            facts: the joystick.
            hand: whether a hand holds it.
            period: of the control [s]; the joystick's own by default.
            fine: how many times as many physics steps as for runs with a machine.
            runge_kutta: fourth-order steps of four times the cost, for motion without stops.

        Raises:
            InputError: its MJCF cannot be read or lacks a part.
        """
        self.facts, self.hand = facts, hand
        self.period = period or 1.0 / facts.control_rate
        steps = max(_STEPS, math.ceil(_STEPS * self.period * facts.control_rate - 1e-9))
        self.steps = fine * steps
        spec = joystick_spec(facts, hand)
        spec.compiler.discardvisual = True
        spec.compiler.fusestatic = True
        spec.option.timestep = self.period / self.steps
        self.model = spec.compile()
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
        self.data = mujoco.MjData(self.model)
        body = self.model.body("flotor")
        self._mass, self._com = float(body.mass[0]), body.ipos.copy()
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, body.iquat)
        turn = turn.reshape(3, 3)
        self._inertia = turn @ np.diag(body.inertia) @ turn.T
        self._inertia += self._mass * (self._com @ self._com * np.eye(3))
        self._inertia -= self._mass * np.outer(self._com, self._com)
        self._gravity = self.model.opt.gravity  # views, which cost time to ask for
        self._gravity[:] = (0.0, 0.0, GRAVITY)
        self._ctrl, self._applied = self.data.ctrl, self.data.qfrc_applied
        self._leaps, self._started, self._before = not runge_kutta, False, np.zeros((2, _HALVES))
        self._speed, self._half_damping = self.data.qvel, 0.5 * _damping(self.model)
        if runge_kutta:
            self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        else:  # MuJoCo counts it by the velocity after a step
            self.model.dof_damping *= 0.5
            self.model.tendon_damping *= 0.5
            if self.model.ntendon:  # its Euler steps do so for joints only
                self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.heat, self.hottest, self.allowed = np.zeros(6), 0.0, facts.coils.max_current
        self._gear, self._full = self.model.actuator_gear, self.model.actuator_gear.copy()
        places = self.model.site_pos[self.model.actuator_trnid[:, 0]]
        self._spots = places + np.array(
            facts.flotor.handle
        )  # from the flotor's to the coils' frame

    def step(self, currents: np.ndarray, muscles: np.ndarray) -> None:
        """Go on by one control period with held currents (6,) [A] and muscle forces (6,) [N, N m].

        Muscles act on the handle: force along the stator's axes, torque about them.
        """
        self._load_coils(currents)
        self._applied[:] = muscles
        self._advance()

    def shaken_step(
        self, currents: np.ndarray, muscles: np.ndarray, mount: np.ndarray, spin: float,
        spin_rate: float,
    ) -> None:  # fmt: skip
        """Like `step`, in a cab that turns about a vertical axis.

        Args:
            currents: (6,) [A].
            muscles: (6,) [N, N m].
            mount: (3,) where the joystick stands, from the cab's axis [m].
            spin: turning of the cab [rad/s].
            spin_rate: its rate [rad/s^2].
        """
        _shake(
            self._mass, self._com, self._inertia, mount, spin, spin_rate, muscles,
            self._gravity, self._applied,
        )  # fmt: skip
        self._load_coils(currents)
        self._advance()

    def _advance(self) -> None:
        """The steps of one period with what has been loaded."""
        model, data, before = self.model, self.data, self._before
        if not self._leaps:
            mujoco.mj_step(model, data, nstep=self.steps)
            return
        inputs = self._ctrl, self._applied, self._gravity
        _keep(*inputs, before)
        if not self._started:
            self._started = True
            before[0] = before[1]
            _load(*inputs, before, self._half_damping, self._speed, 0.0)
            mujoco.mj_forward(model, data)
            self._speed -= 0.5 * model.opt.timestep * data.qacc
        for k in range(self.steps):
            _load(*inputs, before, self._half_damping, self._speed, 0.0 if k else 0.5)
            mujoco.mj_step(model, data)

    def _load_coils(self, currents: np.ndarray) -> None:
        """Put currents on the coils, warm them, and weaken those that leave their field."""
        self._ctrl[:] = currents
        c = self.facts.coils
        hot = heat_step(self.heat, currents, c.continuous_current, c.thermal_time, self.period)
        self.hottest = max(self.hottest, hot)
        if hot >= 1.0:
            self.allowed = min(c.max_current, c.continuous_current)
        elif hot < _COOL:
            self.allowed = c.max_current
        if c.edge_loss > 0.0:
            turn, handle = np.empty(9), np.array(self.facts.flotor.handle)
            mujoco.mju_quat2Mat(turn, self.data.qpos[3:7])
            turn = turn.reshape(3, 3)
            place = self.data.qpos[:3] + handle - turn @ handle
            gap = self.facts.workspace.translation
            shares = field_shares(self._spots, place, turn, gap, c.edge_loss)
            self._gear[:] = self._full * shares[:, None]

    def place(self, pose: np.ndarray) -> None:
        """Put the handle to a pose at rest, (6,) displacement [m] and rotation vector [rad]."""
        mujoco.mj_resetData(self.model, self.data)
        self._started = False
        self.data.qpos[:3] = pose[:3]
        angle = float(np.linalg.norm(pose[3:]))
        way = pose[3:] / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])
        mujoco.mju_axisAngle2Quat(self.data.qpos[3:7], way, angle)


def _damping(model: mujoco.MjModel) -> np.ndarray:
    """(nv, nv) of joints and fixed tendons."""
    found, way = np.diag(model.dof_damping), np.zeros((model.ntendon, model.nv))
    for k in range(model.ntendon):
        at, many = model.tendon_adr[k], model.tendon_num[k]
        dofs = model.jnt_dofadr[model.wrap_objid[at : at + many]]
        way[k, dofs] = model.wrap_prm[at : at + many]
    return found + way.T @ np.diag(model.tendon_damping) @ way


@compiled
def _keep(ctrl, applied, gravity, before):
    """Put a period's inputs into the second row of `before` (2, 15), and what was there above."""
    at = 0
    for part in (ctrl, applied, gravity):
        for i in range(len(part)):
            before[0, at], before[1, at] = before[1, at], part[i]
            at += 1


@compiled
def _load(ctrl, applied, gravity, before, half_damping, speed, share):
    """Inputs of a step: this period's with a `share` of the last one's; half of the damping."""
    at = 0
    for part in (ctrl, applied, gravity):
        for i in range(len(part)):
            part[i] = share * before[0, at] + (1.0 - share) * before[1, at]
            at += 1
    for i in range(len(applied)):
        for k in range(len(speed)):
            applied[i] -= half_damping[i, k] * speed[k]


@compiled
def heat_step(heat, currents, continuous, time_constant, period):
    """Warm coils over a period of held currents.

    `heat' = ((I / I_c)^2 - heat) / T`, by its exact exponential: one thermal capacity that the
    copper loss I^2 R warms, at 1 where the continuous current leaves it in the end.

    Args:
        heat: (6,) temperature rise over that of the continuous current [1], written.
        currents: (6,) [A].
        continuous: I_c, scalar [A].
        time_constant: T of the winding, scalar [s].
        period: scalar [s].

    Returns:
        The largest heat, scalar [1].

    Source: copper loss and one thermal capacity (I^2 t rating of motors).
    """
    share, hot = -np.expm1(-period / time_constant), 0.0
    for i in range(len(heat)):
        heat[i] += share * ((currents[i] / continuous) ** 2 - heat[i])
        hot = max(hot, heat[i])
    return hot


def field_shares(
    spots: np.ndarray, place: np.ndarray, turn: np.ndarray, gap: float, edge_loss: float
) -> np.ndarray:
    """Share of its force per ampere that every coil has in a pose of the flotor.

    `1 - edge_loss (d / gap)^2`, with the displacement d of the coil's centre from its nominal
    place: even about the middle of the gap, as symmetric magnets make it.

    Args:
        spots: (6, 3) centres of the coils in their frame [m].
        place: (3,) of the coils' frame from its nominal place [m].
        turn: (3, 3) flotor to stator.
        gap: displacement at which a coil has lost `edge_loss` [m].
        edge_loss: share of the force that is lost there [1].

    Returns:
        (6,), at least 0.
    """
    moved = place + spots @ turn.T - spots
    return np.maximum(0.0, 1.0 - edge_loss * np.sum(moved**2, axis=1) / gap**2)


@compiled
def _shake(mass, com, inertia, mount, w, a, muscles, gravity, out):
    """Gravity as it is felt at the mount, and the forces on a body in a frame that turns."""
    gravity[0] = w * w * mount[0] + a * mount[1]
    gravity[1] = w * w * mount[1] - a * mount[0]
    gravity[2] = GRAVITY
    out[0] = muscles[0] + mass * (a * com[1] + w * w * com[0])
    out[1] = muscles[1] + mass * (-a * com[0] + w * w * com[1])
    out[2] = muscles[2]
    out[3] = muscles[3] - inertia[0, 2] * a + w * w * inertia[1, 2]
    out[4] = muscles[4] - inertia[1, 2] * a - w * w * inertia[0, 2]
    out[5] = muscles[5] - inertia[2, 2] * a


def joystick_spec(facts: Joystick, hand: bool = True) -> mujoco.MjSpec:
    """The joystick's MJCF with the numbers of its facts.

    Args:
        facts: the joystick.
        hand: whether a hand holds it: its mass on the handle, its spring and damper to the centre.

    Returns:
        The spec, looks included.

    Raises:
        InputError: the MJCF cannot be read or lacks a part.
    """
    path = Path(facts.folder, facts.mjcf)
    try:
        read_xml(path)
        spec = mujoco.MjSpec.from_file(str(path))
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(path, f"cannot be read: {error}") from None
    flotor, grip = spec.body("flotor"), spec.body("hand")
    coils, joints = spec.body("coils"), {j.name: j for j in spec.joints}
    if not (flotor and grip and coils and {"x", "y", "z", "turn"} <= set(joints)):
        raise InputError(path, "needs bodies flotor, hand and coils, joints x, y, z and turn")
    facts_flotor = facts.flotor
    flotor.mass, flotor.inertia = facts_flotor.mass, facts_flotor.inertia
    flotor.ipos = np.subtract(facts_flotor.com, facts_flotor.handle)
    coils.pos = np.negative(facts_flotor.handle)
    degrees = 180.0 / math.pi if spec.compiler.degree else 1.0
    _place_stops(spec, facts, path)
    joints["turn"].range = (0.0, degrees * facts.workspace.rotation)
    for actuator in spec.actuators:
        actuator.ctrlrange = (-facts.coils.max_current, facts.coils.max_current)
        actuator.gear = np.sign(actuator.gear) * facts.coils.force_per_ampere
    for k in range(6):
        place, turn = spec.site(f"coil_{k + 1}"), 2.0 * math.pi * (k % 3) / 3.0
        place.pos = facts.coils.radius * np.array([math.cos(turn), math.sin(turn), 0.0])
    if hand and facts.hand.mass > 0.0:
        grip.mass = facts.hand.carried
    else:
        spec.delete(grip)
    if hand:
        _hold(spec, joints, facts)
    return spec


def _place_stops(spec: mujoco.MjSpec, facts: Joystick, path: Path) -> None:
    """Put the six walls where the ball at the coils' centre has gone through the gap."""
    ball, far = spec.geom("gap"), facts.workspace.translation
    walls = {f"gap_{axis}_{side}": (i, way) for i, axis in enumerate("xyz")
              for side, way in (("low", -1.0), ("high", 1.0))}  # fmt: skip
    missing = [name for name in walls if spec.geom(name) is None]
    if ball is None or missing:
        names = ", ".join(["gap"] * (ball is None) + missing)
        raise InputError(path, f"has no geoms {names}, which are the stops at the coils")
    for name, (axis, way) in walls.items():
        spec.geom(name).pos = np.negative(facts.flotor.handle)
        spec.geom(name).pos[axis] += way * (far + ball.size[0] + spec.geom(name).size[axis])


def _hold(spec: mujoco.MjSpec, joints, facts: Joystick) -> None:
    """Springs and dampers of the arm, and its mass beyond what hangs on the handle.

    In the horizontal plane the short axes of its ellipses are on the slides; what the long axes
    have more is on tendons along them, which add their stiffness, damping and armature.
    """
    hand = facts.hand
    for name in ("x", "y", "z", "turn"):
        turns = name == "turn"
        joints[name].stiffness[0] = hand.rotation_stiffness if turns else hand.stiffness
        joints[name].damping[0] = hand.rotation_damping if turns else hand.damping
    firm, heavy = principal(hand.stiffness_shape), principal(hand.mass_shape)
    joints["z"].armature = hand.mass - hand.carried
    for name in ("x", "y"):
        joints[name].stiffness[0] *= firm.least
        joints[name].damping[0] *= firm.least
        joints[name].armature = heavy.least * hand.mass - hand.carried
    for name, axis in (("stiff", firm), ("heavy", heavy)):
        if axis.greatest <= axis.least * (1.0 + 1e-9):
            continue
        more, arm = axis.greatest - axis.least, spec.add_tendon(name=f"arm_{name}")
        arm.wrap_joint("x", math.cos(axis.angle))
        arm.wrap_joint("y", math.sin(axis.angle))
        if name == "stiff":
            arm.stiffness[0], arm.damping[0] = more * hand.stiffness, more * hand.damping
        else:
            arm.armature = more * hand.mass
