"""Reading of any mechanism for identification: an MJCF file, logs, and a column mapping.

No machine file is needed. The MJCF file defines bodies, joints, closures (`connect`, `weld`) and
drives. A `ColumnMapping` names the columns of positions and forces. `load_mechanism` reads both,
`load_mechanism_records` reads the logs.
"""

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from hydrotele.core.datafile import StrictModel, read_yaml, suggest_valid_name, validate_data
from hydrotele.core.errors import InputError
from hydrotele.identify.joint_motion import MAX_GAP_S
from hydrotele.identify.record import (
    IdentificationRecord,
    correct_sensor_error,
    trim_missing_positions,
)
from hydrotele.identify.regressor_setup import RegressorSetup, mechanism_setup
from hydrotele.logs.clock import fit_clock
from hydrotele.logs.log import SKIP_COLUMN, Log, find_logs, load_log
from hydrotele.logs.table import read_table
from hydrotele.machine.log_channels import suggest_channel_names
from hydrotele.machine.sensors import SensorError
from hydrotele.multibody.chain import load_chain
from hydrotele.multibody.closed_chain_kinematics import solve_joint_positions
from hydrotele.multibody.regressor import BODY_PARAMETERS, FRICTION_TERMS

_FIT_FRACTION = 2.0 / 3.0  # fitted fraction of a single run; the remainder is for validation
_POSITION_PATTERNS = ("position.{joint}", "angle.{joint}", "{joint}")
_FORCE_PATTERNS = ("force.{joint}", "torque.{joint}", "effort.{joint}")
_MAX_TICKS_PER_ROW = 1.5  # clock ticks per row, above which rows are interpolated to their median period


class ColumnMapping(StrictModel):
    """Assignment of log columns to joints, and known properties of the mechanism.

    Names of joints, bodies and closures are those of the MJCF; `*` and `?` are wildcards.

    Attributes:
        time: column of the time [s].
        position: joint -> column of its position [rad] or [m], with a leading minus to reverse the
            sign; or one pattern for all joints, such as `angle.{joint}`.
        force: drive -> column of its force or torque [N] or [N m], in the same form.
        position_noise: standard deviation of a position reading [rad] or [m], per joint or one for
            all. If both noises are stated, the covariance follows from them, and the bias caused by
            position noise is subtracted.
        force_noise: standard deviation of a force reading [N] or [N m], per drive or one for all.
        coordinates: joints whose positions describe the motion; by default the measured joints. If other
            joints are named, such as those of the platform of a hexapod with measured legs, the
            measured positions are converted to theirs before they are filtered.
        passive_friction: joints without drive, and closures, that have friction.
        equal_parameters: groups of bodies or joints that have the same parameters.
        zero_parameters: parameters known to be 0, such as `moment_x.stator_*`.
        offsets: whether drives may have constant forces.
        friction: joint -> friction that an MJCF cannot state. With the velocity v and s = sign(v), it is
            (coulomb + stribeck exp(-(v / stribeck_velocity)^2)) s + viscous v + quadratic v^2 s, in N
            and m/s, or N m and rad/s. `coulomb_asymmetry`, `stribeck_asymmetry` and `viscous_asymmetry`
            add the same terms with s^2 instead of s, and v s instead of v.
        sensor_errors: `position.JOINT` or `force.DRIVE` -> known defect of its sensor, which is
            removed from the readings (after a sign reversal by the mapping).
        relative_uncertainty: relative uncertainty of masses, inertias and friction of the MJCF. A gap search
            first calibrates them within this range.
    """

    renamed = {
        "alike": "equal_parameters", "absent": "zero_parameters", "uncertainty": "relative_uncertainty",
    }  # fmt: skip

    time: str = "time"
    position: str | dict[str, str] | None = None
    force: str | dict[str, str] | None = None
    position_noise: float | dict[str, float] | None = None
    force_noise: float | dict[str, float] | None = None
    coordinates: tuple[str, ...] = ()
    passive_friction: tuple[str, ...] = ()
    equal_parameters: tuple[tuple[str, ...], ...] = ()
    zero_parameters: tuple[str, ...] = ()
    offsets: bool = True
    friction: dict[str, dict[str, float]] = Field(default_factory=dict)
    sensor_errors: dict[str, SensorError] = Field(default_factory=dict)
    relative_uncertainty: Annotated[float, Field(ge=0.0, le=0.5)] = 0.03


