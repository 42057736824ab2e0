"""Base parameters of PaLiDA by three methods: Table 1, regrouping rules, and null space.

Base parameters are the minimal combinations of body parameters that determine the drive forces.
Table 1 of Abdellatif 2008 lists ten combinations. The rules of section 2.1 regroup the parameters
body by body and need only the geometry. The null space of the regressor needs random states and no
rules.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hydrotele.experiments.comparison import Changes, Claim, Evaluation, Experiment, Panel, Sample, merge_settings
from hydrotele.experiments.palida import (
    LEGS,
    PUBLISHED_PARAMETERS,
    SYMBOLS,
    load_robot,
    sample_states,
)
from hydrotele.experiments.statistical_checks import check_deterministic_value, collect_values
from hydrotele.identify.identifiability import Identifiability, classify_parameters
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.inverse_dynamics import project_on_drives
from hydrotele.multibody.regressor import BODY_PARAMETERS, Regressor

_KINDS = tuple(BODY_PARAMETERS)
_INERTIAS = tuple(kind for kind in _KINDS if kind.startswith("inertia"))
MAX_ROUNDING = 1e-8
"""Largest difference of coefficients [kg m^2, kg m, kg] that counts as rounding.

Joint positions in the MJCF have twelve decimals; the null space comes from 600 equations in double
precision.
"""


class Relation(NamedTuple):
    """A linear dependence of one regressor column on other columns, Abdellatif 2008, (10).

    The parameter of the column can be eliminated: its value, times the coefficients, is added to the
    other parameters.

    Attributes:
        parameter: parameter to eliminate, such as `inertia_yy.stator_1`.
        weights: other parameter -> coefficient; empty if the eliminated parameter has no effect.
    """

    parameter: str
    weights: dict[str, float]


def compute_inertial_transformation(rotation: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return the matrix that transforms a body's inertial parameters to its parent's frame.

    Args:
        rotation: (3, 3) orientation of the body's frame in the parent's frame.
        offset: (3,) origin of the body's frame in the parent's frame [m].

    Returns:
        (10, 10) matrix L of Abdellatif 2008, (9), with rows and columns in the order of
        `BODY_PARAMETERS`.

    >>> unit = compute_inertial_transformation(np.eye(3), np.array([0.0, 0.0, 2.0]))
    >>> dict(zip(_KINDS, unit[:, 0].tolist()))["inertia_xx"]  # Steiner: 1 kg at a distance of 2 m
    4.0
    """
    columns = []
    for unit in np.eye(10):
        mass, moment = unit[0], unit[1:4]
        tensor = _build_inertia_tensor(unit[4:])
        shifted = rotation @ moment + mass * offset
        second = rotation @ (0.5 * np.trace(tensor) * np.eye(3) - tensor) @ rotation.T
        cross = np.outer(rotation @ moment, offset)
        second = second + cross + cross.T + mass * np.outer(offset, offset)
        tensor = np.trace(second) * np.eye(3) - second
        columns.append([mass, *shifted, *tensor[np.triu_indices(3)]])
    return np.array(columns).T


def _build_inertia_tensor(entries: np.ndarray) -> np.ndarray:
    tensor = np.zeros((3, 3))
    tensor[np.triu_indices(3)] = entries
    return tensor + np.triu(tensor, 1).T


