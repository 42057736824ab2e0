"""List the trials of a series with their class and the location of their files."""

import dataclasses
import json
from pathlib import Path

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_file

CLASSES = ("single", "double", "clean", "outside")


@dataclasses.dataclass(frozen=True)
class Series:
    """What is tried, from which everything follows.

    Attributes:
        seed: of all random choices.
        counts: class -> number of trials.
        machine: name of the machine.
        duration: of each run [s].
    """

    seed: int
    counts: dict[str, int]
    machine: str = "cat215"
    duration: float = 40.0

    def classes(self) -> list[str]:
        """Class of every trial in order of the trials, shuffled, so that a number tells nothing."""
        listed = [name for name in CLASSES for _ in range(self.counts[name])]
        shuffled = np.random.default_rng([self.seed, 0]).permutation(len(listed))
        return [listed[k] for k in shuffled]

    def names(self) -> list[str]:
        """Names of the trials."""
        return [f"{number:04d}" for number in range(sum(self.counts.values()))]


@dataclasses.dataclass(frozen=True)
class Place:
    """Files of one trial in the folder of a series; a file or folder that is there is whole."""

    out: Path
    trial: str

    @property
    def folder(self) -> Path:
        """What may be seen, apart from the result."""
        return self.out / "trials" / self.trial

    @property
    def data(self) -> Path:
        """The four logs: all that the workflow gets, as a copy."""
        return self.folder / "data"

    @property
    def seal(self) -> Path:
        """SHA-256 of the key, written before the workflow starts."""
        return self.folder / "seal.txt"

    @property
    def result(self) -> Path:
        """What the workflow answered; a trial with a result is finished."""
        return self.folder / "result.json"

    @property
    def key(self) -> Path:
        """What was planted."""
        return self.out / "keys" / f"{self.trial}.json"


def write_json(path: Path, document) -> None:
    """Write strict JSON, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path, ".json") as part:
        part.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


def load_series(out: Path) -> Series:
    """The series that a folder holds.

    Raises:
        InputError: it holds none.
    """
    path = out / "settings.json"
    if not path.is_file():
        raise InputError(out, "holds no series of trials: start one, then score it")
    return Series(**json.loads(path.read_text()))


def begin_series(out: Path, series: Series) -> None:
    """Start a series in a folder, or go on with the one that it holds.

    Raises:
        InputError: the folder holds another series.
    """
    if (out / "settings.json").is_file():
        if (there := load_series(out)) != series:
            raise InputError(out, f"holds another series ({there}); choose another --out")
        return
    write_json(out / "settings.json", dataclasses.asdict(series))