@dataclass(frozen=True)
class Mechanism:
    """A mechanism to be identified.

    Attributes:
        setup: definition of the regressor.
        measured_joints: joints whose positions are measured.
        mapping: the column mapping.
        source: file of the mapping or the MJCF, for messages.
    """

    setup: RegressorSetup
    measured_joints: tuple[str, ...]
    mapping: ColumnMapping
    source: str


def load_mechanism(mjcf: str | Path, mapping: str | Path | ColumnMapping | None = None) -> Mechanism:
    """Read a mechanism from an MJCF file, with the mapping of log columns to its joints.

    Args:
        mjcf: the MJCF file.
        mapping: a `ColumnMapping`, or a YAML file with its keys. None if columns have the names of
            the joints, alone or after `position.`, `angle.`, `force.`, `torque.` or `effort.`.

    Returns:
        The mechanism.

    Raises:
        InputError: a file cannot be read, or a name in the mapping is not in the MJCF.
    """
    chain, source = load_chain(mjcf), str(mapping if isinstance(mapping, str | Path) else mjcf)
    if mapping is None:
        facts = ColumnMapping()
    elif isinstance(mapping, ColumnMapping):
        facts = mapping
    else:
        data, lines = read_yaml(mapping)
        facts = validate_data(ColumnMapping, data, source, lines)
    measured = chain.drives
    if isinstance(facts.position, dict):
        measured = tuple(_match_names(chain.joints, facts.position, source, "joint"))
    for stated in (facts.force, facts.force_noise):
        if isinstance(stated, dict):
            _match_names(chain.drives, stated, source, "drive")
    if isinstance(facts.position_noise, dict):
        _match_names(measured, facts.position_noise, source, "measured joint")
    places = (*chain.joints, *chain.closures)
    bodies = [f"{kind}.{body}" for body in chain.bodies for kind in BODY_PARAMETERS]
    alike = tuple(
        tuple(_match_names((*chain.bodies, *places), group, source, "body or joint"))
        for group in facts.equal_parameters
    )
    passive = _match_names(
        [p for p in places if p not in chain.drives], facts.passive_friction, source,
        "joint without drive",
    )  # fmt: skip
    rubbed = [f"{kind}.{p}" for kind in ("coulomb", "viscous") for p in (*passive, *chain.drives)]
    firsts = {name: group[0] for group in alike for name in group}
    absent = [
        name
        for name in _match_names([*bodies, *rubbed], facts.zero_parameters, source, "parameter")
        if firsts.get(name.partition(".")[2], name.partition(".")[2]) == name.partition(".")[2]
    ]
    given = _match_names(chain.joints, facts.coordinates, source, "joint") or measured
    _match_names([*passive, *chain.drives], facts.friction, source, "joint with friction")
    for numbers in facts.friction.values():
        _match_names((*FRICTION_TERMS, "stribeck_velocity"), numbers, source, "parameter of friction")
    _match_names(
        [*(f"position.{j}" for j in measured), *(f"force.{d}" for d in chain.drives)],
        facts.sensor_errors, source, "sensor",
    )  # fmt: skip
    setup = mechanism_setup(
        chain, given, passive=passive, offsets=facts.offsets, equal_groups=alike, zero_parameters=absent,
        friction=facts.friction,
    )  # fmt: skip
    return Mechanism(setup, measured, facts, source)


def _match_names(known: Sequence[str], patterns, source: str, label: str) -> list[str]:
    """Return the known names that match wildcard patterns, in the order of the patterns.

    Raises:
        InputError: a pattern matches no name.
    """
    out: list[str] = []
    for pattern in patterns:
        found = fnmatch.filter(known, pattern)
        if not found:
            raise InputError(source, f"has no {label} {pattern!r}: {suggest_valid_name(pattern, known)}")
        out += [name for name in found if name not in out]
    return out


