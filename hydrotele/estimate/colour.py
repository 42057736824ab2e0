"""Coloured noise of sensors: what a reading is off by and keeps from one row to the next.

A sensor's noise has a white part and may have a coloured one, a stationary process with the autocorrelation

    exp(-t / T) cos(2 pi f t),

that is one state of the filter at f = 0 (first order: drift, thermal noise, a logger's low-pass) and two at a
resonance. The parts are found from the readings' smoothed noise: a model that is right leaves there the spectrum that
the filter itself predicts. Their sizes are estimated again with all other noise levels (`estimate.levels`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.signal import welch

STATE = "colour"
"""Kind of the filter's states for coloured noise."""


@dataclass(frozen=True)
class Colour:
    """The coloured part of a channel's noise.

    Attributes:
        channel: its number.
        size: stationary standard deviation [channel's unit].
        memory: correlation time T [s].
        frequency: f of a resonance [Hz], 0 for none.
    """

    channel: int
    size: float
    memory: float
    frequency: float = 0.0

    @property
    def states(self) -> int:
        """Number of states of the filter."""
        return 2 if self.frequency else 1

    def transition(self, period: float) -> np.ndarray:
        """Return how the states change over a row (states, states)."""
        angle = 2.0 * np.pi * self.frequency * period
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return self.decay(period) * turn[: self.states, : self.states]

    def decay(self, period: float) -> float:
        """Return by which factor the noise falls over a row [1]."""
        return float(np.exp(-period / self.memory))

    def drift(self, period: float) -> float:
        """Return the variance that a row adds to each state [channel's unit squared]."""
        return self.size**2 * (1.0 - self.decay(period) ** 2)

    def spectrum(self, angles: np.ndarray, period: float) -> np.ndarray:
        """Return the spectrum at angles (k,) [rad per row] of the noise with a variance of 1."""
        keep, own = self.decay(period), 2.0 * np.pi * self.frequency * period
        poles = [1.0 - 2.0 * keep * np.cos(angles + sign * own) + keep**2 for sign in (-1.0, 1.0)]
        return 0.5 * (1.0 - keep**2) * (1.0 / poles[0] + 1.0 / poles[1])


def state_labels(colours: Sequence[Colour]) -> list[str]:
    """Return the names of the filter's states, those of one channel one after the other."""
    return [f"{STATE}.{c.channel}.{k}" for c in colours for k in range(c.states)]