def list_regrouping_relations(chain: Chain, platform_rule: bool = True) -> Iterator[Relation]:
    """List the relations between the parameters of the 19 bodies by the rules of section 2.1.

    Each leg consists of a ring, a stator and a slider that carries the platform. Prismatic joint: all
    moments of inertia of the slider are added to the stator. Platform: the slider's mass is added to the
    platform as a point mass in the platform joint, the origin of the slider's frame (Steiner).
    Revolute joint: the stator's mass, first moment along the axis, and equal inertias about x and y
    represent point masses on the axis. The joint does not move them; they are added to the ring. The
    base does not move, so that of a ring's mass, first moment along its axis and inertias only the
    inertia about its axis remains.

    Args:
        chain: chain of the hexapod; joints of ring, stator and slider are along z of their frames.
        platform_rule: whether the masses of the sliders are added to the platform.

    Yields:
        Relations from the sliders to the base, in the order in which they must be applied.

    Source: Abdellatif 2008, section 2.1, after (11).
    """
    tree = chain.tree
    for leg in LEGS:
        ring, stator, slider = (f"{kind}_{leg}" for kind in ("ring", "stator", "slider"))
        body = chain.bodies.index(slider) + 1
        turned = compute_inertial_transformation(tree.rotation[body], np.zeros(3))
        for kind in _INERTIAS:
            yield Relation(f"{kind}.{slider}", _list_parent_weights(turned, kind, stator))
        if platform_rule:
            joint = compute_inertial_transformation(np.eye(3), tree.closure_points[leg - 1, 1])
            yield Relation(f"mass.{slider}", _list_parent_weights(joint, "mass", "platform"))
        body = chain.bodies.index(stator) + 1
        moved = compute_inertial_transformation(tree.rotation[body], tree.offset[body])
        for kind in ("mass", "moment_z"):
            yield Relation(f"{kind}.{stator}", _list_parent_weights(moved, kind, ring))
        rod = _list_parent_weights(moved, "inertia_xx", ring, "inertia_yy")
        yield Relation(f"inertia_yy.{stator}", rod | {f"inertia_xx.{stator}": -1.0})
        for kind in ("mass", "moment_z", *_INERTIAS):
            if kind != "inertia_zz":
                yield Relation(f"{kind}.{ring}", {})


def _list_parent_weights(matrix: np.ndarray, kind: str, body: str, *more: str) -> dict[str, float]:
    """Return the parameters of the parent body, with coefficients, that replace a parameter of a body.

    Args:
        matrix: (10, 10) transformation from the body's to the parent's inertial parameters.
        kind: kind of the body's parameter, such as `mass`.
        body: name of the parent body.
        *more: further kinds of parameters of the body, which have the same value as `kind`; the
            coefficients of all these kinds are added.

    Returns:
        Parameter of the parent body, such as `mass.ring_1` -> coefficient; zeros are left out.
    """
    column = matrix[:, [_KINDS.index(one) for one in (kind, *more)]].sum(axis=1)
    return {f"{k}.{body}": float(c) for k, c in zip(_KINDS, column, strict=True) if abs(c) > 1e-12}


def regroup_parameters(names: Sequence[str], relations: Iterator[Relation]) -> np.ndarray:
    """Regroup inertial parameters: eliminate one parameter per relation by adding it to others.

    Args:
        names: names of the m inertial parameters.
        relations: relations in the order of their application.

    Returns:
        (m, m) coefficients. Row i gives the regrouped parameter i as a linear combination of the m
        original parameters; rows of eliminated parameters are 0.

    Source: Abdellatif 2008, (11).
    """
    places = {name: k for k, name in enumerate(names)}
    regrouped = np.eye(len(names))
    for parameter, weights in relations:
        row = places[parameter]
        for name, weight in weights.items():
            regrouped[places[name]] += weight * regrouped[row]
        regrouped[row] = 0.0
    return regrouped


def list_printed_combinations(joints: np.ndarray) -> dict[str, dict[str, float]]:
    """Return the ten combinations of Abdellatif 2008, Table 1, with parameter names of the model's first leg.

    Args:
        joints: (6, 3) positions of the platform joints r_B in the platform's frame [m].

    Returns:
        Symbol (p1 to p10) -> parameter -> coefficient. For p5 the table prints s_y3, but its p1 contains
        I_yy2 + I_zz3, by which the strut's axis is z of frame 3. p5 is therefore returned as the
        slider's first moment along z.
    """
    x, y, z = np.sum(joints**2, axis=0)
    slider = "mass.slider_1"
    return {
        "p1": {"inertia_zz.ring_1": 1.0, "inertia_yy.stator_1": 1.0, "inertia_zz.slider_1": 1.0},
        "p2": {"inertia_xx.stator_1": 1.0, "inertia_xx.slider_1": 1.0,
               "inertia_yy.stator_1": -1.0, "inertia_zz.slider_1": -1.0},
        "p3": {"inertia_zz.stator_1": 1.0, "inertia_yy.slider_1": 1.0},
        "p4": {"moment_y.stator_1": 1.0},
        "p5": {"moment_z.slider_1": 1.0},
        "p6": {"inertia_xx.platform": 1.0, slider: float(y + z)},
        "p7": {"inertia_yy.platform": 1.0, slider: float(x + z)},
        "p8": {"inertia_zz.platform": 1.0, slider: float(x + y)},
        "p9": {"moment_z.platform": 1.0, slider: float(joints[:, 2].sum())},
        "p10": {"mass.platform": 1.0, slider: 6.0},
    }  # fmt: skip


