"""Time step of soil and bucket for a control loop: forces, cutting, filling, spilling, sliding.

Four surfaces of the bucket press on the soil, each in its own direction: the face (Coulomb's wedge
ahead of it, pushed towards the machine), the edge (into the soil, along the floor), the underside
of the floor and the heel (Prandtl's zones below). Each is an elastic-plastic spring that yields at
the limit force of soil mechanics, with a damper in parallel. It supports a resting bucket and
returns at most the energy of the spring (some joules). Its force can therefore be held over a step
of 5 ms on a machine of 20 t.

A blade drawn through soil shears off a wedge along a plane that rises from its edge. The forces on
this wedge (weight, cohesion and friction on the plane, adhesion and friction on the blade) give the
Fundamental Equation of Earthmoving (Reece 1964; McKyes and Ali 1977; McKyes 1985)
`P = w (g d^2 N_g + c d N_c + c_a d N_ca) + Q N_q`, P inclined by delta to the normal of the blade.
The plane is the one with the minimum N_g. Luengo, Singh and Cannon (1998) tilt it by the slope of
the surface and load it with the weight Q of the soil in the bucket. All angles are in radians.

`compute_bucket_wrench` converts forces and load to the wrench on a MuJoCo body about its centre of mass.
"""

import math
from typing import NamedTuple

from hydrotele.core.compiled import compile_without_allocation
from hydrotele.soil.parameters import (
    ADHESION,
    BUCKET_SIZE,
    CARRIED_VOLUME,
    CELL_LENGTH,
    COHESION,
    CORNER_COUNT,
    CUT_FRONT,
    DAMPING,
    DENSITY,
    DEPTH,
    EDGE_THICKNESS,
    FACE,
    FIRST_SLIDING_CELL,
    FLOOR,
    FLOOR_ANGLE,
    FLOOR_LENGTH,
    FORCE_R,
    FORCE_Z,
    FRICTION,
    GRAVITY,
    GRAVITY_INDEX,
    HEEL,
    HEEL_X,
    HEEL_Z,
    INNER_WIDTH,
    IS_INITIALISED,
    LAST_HEEL_R,
    LAST_HEEL_Z,
    LAST_R,
    LAST_SLIDING_CELL,
    LAST_Z,
    LOST_VOLUME,
    MASS,
    MASS_R,
    MASS_Z,
    MOMENT,
    OUTLINE_START,
    REPOSE,
    RESULT_SIZE,
    SLIDE,
    STIFFNESS,
    SWELL,
    TIP,
    TOOL_FRICTION,
    WIDTH,
)
from hydrotele.soil.terrain import add_loose_soil, cut_cells, find_cell_at_radius, slide_soil_in_range, surface_height