def join_transitions(colours: Sequence[Colour], period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the channel of every state (k,), -1 where it shows in none, and their transition (k, k)."""
    count = sum(c.states for c in colours)
    channel, flow, at = np.full(count, -1), np.zeros((count, count)), 0
    for colour in colours:
        channel[at], end = colour.channel, at + colour.states
        flow[at:end, at:end] = colour.transition(period)
        at = end
    return channel, flow


@dataclass(frozen=True)
class Spectrum:
    """Spectra of the smoothed noise of a run over its variance, c channels at k angles.

    Attributes:
        period: of the run's rows [s].
        angles: (k,) [rad per row].
        found: (k, c) of the readings [1 / channel's unit squared].
        expected: (k, c) of readings of the model itself.
        count: independent values per angle that each found one is the mean of.
    """

    period: float
    angles: np.ndarray
    found: np.ndarray
    expected: np.ndarray
    count: float


_SEGMENT = 128  # rows of a spectrum's segments: 2.6 s at 50 Hz, and resonances are resolved to 0.4 Hz
_LEAST_WHITE = 1.0e-3  # smallest share of the white variance that remains
_STARTS = ((0.02, 0.0), (0.2, 0.0), (2.0, 0.0), (0.1, 0.15), (0.1, 0.3), (0.1, 0.45))
# Correlation times [s] and frequencies [1 per row] from which the best ones are looked for.


def measure_spectrum(found: np.ndarray, expected: np.ndarray, period: float) -> Spectrum:
    """Return the spectra of the smoothed noise of a run's readings over its variance, by Welch's method.

    Args:
        found: (n, c) of the readings, 0 where missing.
        expected: (n, c) of readings simulated with the same model.
        period: of the rows [s].
    """
    rows = min(_SEGMENT, len(found))
    spectra = [welch(values, 1.0, nperseg=rows, axis=0, return_onesided=False)[1] for values in (found, expected)]
    half = slice(1, (rows + 1) // 2)  # without the mean: it is an offset
    angles = 2.0 * np.pi * np.arange(rows)[half] / rows
    return Spectrum(period, angles, spectra[0][half], spectra[1][half], len(found) / rows)


def find_colour(spectra: Sequence[Spectrum], channel: int, white: float, largest: float) -> tuple[Colour, float, float]:
    """Find the coloured noise of a channel that explains its spectra best.

    Args:
        spectra: of the runs.
        channel: its number.
        white: variance of its white noise in the model [channel's unit squared].
        largest: standard deviation that the coloured part can have.

    Returns:
        The coloured part, the standard deviation of the remaining white part, and twice the log likelihood that both
        bring. A resonance must bring twice the log of the number of readings more than a first-order part.

    Source: likelihood of Whittle 1953; a noise of covariance C added to a channel changes the spectrum D of its
        smoothed noise over its variance to D + D C D.
    """
    nyquist = 0.5 / max(s.period for s in spectra)
    fastest, slowest = 0.5 / nyquist / 4.0, max(s.period for s in spectra) * _SEGMENT

    def parts(x: np.ndarray, period: float) -> tuple[Colour, float]:
        share = 1.0 / (1.0 + np.exp(-x[1]))  # of the white variance that remains
        frequency = nyquist / (1.0 + np.exp(-x[3])) if len(x) > 3 else 0.0
        colour = Colour(channel, float(np.exp(x[0])), float(np.exp(x[2])), float(frequency))
        return colour, float(_LEAST_WHITE + (1.0 - _LEAST_WHITE) * share)

    def loss(x: np.ndarray) -> float:
        total = 0.0
        for s in spectra:
            colour, share = parts(x, s.period)
            added = colour.size**2 * colour.spectrum(s.angles, s.period) - (1.0 - share) * white
            expected = s.expected[:, channel]
            change = np.maximum(added * expected, 0.5 * _LEAST_WHITE - 1.0)
            ratio = s.found[:, channel] / np.where(expected > 0.0, expected, 1.0)
            terms = np.log1p(change) - ratio * change / (1.0 + change)
            total += 2.0 * s.count * float(np.sum(np.where(expected > 0.0, terms, 0.0)))
        return total

    low, high = np.log(1.0e-2 * largest), np.log(largest)
    starts: dict[bool, list[tuple[np.ndarray, list[tuple[float, float]]]]] = {False: [], True: []}
    for memory, cycles in _STARTS:
        x = [0.5 * np.log(white), 0.0, np.log(memory)]
        bounds = [(low, high), (-5.0, 5.0), (np.log(fastest), np.log(slowest))]
        if cycles:
            x.append(np.log(cycles / (0.5 - cycles)))
            bounds.append((-4.0, 4.0))
        starts[bool(cycles)].append((np.clip(x, *np.transpose(bounds)), bounds))
    best: dict[bool, tuple[float, np.ndarray]] = {}
    for turns, tried in starts.items():
        start, bounds = min(tried, key=lambda pair: loss(pair[0]))
        found = minimize(loss, start, method="L-BFGS-B", bounds=bounds)
        best[turns] = float(found.fun), found.x
    readings = sum(2.0 * s.count * len(s.angles) for s in spectra)
    turns = best[True][0] + 2.0 * np.log(readings) < best[False][0]
    fall, x = best[turns]
    colour, share = parts(x, spectra[0].period)
    return colour, float(np.sqrt(share * white)), -fall
