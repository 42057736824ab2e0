"""Move soil between the cells of a profile: cut it, lay it down, and let it slide.

Cell i extends from `start + i cell` to the next cell. `surface` [m] is the height of its top, and
`loose` [m] the thickness of the loose soil on the undisturbed bank. All volumes are loose volumes;
soil that is cut from the bank swells. The functions return the volume that leaves the profile at
its ends, so that mass is conserved.
"""

import math

from hydrotele.core.compiled import compile_without_allocation
from hydrotele.soil.parameters import CELL_LENGTH, CUT_SLOPE, PROFILE_START, REPOSE, SWELL, WIDTH

MIN_SLIDING_HEIGHT = 1e-4  # m, height difference above the stable one at which soil does not slide


@compile_without_allocation
def surface_height(n, surface, r):
    """Return the height of the soil surface at a radius.

    The height is linear between cell centres, and constant before the first and after the last one.

    Args:
        n: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        surface: (m,) heights [m].
        r: radius, scalar [m].

    Returns:
        height, scalar [m].

    Source: linear interpolation.
    """
    place = (r - n[PROFILE_START]) / n[CELL_LENGTH] - 0.5
    last = len(surface) - 1
    if place <= 0.0:
        return surface[0]
    if place >= last:
        return surface[last]
    i = int(place)
    return surface[i] + (place - i) * (surface[i + 1] - surface[i])


@compile_without_allocation
def cut_cells(n, surface, loose, r0, z0, r1, z1):
    """Remove the soil above the path of the bucket's edge from the cells that the edge sweeps in a step.

    A partly swept cell gets the mean height of its cut and uncut parts. When the edge later sweeps
    on in this cell, the corresponding fraction of the uncut part is removed.

    Args:
        n: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        surface: (m,) heights, changed [m].
        loose: (m,) loose part of them, changed [m].
        r0: radius of the edge before the step, scalar [m].
        z0: height before the step, scalar [m].
        r1: radius after the step, scalar [m].
        z1: height after the step, scalar [m].

    Returns:
        Loose volume removed, scalar [m^3].

    Source: conservation of volume.
    """
    last = len(surface) - 1
    low = max((min(r0, r1) - n[PROFILE_START]) / n[CELL_LENGTH], 0.0)
    high = min((max(r0, r1) - n[PROFILE_START]) / n[CELL_LENGTH], last + 1.0)
    if not low < high:
        return 0.0
    inwards = r1 < r0
    slope = (z1 - z0) / (r1 - r0)
    taken = 0.0
    for i in range(int(low), min(int(high), last) + 1):
        left, right = max(low, float(i)), min(high, i + 1.0)
        if right <= left:
            continue
        remains = right - i if inwards else i + 1.0 - left
        middle = n[PROFILE_START] + n[CELL_LENGTH] * 0.5 * (left + right)
        over = surface[i] - (z0 + slope * (middle - r0))
        if over <= 0.0:
            continue
        depth = over * min((right - left) / remains, 1.0)
        from_loose = min(depth, loose[i])
        surface[i] -= depth
        loose[i] -= from_loose
        taken += from_loose + n[SWELL] * (depth - from_loose)
    return taken * n[CELL_LENGTH] * n[WIDTH]


@compile_without_allocation
def add_loose_soil(n, surface, loose, cell, volume):
    """Add a volume of loose soil to the top of a cell.

    Args:
        n: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        surface: (m,) heights, changed [m].
        loose: (m,) loose part of them, changed [m].
        cell: index of the cell, scalar [1].
        volume: of loose soil, scalar [m^3].

    Returns:
        Volume lost because the cell is outside the profile, scalar [m^3].

    Source: conservation of volume.
    """
    if cell < 0 or cell >= len(surface):
        return volume
    rise = volume / (n[CELL_LENGTH] * n[WIDTH])
    surface[cell] += rise
    loose[cell] += rise
    return 0.0


@compile_without_allocation
def find_cell_at_radius(n, r):
    """Return the index of the cell at a radius; outside the profile it is negative or too large.

    Args:
        n: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        r: radius, scalar [m].

    Returns:
        index, scalar [1].

    Source: definition of the profile.
    """
    return int(math.floor((r - n[PROFILE_START]) / n[CELL_LENGTH]))


@compile_without_allocation
def slide_soil_between_cells(n, surface, loose, upper, lower):
    """Let soil slide from one cell to its lower neighbour, in place.

    Loose soil slides until the slope between the cells is the angle of repose. If the upper cell
    then has no loose soil and the slope exceeds the cut slope, the bank breaks off down to the cut
    slope. Height differences of less than MIN_SLIDING_HEIGHT above the stable one remain.

    Args:
        n: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        surface: (m,) heights, changed [m].
        loose: (m,) loose part of them, changed [m].
        upper: index of the higher cell, scalar [1].
        lower: index of its neighbour, scalar [1].

    Returns:
        Whether soil has moved.

    Source: loose soil rests at the angle of repose; the bank stands up to its cut slope, and soil
    that breaks off is loose.
    """
    step = surface[upper] - surface[lower]
    excess = step - n[REPOSE] * n[CELL_LENGTH]
    if excess <= MIN_SLIDING_HEIGHT:
        return False
    moved = min(0.5 * excess, loose[upper])
    if moved > 0.0:
        surface[upper] -= moved
        loose[upper] -= moved
        surface[lower] += moved
        loose[lower] += moved
    excess = step - 2.0 * moved - n[CUT_SLOPE] * n[CELL_LENGTH]
    if excess > MIN_SLIDING_HEIGHT and loose[upper] <= 0.0:
        broken = excess / (1.0 + n[SWELL])
        surface[upper] -= broken
        surface[lower] += n[SWELL] * broken
        loose[lower] += n[SWELL] * broken
        return True
    return moved > 0.0


@compile_without_allocation
def slide_soil_in_range(n, surface, loose, low, high, wall):
    """Let the soil of a range of cells slide in one forward and one backward sweep.

    Args:
        n: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        surface: (m,) heights, changed [m].
        loose: (m,) loose part of them, changed [m].
        low: index of the first cell, scalar [1].
        high: index of the last cell, scalar [1].
        wall: index of the cell that contains the bucket, -2 for none; no soil slides into or out of
            it, scalar [1].

    Returns:
        Whether soil has moved.

    Source: Gauss-Seidel sweeps; every move conserves mass.
    """
    slid = False
    for i in range(low, high):
        if i != wall and i + 1 != wall:
            if surface[i] >= surface[i + 1]:
                slid |= slide_soil_between_cells(n, surface, loose, i, i + 1)
            else:
                slid |= slide_soil_between_cells(n, surface, loose, i + 1, i)
    for j in range(low, high):
        i = high - 1 - (j - low)
        if i != wall and i + 1 != wall:
            if surface[i] >= surface[i + 1]:
                slid |= slide_soil_between_cells(n, surface, loose, i, i + 1)
            else:
                slid |= slide_soil_between_cells(n, surface, loose, i + 1, i)
    return slid
