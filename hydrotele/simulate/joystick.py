"""Simulation of a maglev joystick in MuJoCo: levitated part, coils, stops, operator's arm, cab motion.

The flotor is the levitated part with the handle and the coils; the stator is fixed to the cab.

The cab's frame is not inertial: its acceleration is added to gravity, and its rotation acts on the
flotor as force and torque. The coil currents heat the coils. The coil force decreases towards the
ends of the gap, where the magnetic field is weaker.

The integrator is a leapfrog with positions at the steps and velocities half a step earlier. An
input that changes between two control periods acts in the step between them with the mean of both
values. Damping uses the mean of the velocities before and after a step. Positions are then of
second order in the step, and the motion of a free body under a held force is exact. Without the
mean, the simulation would be half a step ahead, as if the control sampled faster.
"""
# pyright: reportCallIssue=false
# numba's intrinsics are called without their typing context.

import math
from pathlib import Path

import mujoco
import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.core.memory import address_record, float64_view, matrix_view
from hydrotele.core.mjcf import load_spec, read_mjcf
from hydrotele.machine.joystick import Joystick, find_principal_values
from hydrotele.simulate.mujoco_c_api import call_mj_step, function_address

GRAVITY = -9.81
_COOLED_HEAT = 0.9  # relative heat below which the largest current is allowed again after overheating
_MIN_STEPS_PER_PERIOD = 2  # physics steps per control period of 5 ms: the stiffest spring's period is 30 ms
_INPUT_COUNT = 15  # number of inputs that change between periods: 6 currents, 6 forces, 3 of gravity

FLOTOR_DTYPE = np.dtype(
    [(name, np.int64) for name in ("mj_step", "mj_forward", "model", "data")]
    + [(name, np.int64) for name in ("steps", "leaps", "started")]
    + [(name, np.float64) for name in ("timestep", "period", "mass", "continuous_current")]
    + [(name, np.float64) for name in ("thermal_time", "max_current", "hottest", "allowed")]
    + [(name, np.int64) for name in ("com", "inertia", "mount")]  # addresses from here on
    + [(name, np.int64) for name in ("ctrl", "applied", "gravity", "before")]
    + [(name, np.int64) for name in ("speed", "acceleration", "half_damping", "heat")],
    align=True,
)
"""Record type of a SimulatedFlotor for compiled code."""