def load_mechanism_records(
    paths: Sequence[str | Path], mechanism: Mechanism, heldout: str | None = None,
    period: float | None = None, keep_measured_joints: bool = False,
) -> tuple[tuple[IdentificationRecord, ...], IdentificationRecord, tuple[str, ...]]:  # fmt: skip
    """Read logs of a mechanism as identification records: runs to fit, and one held-out run.

    Args:
        paths: log files (.csv, .parquet), folders of them, run folders.
        mechanism: the mechanism.
        heldout: name of the held-out run. By default it is the first one, in order of names, that
            begins with `test`, otherwise the last. A single run is split in time: its first two
            thirds are fitted, the remainder is held out.
        period: period of a repeated motion [s]; a single run is then split at a whole period.
        keep_measured_joints: whether to keep positions of the measured joints, instead of converting
            them to the joints in which the mechanism's motion is described.

    Returns:
        Records of the fitted runs, of the held-out run, and notes.

    Raises:
        InputError: a file cannot be read, a column is missing, or there is no such run.
    """
    runs, notes = {}, []
    files = [pair for path in paths for pair in find_logs(Path(path))]
    if not files:
        raise InputError("the data", "no file was given: name log files, or a folder with logs")
    for name, path in files:
        log, columns = _load_with_columns(path, mechanism)
        if name in runs:
            raise InputError(log.source, f"the run name {name!r} is used twice: rename one")
        run, said = _build_record(log, name, columns, mechanism)
        runs[name] = run if keep_measured_joints else convert_to_given_joints(run, mechanism.setup)
        notes += [*log.notes, *said]
    if heldout is not None and heldout not in runs:
        raise InputError("--heldout", f"there is no run {heldout!r}; {suggest_valid_name(heldout, runs)}")
    if len(runs) == 1:
        (whole,) = runs.values()
        first = round(_FIT_FRACTION * len(whole.force))
        if period:
            step = round(period / whole.period)
            first = max(1, round(first / step)) * step
        fit, judge = (_cut_rows(whole, slice(0, first)), _cut_rows(whole, slice(first, None)))
        notes.append(
            f"{whole.name} is the only run: fitted up to {first * whole.period:.3g} s, validated on the remainder."
        )
        return (fit,), replace(judge, name=f"{whole.name}, last part"), tuple(notes)
    named = sorted(runs)
    chosen = heldout or next((n for n in named if n.startswith("test")), named[-1])
    return tuple(runs[n] for n in named if n != chosen), runs[chosen], tuple(notes)


class _Column(NamedTuple):
    """Log column of a position or force.

    Attributes:
        channel: name of the channel in the log.
        sign: factor of its readings, +1 or -1.
    """

    channel: str
    sign: float


def _load_with_columns(path: Path, mechanism: Mechanism) -> tuple[Log, dict[tuple[str, str], _Column]]:
    """Read a log and find its columns of positions and forces.

    Returns:
        (the log, (`position` or `force`, joint) -> column with sign).
    """
    mapping, chain, source = mechanism.mapping, mechanism.setup.chain, mechanism.source
    raw, columns = read_table(path, missing=True), {}
    names, ours = raw.names, "hydrotele" in raw.metadata  # logs of hydrotele keep their names
    aliases = dict.fromkeys(names, SKIP_COLUMN)
    if mapping.time not in names:
        hint = next((f" {name}" for name in names if "time" in suggest_channel_names(name)[:1]), "")
        raise InputError(path, f"has no time column {mapping.time!r}: name it in the"
                         f" mapping, as `time:{hint or ' COLUMN'}`; columns: {', '.join(names)}")  # fmt: skip
    aliases[mapping.time] = "time"
    for what, joints, stated, usual in (
        ("position", mechanism.measured_joints, mapping.position, _POSITION_PATTERNS),
        ("force", chain.drives, mapping.force, _FORCE_PATTERNS),
    ):
        for number, joint in enumerate(joints):
            if isinstance(stated, dict):
                name = stated.get(joint)
            elif stated is not None:
                name = stated.replace("{joint}", joint)
            else:
                expected = [one.replace("{joint}", joint) for one in usual]
                name = next((one for one in expected if one in names), None)
            if name is None:
                continue
            sign, name = (-1.0, name[1:]) if name.startswith("-") else (1.0, name)
            if name not in names:
                raise InputError(
                    path, f"has no column {name!r}, which {source} requires for the {what} of"
                    f" {joint}; {suggest_valid_name(name, names)}",
                )  # fmt: skip
            straight = chain.tree.is_slide[chain.index(joint)]
            kinds = {"position": ("angle", "position"), "force": ("torque", "force")}[what]
            aliases[name] = f"{kinds[int(straight)]}.{what[0]}{number}"
            columns[what, joint] = _Column(name if ours else aliases[name], sign)
    log = load_log(path, aliases=aliases)
    return log, columns