_BODY_ASSUMPTIONS = {
    "19 bodies": {"equal_groups": (), "zero_parameters": ()},
    "equal legs": {"zero_parameters": ()},
    "equal legs, symmetrical bodies": {},
}
"""Assumption about the bodies -> changes of the model's regressor.

With symmetrical bodies, 19 inertial parameters of a leg and of the platform are declared absent, as
in Table 1.
"""


def compare_base_parameter_methods(seed: int, changes: Changes) -> Sample:
    """Find base parameters by a published table, by regrouping rules and by the null space; compare them.

    The table is Abdellatif 2008, Table 1. The null space is that of the regressor at random states.

    Args:
        seed: not used.
        changes: `declare_symmetry`: whether parameters are declared absent; `platform_rule`:
            whether the rule for the platform is applied; `joint_radius`: factor of the positions
            of the platform joints in Table 1.

    Returns:
        For three assumptions about the bodies (19 different bodies, equal legs, equal legs with
        symmetrical bodies): number of inertial `columns`, `rank` by the null space, number of base
        parameters by the `rules`, and largest `difference` of coefficients between both. Compared with
        Table 1: numbers of `rigid` and `friction` base parameters, and number of combinations that are
        the `same`. `values`: largest difference of the model's base parameters from Table 2 [SI].
    """
    defaults = {"declare_symmetry": True, "platform_rule": True, "joint_radius": 1.0}
    settings = merge_settings(defaults, changes)
    own = load_robot()
    chain, found = (
        own.setup.chain,
        project_on_drives(own.setup.chain, own.setup.given_joints, *sample_states()),
    )
    bodies = [f"{kind}.{body}" for body in chain.bodies for kind in _KINDS]
    regrouped = regroup_parameters(bodies, list_regrouping_relations(chain, settings["platform_rule"]))
    values: dict[str, float] = {}
    spectra = []
    for stage, options in _BODY_ASSUMPTIONS.items():
        table = replace(own.setup, **options).compute_regressor(found)
        structure, kept = _find_inertial_base_parameters(table)
        names = [table.names[k] for k in kept]
        sums = _build_shared_parameter_matrix(bodies, names, own.setup.equal_groups if stage != "19 bodies" else ())
        rules = (regrouped @ sums)[[bodies.index(name) for name in names]]  # one of equal legs
        rules = rules[np.any(rules, axis=1)]
        values[f"columns, {stage}"] = len(kept)
        values[f"rank, {stage}"] = len(structure.base)
        values[f"rules, {stage}"] = len(rules)
        values[f"difference, {stage}"] = _find_largest_difference(rules, structure)
        spectra.append(_compute_singular_values(table.matrix[:, :, kept]))
    printed = list_printed_combinations(settings["joint_radius"] * chain.tree.closure_points[:, 1])
    structure = own.base_parameters
    if not settings["declare_symmetry"]:
        table = replace(own.setup, zero_parameters=()).compute_regressor(found)
        rows = table.matrix.reshape(-1, len(table.names))
        structure = classify_parameters(rows, table.names, table.units, [one.column for one in PUBLISHED_PARAMETERS])
    values |= _compare_with_table_1(structure, printed)
    values["values"] = float(np.abs(own.truth - [one.value for one in PUBLISHED_PARAMETERS]).max())
    labels = ("19 bodies", "equal legs", "symmetry")
    panels = tuple(
        Panel(f"singular value, {label} [1]", np.arange(1.0, len(s) + 1), {"": s}, "number",
              log=True, discrete=True)
        for label, s in zip(labels, spectra, strict=True)
    )  # fmt: skip
    return Sample(values, panels)


