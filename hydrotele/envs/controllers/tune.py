"""Gains tuned by trying: one after the other, up and down, as an engineer does at the machine."""

from collections.abc import Callable, Mapping


def tune(
    value: Callable[[dict[str, float]], float], start: Mapping[str, float], factor: float = 1.5,
    rounds: int = 2, gain: float = 0.0, most: Mapping[str, float] | None = None,
) -> tuple[dict[str, float], float]:  # fmt: skip
    """Better gains by a search along one of them at a time.

    Args:
        value: of a set of gains, the more the better; always on the same episodes.
        start: gains to begin with, all positive.
        factor: by which a gain is changed, again as long as that helps.
        rounds: through all gains.
        gain: in value that a change must bring.
        most: largest sensible values.

    Returns:
        (gains, their value).
    """
    best, score = dict(start), value(dict(start))
    for _ in range(rounds):
        for name in start:
            for step in (factor, 1.0 / factor):
                moved = False
                while True:
                    trial = min(best[name] * step, (most or {}).get(name, float("inf")))
                    found = value({**best, name: trial}) if trial != best[name] else score
                    if found <= score + gain:
                        break
                    best[name], score, moved = trial, found, True
                if moved:
                    break
    return best, score