@compile_without_allocation
def compute_bucket_capacity(n, attitude, level, out):
    """Compute the maximum volume of soil that a bucket holds at an attitude, and the centre of this soil.

    The soil fills the bucket below a surface at the angle of repose, which rises from the lower rim
    into the bucket. If the mouth is tilted less than the angle of repose, the bucket is full and a
    heap lies on top, at the angle of repose from both rims. Soil ahead of the mouth supports the
    soil behind it: the surface then starts where the soil ahead meets the mouth.

    Args:
        n: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        attitude: angle of the line from pin to edge above the horizontal, scalar [rad].
        level: height of the soil ahead of the mouth above the edge, scalar [m].
        out: (4,) written: volume [m^3]; centre outwards and up from the edge [m]; outward distance
            of the lower rim from the edge [m].

    Returns:
        Nothing.

    Source: geometry; the heap as in SAE J296, with the angle of repose for its 1:1.
    """
    c, s = math.cos(attitude), math.sin(attitude)
    count = int(n[CORNER_COUNT])
    last = OUTLINE_START + 2 * (count - 1)
    rim_r, rim_z = c * n[last] - s * n[last + 1], s * n[last] + c * n[last + 1]
    low_r, low_z = (0.0, 0.0) if rim_z >= 0.0 else (rim_r, rim_z)
    out[3] = low_r
    chord = math.sqrt(rim_r * rim_r + rim_z * rim_z)
    tilt = math.atan2(abs(rim_z), rim_r)  # angle of the mouth to the horizontal
    repose = math.atan(n[REPOSE])
    heaped = tilt < repose
    slope = n[REPOSE] if rim_z >= 0.0 else -n[REPOSE]
    if rim_z > 0.0 and level > 0.0:
        share = min(level / rim_z, 1.0)
        low_r, low_z = share * rim_r, share * rim_z
    area, moment_r, moment_z = 0.0, 0.0, 0.0
    first_r, first_z, before_r, before_z, any_point = 0.0, 0.0, 0.0, 0.0, False
    r0, z0 = rim_r, rim_z
    over0 = z0 - low_z - slope * (r0 - low_r)
    for i in range(count):
        x, y = n[OUTLINE_START + 2 * i], n[OUTLINE_START + 2 * i + 1]
        r1, z1 = c * x - s * y, s * x + c * y
        over1 = z1 - low_z - slope * (r1 - low_r)
        for part in range(2):  # intersection of the side with the surface, then its end if below
            if part == 0:
                if heaped or (over0 <= 0.0) == (over1 <= 0.0):
                    continue
                t = over0 / (over0 - over1)
                pr, pz = r0 + t * (r1 - r0), z0 + t * (z1 - z0)
            else:
                if not heaped and over1 > 0.0:
                    continue
                pr, pz = r1, z1
            if any_point:
                cross = before_r * pz - pr * before_z
                area += cross
                moment_r += cross * (before_r + pr)
                moment_z += cross * (before_z + pz)
            else:
                first_r, first_z, any_point = pr, pz, True
            before_r, before_z = pr, pz
        r0, z0, over0 = r1, z1, over1
    cross = before_r * first_z - first_r * before_z
    area += cross
    moment_r += cross * (before_r + first_r)
    moment_z += cross * (before_z + first_z)
    area, moment_r, moment_z = 0.5 * area, moment_r / 6.0, moment_z / 6.0
    if area < 0.0:
        area, moment_r, moment_z = -area, -moment_r, -moment_z
    if heaped:
        near, far = repose - tilt, repose + tilt
        heap = 0.5 * chord * chord * math.sin(near) * math.sin(far) / math.sin(near + far)
        height = 2.0 * heap / chord
        area += heap
        moment_r += heap * 0.5 * rim_r
        moment_z += heap * (0.5 * rim_z + height / 3.0)
    out[0] = area * n[INNER_WIDTH]
    out[1] = moment_r / area if area > 1e-9 else 0.0
    out[2] = moment_z / area if area > 1e-9 else 0.0


MAX_RAKE = 0.5 * math.pi  # rad; soil that sticks to a steeper blade acts as the blade
MIN_RAKE = math.radians(15.0)  # rad, minimum rake
MAX_FAN_ANGLE = math.radians(150.0)  # rad, rake + delta + phi above which Coulomb's plane fails
MAX_SLOPE_RATIO = 0.6  # maximum slope as a fraction of the friction angle
_MIN_SQUARE = 0.05  # lower bound that avoids jamming of nearly parallel blade and surface


