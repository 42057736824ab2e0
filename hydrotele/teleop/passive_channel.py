"""Both ends of a passive communication channel: wave variables and time-domain passivity control.

A channel is passive if it releases no more energy than has entered it, so that its delay cannot make
the loop unstable. The functions treat one axis and one control period. A spring and damper at the
slave's end connect the received reference with the slave. Their force moves the slave and is returned
to the master.

Wave variables transmit `u = (b v + F) / sqrt(2 b)` forward and `w = (b v - F) / sqrt(2 b)` back, with
velocity v, force F and wave impedance b; a constant delay between them is lossless. Packets carry the
sums of all waves and of their energy. A lost packet therefore causes no offset, a duplicate counts
once, and with varying delays no more energy is used than was sent.

Passivity control transmits position forward and force back, each with the energy that has entered
the channel at its end. The slave's reference and the master's force are limited so that no more
energy leaves at one end than has entered at the other. A small constant power is always permitted:
otherwise a slave that needs energy to move and a master that supplies it only to a moving slave
would both wait.

Source: Niemeyer and Slotine 1991, 2004 (wave variables, wave integrals); Hannaford and Ryu 2002;
Ryu, Artigas and Preusche 2010 (two ports with delay).
"""

import math

from hydrotele.core.compiled import compiled

# elements of the state of an end, (8,): energy into the channel [J]; its positive part and its
# negative part, accumulated separately; sum of waves, or position, used so far; energy of the waves
# used so far; force on the master, or energy reported by the last packet; deflection of the slave's
# spring [m] or [rad]; last received position
(
    STORED_ENERGY,
    ENERGY_IN,
    ENERGY_OUT,
    USED_SIGNAL,
    USED_ENERGY,
    MASTER_FORCE,
    SPRING_DEFLECTION,
    RECEIVED_POSITION,
) = range(8)
REPORTED_ENERGY = MASTER_FORCE  # at the slave's end
END_SIZE = RECEIVED_POSITION + 1
_CATCH_UP_RATE = 2.0  # 1/s, rate at which a limited reference catches up


@compiled
def take_received_wave(wave_integral, wave_energy, period, end_state):
    """Return the received wave of this period, from the sent waves that were not yet used.

    It is the time integral of these waves divided by the period, limited so that no more energy is
    used than was sent. The used wave integral and energy are added up in the state.

    Args:
        wave_integral: time integral of all waves that the other end had sent, from the newest packet, scalar
            [sqrt(J s)].
        wave_energy: energy of these waves, scalar [J].
        period: control period, scalar [s].
        end_state: (8,) state of this end of the channel, written.

    Returns:
        The wave [sqrt(W)].

    Source: Niemeyer and Slotine 2004 (wave integrals).
    """
    wave = (wave_integral - end_state[USED_SIGNAL]) / period
    left = max(0.0, wave_energy - end_state[USED_ENERGY]) / period
    if wave * wave > left:
        wave = math.copysign(math.sqrt(left), wave)
    end_state[USED_SIGNAL] += period * wave
    end_state[USED_ENERGY] += period * wave * wave
    return wave


@compiled
def step_wave_master(v, wave_integral, wave_energy, b, period, end_state):
    """Compute force and outgoing wave at the master's end of a channel with wave variables.

    Args:
        v: speed of the handle, scalar [m/s].
        wave_integral: time integral of the waves that the slave had sent, scalar [sqrt(J s)].
        wave_energy: energy of these waves, scalar [J].
        b: wave impedance, scalar [N s/m].
        period: control period, scalar [s].
        end_state: (8,) state of this end of the channel, written.

    Returns:
        Force against the handle's motion [N], and the wave to send [sqrt(W)].

    Source: Niemeyer and Slotine 1991.
    """
    root = math.sqrt(2.0 * b)
    w = take_received_wave(wave_integral, wave_energy, period, end_state)
    pushed = b * v - root * w
    end_state[STORED_ENERGY] += period * pushed * v
    return pushed, root * v - w


@compiled
def step_wave_slave(v, wave_integral, wave_energy, stiffness, damping, b, period, end_state):
    """Compute force and outgoing wave at the slave's end of a channel with wave variables.

    Args:
        v: speed of the slave in the handle's scale, scalar [m/s].
        wave_integral: time integral of the waves that the master had sent, scalar [sqrt(J s)].
        wave_energy: energy of these waves, scalar [J].
        stiffness: stiffness of the slave's controller, scalar [N/m].
        damping: damping of the slave's controller, scalar [N s/m].
        b: wave impedance, scalar [N s/m].
        period: control period, scalar [s].
        end_state: (8,) state of this end of the channel, written.

    Returns:
        Force on the slave [N], and the wave to send back [sqrt(W)].

    Source: Niemeyer and Slotine 1991; backward differences.
    """
    less = math.sqrt(2.0 / b)
    u = take_received_wave(wave_integral, wave_energy, period, end_state)
    stiff = damping + stiffness * period
    pull = (stiffness * end_state[SPRING_DEFLECTION] + stiff * (less * u - v)) / (1.0 + stiff / b)
    asked = less * u - pull / b
    end_state[SPRING_DEFLECTION] += period * (asked - v)
    end_state[STORED_ENERGY] -= period * pull * asked
    return pull, u - less * pull


