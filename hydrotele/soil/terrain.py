"""Soil that moves between the cells of a profile: cut, laid down, sliding.

Cell i reaches from `start + i cell` to the next; `surface` [m] is the height of its top and `loose`
[m] how much of it lies loose on the undisturbed bank. Volumes are loose ones; what is cut from the
bank swells. What leaves the profile at its ends is told, so that no mass is lost unnoticed.
"""

import math

from hydrotele.core.compiled import allocation_free
from hydrotele.soil.facts import CELL, CUT_SLOPE, REPOSE, START, SWELL, WIDTH

SETTLED = 1e-4  # m, a step between cells beyond the stable one that is left alone


@allocation_free
def surface_height(n, surface, r):
    """Height of the surface between the middles of cells, that of the end cells beyond them.

    Args:
        n: (k,) of `soil_parameters`.
        surface: (m,) heights [m].
        r: radius, scalar [m].

    Returns:
        height, scalar [m].

    Source: linear interpolation.
    """
    place = (r - n[START]) / n[CELL] - 0.5
    last = len(surface) - 1
    if place <= 0.0:
        return surface[0]
    if place >= last:
        return surface[last]
    i = int(place)
    return surface[i] + (place - i) * (surface[i + 1] - surface[i])


@allocation_free
def cut_cells_(n, surface, loose, r0, z0, r1, z1):
    """Take away what lies above the path of the edge in the cells that it sweeps.

    A cell of which the edge has passed a part holds the mean of what is cut and what is not: a
    further part takes its share of what remains.

    Args:
        n: (k,) of `soil_parameters`.
        surface: (m,) heights, changed [m].
        loose: (m,) loose part of them, changed [m].
        r0: radius before, scalar [m].
        z0: height before, scalar [m].
        r1: radius after, scalar [m].
        z1: height after, scalar [m].

    Returns:
        Volume taken, loose, scalar [m^3].

    Source: conservation of volume.
    """
    last = len(surface) - 1
    low = max((min(r0, r1) - n[START]) / n[CELL], 0.0)
    high = min((max(r0, r1) - n[START]) / n[CELL], last + 1.0)
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
        middle = n[START] + n[CELL] * 0.5 * (left + right)
        over = surface[i] - (z0 + slope * (middle - r0))
        if over <= 0.0:
            continue
        depth = over * min((right - left) / remains, 1.0)
        from_loose = min(depth, loose[i])
        surface[i] -= depth
        loose[i] -= from_loose
        taken += from_loose + n[SWELL] * (depth - from_loose)
    return taken * n[CELL] * n[WIDTH]


@allocation_free
def lay_down_(n, surface, loose, cell, volume):
    """Lay loose soil on a cell.

    Args:
        n: (k,) of `soil_parameters`.
        surface: (m,) heights, changed [m].
        loose: (m,) loose part of them, changed [m].
        cell: number of the cell, scalar [1].
        volume: of loose soil, scalar [m^3].

    Returns:
        Volume that fell beside the profile, scalar [m^3].

    Source: conservation of volume.
    """
    if cell < 0 or cell >= len(surface):
        return volume
    rise = volume / (n[CELL] * n[WIDTH])
    surface[cell] += rise
    loose[cell] += rise
    return 0.0


@allocation_free
def cell_of(n, r):
    """Number of the cell at a radius, below 0 or beyond the last outside of the profile.

    Args:
        n: (k,) of `soil_parameters`.
        r: radius, scalar [m].

    Returns:
        number, scalar [1].

    Source: definition of the profile.
    """
    return int(math.floor((r - n[START]) / n[CELL]))


@allocation_free
def slide_pair_(n, surface, loose, upper, lower):
    """Let soil slide from one cell to its lower neighbour, at most to the stable slope.

    Args:
        n: (k,) of `soil_parameters`.
        surface: (m,) heights, changed [m].
        loose: (m,) loose part of them, changed [m].
        upper: number of the higher cell, scalar [1].
        lower: number of its neighbour, scalar [1].

    Returns:
        Whether something slid.

    Source: loose soil rests at the angle of repose; the bank stands up to its cut slope, and what
    breaks from it is loose.
    """
    step = surface[upper] - surface[lower]
    excess = step - n[REPOSE] * n[CELL]
    if excess <= SETTLED:
        return False
    moved = min(0.5 * excess, loose[upper])
    if moved > 0.0:
        surface[upper] -= moved
        loose[upper] -= moved
        surface[lower] += moved
        loose[lower] += moved
    excess = step - 2.0 * moved - n[CUT_SLOPE] * n[CELL]
    if excess > SETTLED and loose[upper] <= 0.0:
        broken = excess / (1.0 + n[SWELL])
        surface[upper] -= broken
        surface[lower] += n[SWELL] * broken
        loose[lower] += n[SWELL] * broken
        return True
    return moved > 0.0


@allocation_free
def slide_cells_(n, surface, loose, low, high, wall):
    """Let the soil of a range of cells slide once, from the left and from the right.

    Args:
        n: (k,) of `soil_parameters`.
        surface: (m,) heights, changed [m].
        loose: (m,) loose part of them, changed [m].
        low: first cell, scalar [1].
        high: last cell, scalar [1].
        wall: cell into which and from which nothing slides, -2 for none, scalar [1].

    Returns:
        Whether something slid.

    Source: Gauss-Seidel sweeps; every move conserves mass.
    """
    slid = False
    for i in range(low, high):
        if i != wall and i + 1 != wall:
            if surface[i] >= surface[i + 1]:
                slid |= slide_pair_(n, surface, loose, i, i + 1)
            else:
                slid |= slide_pair_(n, surface, loose, i + 1, i)
    for j in range(low, high):
        i = high - 1 - (j - low)
        if i != wall and i + 1 != wall:
            if surface[i] >= surface[i + 1]:
                slid |= slide_pair_(n, surface, loose, i, i + 1)
            else:
                slid |= slide_pair_(n, surface, loose, i + 1, i)
    return slid