@compile_without_allocation
def failure_plane_angle(rake, slope, friction, tool_friction):
    """Return the angle between the surface and the plane along which a blade shears off the soil.

    Of all planes through the edge, soil fails along the one with the minimum weight factor N_g
    (`wedge_weight_factor`). Setting the derivative of `N_g(cot beta)` to zero gives a quadratic equation.

    Args:
        rake: between blade and surface, scalar [rad].
        slope: of the surface, positive where it rises ahead of the blade, scalar [rad].
        friction: phi, angle of internal friction of the soil, scalar [rad].
        tool_friction: delta, angle of friction between soil and blade, scalar [rad].

    Returns:
        beta, scalar [rad], within 5 .. 85 deg.

    Source: McKyes 1985, chapter 3; Coulomb's passive wedge.

    >>> import math
    >>> smooth_wall = failure_plane_angle(math.pi / 2, 0.0, math.radians(30), 0.0)
    >>> round(math.degrees(smooth_wall), 6)  # 45 - phi / 2
    30.0
    """
    fan = rake + tool_friction + friction
    square = (math.sin(tool_friction + friction) * math.sin(rake + tool_friction - slope)) / (
        math.sin(rake) * math.sin(friction + slope)
    )
    root = math.sqrt(max(square, _MIN_SQUARE))
    plane = math.atan2(math.sin(fan), root - math.cos(fan))
    return min(max(plane, math.radians(5.0)), math.radians(85.0))


@compile_without_allocation
def wedge_weight_factor(rake, slope, friction, tool_friction, plane):
    """Return the factor N_g of the blade force that is due to the weight of the soil wedge.

    This force is N_g times the specific weight of the soil, the blade width and the depth squared.

    Args:
        rake: between blade and surface, scalar [rad].
        slope: of the surface, scalar [rad].
        friction: phi, angle of internal friction of the soil, scalar [rad].
        tool_friction: delta, angle of friction between soil and blade, scalar [rad].
        plane: beta, angle between the surface and the failure plane, scalar [rad].

    Returns:
        N_g, scalar [1]; the depth is measured perpendicular to the surface.

    Source: McKyes 1985, chapter 3; Luengo et al. 1998.

    >>> import math
    >>> phi = math.radians(30)
    >>> N = wedge_weight_factor(math.pi / 2, 0.0, phi, 0.0, math.radians(30))
    >>> round(2.0 * N, 6)  # Rankine's tan^2(45 + phi / 2)
    3.0
    """
    top = 1.0 / math.tan(rake) + 1.0 / math.tan(plane)
    return 0.5 * top * surcharge_factor(rake, slope, friction, tool_friction, plane)


@compile_without_allocation
def surcharge_factor(rake, slope, friction, tool_friction, plane):
    """Return the factor N_q: blade force due to a load on the soil wedge, divided by this load.

    Args:
        rake: between blade and surface, scalar [rad].
        slope: of the surface, scalar [rad].
        friction: phi, angle of internal friction of the soil, scalar [rad].
        tool_friction: delta, angle of friction between soil and blade, scalar [rad].
        plane: beta, angle between the surface and the failure plane, scalar [rad].

    Returns:
        N_q, scalar [1].

    Source: Luengo et al. 1998.
    """
    return math.sin(plane + friction + slope) / math.sin(rake + tool_friction + friction + plane)


@compile_without_allocation
def cohesion_factor(rake, friction, tool_friction, plane):
    """Return the factor N_c of the blade force that is due to cohesion on the failure plane.

    This force is N_c times the cohesion, the blade width and the depth.

    Args:
        rake: between blade and surface, scalar [rad].
        friction: phi, angle of internal friction of the soil, scalar [rad].
        tool_friction: delta, angle of friction between soil and blade, scalar [rad].
        plane: beta, angle between the surface and the failure plane, scalar [rad].

    Returns:
        N_c, scalar [1].

    Source: McKyes 1985, chapter 3, simplified.
    """
    fan = rake + tool_friction + friction + plane
    return math.cos(friction) / (math.sin(plane) * math.sin(fan))


@compile_without_allocation
def adhesion_factor(rake, friction, tool_friction, plane):
    """Return the factor N_ca of the blade force that is due to adhesion of soil to the blade.

    This force is N_ca times the adhesion, the blade width and the depth.

    Args:
        rake: between blade and surface, scalar [rad].
        friction: phi, angle of internal friction of the soil, scalar [rad].
        tool_friction: delta, angle of friction between soil and blade, scalar [rad].
        plane: beta, angle between the surface and the failure plane, scalar [rad].

    Returns:
        N_ca, scalar [1]; it does not include the adhesion force along the blade itself.

    Source: McKyes 1985, chapter 3, simplified.
    """
    fan = rake + tool_friction + friction + plane
    return -math.cos(rake + friction + plane) / (math.sin(rake) * math.sin(fan))