@compiled
def step_passivity_master(v, force, slave_energy, mass, period, end_state):
    """Compute the force at the master's end under passivity control.

    The received force is limited so that no more energy leaves here than has entered at the slave.
    The motion of the mass in the next period is predicted from its speed and the channel's force.
    A hand that pushes as well can still extract too much energy. A damper dissipates this excess in
    the next periods; it is limited so that it at most stops the mass in two periods.

    Args:
        v: mean speed of the handle over the last period, scalar [m/s].
        force: received force against the handle's motion, scalar [N].
        slave_energy: energy that had entered at the slave at the time of sending, scalar [J].
        mass: mass of the master, scalar [kg].
        period: control period, scalar [s].
        end_state: (8,) state of this end, written; the caller sends its ENERGY_IN in the next packet.

    Returns:
        The applied force against the handle's motion [N].

    Source: passivity condition of Hannaford and Ryu 2002, solved for the force.
    """
    gone = end_state[MASTER_FORCE] * v * period
    end_state[STORED_ENERGY] += gone
    end_state[ENERGY_IN] += max(gone, 0.0)
    end_state[ENERGY_OUT] += max(-gone, 0.0)
    firm, left = mass / period, slave_energy - end_state[ENERGY_OUT]
    if left < 0.0:
        end_state[MASTER_FORCE] = _power_dissipating_force(v, force, -left / period, 0.5 * firm)
        return end_state[MASTER_FORCE]
    now = v - 0.5 / firm * end_state[MASTER_FORCE]
    # -F x <= E with x = v T - F T^2 / (2 M) is quadratic in F
    root = math.sqrt(now * now + 2.0 * left / mass)
    end_state[MASTER_FORCE] = min(firm * (now + root), max(firm * (now - root), force))
    return end_state[MASTER_FORCE]


@compiled
def _power_dissipating_force(v, force, power, most):
    """Return a force [N] against the motion at speed v that dissipates the power `power` [W].

    The force has the sign of v and acts against it. If the received force `force` dissipates more,
    it is returned instead. The magnitude of the result is at most `most` [N s/m] times the speed;
    it is 0 at rest.
    """
    speed = abs(v)
    if speed == 0.0:
        return 0.0
    against = force if v > 0.0 else -force
    size = min(most * speed, max(power / speed, against))
    return size if v > 0.0 else -size


@compiled
def step_passivity_slave(v, place, master_energy, stiffness, damping, min_power, period, end_state):
    """Compute the force at the slave's end under passivity control.

    The force is that of a spring and damper between the received handle position and the slave. The
    motion of the reference is limited so that no more energy leaves here than has entered at the
    master, apart from the power `min_power`.

    Args:
        v: speed of the slave in the handle's scale, scalar [m/s].
        place: position of the handle in the newest packet, scalar [m].
        master_energy: energy that had entered at the master at the time of sending, scalar [J].
        stiffness: stiffness of the slave's controller, scalar [N/m].
        damping: damping of the slave's controller, scalar [N s/m].
        min_power: power that is always permitted, scalar [W].
        period: control period, scalar [s].
        end_state: (8,) state of this end, written; the caller sends its ENERGY_IN in the next packet.

    Returns:
        Force on the slave [N].

    Source: passivity condition of Ryu, Artigas and Preusche 2010, solved for the reference.
    """
    asked = (
        _CATCH_UP_RATE * (end_state[RECEIVED_POSITION] - end_state[USED_SIGNAL])
        + (place - end_state[RECEIVED_POSITION]) / period
    )
    end_state[RECEIVED_POSITION], end_state[REPORTED_ENERGY] = place, master_energy
    stiff = damping + stiffness * period
    offset = stiffness * end_state[SPRING_DEFLECTION] - stiff * v
    power = min_power + max(0.0, master_energy - end_state[ENERGY_OUT]) / period
    # (offset + stiff rate) rate <= power
    root = math.sqrt(offset * offset + 4.0 * stiff * power)
    asked = min((-offset + root) / (2.0 * stiff), max((-offset - root) / (2.0 * stiff), asked))
    pull = offset + stiff * asked
    end_state[USED_SIGNAL] += period * asked
    end_state[SPRING_DEFLECTION] += period * (asked - v)
    gone = -pull * asked * period
    end_state[STORED_ENERGY] += gone
    end_state[ENERGY_IN] += max(gone, 0.0)
    end_state[ENERGY_OUT] += max(-gone - min_power * period, 0.0)
    return pull
