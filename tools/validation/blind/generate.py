"""Make the data of one trial and seal its key; runs as a separate process.

    python -m tools.validation.blind.generate FOLDER_OF_THE_SERIES TRIAL

Writes `trials/TRIAL/data` (four logs and nothing else), `keys/TRIAL.json` and, over the key's
bytes, `trials/TRIAL/seal.txt`. The same series makes the same logs.
"""

import argparse
import hashlib
import os
import secrets
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.logs.log import Log, save_log
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.record import SimulationFailed
from tools.validation.blind.draw import (
    Planted,
    draw_double,
    draw_effect,
    draw_outside,
    with_effects,
)
from tools.validation.blind.motions import motions
from tools.validation.blind.outside import OUTSIDE
from tools.validation.blind.plant import Recorded, record
from tools.validation.blind.trials import Place, Series, load_series, write_json
from tools.validation.blind.visibility import visibility

_ATTEMPTS = 10  # an effect can make a machine impossible, such as a linkage that does not close


def make_trial(place: Place, series: Series) -> None:
    """Plant, record, and write logs, key and seal of a trial.

    Args:
        place: where its files lie.
        series: the series that it is part of.

    Raises:
        InputError: no effect drawn for it could be simulated.
    """
    machine = load_machine(series.machine)
    number = series.names().index(place.trial)
    redrawn: list[str] = []
    while True:
        rng = np.random.default_rng([series.seed, 1, number, len(redrawn)])
        planted = _draw(machine, series, number, rng)
        try:
            runs = {
                scenario.name: record(machine, scenario, planted) for scenario in motions(machine, rng, series.duration)
            }
            break
        except (InputError, SimulationFailed) as error:
            redrawn.append(f"{planted}: {str(error).splitlines()[0]}")
            if len(redrawn) == _ATTEMPTS:
                raise InputError(f"trial {place.trial}", redrawn[-1]) from None
    key = _key(machine, series.classes()[number], planted, runs)
    key |= {"trial": place.trial, "redrawn": redrawn, "nonce": rng.bytes(16).hex()}
    write_json(place.key, key)
    place.key.chmod(0o600)
    place.folder.mkdir(parents=True, exist_ok=True)
    place.seal.write_text(key_hash(place) + "\n")
    write_logs(place, {name: run.log for name, run in runs.items()})


def key_hash(place: Place) -> str:
    """SHA-256 of a trial's key file."""
    return hashlib.sha256(place.key.read_bytes()).hexdigest()


def _draw(machine: Machine, series: Series, number: int, rng) -> list[Planted]:
    classes = series.classes()
    match classes[number]:
        case "single":
            return [draw_effect(machine, rng)]
        case "double":
            return draw_double(machine, rng)
        case "outside":
            turn = series.seed + classes[:number].count("outside")
            return [draw_outside(machine, turn, rng)]
        case _:
            return []


def _key(machine, kind: str, planted: list[Planted], runs: dict[str, Recorded]) -> dict[str, Any]:
    effects = []
    for effect in planted:
        others = [p for p in planted if p is not effect and p.name not in OUTSIDE]
        alone = visibility(with_effects(machine, others), runs)
        effects.append({**effect.facts(machine), "visibility": alone})
    return {"class": kind, "effects": effects}


def write_logs(place: Place, logs: dict[str, Log]) -> None:
    """Write a trial's logs, all or none."""
    part = place.folder / f".data.{os.getpid()}.{secrets.token_hex(4)}.part"
    part.mkdir()
    for name, log in logs.items():
        save_log(log, part / f"{name}.parquet")
    try:
        part.rename(place.data)
    except OSError:  # another process was faster, with the same bits
        shutil.rmtree(part)


def main() -> None:
    """Parse the arguments and make the trial."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("trial")
    args = parser.parse_args()
    make_trial(Place(args.out, args.trial), load_series(args.out))


if __name__ == "__main__":
    main()