@compile_without_allocation
def bearing_pressure(overburden, cohesion, friction, tilt):
    """Return the pressure at which soil yields under a smooth face that is pushed into it.

    `p + c cot phi = (q + c cot phi) tan^2(45 deg + phi/2) e^(2 theta tan phi)`. A level face
    rotates the principal stresses by theta = 90 deg, as in the strip footing of Prandtl and Reissner
    (N_q = 18.4 for phi = 30 deg). An upright face does not rotate them, as in Rankine's passive wall.

    Args:
        overburden: q, vertical pressure next to the face, scalar [Pa].
        cohesion: c, scalar [Pa].
        friction: phi, above 0, scalar [rad].
        tilt: angle between face and surface, 0 .. pi/2, scalar [rad].

    Returns:
        p, scalar [Pa].

    Source: Prandtl 1920, Reissner 1924; tilted faces Sokolovskii 1960. The weight of the soil below
    the face (N_gamma) is neglected, which is conservative and has little effect for narrow edges.
    """
    sine, t = math.sin(friction), math.tan(friction)
    factor = (1.0 + sine) / (1.0 - sine) * math.exp(2.0 * (0.5 * math.pi - tilt) * t)
    return (overburden + cohesion / t) * factor - cohesion / t


@compile_without_allocation
def limit_rake_angle(rake, slope, friction, tool_friction):
    """Return the rake of the blade relative to the surface, limited to the valid range of the wedge equation.

    A wedge of soil sticks to a blade that is steeper than upright, or too steep for its friction
    (Hettiaratchi and Reece 1975), and acts as the blade. A rake below 15 deg is replaced by 15 deg.

    Args:
        rake: of the blade to the horizontal, scalar [rad].
        slope: of the surface, scalar [rad].
        friction: phi, angle of internal friction of the soil, scalar [rad].
        tool_friction: delta, angle of friction between soil and blade, scalar [rad].

    Returns:
        rake relative to the surface, scalar [rad].

    Source: Hettiaratchi and Reece 1975.
    """
    steepest = min(MAX_RAKE, MAX_FAN_ANGLE - friction - tool_friction)
    return min(max(rake + slope, MIN_RAKE), steepest)


@compile_without_allocation
def limit_surface_slope(slope, friction):
    """Return the slope of the surface, limited to the range in which a failure plane can form.

    Args:
        slope: of the surface, scalar [rad].
        friction: phi, angle of internal friction of the soil, scalar [rad].

    Returns:
        slope, limited to +-0.6 phi, scalar [rad].

    Source: Coulomb's forces grow without bound as the slope approaches phi.
    """
    limit = MAX_SLOPE_RATIO * friction
    return min(max(slope, -limit), limit)


DEPTH_READING_DISTANCE = 1.5  # cells, distance ahead of the edge at which the depth of a cut is read: not yet cut
PUSH_DEAD_BAND = 0.02  # m, distance that the edge moves back before it pushes soil outwards
SPILL_TIME = 0.3  # s, time constant with which excess soil falls out of a tilted bucket
MIN_SPILL_RATE = 0.2  # m^3/s, minimum spill rate, so that the spilling ends
MAX_HEEL_CONTACT = 0.4  # m, maximum contact length of the heel, reached at a quarter of it in depth
SLIDE_SWEEPS = 2  # sweeps of sliding soil per step
EARTH_PRESSURE_RATIO = 0.5  # ratio of horizontal to vertical pressure next to a blade


