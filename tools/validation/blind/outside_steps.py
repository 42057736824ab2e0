"""Apply the effects that the library does not have, before every physics step.

Each function gets the model, the number of the actuator (0 for `supply` and `all`), the machine,
the location and the parameters, and returns what to do with the MjData at the start of a step. They
change the actuators' numbers, activations or applied forces, and no code of the library.
"""

import math

from hydrotele.hydraulics.circuit import Slot, circuit_scratch, solve_state_supplies
from hydrotele.hydraulics.laws import orifice_flow
from hydrotele.hydraulics.valve import axis_valve_opening

_WARM_UP = 40.0  # s
_REGULATOR = 0.05  # s, of a pump's torque control
_TANK_LINE = 0.02  # s, filling of a tank line


def bore_friction(model, i, machine, location, p):
    """More Coulomb friction around one piston position, like a bell."""
    user = model.actuator_user[i]
    base = user[Slot.COULOMB]

    def step(data):
        off = (data.actuator_length[i] - p["centre"]) / p["width"]
        user[Slot.COULOMB] = base + p["force"] * math.exp(-0.5 * off * off)

    return step


def sticking_spool(model, i, machine, location, p):
    """The spool rests until the command differs by the threshold, then runs until it is there."""
    state = {"held": None, "moving": False}

    def step(data):
        spool, rate = data.act[4 * i], data.act[4 * i + 1]
        command = min(1.0, max(-1.0, data.ctrl[i]))
        if state["held"] is None:
            state["held"] = spool
        if not state["moving"]:
            if abs(command - state["held"]) > p["threshold"]:
                state["moving"] = True
            else:
                data.act[4 * i], data.act[4 * i + 1] = state["held"], 0.0
        elif abs(command - spool) < 0.2 * p["threshold"] and abs(rate) < 10.0 * p["threshold"]:
            state["held"], state["moving"] = spool, False

    return step


def meter_out(model, i, machine, location, p):
    """Only `ratio` of the return flow passes."""
    chambers = _Chambers(model, i)

    def step(data):
        side, flow = chambers.returning(data)
        chambers.add(data, side, (1.0 - p["ratio"]) * flow)

    return step


def blowby(model, i, machine, location, p):
    """Leakage `gain (|dp| - beyond)` from chamber to chamber, none below."""
    chambers = _Chambers(model, i)

    def step(data):
        difference = data.act[4 * i + 2] - data.act[4 * i + 3]
        if abs(difference) > p["beyond"]:
            flow = math.copysign(p["gain"] * (abs(difference) - p["beyond"]), difference)
            chambers.add(data, 0, -flow)
            chambers.add(data, 1, flow)

    return step


def pump_sag(model, i, machine, location, p):
    """Pump flow `Q (1 - depth (1 - cos(2 pi f t)) / 2)`."""
    user = model.actuator_user
    base = user[:, Slot.PUMP_FLOW].copy()

    def step(data):
        turn = 2.0 * math.pi * p["frequency"] * data.time
        user[:, Slot.PUMP_FLOW] = base * (1.0 - 0.5 * p["depth"] * (1.0 - math.cos(turn)))

    return step


def power_limit(model, i, machine, location, p):
    """Pump flow `min(Q, power / p_s)`, followed with the regulator's time constant."""
    user, count = model.actuator_user, len(machine.hydraulic_axes)
    base, scratch, flat = user[0, Slot.PUMP_FLOW], circuit_scratch(), user.ravel()
    part = model.opt.timestep / _REGULATOR

    def step(data):
        supply = solve_state_supplies(flat, 0, count, data.act, scratch)
        wanted = min(base, p["power"] / max(supply, 1e6))
        user[:, Slot.PUMP_FLOW] += part * (wanted - user[0, Slot.PUMP_FLOW])

    return step


def warming_oil(model, i, machine, location, p):
    """Leakage grows to `1 + leakage` times, viscous friction falls to `1 - thinning` in 40 s."""
    user = model.actuator_user
    base = user.copy()

    def step(data):
        part = data.time / _WARM_UP
        user[:, Slot.LEAKAGE] = base[:, Slot.LEAKAGE] * (1.0 + p["leakage"] * part)
        user[:, Slot.VISCOUS] = base[:, Slot.VISCOUS] * (1.0 - p["thinning"] * part)

    return step


def back_pressure(model, i, machine, location, p):
    """Tank pressure `p_t + drop (Q_return / Q_pump)^2`, lagging by the filling of the line."""
    user = model.actuator_user
    chambers = [_Chambers(model, k) for k in range(len(machine.hydraulic_axes))]
    base, pump = user[0, Slot.TANK_PRESSURE], user[0, Slot.PUMP_FLOW]
    part = model.opt.timestep / _TANK_LINE

    def step(data):
        total = sum(chamber.returning(data)[1] for chamber in chambers)
        wanted = base + p["drop"] * (total / pump) ** 2
        user[:, Slot.TANK_PRESSURE] += part * (wanted - user[0, Slot.TANK_PRESSURE])

    return step


def gear_ripple(model, i, machine, location, p):
    """Torque `A sin(N q)` on the joint of the axis."""
    dof = int(model.joint(machine.axes[location].joint).dofadr[0])
    place = int(model.joint(machine.axes[location].joint).qposadr[0])

    def step(data):
        data.qfrc_applied[dof] = p["torque"] * math.sin(p["teeth"] * data.qpos[place])

    return step


class _Chambers:
    """The two chambers of an axis: what returns to tank, and what more oil does to the pressure."""

    def __init__(self, model, i: int) -> None:
        self.user, self.i, self.dt = model.actuator_user[i], i, model.opt.timestep

    def returning(self, data) -> tuple[int, float]:
        """Side that drains to tank (0 head, 1 rod) and its flow out [m^3/s]."""
        user = self.user
        opening = axis_valve_opening(user, 0, data.act[4 * self.i])
        side = 1 if opening > 0.0 else 0
        edge = user[Slot.METERING_BT if opening > 0.0 else Slot.METERING_AT]
        drop = data.act[4 * self.i + 2 + side] - user[Slot.TANK_PRESSURE]
        gain = user[Slot.FLOW_GAIN] * edge * abs(opening)
        return side, max(0.0, orifice_flow(drop, gain, user[Slot.ORIFICE_SMOOTHING])[0])

    def add(self, data, side: int, flow: float) -> None:
        """Let more oil [m^3/s] into a chamber over the coming step."""
        user = self.user
        x = data.actuator_length[self.i] if user[Slot.KIND] == 1.0 else 0.0
        if side == 0:
            volume = user[Slot.VOLUME_HEAD] + user[Slot.AREA_HEAD] * x
        else:
            volume = user[Slot.VOLUME_ROD] + user[Slot.AREA_ROD] * (user[Slot.STROKE] - x)
        volume += user[Slot.BULK_MODULUS] * user[Slot.HOSE_COMPLIANCE]
        data.act[4 * self.i + 2 + side] += self.dt * user[Slot.BULK_MODULUS] / volume * flow
