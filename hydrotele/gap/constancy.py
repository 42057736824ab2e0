"""Does an effect have the same size in every run? Something else that looks alike has not."""

from typing import Any

import numpy as np

from hydrotele.estimate.calibration import CALIBRATION
from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import Guess
from hydrotele.gap.residuals import ALLOWED

LIMIT = 8.0
"""Largest chi-square per degree of freedom that still passes; noise alone leaves 1."""
_KNOWN = 1.0  # least information on a direction in units of the prior's: it tells as much


def constancy(evidence: Evidence, guess: Guess, perfect: Evidence) -> dict[str, Any]:
    """Test of the sizes that the runs ask for, each by itself, against each other.

    With slopes S_r and errors e_r of run r, `chi^2 = sum_r g_r' I_r^-1 g_r - g' I^-1 g`, where
    `g_r = S_r' e_r` and `I_r = S_r' S_r`, and g and I are their sums: how much better the runs
    would be explained with numbers of their own. Five times what the filter leaves on readings
    that the guess made itself is allowed, too.

    Args:
        evidence: with the guess as its base, fitted.
        guess: at least one effect.
        perfect: the same runs with readings that the guess made, with the guess as its base.

    Returns:
        As one of `residual_tests`; `channel` is the run that departs most.
    """
    value, run = _spread(evidence, guess)
    limit = max(LIMIT, ALLOWED * _spread(perfect, guess)[0])
    return {"value": value, "channel": run, "limit": limit, "passed": value <= limit}


def _spread(evidence: Evidence, guess: Guess) -> tuple[float, str]:
    """Chi-square per degree of freedom, and the run that departs most."""
    table = [_pull(evidence, guess, index) for index in range(len(evidence.tracks))]
    gains = [_gain(g, information) for g, information in table]
    whole, _ = _gain(np.sum([g for g, _ in table], axis=0), np.sum([i for _, i in table], axis=0))
    freedom = sum(rank for _, rank in gains) - len(guess.deviation) + len(_calibrated(guess))
    value = (sum(gain for gain, _ in gains) - whole) / freedom if freedom > 0 else 0.0
    worst = int(np.argmax([gain for gain, _ in gains]))
    return float(value), evidence.tracks[worst].run.name


def _calibrated(guess: Guess) -> set[int]:
    """Places of numbers that belong to a calibration: they may take up what runs differ by."""
    found, first = set(), 0
    for hypothesis, deviation in guess.parts:
        if hypothesis.name == CALIBRATION:
            found |= set(range(first, first + len(deviation)))
        first += len(deviation)
    return found


def _pull(evidence: Evidence, guess: Guess, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (P,) and information (P, P) of one run."""
    tracks = (evidence.tracks[index],)
    errors = evidence.errors(guess, tracks=tracks)
    columns, left_out = [], _calibrated(guess)
    for place, nudge in enumerate(guess.nudges()):
        if place in left_out:
            continue
        moved = guess.deviation
        moved[place] += nudge
        columns.append((evidence.errors(guess.at(moved), tracks=tracks) - errors) / nudge)
    slopes = np.column_stack(columns)
    return slopes.T @ errors, slopes.T @ slopes


def _gain(g: np.ndarray, information: np.ndarray) -> tuple[float, int]:
    """`g' I^-1 g` over the directions on which there is information, and their number."""
    sizes, directions = np.linalg.eigh(information)
    known = sizes > _KNOWN
    along = directions.T[known] @ g
    return float(np.sum(along**2 / sizes[known])), int(known.sum())
