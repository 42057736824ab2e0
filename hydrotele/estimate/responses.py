"""How prediction errors answer to what would be added to a balance, row by row, to first order.

With a track's kept gains, whitened errors are nearly linear in a small addition. So the responses
to many candidate laws cost one pass of small matrices each, not one simulation each, and a
regression of the errors on them weighs every reading as the likelihood does, with what the unknown
inputs of the track have taken up counted as unknown.
"""

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.estimate.track import Track


@compiled
def _respond(slope, gain, spread, whitened, flow, column, values, out):
    rows, channels, size = slope.shape
    count, states = values.shape[1], column.shape[1]
    moved, next_ = np.zeros((size, count)), np.zeros((size, count))
    delta, error = np.zeros((size, count)), np.zeros(count)
    for row in range(rows):
        delta[:] = 0.0
        for c in range(channels):
            if np.isnan(whitened[row, c]):
                continue
            error[:] = 0.0
            for s in range(size):
                h = slope[row, c, s]
                if h != 0.0:
                    for p in range(count):
                        error[p] -= h * (moved[s, p] + delta[s, p])
            for p in range(count):
                out[row, c, p] = error[p] / spread[row, c]
            for s in range(size):
                k = gain[row, c, s]
                for p in range(count):
                    delta[s, p] += k * error[p]
        moved += delta
        if row == rows - 1:
            break
        next_[:] = 0.0
        for s in range(size):
            for r in range(size):
                f = flow[row, s, r]
                if f != 0.0:
                    for p in range(count):
                        next_[r, p] += f * moved[s, p]
        for r in range(states):
            for p in range(count):
                next_[r, p] += column[row, r] * values[row, p]
        moved[:] = next_


def error_responses(
    track: Track, column: np.ndarray, values: np.ndarray, rows: slice = slice(None)
) -> np.ndarray:
    """Change of a track's whitened errors per unit of each of p additions.

    Args:
        track: linearised, with n rows and c channels.
        column: (n, nz) what a unit of the addition, held over a row, adds to the model's states, as
            `inputs.input_columns` has it [state's unit per unit of the addition].
        values: (n, p) the additions in every row.
        rows: some of the track's, n of which there are values.

    Returns:
        (n, c, p) changes [1 per unit of the addition]; 0 where a reading is missing.

    Source: linearised innovations with kept gains, Anderson and Moore 1979, Optimal Filtering,
        chapter 8.
    """
    gains = track.gains
    out = np.zeros((*track.whitened[rows].shape, values.shape[1]))
    _respond(
        gains.slope[rows], gains.gain[rows], gains.spread[rows], track.whitened[rows],
        track.flow[rows], np.ascontiguousarray(column)[rows], np.ascontiguousarray(values), out,
    )  # fmt: skip
    return out