class SimulatedFlotor:
    """MuJoCo simulation of a maglev joystick with its coils and the operator's arm.

    Attributes:
        model: its MuJoCo model; the coils are its actuators [A].
        data: its state; `qpos` (7,) handle position [m] and quaternion, `qvel` (6,) [m/s] in the
            stator's axes and [rad/s] in the flotor's axes. After the first step `qvel` is that of
            half a step earlier.
        hand: whether the operator holds the handle.
        heat: (6,) relative heat of the coils, see `heat_step`.
        record: (1,) the simulation as a record for compiled code, see `flotor_step`.
        has_edge_loss: whether coils lose force towards the end of their gap;
            `update_coil_force_constants` must then be called before every period.
    """

    def __init__(
        self, facts: Joystick, *, hand: bool = True, period: float | None = None, refinement: int = 1,
        runge_kutta: bool = False,
    ) -> None:  # fmt: skip
        """Compile the joystick.

        Args:
            facts: parameters of the joystick.
            hand: whether the operator holds the handle.
            period: control period [s]; by default that of the joystick.
            refinement: factor on the number of physics steps per period.
            runge_kutta: use fourth-order steps of four times the cost, for motion without contact
                with the stops.

        Raises:
            InputError: its MJCF cannot be read or is incomplete.
        """
        self.facts, self.hand = facts, hand
        self.period = period or 1.0 / facts.control_rate
        steps = max(
            _MIN_STEPS_PER_PERIOD,
            math.ceil(_MIN_STEPS_PER_PERIOD * self.period * facts.control_rate - 1e-9),
        )
        self.steps = refinement * steps
        spec = joystick_spec(facts, hand)
        spec.compiler.discardvisual = True
        spec.compiler.fusestatic = True
        spec.option.timestep = self.period / self.steps
        self.model = compile_joystick(facts, spec)
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
        self.data = mujoco.MjData(self.model)
        self.model.opt.gravity[:] = (0.0, 0.0, GRAVITY)
        self.heat, self.has_edge_loss = np.zeros(6), facts.coils.edge_loss > 0.0
        self._fill_record(0.5 * _damping_matrix(self.model), not runge_kutta)
        if runge_kutta:
            self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        else:  # MuJoCo's damping uses the velocity after a step: half of it goes there
            self.model.dof_damping *= 0.5
            self.model.tendon_damping *= 0.5
            if self.model.ntendon:  # MuJoCo's Euler steps are implicit in joint damping only
                self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self._gear, self._full = self.model.actuator_gear, self.model.actuator_gear.copy()
        places = self.model.site_pos[self.model.actuator_trnid[:, 0]]
        self._spots = places + np.array(facts.flotor.handle)  # from the flotor's to the coils' frame

    def _fill_record(self, half_damping: np.ndarray, leaps: bool) -> None:
        """Create the record of sizes and addresses for compiled code, and keep its arrays alive.

        `half_damping` (6, 6) is half the damping matrix. `leaps` selects the leapfrog of the module
        instead of MuJoCo's plain integration.
        """
        model, data, coils = self.model, self.data, self.facts.coils
        body = model.body("flotor")
        mass, com, turn = float(body.mass[0]), body.ipos.copy(), np.zeros(9)
        mujoco.mju_quat2Mat(turn, body.iquat)
        turn = turn.reshape(3, 3)
        inertia = turn @ np.diag(body.inertia) @ turn.T
        inertia += mass * (com @ com * np.eye(3))
        inertia -= mass * np.outer(com, com)
        self._arrays = {
            "com": com, "inertia": inertia, "mount": np.array(self.facts.mount, float),
            "ctrl": data.ctrl, "applied": data.qfrc_applied, "gravity": model.opt.gravity,
            "before": np.zeros((2, _INPUT_COUNT)), "speed": data.qvel, "acceleration": data.qacc,
            "half_damping": half_damping, "heat": self.heat,
        }  # fmt: skip
        self.record = address_record(FLOTOR_DTYPE, self._arrays)
        for name, value in {
            "mj_step": function_address("mj_step"), "mj_forward": function_address("mj_forward"),
            "model": model._address, "data": data._address, "steps": self.steps, "leaps": leaps,
            "timestep": model.opt.timestep, "period": self.period, "mass": mass,
            "continuous_current": coils.continuous_current, "thermal_time": coils.thermal_time,
            "max_current": coils.max_current, "allowed": coils.max_current,
        }.items():  # fmt: skip
            self.record[name] = value

    @property
    def max_relative_temperature_rise(self) -> float:
        """Largest temperature rise of any coil so far, relative to that at the continuous current [1]."""
        return float(self.record["hottest"][0])

    @property
    def current_limit(self) -> float:
        """Current limit of the coils at present [A].

        It is the maximum current. Once the relative heat (`heat_step`) of a coil reaches 1, it is
        the continuous current, until the relative heat of all coils is below 0.9.
        """
        return float(self.record["allowed"][0])

    def step(self, currents: np.ndarray, operator_wrench: np.ndarray) -> None:
        """Simulate one control period with constant coil currents and a constant force of the operator.

        Args:
            currents: (6,) coil currents [A].
            operator_wrench: (6,) force of the operator on the handle along the stator's axes [N] and torque
                about them [N m].
        """
        if self.has_edge_loss:
            self.update_coil_force_constants()
        _step_flotor_record(self.record, np.asarray(currents, float), np.asarray(operator_wrench, float))

    def step_in_cab(
        self, currents: np.ndarray, operator_wrench: np.ndarray, mount: np.ndarray, spin: float,
        spin_rate: float,
    ) -> None:  # fmt: skip
        """Simulate one control period like `step`, but in a cab that rotates about a vertical axis.

        Args:
            currents: (6,) coil currents [A].
            operator_wrench: (6,) force and torque of the operator on the handle [N], [N m].
            mount: (3,) position of the joystick relative to the cab's axis [m].
            spin: angular velocity of the cab [rad/s].
            spin_rate: its angular acceleration [rad/s^2].
        """
        if self.has_edge_loss:
            self.update_coil_force_constants()
        self._arrays["mount"][:] = mount
        currents, operator_wrench = np.asarray(currents, float), np.asarray(operator_wrench, float)
        _step_record_in_cab(self.record, currents, operator_wrench, float(spin), float(spin_rate))

    def update_coil_force_constants(self) -> None:
        """Set the force per ampere of each coil in the MuJoCo model according to the flotor's pose.

        The force decreases with the distance of a coil from its nominal position
        (`coil_force_factors`).
        """
        turn, handle = np.empty(9), np.array(self.facts.flotor.handle)
        mujoco.mju_quat2Mat(turn, self.data.qpos[3:7])
        turn = turn.reshape(3, 3)
        place = self.data.qpos[:3] + handle - turn @ handle
        gap = self.facts.workspace.translation
        shares = coil_force_factors(self._spots, place, turn, gap, self.facts.coils.edge_loss)
        self._gear[:] = self._full * shares[:, None]

    def set_pose(self, pose: np.ndarray) -> None:
        """Reset the simulation to a pose of the handle at rest; the heat of the coils is kept.

        `pose` (6,) is the displacement [m] and the rotation vector [rad].
        """
        mujoco.mj_resetData(self.model, self.data)
        self.record["started"] = 0
        self.data.qpos[:3] = pose[:3]
        angle = float(np.linalg.norm(pose[3:]))
        way = pose[3:] / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])
        mujoco.mju_axisAngle2Quat(self.data.qpos[3:7], way, angle)