@compile_without_allocation
def compute_cutting_force(n, depth, loose, rake, slope, load, out):
    """Compute the force of the soil on a blade that is drawn towards the machine.

    Args:
        n: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        depth: of the edge below the surface ahead, scalar [m].
        loose: thickness of the loose soil in this depth, which has no cohesion, scalar [m].
        rake: of the blade to the horizontal, scalar [rad].
        slope: of the surface, positive if it rises towards the machine, scalar [rad].
        load: weight of the soil in the bucket, which rests on the wedge, scalar [N].
        out: (2,) written: force outwards and up [N].

    Returns:
        Nothing.

    Source: Fundamental Equation of Earthmoving, see the module; adhesion along the blade as in McKyes 1985, chapter 3.
    """
    out[0], out[1] = 0.0, 0.0
    if depth <= 0.0:
        return
    phi, delta = n[FRICTION], n[TOOL_FRICTION]
    slope = limit_surface_slope(slope, phi)
    rake = limit_rake_angle(rake, slope, phi, delta)
    plane = failure_plane_angle(rake, slope, phi, delta)
    across = depth * math.cos(slope)
    bank = min(max(depth - loose, 0.0), depth) * math.cos(slope)
    weight = n[DENSITY] * n[GRAVITY_INDEX] * across * across * n[WIDTH]
    force = weight * wedge_weight_factor(rake, slope, phi, delta, plane)
    force += n[COHESION] * bank * n[WIDTH] * cohesion_factor(rake, phi, delta, plane)
    stuck = n[ADHESION] * bank * n[WIDTH]
    force += stuck * adhesion_factor(rake, phi, delta, plane)
    resting = min(load, 4.0 * weight)  # a thin wedge cannot carry a full bucket
    force += resting * surcharge_factor(rake, slope, phi, delta, plane)
    force = max(force, 0.0)
    upright = rake - slope
    out[0] = force * math.sin(upright + delta) + stuck * math.cos(upright) / math.sin(rake)
    out[1] = -force * math.cos(upright + delta) + stuck * math.sin(upright) / math.sin(rake)


@compile_without_allocation
def update_elastic_plastic_force(n, state, deflection_index, displacement, rate, low, high):
    """Update the elastic-plastic spring of one surface of the bucket and return the soil's force on it.

    A damper acts in parallel with the spring.

    The spring deflects as the surface moves into the soil and yields at the limit forces of soil
    mechanics. The force acts against the displacement.

    Args:
        n: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        state: (STATE_SIZE,) of the bucket; its deflection is changed [m].
        deflection_index: index of the deflection in the state, scalar [1].
        displacement: displacement of the surface into the soil since the last step, scalar [m].
        rate: rate of this displacement, scalar [m/s].
        low: minimum force, at most 0, scalar [N].
        high: maximum force, at least 0, scalar [N].

    Returns:
        force, scalar [N].

    Source: Prandtl's elastic-plastic element; it returns at most the energy of the spring.
    """
    k = n[STIFFNESS]
    spring = min(max(k * (state[deflection_index] + displacement), low), high)
    state[deflection_index] = spring / k
    return min(max(spring + n[DAMPING] * rate, low), high)


@compile_without_allocation
def _drop_soil(n, surface, loose, state, first, second, volume):
    lost = add_loose_soil(n, surface, loose, first, 0.5 * volume)
    lost += add_loose_soil(n, surface, loose, second, 0.5 * volume)
    state[LOST_VOLUME] += lost
    _widen_sliding_range(state, min(first, second), max(first, second), len(surface))


@compile_without_allocation
def _widen_sliding_range(state, low, high, count):
    """Add the cells `low` to `high` and their neighbours to the range in `state` in which soil may slide.

    `count` is the number of cells of the profile.
    """
    low, high = max(low - 1, 0), min(high + 1, count - 1)
    if state[LAST_SLIDING_CELL] <= state[FIRST_SLIDING_CELL]:
        state[FIRST_SLIDING_CELL], state[LAST_SLIDING_CELL] = low, high
    else:
        state[FIRST_SLIDING_CELL], state[LAST_SLIDING_CELL] = (
            min(state[FIRST_SLIDING_CELL], low),
            max(state[LAST_SLIDING_CELL], high),
        )


