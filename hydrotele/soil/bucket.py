"""How much loose soil a tilted bucket holds, and where its centre lies."""

import math

from hydrotele.core.compiled import lean
from hydrotele.soil.numbers import CORNERS, INNER_WIDTH, OUTLINE, REPOSE


@lean
def held_soil(n, attitude, level, out):
    """Volume of soil that rests in the bucket: below a surface at the angle of repose from its rim.

    The surface rises from the lower rim into the bucket. With the mouth tilted less than the angle
    of repose the bucket is full and a heap lies on top, at the angle of repose from both rims. Soil
    ahead of the mouth props what lies behind it: the surface then begins where it meets the mouth.

    Args:
        n: (k,) of `soil_numbers`.
        attitude: of the bucket, scalar [rad].
        level: height of the soil ahead of the mouth over the edge, scalar [m].
        out: (4,) written: volume [m^3]; centre outwards and up from the edge [m]; how far out the
            lower rim lies from the edge [m].

    Returns:
        Nothing.

    Source: geometry; the heap as in SAE J296, with the angle of repose for its 1:1.
    """
    c, s = math.cos(attitude), math.sin(attitude)
    count = int(n[CORNERS])
    last = OUTLINE + 2 * (count - 1)
    rim_r, rim_z = c * n[last] - s * n[last + 1], s * n[last] + c * n[last + 1]
    low_r, low_z = (0.0, 0.0) if rim_z >= 0.0 else (rim_r, rim_z)
    out[3] = low_r
    chord = math.sqrt(rim_r * rim_r + rim_z * rim_z)
    tilt = math.atan2(abs(rim_z), rim_r)  # of the mouth against level
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
        x, y = n[OUTLINE + 2 * i], n[OUTLINE + 2 * i + 1]
        r1, z1 = c * x - s * y, s * x + c * y
        over1 = z1 - low_z - slope * (r1 - low_r)
        for part in range(2):  # where the side crosses the surface, then its end if below
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