def _damping_matrix(model: mujoco.MjModel) -> np.ndarray:
    """Return the viscous damping matrix (nv, nv) of joints and fixed tendons [N s/m], [N m s/rad]."""
    found, way = np.diag(model.dof_damping), np.zeros((model.ntendon, model.nv))
    for k in range(model.ntendon):
        at, many = model.tendon_adr[k], model.tendon_num[k]
        dofs = model.jnt_dofadr[model.wrap_objid[at : at + many]]
        way[k, dofs] = model.wrap_prm[at : at + many]
    return found + way.T @ np.diag(model.tendon_damping) @ way


@compiled
def flotor_step(r, currents, operator_wrench):
    """Advance the flotor by one control period with constant currents.

    Args:
        r: `SimulatedFlotor.record[0]`; the heat and the MuJoCo state it points to are written.
        currents: (6,) coil currents [A].
        operator_wrench: (6,) force and torque of the operator on the handle [N], [N m].

    Returns:
        Nothing.

    Source: this module.
    """
    applied = float64_view(r.applied, 6)
    for i in range(6):
        applied[i] = operator_wrench[i]
    _simulate_period(r, currents)


@compiled
def flotor_step_in_cab(r, currents, operator_wrench, spin, spin_rate):
    """Advance the flotor by one control period in a cab that rotates about a vertical axis.

    Args:
        r: `SimulatedFlotor.record[0]`; the heat and the MuJoCo state it points to are written.
        currents: (6,) coil currents [A].
        operator_wrench: (6,) force and torque of the operator on the handle [N], [N m].
        spin: angular velocity of the cab, scalar [rad/s].
        spin_rate: its angular acceleration, scalar [rad/s^2].

    Returns:
        Nothing.

    Source: inertial forces in a rotating frame.
    """
    _compute_cab_inertial_forces(
        r.mass, float64_view(r.com, 3), matrix_view(r.inertia, 3, 3), float64_view(r.mount, 3), spin, spin_rate,
        operator_wrench, float64_view(r.gravity, 3), float64_view(r.applied, 6),
    )  # fmt: skip
    _simulate_period(r, currents)