class EdgeMotion(NamedTuple):
    """Position and velocity of the bucket's edge in the plane of the arm; scalars.

    Attributes:
        r: radius [m].
        z: height [m].
        r_rate: outward speed [m/s].
        z_rate: upward speed [m/s].
        attitude: angle of the line from pin to edge above the horizontal [rad].
    """

    r: float
    z: float
    r_rate: float
    z_rate: float
    attitude: float


@compile_without_allocation
def _compute_bucket_forces(n, surface, loose, state, edge, dt, out):
    """Compute the total soil force on the bucket and its moment, and the depth of the edge in the soil.

    Outward force, upward force [N] and moment about the edge [N m] are written to the first three
    values of `out`. The deflections and the previous positions in `state` are updated. The other
    arguments are those of `step_soil`.

    Returns:
        (depth below the soil on the machine's side, depth below the soil on the far side), scalars
        [m]; negative if the edge is above the soil.
    """
    r, z, r_rate, z_rate, attitude = edge
    phi, delta = n[FRICTION], n[TOOL_FRICTION]
    reach = DEPTH_READING_DISTANCE * n[CELL_LENGTH]
    height = surface_height(n, surface, r - reach)
    inside = min(height - z, n[BUCKET_SIZE])  # higher soil falls into the mouth
    outside = min(surface_height(n, surface, r + reach) - z, n[BUCKET_SIZE])
    dr, dz = r - state[LAST_R], z - state[LAST_Z]
    # the face
    if inside > 0.0:
        slope = math.atan2(surface_height(n, surface, r - 4.0 * reach) - height, 3.0 * reach)
        over = surface_height(n, loose, r - reach)
        rake = attitude + math.pi - n[FLOOR_ANGLE]
        rake -= 2.0 * math.pi * math.floor((rake + math.pi) / (2.0 * math.pi))
        load = state[CARRIED_VOLUME] / n[SWELL] * n[DENSITY] * n[GRAVITY_INDEX]
        compute_cutting_force(n, inside, over, rake, slope, load, out)
        limit = math.hypot(out[0], out[1])
        ar, az = (out[0] / limit, out[1] / limit) if limit > 0.0 else (1.0, 0.0)
        f = update_elastic_plastic_force(n, state, FACE, -dr * ar - dz * az, -r_rate * ar - z_rate * az, 0.0,
                           limit)  # fmt: skip
        out[0], out[1] = f * ar, f * az
    else:
        state[FACE], out[0], out[1] = 0.0, 0.0, 0.0
        rake = attitude + math.pi - n[FLOOR_ANGLE]
        rake -= 2.0 * math.pi * math.floor((rake + math.pi) / (2.0 * math.pi))
    # edge and underside of the floor
    deepest = max(inside, outside)
    if deepest > 0.0:
        tilt = min(max(rake, 0.0), 0.5 * math.pi)
        c, s = math.cos(tilt), math.sin(tilt)
        weight = n[DENSITY] * n[GRAVITY_INDEX]
        contact = min(deepest / max(s, 0.1), n[FLOOR_LENGTH])
        shear = n[ADHESION] + EARTH_PRESSURE_RATIO * 0.5 * weight * deepest * math.tan(delta)
        rub = 2.0 * n[WIDTH] * contact * shear
        sharp = n[EDGE_THICKNESS] * n[WIDTH] * min(deepest / n[EDGE_THICKNESS], 1.0)
        push = sharp * bearing_pressure(weight * deepest, n[COHESION], phi, 0.0) + rub
        f = update_elastic_plastic_force(n, state, TIP, -dr * c - dz * s, -r_rate * c - z_rate * s, -rub, push)
        out[0] += f * c
        out[1] += f * s
        yield_at = 0.0
        if outside > 0.0:
            contact = min(outside / max(s, 0.1), n[FLOOR_LENGTH])
            pressure = bearing_pressure(0.5 * weight * outside, n[COHESION], phi, tilt)
            yield_at = pressure * contact * n[WIDTH]
        f = update_elastic_plastic_force(n, state, FLOOR, dr * s - dz * c, r_rate * s - z_rate * c, 0.0,
                           yield_at)  # fmt: skip
        out[0] -= f * s
        out[1] += f * c
    else:
        state[TIP], state[FLOOR] = 0.0, 0.0
    # the heel
    c, s = math.cos(attitude), math.sin(attitude)
    from_edge_r, from_edge_z = n[HEEL_X] * c - n[HEEL_Z] * s, n[HEEL_X] * s + n[HEEL_Z] * c
    heel_r, heel_z = r + from_edge_r, z + from_edge_z
    deep = min(surface_height(n, surface, heel_r) - heel_z, n[BUCKET_SIZE])
    if deep > 0.0:
        dr, dz = heel_r - state[LAST_HEEL_R], heel_z - state[LAST_HEEL_Z]
        contact = min(4.0 * deep, MAX_HEEL_CONTACT)
        pressure = bearing_pressure(0.5 * n[DENSITY] * n[GRAVITY_INDEX] * deep, n[COHESION], phi, 0.0)
        up = update_elastic_plastic_force(n, state, HEEL, -dz, -dz / dt, 0.0, pressure * contact * n[WIDTH])
        rub = up * math.tan(delta)
        back = update_elastic_plastic_force(n, state, SLIDE, -dr, -dr / dt, -rub, rub)
        out[0] += back
        out[1] += up
        out[2] = from_edge_r * up - from_edge_z * back
    else:
        state[HEEL], state[SLIDE], out[2] = 0.0, 0.0, 0.0
    state[LAST_R], state[LAST_Z] = r, z
    state[LAST_HEEL_R], state[LAST_HEEL_Z] = heel_r, heel_z
    return inside, outside


