r"""The bucket seen from its side.

```
             o pin        Attitude a: of the line pin -> edge against the horizontal, positive
             |\           raises the edge. The mouth lies along that line and looks along
             | \          (sin a, -cos a): towards the machine at -90 deg (drawn here: it digs),
       mouth |  ) shell   straight up at -180 deg (curled in: it holds), straight down at 0
             | /          (dumped).
             |/ rake
 machine <-- +-------     edge
```

Here the machine is on the left, radius grows to the right. The floor runs from the edge back into
the shell, `floor_angle` from the mouth; seen from the edge it rises outwards at
`rake = a + 180 deg - floor_angle`. That is the rake of a blade which is drawn towards the machine:
90 deg is an upright wall, 0 a level floor that only slides, and below 0 the heel lies deeper than
the edge.

| attitude [deg] | rake | |
| ---: | ---: | --- |
| -45 | 93 | upright blade; everything falls out |
| -75 | 63 | enters the ground |
| -90 | 48 | cuts; holds only what the ground ahead props |
| -110 | 28 | cuts flat, begins to hold |
| -138 | 0 | floor level: grading; holds nearly a struck load |
| -170 .. -190 | -32 .. | carries a heaped load |
"""

from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError


class Bucket(NamedTuple):
    """A bucket's side view, in its own frame: x from pin to edge, z up, [m].

    Attributes:
        outline: ((x, z), ...) of the room inside, from the edge along floor and shell to the rim
            beside the pin; the mouth closes it.
        heel: (x, z) of the lowest point once the bucket is curled in.
        floor_angle: between mouth and floor, at the edge [rad].
        floor_length: of the flat floor [m].
        width: of the cut [m].
        inner_width: of the room inside [m].
        edge: thickness of the cutting edge [m].
    """

    outline: tuple[tuple[float, float], ...]
    heel: tuple[float, float]
    floor_angle: float
    floor_length: float
    width: float
    inner_width: float
    edge: float


CAT215 = Bucket(
    outline=(
        (1.35, 0.0), (0.74, 0.55), (0.57, 0.635), (0.40, 0.64), (0.25, 0.57), (0.14, 0.44),
        (0.085, 0.28), (0.10, 0.06),
    ),
    heel=(0.57, 0.65),
    floor_angle=0.7389,
    floor_length=0.85,
    width=1.2,
    inner_width=1.168,
    edge=0.03,
)  # fmt: skip
"""Of the shapes in models/cat215/cat215.xml: side plates, floor, teeth; edge assumed. 0.59 m^3 to
the mouth, 0.91 m^3 heaped at 35 deg."""


def outline_from_edge(bucket: Bucket) -> np.ndarray:
    """Outline (m, 2) of the room inside with the edge as origin [m].

    Raises:
        InputError: the outline has too few or too many corners.
    """
    outline = np.array(bucket.outline, float)
    if not 3 <= len(outline) <= 16:
        raise InputError("bucket", f"its outline has {len(outline)} corners; 3 to 16 are allowed")
    return outline - outline[0]