@compiled
def _simulate_period(r, currents):
    """Update coil heat and current limit, and simulate one control period with currents (6,) [A].

    Applied forces and gravity are already set in the MuJoCo state of the record.
    """
    ctrl, heat = float64_view(r.ctrl, 6), float64_view(r.heat, 6)
    for i in range(6):
        ctrl[i] = currents[i]
    hot = heat_step(heat, currents, r.continuous_current, r.thermal_time, r.period)
    r.hottest = max(r.hottest, hot)
    if hot >= 1.0:
        r.allowed = min(r.max_current, r.continuous_current)
    elif hot < _COOLED_HEAT:
        r.allowed = r.max_current
    if not r.leaps:
        for _ in range(r.steps):
            call_mj_step(r.mj_step, r.model, r.data)
        return
    inputs = ctrl, float64_view(r.applied, 6), float64_view(r.gravity, 3)
    before, speed = matrix_view(r.before, 2, _INPUT_COUNT), float64_view(r.speed, 6)
    damping = matrix_view(r.half_damping, 6, 6)
    _store_inputs(inputs, before)
    if not r.started:
        r.started = 1
        for i in range(_INPUT_COUNT):
            before[0, i] = before[1, i]
        _set_step_inputs(inputs, before, damping, speed, 0.0)
        call_mj_step(r.mj_forward, r.model, r.data)
        acceleration = float64_view(r.acceleration, 6)
        for i in range(6):
            speed[i] -= 0.5 * r.timestep * acceleration[i]
    for k in range(r.steps):
        _set_step_inputs(inputs, before, damping, speed, 0.0 if k else 0.5)
        call_mj_step(r.mj_step, r.model, r.data)


@compiled
def _store_inputs(inputs, before):
    """Store the inputs of this control period in `before` (2, 15) and keep those of the last period.

    Row 1 receives the new inputs, and row 0 those that were in row 1. `inputs` are three arrays:
    coil currents, applied forces and gravity.
    """
    at = 0
    for part in inputs:
        for i in range(len(part)):
            before[0, at], before[1, at] = before[1, at], part[i]
            at += 1


@compiled
def _set_step_inputs(inputs, before, half_damping, speed, previous_weight):
    """Set currents, applied forces and gravity of a physics step, with half of the damping force.

    `inputs` are MuJoCo's three arrays, which are written. Their values are a weighted mean of those
    of the last and of this period (`before`, see `_store_inputs`); `previous_weight` is the weight
    of the last period. `half_damping @ speed` is subtracted from the applied forces.
    """
    at = 0
    for part in inputs:
        for i in range(len(part)):
            part[i] = previous_weight * before[0, at] + (1.0 - previous_weight) * before[1, at]
            at += 1
    applied = inputs[1]
    for i in range(len(applied)):
        for k in range(len(speed)):
            applied[i] -= half_damping[i, k] * speed[k]


@compiled
def _step_flotor_record(record, currents, operator_wrench):
    flotor_step(record[0], currents, operator_wrench)


@compiled
def _step_record_in_cab(record, currents, operator_wrench, spin, spin_rate):
    flotor_step_in_cab(record[0], currents, operator_wrench, spin, spin_rate)


@compiled
def heat_step(heat, currents, continuous, time_constant, period):
    """Update the relative temperature rise ("heat") of the coils over a period of constant currents.

    `d heat/dt = ((I / I_c)^2 - heat) / T`, by its exact exponential: one thermal capacity heated by the
    copper loss I^2 R. The steady state at the continuous current is 1.

    Args:
        heat: (6,) temperature rise relative to that at the continuous current [1], written.
        currents: (6,) coil currents [A].
        continuous: continuous current I_c, scalar [A].
        time_constant: thermal time constant T of the winding, scalar [s].
        period: duration, scalar [s].

    Returns:
        The largest heat, scalar [1].

    Source: copper loss and one thermal capacity (I^2 t rating of motors).
    """
    share, hot = -np.expm1(-period / time_constant), 0.0
    for i in range(len(heat)):
        heat[i] += share * ((currents[i] / continuous) ** 2 - heat[i])
        hot = max(hot, heat[i])
    return hot