@compile_without_allocation
def step_soil(n, surface, loose, state, edge, dt, out):
    """Advance profile and bucket by one time step and compute the force of the soil on the bucket.

    The step comprises cutting, filling, spilling and sliding of the soil.

    The function allocates nothing and changes only its arguments, so every environment can run in
    its own thread. The force changes smoothly with depth, also between cells.

    Args:
        n: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        surface: (m,) height of the profile, changed [m].
        loose: (m,) thickness of the loose layer, changed [m].
        state: (STATE_SIZE,) state of the bucket from `make_bucket_state`, changed.
        edge: EdgeMotion: position [m], attitude [rad] and velocity [m/s] of the cutting edge.
        dt: time since the previous step, scalar [s].
        out: (RESULT_SIZE,) written: force outwards and up [N], moment about the edge [N m], mass
            carried [kg] and its position relative to the edge [m]. The force does not include the
            weight of the soil carried.

    Returns:
        Nothing.

    Source: this module and `terrain`.
    """
    r, z, attitude = edge.r, edge.z, edge.attitude
    for i in range(RESULT_SIZE):
        out[i] = 0.0
    if state[IS_INITIALISED] == 0.0:
        c, s = math.cos(attitude), math.sin(attitude)
        state[IS_INITIALISED], state[LAST_R], state[LAST_Z], state[CUT_FRONT] = 1.0, r, z, r
        state[LAST_HEEL_R] = r + n[HEEL_X] * c - n[HEEL_Z] * s
        state[LAST_HEEL_Z] = z + n[HEEL_X] * s + n[HEEL_Z] * c
        state[FIRST_SLIDING_CELL], state[LAST_SLIDING_CELL] = 0.0, len(surface) - 1.0
    z_before, count = state[LAST_Z], len(surface)
    inside, outside = _compute_bucket_forces(n, surface, loose, state, edge, dt, out)
    state[DEPTH] = max(inside, 0.0)
    force_r, force_z, moment = out[FORCE_R], out[FORCE_Z], out[MOMENT]
    here = find_cell_at_radius(n, r)
    wall = here if inside > 0.0 or outside > 0.0 else -2  # cell that contains the bucket
    taken, pushed = 0.0, 0.0
    if r < state[CUT_FRONT]:
        taken = cut_cells(n, surface, loose, state[CUT_FRONT], z_before, r, z)
        state[CUT_FRONT] = r
    elif r > state[CUT_FRONT] + PUSH_DEAD_BAND:
        pushed = cut_cells(n, surface, loose, state[CUT_FRONT] + PUSH_DEAD_BAND, z_before, r, z)
        state[CUT_FRONT] = r - PUSH_DEAD_BAND
    if pushed > 0.0:
        _drop_soil(n, surface, loose, state, here + 1, here + 2, pushed)
    state[CARRIED_VOLUME] += taken
    if state[CARRIED_VOLUME] > 0.0:
        compute_bucket_capacity(n, attitude, max(inside, 0.0), out)
        most, rim = out[0], out[3]
        centre_r, centre_z = out[1], out[2]
        excess = state[CARRIED_VOLUME] - most
        if excess > 0.0:
            if inside > 0.0:  # the pile ahead of the edge
                falls = excess
                _drop_soil(n, surface, loose, state, here - 1, here - 2, falls)
            else:
                falls = min(excess, (excess / SPILL_TIME + MIN_SPILL_RATE) * dt)
                below = find_cell_at_radius(n, r + rim)
                _drop_soil(n, surface, loose, state, below, below - 1, falls)
            state[CARRIED_VOLUME] -= falls
        out[MASS] = state[CARRIED_VOLUME] / n[SWELL] * n[DENSITY]
        out[MASS_R], out[MASS_Z] = centre_r, centre_z
    out[FORCE_R], out[FORCE_Z], out[MOMENT] = force_r, force_z, moment
    if wall > -2:
        _widen_sliding_range(state, min(max(here - 1, 0), count - 1), min(max(here + 1, 0), count - 1), count)
    if state[LAST_SLIDING_CELL] > state[FIRST_SLIDING_CELL]:
        slid = False
        low, high = int(state[FIRST_SLIDING_CELL]), int(state[LAST_SLIDING_CELL])
        for _ in range(SLIDE_SWEEPS):
            slid |= slide_soil_in_range(n, surface, loose, low, high, wall)
        if slid:
            state[FIRST_SLIDING_CELL], state[LAST_SLIDING_CELL] = (
                max(low - 1, 0),
                min(high + 1, count - 1),
            )
        else:
            state[FIRST_SLIDING_CELL], state[LAST_SLIDING_CELL] = 0.0, 0.0


