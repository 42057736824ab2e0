"""Posterior samples of the parameters that a gap search changed, and the machine of each sample.

The posterior is the normal distribution about the final fit whose covariance gives the reported 95 %
intervals (`estimate.evidence.posterior_covariance`). It is truncated at the bounds of the parameters and
where the machine is not valid: a sample outside is drawn again. A parameter whose estimate is close to a
bound therefore has a narrower interval than the reported one, which is cut off at the bound.

In a result folder, `posterior.parquet` has one row per sample and one column per parameter in SI units.
`posterior/machine.yaml` is the machine that the samples change: the given one with the learned laws.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from hydrotele.core.errors import InputError
from hydrotele.core.files import parse_json, read_json
from hydrotele.core.output import atomic_file
from hydrotele.effects import EFFECTS
from hydrotele.estimate.evidence import draw_truncated_normal
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, Hypothesis, calibration
from hydrotele.logs.table import read_table
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import MACHINE_FILE, load_machine, save_machine

POSTERIOR_FILE, POSTERIOR_FOLDER = "posterior.parquet", "posterior"
SAMPLES = 200


@dataclass(frozen=True)
class Posterior:
    """Joint posterior samples of P parameters.

    Attributes:
        names: (P,) `valve_deadband.stick.deadband` (effect, location, parameter) or the key of a calibrated
            parameter, as in `gap.json`.
        units: (P,) SI units.
        samples: (n, P) values [units].
        calibrated: names of the calibrated parameters; all others belong to effects.
        noise: channel -> standard deviation of a reading, estimated by the search [channel's unit].
        machine: the machine that the samples change, with the learned laws.
        source: file of the samples, or `memory`.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    samples: np.ndarray
    calibrated: frozenset[str]
    noise: Mapping[str, float]
    machine: Machine
    source: str = "memory"


def sample_posterior(
    machine: Machine, fits: Sequence[tuple[Guess, np.ndarray]], noise: Mapping[str, float], count: int = SAMPLES,
) -> Posterior | None:  # fmt: skip
    """Draw samples of the parameters of effects and calibrations, with a fixed seed.

    Args:
        machine: the given machine.
        fits: guesses that change the machine one after the other, each with the covariance (P, P) of its
            normalised deviations. Fits are independent of each other. A parameter that a later fit has, too, is
            sampled there only. Learned laws, and parameters that are neither of an effect nor calibrated, keep
            their estimates.
        noise: channel -> standard deviation of a reading [channel's unit].
        count: number of samples.

    Returns:
        The samples; None if there is no parameter, or its covariance is unknown.
    """
    parts: list[tuple[Hypothesis, np.ndarray]] = []
    chosen: list[int] = []  # places of the sampled parameters among all deviations
    first = 0
    for number, (guess, _) in enumerate(fits):
        later = {name for other, _ in fits[number + 1 :] for name in _names(other.parts)}
        for hypothesis, deviation in guess.parts:
            names = _names([(hypothesis, deviation)])
            varies = hypothesis.change is None or hypothesis.name == CALIBRATION
            own = [k for k, name in enumerate(names) if varies and name not in later]
            others = [k for k in range(len(names)) if k not in own]
            if others or not names:
                machine = _select(hypothesis, others).machine(machine, deviation[others])
            if own:
                parts.append((_select(hypothesis, own), deviation[own]))
                chosen += [first + k for k in own]
            first += len(names)
    covariance = np.asarray(block_diag(*(c for _, c in fits)))[np.ix_(chosen, chosen)]
    if not chosen or not np.isfinite(covariance).all():
        return None
    fitted = Guess(tuple(parts))
    low, high = (np.concatenate([getattr(h, side) for h, _ in parts]) for side in ("low", "high"))
    deviations = draw_truncated_normal(
        fitted.deviation, covariance, (low, high), lambda d: fitted.at(d).is_in_domain(machine), count
    )
    if not len(deviations):
        return None
    samples = [[v for h, d in fitted.at(row).parts for v in h.values(d).values()] for row in deviations]
    return Posterior(
        tuple(_names(parts)), tuple(p.unit for h, _ in parts for p in h.parameters.values()), np.array(samples),
        frozenset(name for h, d in parts if h.name == CALIBRATION for name in h.parameters), dict(noise), machine,
    )  # fmt: skip


def _names(parts: Sequence[tuple[Hypothesis, np.ndarray]]) -> list[str]:
    return [
        key if h.name == CALIBRATION else f"{h.name}.{h.location}.{key}" for h, _ in parts for key in h.parameters
    ]  # fmt: skip


def _select(hypothesis: Hypothesis, places: Sequence[int]) -> Hypothesis:
    keys = list(hypothesis.parameters)
    return replace(hypothesis, parameters={keys[k]: hypothesis.parameters[keys[k]] for k in places})


def machine_of_sample(posterior: Posterior, index: int) -> Machine:
    """Return the machine of a sample.

    Args:
        posterior: the samples.
        index: number of the sample, from 0.

    Raises:
        InputError: a parameter does not exist in the machine or in the library, or the machine is not valid.
    """
    machine, values = posterior.machine, dict(zip(posterior.names, posterior.samples[index].tolist(), strict=True))
    where = f"{posterior.source}, row {index}"
    for (effect, place), group in groupby(posterior.names, lambda name: _effect_of(posterior, name)):
        own = {name: values[name] for name in group}
        if effect == CALIBRATION:
            hypothesis = calibration(posterior.machine)
            if strange := sorted(own.keys() - hypothesis.parameters.keys()):
                raise InputError(f"{where}, {strange[0]}", f"is no uncertain parameter of {machine.name}")
        elif effect not in EFFECTS:
            raise InputError(f"{where}, effect {effect}", "is not known: load its file, --effects FILE.py")
        elif place not in (places := EFFECTS[effect].locations(machine)):
            raise InputError(f"{where}, effect {effect}", f"has no location {place!r}; {machine.name} has {places}")
        else:
            hypothesis, own = Hypothesis(effect, place, {}), {n.rpartition(".")[2]: v for n, v in own.items()}
        try:
            change = hypothesis.change or (lambda m, v, h=hypothesis: EFFECTS[h.name].apply(m, h.location, v))
            machine = change(machine, own)
        except (ValueError, ArithmeticError, KeyError) as error:
            raise InputError(where, f"cannot be applied to {machine.name}: {error}") from error
    return machine


def _effect_of(posterior: Posterior, name: str) -> tuple[str, str]:
    """Return name and location of the effect of a column."""
    if name in posterior.calibrated:
        return CALIBRATION, "all"
    effect, _, rest = name.partition(".")
    return effect, rest.rpartition(".")[0]


def write_posterior(posterior: Posterior, folder: Path) -> None:
    """Write `posterior.parquet` and the machine that its samples change into an existing folder."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    (folder / POSTERIOR_FOLDER).mkdir()
    save_machine(posterior.machine, folder / POSTERIOR_FOLDER / MACHINE_FILE)
    columns = zip(posterior.names, posterior.units, strict=True)
    fields = [pa.field(name, pa.float64(), nullable=False, metadata={"unit": unit}) for name, unit in columns]
    metadata = {
        "kind": POSTERIOR_FOLDER, "machine": posterior.machine.name, "tool": posterior.machine.tool,
        "calibrated": json.dumps(sorted(posterior.calibrated)), "noise": json.dumps(dict(posterior.noise)),
    }  # fmt: skip
    table = pa.Table.from_arrays(
        [pa.array(column) for column in posterior.samples.T], schema=pa.schema(fields, metadata)
    )
    with atomic_file(folder / POSTERIOR_FILE, ".parquet") as part:
        pq.write_table(table, part, write_page_checksum=True)


def read_posterior(folder: str | Path) -> Posterior:
    """Read the posterior samples of a result folder of `hydrotele gap`.

    Raises:
        InputError: the folder is no such folder, has no samples, belongs to another machine, or is damaged.
    """
    folder = Path(folder)
    file = folder / POSTERIOR_FILE
    if not (folder / "gap.json").is_file():
        raise InputError(folder, "is not a result folder of `hydrotele gap`: it has no gap.json")
    if not file.is_file():
        raise InputError(
            folder,
            f"has no {POSTERIOR_FILE}: the search changed no parameter of the machine, or an earlier version wrote"
            " the folder; then repeat `hydrotele gap`",
        )
    table = read_table(file)
    if table.metadata.get("kind") != POSTERIOR_FOLDER or not table.names or not len(table.values[0]):
        raise InputError(file, "contains no posterior samples: repeat `hydrotele gap`")
    samples = np.column_stack(table.values)
    if None in table.units or not np.isfinite(samples).all():
        raise InputError(file, "has a column without unit, or a value that is not finite: repeat `hydrotele gap`")
    machine = load_machine(folder / POSTERIOR_FOLDER / MACHINE_FILE)
    summary = read_json(folder / "summary.json")
    for where, stated in ((file, table.metadata), (folder / "summary.json", summary)):
        if (stated.get("machine"), stated.get("tool")) != (machine.name, machine.tool):
            other = f"the machine {stated.get('machine')} with the tool {stated.get('tool')}"
            message = f"is of {other}, but {POSTERIOR_FOLDER}/{MACHINE_FILE} is {machine.name} with {machine.tool}"
            raise InputError(where, f"{message}: repeat `hydrotele gap`")
    try:
        calibrated = frozenset(map(str, parse_json(table.metadata["calibrated"])))
        noise = {str(k): float(v) for k, v in parse_json(table.metadata["noise"]).items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(file, f"has damaged metadata ({error}): repeat `hydrotele gap`") from None
    units = tuple(str(unit) for unit in table.units)
    found = Posterior(tuple(table.names), units, samples, calibrated, noise, machine, str(file))
    machine_of_sample(found, 0)
    return found