def coil_force_factors(
    coil_centres: np.ndarray,
    displacement: np.ndarray,
    rotation_matrix: np.ndarray,
    gap: float,
    edge_loss: float,
) -> np.ndarray:
    """Return the relative force constant of every coil in a pose of the flotor.

    `1 - edge_loss (d / gap)^2`, with the displacement d of the coil's centre from its nominal
    position. The function is even in d, because the magnets are symmetric about the gap's centre.

    Args:
        coil_centres: (6, 3) centres of the coils in their frame [m].
        displacement: (3,) displacement of the coils' frame from its nominal position [m].
        rotation_matrix: (3, 3) rotation matrix from flotor to stator.
        gap: displacement at which a coil has lost the fraction `edge_loss` [m].
        edge_loss: fraction of the force lost at this displacement [1].

    Returns:
        (6,) factors on the force per ampere, at least 0 [1].
    """
    moved = displacement + coil_centres @ rotation_matrix.T - coil_centres
    return np.maximum(0.0, 1.0 - edge_loss * np.sum(moved**2, axis=1) / gap**2)


@compiled
def _compute_cab_inertial_forces(mass, com, inertia, mount, w, a, operator_wrench, gravity, out):
    """Compute apparent gravity and inertial forces of a flotor in a frame that rotates about the vertical.

    The flotor is taken at rest in its nominal pose in this frame, without Coriolis forces.

    Args:
        mass: of the flotor, scalar [kg].
        com: (3,) its centre of mass relative to the handle [m].
        inertia: (3, 3) its inertia about the handle [kg m^2].
        mount: (3,) position of the joystick relative to the axis of rotation [m].
        w: angular velocity of the frame, scalar [rad/s].
        a: its angular acceleration, scalar [rad/s^2].
        operator_wrench: (6,) force and torque of the operator [N], [N m].
        gravity: (3,) written: gravity minus the acceleration of the mount [m/s^2].
        out: (6,) written: operator's force and torque plus the inertial ones [N], [N m].
    """
    gravity[0] = w * w * mount[0] + a * mount[1]
    gravity[1] = w * w * mount[1] - a * mount[0]
    gravity[2] = GRAVITY
    out[0] = operator_wrench[0] + mass * (a * com[1] + w * w * com[0])
    out[1] = operator_wrench[1] + mass * (-a * com[0] + w * w * com[1])
    out[2] = operator_wrench[2]
    out[3] = operator_wrench[3] - inertia[0, 2] * a + w * w * inertia[1, 2]
    out[4] = operator_wrench[4] - inertia[1, 2] * a - w * w * inertia[0, 2]
    out[5] = operator_wrench[5] - inertia[2, 2] * a