@compile_without_allocation
def compute_bucket_wrench(out, edge, theta, centre, wrench):
    """Compute the wrench of the soil and of the carried load on the bucket's body, in the world frame.

    Args:
        out: (RESULT_SIZE,) result of `step_soil` [N], [N m], [kg], [m].
        edge: (3,) position of the edge in the world [m].
        theta: azimuth of the edge about the swing axis, scalar [rad].
        centre: (3,) centre of mass of the bucket's body in the world, `xipos` [m].
        wrench: (6,) written: force, and torque about `centre`, as for `xfrc_applied` [N], [N m].

    Returns:
        Nothing.

    Source: statics; the inertia of the load is neglected.
    """
    c, s = math.cos(theta), math.sin(theta)
    weight = GRAVITY * out[MASS]
    fx, fy, fz = c * out[FORCE_R], s * out[FORCE_R], out[FORCE_Z]
    x, y, z = edge[0] - centre[0], edge[1] - centre[1], edge[2] - centre[2]
    load_x, load_y = x + c * out[MASS_R], y + s * out[MASS_R]
    wrench[0], wrench[1], wrench[2] = fx, fy, fz - weight
    wrench[3] = y * fz - z * fy - load_y * weight + s * out[MOMENT]
    wrench[4] = z * fx - x * fz + load_x * weight - c * out[MOMENT]
    wrench[5] = x * fy - y * fx