def _compute_singular_values(matrix: np.ndarray) -> np.ndarray:
    """Return the singular values of a regressor, divided by the largest one.

    Zero columns are left out, and the others are scaled to unit length. Values below half the machine
    epsilon are replaced by this bound.

    Args:
        matrix: (n, k, m) regressor of n samples, k drives and m parameters.
    """
    rows = matrix.reshape(-1, matrix.shape[2])
    length = np.linalg.norm(rows, axis=0)
    kept = length > MAX_ROUNDING
    values = np.linalg.svd(rows[:, kept] / length[kept], compute_uv=False)
    return np.maximum(values / values[0], np.finfo(float).eps / 2)


def _find_inertial_base_parameters(table: Regressor) -> tuple[Identifiability, list[int]]:
    """Find the base parameters of a regressor's inertial columns; friction columns are left out.

    Return the identifiability of the inertial parameters, and the indices of their columns in `table`.
    """
    kept = [k for k, name in enumerate(table.names) if name.partition(".")[0] in _KINDS]
    names, units = [table.names[k] for k in kept], [table.units[k] for k in kept]
    rows = table.matrix[:, :, kept].reshape(-1, len(kept))
    first = [one.column for one in PUBLISHED_PARAMETERS[:10]]
    return classify_parameters(rows, names, units, [name for name in first if name in names]), kept


def _build_shared_parameter_matrix(
    bodies: Sequence[str], names: Sequence[str], equal_bodies: Sequence[Sequence[str]]
) -> np.ndarray:
    """Return the matrix (190, m) that computes the parameters of all 19 bodies from m distinct ones.

    The entry of a body parameter (row) and a distinct parameter (column) is 1 if the former equals the
    latter, else 0. `bodies` names the 190 body parameters and `names` the m distinct ones. The bodies of
    a group in `equal_bodies` share the parameters of the group's first body. Rows of parameters that are
    not in `names` are 0.
    """
    first = {body: group[0] for group in equal_bodies for body in group}
    sums = np.zeros((len(bodies), len(names)))
    for k, name in enumerate(bodies):
        kind, _, body = name.partition(".")
        united = f"{kind}.{first.get(body, body)}"
        if united in names:
            sums[k, names.index(united)] = 1.0
    return sums


def _find_largest_difference(rules: np.ndarray, structure: Identifiability) -> float:
    """Return the largest difference of coefficients between regrouping rules and null space.

    The null space may represent the same combinations by other parameters. The combinations by the rules
    are therefore first solved for the parameters that represent the null space's combinations. The
    result is infinite if the numbers of combinations differ.

    Args:
        rules: (r, m) coefficients of r combinations of m parameters by the rules.
        structure: base parameters from the null space.
    """
    if len(rules) != len(structure.base):
        return np.inf
    solved = np.linalg.solve(rules[:, structure.base], rules)
    return float(np.abs(solved - structure.combination).max())


def _compare_with_table_1(structure: Identifiability, printed: dict[str, dict[str, float]]) -> dict[str, float]:
    """Count the base parameters, and the combinations that agree with Abdellatif 2008, Table 1.

    A combination agrees if it has the same parameters and coefficients; inertias of drives are ignored.
    Return the numbers of base parameters of bodies (`rigid`) and of `friction`, and the number of
    combinations that agree (`same`).
    """
    names, same = [structure.names[k] for k in structure.base], 0
    for symbol, members in printed.items():
        column = PUBLISHED_PARAMETERS[SYMBOLS.index(symbol)].column
        if column not in names:
            continue
        row = structure.combination[names.index(column)]
        found = {structure.names[k]: row[k] for k in np.flatnonzero(row)
                 if not structure.names[k].startswith("drive_inertia")}  # fmt: skip
        same += set(found) == set(members) and all(abs(found[name] - members[name]) < MAX_ROUNDING for name in members)
    friction = sum(name.startswith(("coulomb", "viscous")) for name in names)
    return {"rigid": len(names) - friction, "friction": friction, "same": same}