def joystick_spec(facts: Joystick, hand: bool = True) -> mujoco.MjSpec:
    """Load the joystick's MJCF and set its parameters: masses, coils, end stops and operator's arm.

    Args:
        facts: parameters of the joystick.
        hand: whether the operator holds the handle; this adds the mass on the handle and a spring
            and damper to the centre.

    Returns:
        The spec, including visual geometry.

    Raises:
        InputError: the MJCF cannot be read or is incomplete.
    """
    path = Path(facts.folder, facts.mjcf)
    spec = load_spec(path)
    flotor, grip = spec.body("flotor"), spec.body("hand")
    coils, joints = spec.body("coils"), {j.name: j for j in spec.joints}
    if not (flotor and grip and coils and {"x", "y", "z", "turn"} <= set(joints)):
        raise InputError(path, "must have bodies flotor, hand and coils, and joints x, y, z and turn")
    facts_flotor = facts.flotor
    flotor.mass, flotor.inertia = facts_flotor.mass, facts_flotor.inertia
    flotor.ipos = np.subtract(facts_flotor.com, facts_flotor.handle)
    coils.pos = np.negative(facts_flotor.handle)
    degrees = 180.0 / math.pi if spec.compiler.degree else 1.0
    _place_end_stop_walls(spec, facts, path)
    joints["turn"].range = (0.0, degrees * facts.workspace.rotation)
    for actuator in spec.actuators:
        actuator.ctrlrange = (-facts.coils.max_current, facts.coils.max_current)
        actuator.gear = np.sign(actuator.gear) * facts.coils.force_per_ampere
    for k in range(6):
        place, turn = spec.site(f"coil_{k + 1}"), 2.0 * math.pi * (k % 3) / 3.0
        place.pos = facts.coils.radius * np.array([math.cos(turn), math.sin(turn), 0.0])
    if hand and facts.hand.mass > 0.0:
        grip.mass = facts.hand.carried_mass
    else:
        spec.delete(grip)
    if hand:
        _add_arm_impedance(spec, joints, facts)
    return spec


def compile_joystick(facts: Joystick, spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a joystick specification, made by `joystick_spec`, to a MuJoCo model.

    Raises:
        InputError: MuJoCo refuses it; names file and line.
    """
    return read_mjcf(Path(facts.folder, facts.mjcf)).compile(spec)


def _place_end_stop_walls(spec: mujoco.MjSpec, facts: Joystick, path: Path) -> None:
    """Place the six end-stop walls where the ball at the coils' centre touches them at the end of travel.

    Raise InputError if the MJCF has no geom for the ball or for a wall.
    """
    ball, far = spec.geom("gap"), facts.workspace.translation
    walls = {f"gap_{axis}_{side}": (i, way) for i, axis in enumerate("xyz")
              for side, way in (("low", -1.0), ("high", 1.0))}  # fmt: skip
    missing = [name for name in walls if spec.geom(name) is None]
    if ball is None or missing:
        names = ", ".join(["gap"] * (ball is None) + missing)
        raise InputError(path, f"has no geoms {names}, which are the end stops of the coils")
    for name, (axis, way) in walls.items():
        spec.geom(name).pos = np.negative(facts.flotor.handle)
        spec.geom(name).pos[axis] += way * (far + ball.size[0] + spec.geom(name).size[axis])


def _add_arm_impedance(spec: mujoco.MjSpec, joints, facts: Joystick) -> None:
    """Add springs, dampers and mass of the operator's arm, except the mass on the handle itself.

    In the horizontal plane, stiffness and mass are ellipses. The slides have the values of the
    short axes. Tendons along the long axes add the differences as stiffness, damping and armature.
    """
    hand = facts.hand
    for name in ("x", "y", "z", "turn"):
        turns = name == "turn"
        joints[name].stiffness[0] = hand.rotation_stiffness if turns else hand.stiffness
        joints[name].damping[0] = hand.rotation_damping if turns else hand.damping
    firm, heavy = find_principal_values(hand.stiffness_shape), find_principal_values(hand.mass_shape)
    joints["z"].armature = hand.mass - hand.carried_mass
    for name in ("x", "y"):
        joints[name].stiffness[0] *= firm.min_value
        joints[name].damping[0] *= firm.min_value
        joints[name].armature = heavy.min_value * hand.mass - hand.carried_mass
    for name, axis in (("stiff", firm), ("heavy", heavy)):
        if axis.max_value <= axis.min_value * (1.0 + 1e-9):
            continue
        more, arm = axis.max_value - axis.min_value, spec.add_tendon(name=f"arm_{name}")
        arm.wrap_joint("x", math.cos(axis.angle))
        arm.wrap_joint("y", math.sin(axis.angle))
        if name == "stiff":
            arm.stiffness[0], arm.damping[0] = more * hand.stiffness, more * hand.damping
        else:
            arm.armature = more * hand.mass
