"""Both ends of a line that gives no energy: wave variables, and time-domain passivity control.

One axis, one period at a time. The slave's end has a spring and damper between the reference that
comes and the slave: their force moves the slave, and comes back to the master.

Wave variables carry `u = (b v + F) / sqrt(2 b)` forward and `w = (b v - F) / sqrt(2 b)` back; a
constant delay between them is lossless. Packets carry the sums of all waves and of their energy:
a packet that was lost leaves no offset, one that comes twice counts once, and where delays jitter
no more energy is used than was sent.

Passivity control carries place forward and force back, each with the energy that has gone into the
line at its end so far. The slave's reference and the master's force are held back so that no more
comes out at either end than had gone in at the other, and a trickle of power, without which a
slave that needs energy to move, and a master that gives it only to a slave that moves, both wait.

Source: Niemeyer and Slotine 1991, 2004 (wave variables, wave integrals); Hannaford and Ryu 2002;
Ryu, Artigas and Preusche 2010 (two ports with delay).
"""

import math

from hydrotele.core.compiled import compiled

# state of an end, (8,): energy gone into the line [J]; of it what went in and what came out, each
# counted by itself; sum of waves, or place, used so far; energy of the waves used so far; force put
# on the master, or energy that the last packet told of; stretch of the slave's spring [m] or [rad];
# place that came last
ENERGY, GONE_IN, GONE_OUT, USED, SPENT, PUSHED, STRETCH, GOAL = range(8)
BUDGET_IN = PUSHED  # of the slave's end
END = GOAL + 1
_CATCH_UP = 2.0  # 1/s at which a reference that was held back makes up for it


@compiled
def arrived_wave(total, budget, period, end):
    """Wave to use now: what has come and was not used yet, as far as its energy reaches.

    Args:
        total: sum of all waves sent, by the newest packet, scalar [sqrt(J s)].
        budget: their energy, scalar [J].
        period: scalar [s].
        end: (8,) state, written.

    Returns:
        The wave [sqrt(W)].

    Source: this module.
    """
    wave = (total - end[USED]) / period
    left = max(0.0, budget - end[SPENT]) / period
    if wave * wave > left:
        wave = math.copysign(math.sqrt(left), wave)
    end[USED] += period * wave
    end[SPENT] += period * wave * wave
    return wave


@compiled
def wave_master(v, total, budget, b, period, end):
    """Master's end of waves.

    Args:
        v: speed of the handle, scalar [m/s].
        total: as of `arrived_wave`, scalar.
        budget: as of `arrived_wave`, scalar.
        b: wave impedance, scalar [N s/m].
        period: scalar [s].
        end: (8,) state, written.

    Returns:
        Force against the handle's motion [N], and the wave to send [sqrt(W)].

    Source: Niemeyer and Slotine 1991.
    """
    root = math.sqrt(2.0 * b)
    w = arrived_wave(total, budget, period, end)
    pushed = b * v - root * w
    end[ENERGY] += period * pushed * v
    return pushed, root * v - w


@compiled
def wave_slave(v, total, budget, stiffness, damping, b, period, end):
    """Slave's end of waves.

    Args:
        v: speed of the slave in the handle's scale, scalar [m/s].
        total: as of `arrived_wave`, scalar.
        budget: as of `arrived_wave`, scalar.
        stiffness: of the slave's controller, scalar [N/m].
        damping: of the same, scalar [N s/m].
        b: wave impedance, scalar [N s/m].
        period: scalar [s].
        end: (8,) state, written.

    Returns:
        Force on the slave [N], and the wave to send back [sqrt(W)].

    Source: Niemeyer and Slotine 1991; backward differences.
    """
    less = math.sqrt(2.0 / b)
    u = arrived_wave(total, budget, period, end)
    stiff = damping + stiffness * period
    pull = (stiffness * end[STRETCH] + stiff * (less * u - v)) / (1.0 + stiff / b)
    asked = less * u - pull / b
    end[STRETCH] += period * (asked - v)
    end[ENERGY] -= period * pull * asked
    return pull, u - less * pull


@compiled
def controlled_master(v, force, budget, mass, period, end):
    """Master's end of passivity control.

    How far the mass will move in the next period follows from its speed and the line's own force.
    What came out too much nevertheless, because a hand pushes too, is taken away by a damper in the
    next ones, which at most stops the mass in two.

    Args:
        v: mean speed of the handle over the last period, scalar [m/s].
        force: against the handle's motion, as it came from the slave, scalar [N].
        budget: energy that had gone in at the slave then, scalar [J].
        mass: of the master, scalar [kg].
        period: scalar [s].
        end: (8,) state, written; GONE_IN is what the next packet tells.

    Returns:
        The force that is put on [N].

    Source: Hannaford and Ryu 2002, solved for the force; see this module.
    """
    gone = end[PUSHED] * v * period
    end[ENERGY] += gone
    end[GONE_IN] += max(gone, 0.0)
    end[GONE_OUT] += max(-gone, 0.0)
    firm, left = mass / period, budget - end[GONE_OUT]
    if left < 0.0:
        end[PUSHED] = _damped(v, force, -left / period, 0.5 * firm)
        return end[PUSHED]
    now = v - 0.5 / firm * end[PUSHED]
    # -F x <= E with x = v T - F T^2 / (2 M) is quadratic in F
    root = math.sqrt(now * now + 2.0 * left / mass)
    end[PUSHED] = min(firm * (now + root), max(firm * (now - root), force))
    return end[PUSHED]


@compiled
def _damped(v, force, power, most):
    """Force that takes a power out of a speed, or the one that came if that takes more."""
    speed = abs(v)
    if speed == 0.0:
        return 0.0
    against = force if v > 0.0 else -force
    size = min(most * speed, max(power / speed, against))
    return size if v > 0.0 else -size


@compiled
def controlled_slave(v, place, budget, stiffness, damping, trickle, period, end):
    """Slave's end of passivity control.

    Args:
        v: speed of the slave in the handle's scale, scalar [m/s].
        place: of the handle, by the newest packet, scalar [m].
        budget: energy that had gone in at the master then, scalar [J].
        stiffness: of the slave's controller, scalar [N/m].
        damping: of the same, scalar [N s/m].
        trickle: power that it may always take, scalar [W].
        period: scalar [s].
        end: (8,) state, written; GONE_IN is what the next packet tells.

    Returns:
        Force on the slave [N].

    Source: Ryu, Artigas and Preusche 2010, solved for the reference; see this module.
    """
    asked = _CATCH_UP * (end[GOAL] - end[USED]) + (place - end[GOAL]) / period
    end[GOAL], end[BUDGET_IN] = place, budget
    stiff = damping + stiffness * period
    offset = stiffness * end[STRETCH] - stiff * v
    power = trickle + max(0.0, budget - end[GONE_OUT]) / period
    # (offset + stiff rate) rate <= power
    root = math.sqrt(offset * offset + 4.0 * stiff * power)
    asked = min((-offset + root) / (2.0 * stiff), max((-offset - root) / (2.0 * stiff), asked))
    pull = offset + stiff * asked
    end[USED] += period * asked
    end[STRETCH] += period * (asked - v)
    gone = -pull * asked * period
    end[ENERGY] += gone
    end[GONE_IN] += max(gone, 0.0)
    end[GONE_OUT] += max(-gone - trickle * period, 0.0)
    return pull
