"""Draw random smooth functions of physical variables that act on the machine.

Drawn without a look at the search's own terms: waves of random direction in the plane of two
variables, with and without switching, play (hysteresis) and a window of time.
"""

import numpy as np

from hydrotele.machine.machine import Machine as Facts
from tools.validation.blind.world import TARGETS, VARIABLES, Added, Machine

_WAVES = 6
_SIZES = {  # share of the target's own scale, A: large enough to matter, small enough to run
    "force": (0.01, 0.06), "flow_head": (0.01, 0.06), "flow_rod": (0.01, 0.06),
    "command": (0.01, 0.06), "spool_rate": (0.1, 0.6), "pump_flow": (0.05, 0.25),
}  # fmt: skip


def draw_unknown(
    machine: Machine, facts: Facts, travelled: dict[str, np.ndarray], rng: np.random.Generator
) -> tuple[Machine, dict]:
    """Give a machine an unknown term.

    Args:
        machine: the independent machine without one.
        facts: its facts.
        travelled: variable -> (rows, n) values of a run without the term, which say how wide each
            variable runs.
        rng: source of the choice.

    Returns:
        (the machine, what was drawn).
    """
    n, names = len(facts.axes), list(facts.axes)
    target, axis = str(rng.choice(TARGETS)), int(rng.integers(n))
    if target == "pump_flow":
        axis = 0
    # a term of the clock alone would be noise to all: the first variable is one of the machine
    kinds = [int(rng.integers(len(VARIABLES) - 1)), int(rng.integers(len(VARIABLES)))]
    of = [axis if rng.random() < 0.7 else int(rng.integers(n)) for _ in kinds]
    if rng.random() < 0.5:  # of one variable only
        kinds[1], of[1] = kinds[0], of[0]
    seen = [travelled[VARIABLES[k]][:, i] for k, i in zip(kinds, of, strict=True)]
    centre = np.array([np.median(v) for v in seen])
    width = np.array([max(np.std(v), 1e-9) for v in seen])
    weight = rng.normal(size=_WAVES)
    weight *= np.sqrt(2.0) / np.linalg.norm(weight)
    gate = int(rng.choice([0, 0, 1, 2, 3]))
    low, high = 0.0, 0.0
    if gate == 1:
        low, high = sorted(rng.uniform(-0.8, 0.8, 2))
    elif gate == 2:
        low = float(rng.uniform(0.3, 1.0))
    elif gate == 3:
        low = float(rng.uniform(3.0, 20.0))
        high = low + float(rng.uniform(3.0, 15.0))
    d = machine.drives
    rated = d.flow_gain[axis] * np.sqrt(7e6)
    whole = {
        "force": d.relief * d.area_head[axis], "flow_head": rated, "flow_rod": rated,
        "command": 1.0, "spool_rate": 1.0, "pump_flow": d.pump,
    }[target]  # fmt: skip
    size = whole * float(rng.uniform(*_SIZES[target]))
    added = Added(
        TARGETS.index(target), axis, np.array(kinds), np.array(of), centre, width, weight,
        rng.normal(scale=1.2, size=(_WAVES, 2)), rng.uniform(0, 2 * np.pi, _WAVES), size, gate,
        float(low), float(high),
    )  # fmt: skip
    told = {
        "name": "unknown_term",
        "acts_on": target,
        "location": "supply" if target == "pump_flow" else names[axis],
        "variables": [
            VARIABLES[k] if VARIABLES[k] in ("supply", "time") else f"{VARIABLES[k]}.{names[i]}"
            for k, i in zip(kinds, of, strict=True)
        ],
        "gate": ["always", "switch", "play", "window"][gate],
        "parameters": {"size": size, "low": low, "high": high},
    }
    return machine._replace(added=added), told
