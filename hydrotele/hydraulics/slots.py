"""Where the numbers of an actuator stand in MuJoCo's `actuator_user`."""

import enum

CURVE_KNOTS = 8  # at most, of a valve's flow curve in one direction


class Slot(enum.IntEnum):
    """Places of an actuator's numbers in `actuator_user`, all SI; a new number is a new line.

    Beyond the plain valve and drive, 0 switches a law off (a metering ratio of 1 does). BRISTLE,
    DELIVERY and ADDED_DELIVERY are places among the activations, counted from the first hydraulic
    axis, and MEMORY is how many of them follow those of the hydraulic axes (see
    `parameters.memory_names`). CURVES, the last, begins two flow curves, of the positive and of the
    negative direction: number of knots (0: straight), CURVE_KNOTS travels and CURVE_KNOTS openings
    each.
    """

    @staticmethod
    def _generate_next_value_(name, start, count, last_values):
        return count

    MARKER = enum.auto()
    KIND = enum.auto()
    FIRST = enum.auto()
    COUNT = enum.auto()
    AREA_HEAD = enum.auto()
    AREA_ROD = enum.auto()
    VOLUME_HEAD = enum.auto()
    VOLUME_ROD = enum.auto()
    STROKE = enum.auto()
    LEAKAGE = enum.auto()
    BANDWIDTH = enum.auto()
    DAMPING = enum.auto()
    DEADBAND = enum.auto()
    FLOW_GAIN = enum.auto()
    ORIFICE_SMOOTHING = enum.auto()
    PORT_RELIEF = enum.auto()
    RELIEF_GAIN = enum.auto()
    MAKEUP_GAIN = enum.auto()
    BULK_MODULUS = enum.auto()
    TANK_PRESSURE = enum.auto()
    AIR_RELEASE = enum.auto()
    AIR_ONSET = enum.auto()
    RELIEF_PRESSURE = enum.auto()
    PUMP_FLOW = enum.auto()
    COULOMB = enum.auto()
    STRIBECK = enum.auto()
    STRIBECK_VELOCITY = enum.auto()
    VISCOUS = enum.auto()
    COULOMB_VELOCITY = enum.auto()
    OFFSET = enum.auto()
    COULOMB_ASYMMETRY = enum.auto()
    VISCOUS_ASYMMETRY = enum.auto()
    HOSE_COMPLIANCE = enum.auto()
    DRIVE_INERTIA = enum.auto()
    DEADBAND_NEGATIVE = enum.auto()
    SLEW_LIMIT = enum.auto()
    METERING_PA = enum.auto()
    METERING_BT = enum.auto()
    METERING_PB = enum.auto()
    METERING_AT = enum.auto()
    COMPENSATED_DROP = enum.auto()
    HOLDING_HEAD = enum.auto()
    HOLDING_HEAD_RATIO = enum.auto()
    HOLDING_HEAD_RANGE = enum.auto()
    HOLDING_ROD = enum.auto()
    HOLDING_ROD_RATIO = enum.auto()
    HOLDING_ROD_RANGE = enum.auto()
    LOAD_SENSING_MARGIN = enum.auto()
    PUMP_DROOP = enum.auto()
    STOP_LOW = enum.auto()
    STOP_HIGH = enum.auto()
    STOP_STIFFNESS = enum.auto()
    STOP_DAMPING = enum.auto()
    BRISTLE_STIFFNESS = enum.auto()
    BRISTLE_DAMPING = enum.auto()
    BRISTLE_INERTIA = enum.auto()
    BRISTLE = enum.auto()
    PUMP_TIME_CONSTANT = enum.auto()
    DELIVERY = enum.auto()
    ADDED_DELIVERY = enum.auto()
    MEMORY = enum.auto()
    CURVES = enum.auto()


CURVE = 1 + 2 * CURVE_KNOTS  # numbers of one flow curve


class PumpSlot(enum.IntEnum):
    """Places of a pump drive's numbers in its block, all SI."""

    DISPLACEMENT = 0
    LEAKAGE = 1
    RATED_SPEED = 2
    BULK_MODULUS = 3
    COMPLIANCE_HEAD = 4
    COMPLIANCE_ROD = 5
    AIR_HEAD = 6
    AIR_ROD = 7
    ACCUMULATOR_PRESSURE = 8
    GAS_VOLUME = 9
    LINE_EXTENDING = 10
    LINE_RETRACTING = 11
    VOLTAGE = 12
    RESISTANCE = 13
    EMF = 14
    INERTIA = 15
    DRAG = 16
    BREAKAWAY = 17
    BREAKAWAY_SPEED = 18
    VISCOUS_DRAG = 19
    TORQUE_LOSS = 20
    MOVING_MASS = 21
    LOAD_AREA = 22
    LOAD_RELIEF = 23
    LOAD_OVERRIDE = 24
    LOAD_STIFFNESS = 25
    LOAD_VOID = 26
    LOAD_VOID_PRESSURE = 27
    LOAD_FRICTION = 28
    LOAD_RETURN = 29


PUMP = Slot.CURVES + 2 * CURVE  # first place of the pump drive's block
SLOTS = PUMP + len(PumpSlot)


class Kind(enum.IntEnum):
    """What an actuator is: a cylinder, a rotary motor or a plain force drive with friction.

    PUMPED is a cylinder with a pump of its own in the place of a valve.
    """

    CYLINDER = 1
    MOTOR = 2
    FORCE = 3
    PUMPED = 4