def _build_record(
    log: Log, name: str, columns: dict[tuple[str, str], _Column], mechanism: Mechanism
) -> tuple[IdentificationRecord, tuple[str, ...]]:
    chain = mechanism.setup.chain
    clock, notes = fit_clock(log.time, log.source)
    time, period = log.time[clock.row], clock.period
    if clock.tick[-1] > _MAX_TICKS_PER_ROW * len(time):  # no common clock: use the median period
        period = float(np.median(np.diff(time)))
        notes = (f"{name}: {notes[0].rpartition('; ')[0].partition(': ')[2]}; interpolated to"
                 f" {1.0 / period:.4g} Hz.",)  # fmt: skip
    ticks = time[0] + period * np.arange(round((time[-1] - time[0]) / period) + 1)

    def interpolate_values(values: np.ndarray | None) -> np.ndarray:
        if values is None:
            return np.full(len(ticks), np.nan)
        known = np.isfinite(values[clock.row])
        if not known.any():
            return np.full(len(ticks), np.nan)
        out = np.interp(ticks, time[known], values[clock.row][known])
        after = np.searchsorted(time[known], ticks).clip(1, max(1, known.sum() - 1))
        apart = np.diff(time[known], prepend=time[known][0])[after.clip(0, known.sum() - 1)]
        outside = (ticks < time[known][0] - 0.5 * period) | (ticks > time[known][-1] + 0.5 * period)
        return np.where(outside | (apart > MAX_GAP_S), np.nan, out)

    def read_corrected_column(what: str, joint: str) -> np.ndarray | None:
        column = columns.get((what, joint))
        if column is None:
            return None
        known = mechanism.mapping.sensor_errors.get(f"{what}.{joint}", SensorError())
        return correct_sensor_error(column.sign * log[column.channel], known, period)

    position = []
    for joint in mechanism.measured_joints:
        if (values := read_corrected_column("position", joint)) is None:
            raise InputError(
                log.source, f"has no column for the position of {joint}: name it in the mapping, as"
                f" `position: {{{joint}: COLUMN}}`",
            )  # fmt: skip
        position.append(interpolate_values(values))
    force = [interpolate_values(read_corrected_column("force", drive)) for drive in chain.drives]
    if not np.isfinite(force).any():
        raise InputError(
            log.source, "has no column of a drive force: name the columns in the mapping, as"
            f" `force: {{{chain.drives[0]}: COLUMN}}`",
        )  # fmt: skip
    mapping = mechanism.mapping
    record = IdentificationRecord(
        name, period, mechanism.measured_joints, np.array(position).T,
        _expand_noise(mapping.position_noise, mechanism.measured_joints), np.array(force).T,
        _expand_noise(mapping.force_noise, chain.drives),
    )  # fmt: skip
    return trim_missing_positions(record), notes


def _expand_noise(stated: float | dict[str, float] | None, joints: Sequence[str]) -> np.ndarray:
    """Expand noise stated for all joints or by joint to an array (k,), NaN where it is not stated."""
    if isinstance(stated, dict):
        return np.array([stated.get(joint, np.nan) for joint in joints])
    return np.full(len(joints), np.nan if stated is None else stated)


def convert_to_given_joints(record: IdentificationRecord, setup: RegressorSetup) -> IdentificationRecord:
    """Convert a record's measured joint positions to the joints that describe the motion in a setup.

    Args:
        record: record of the measured joints, which determine all other joints.
        setup: definition of the regressor with the given joints.

    Returns:
        The record, unchanged if the joints are the same. Otherwise positions are computed by forward
        kinematics row by row, and their noise is unknown (NaN).

    Raises:
        InputError: a position is missing in a row, or cannot be reached.

    Source: Abdellatif 2008, section 4.1.
    """
    if record.axes == setup.given_joints:
        return record
    places = [setup.chain.index(name) for name in setup.given_joints]
    try:
        q = solve_joint_positions(setup.chain, record.axes, record.position)
    except InputError as error:
        raise InputError(record.name, str(error)) from None
    return replace(
        record, axes=setup.given_joints, position=q[:, places],
        position_noise=np.full(len(places), np.nan),
    )  # fmt: skip


def _cut_rows(record: IdentificationRecord, rows: slice) -> IdentificationRecord:
    return replace(record, position=record.position[rows], force=record.force[rows])