def evaluate_table_1(samples: Sequence[Sample]) -> Evaluation:
    """Compare the base parameters from the null space with Abdellatif 2008, Table 1.

    There must be 10 base parameters of rigid bodies and 14 of friction, and all 10 combinations of the
    table must have the same parameters and coefficients.
    """
    values = samples[0].values
    return Evaluation(
        (
            check_deterministic_value("rigid-body base parameters", values["rigid"], (10, 10), "Table 1",
                        published=10),
            check_deterministic_value("friction parameters", values["friction"], (14, 14), "Table 1",
                        published=14),
            check_deterministic_value("combinations with the members and coefficients of Table 1", values["same"],
                        (10, 10), "Table 1", published=10),
        ),
        "the null space is computed from a regressor with equal legs and 19 inertial columns"
        " declared absent, because the bodies in Table 1 are symmetrical; without this"
        f" declaration the rank of the inertial columns is {values['rank, equal legs']:.0f}",
    )  # fmt: skip


def evaluate_regrouping_rules(samples: Sequence[Sample]) -> Evaluation:
    """Check that the regrouping rules give the same base parameters as the null space of the regressor.

    Their number and, up to rounding, their coefficients must agree for 19 different bodies, for equal
    legs, and for equal legs with symmetrical bodies.
    """
    values, checks = samples[0].values, []
    for stage in _BODY_ASSUMPTIONS:
        rank = values[f"rank, {stage}"]
        checks += [
            check_deterministic_value(f"base parameters by the rules, {stage}", values[f"rules, {stage}"],
                        (rank, rank), f"rank of {values[f'columns, {stage}']:.0f} columns"),
            check_deterministic_value(f"largest difference of coefficients, {stage}",
                        values[f"difference, {stage}"], (0.0, MAX_ROUNDING), "rounding"),
        ]  # fmt: skip
    return Evaluation(tuple(checks))


def evaluate_parameter_values(samples: Sequence[Sample]) -> Evaluation:
    """Check that the model's 24 base parameters equal the estimates of Abdellatif 2008, Table 2, within 1e-9."""
    worst = float(collect_values(samples, "values").max())
    check = check_deterministic_value("largest difference from the estimates of Table 2", worst, (0.0, 1e-9),
                        "rounding of the decimals in the MJCF", unit="SI")  # fmt: skip
    return Evaluation((check,))


STRUCTURE = Experiment(
    "base parameters",
    compare_base_parameter_methods,
    (
        Claim(
            "base parameters",
            '"The rigid-body part contains 10 base parameters (see Table 1)." "The friction model'
            ' contains therefore 14 different parameters."',
            "Table 1, section 5.1", "document", evaluate_table_1,
            {"declare_symmetry": False},
            "no inertial parameter and no viscous friction of the passive hinges is assumed to be zero", (),
        ),
        Claim(
            "regrouping rules",
            '"For revolute joints the 9th, the 10th and the sum of the 1st and 4th columns of Li'
            ' and Ki comply with the mentioned conditions." "For prismatic joints however, the'
            ' moments of inertia can be added to the carrying antecedent joint" "The masses of'
            " terminal bodies can be grouped to the inertial parameter of the platform according to"
            " Steiner's laws.\"",
            "section 2.1, (9) to (11)", "document", evaluate_regrouping_rules,
            {"platform_rule": False}, "the regrouping rule for the platform is not applied",
        ),
        Claim(
            "parameters of the model",
            "24 estimates",
            "Table 2", "input", evaluate_parameter_values, None, "", (),
        ),
    ),
    fixed_repetitions=1,
)  # fmt: skip
