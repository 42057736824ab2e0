"""Effects that act for a while: when they begin is read from the unknown inputs."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hydrotele.estimate.evidence import Judged
from hydrotele.estimate.hypothesis import Hypothesis
from hydrotele.estimate.inputs import Input
from hydrotele.estimate.levels import smoothed_inputs


def timed(candidates: Sequence[Hypothesis], base: Judged) -> list[Hypothesis]:
    """Candidates of which those that act for a while only begin when the unknown inputs say so."""
    inputs = base.tracks[0].levels.inputs
    series = None
    found = []
    for candidate in candidates:
        acts = Input("force", candidate.location)
        if not {"size", "start", "duration"} <= candidate.parameters.keys() or acts not in inputs:
            found.append(candidate)
            continue
        if series is None:
            series = [smoothed_inputs(t) for t in base.tracks]
        place = inputs.index(acts)
        spans = [
            _loudest(u[:, place], t.run.period) for u, t in zip(series, base.tracks, strict=True)
        ]
        best = int(np.argmax([span[0] for span in spans]))
        _, size, first, rows = spans[best]
        run, table = base.tracks[best].run, dict(candidate.parameters)
        table["size"] = replace(table["size"], starts=(size,))
        for key, value in (
            ("start", run.start + first * run.period),
            ("duration", rows * run.period),
        ):
            table[key] = replace(table[key], nominal=value)
        found.append(replace(candidate, parameters=table))
    return found


def _loudest(u: np.ndarray, period: float) -> tuple[float, float, int, int]:
    """The span of a series (n,) whose mean stands out most: its score, mean, first row, rows."""
    total = np.concatenate([[0.0], np.cumsum(u - np.median(u))])
    best = (0.0, 0.0, 0, 1)
    rows = max(2, round(0.1 / period))
    while rows < 0.7 * len(u):
        sums = total[rows:] - total[:-rows]
        at = int(np.argmax(np.abs(sums)))
        score = float(sums[at] ** 2 / rows)
        if score > best[0]:
            best = score, float(sums[at] / rows), at, rows
        rows = max(rows + 1, int(1.3 * rows))
    return best
