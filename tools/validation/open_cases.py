"""Run the workflow on the measured open cases and compare with their answers.

    python tools/validation/open_cases.py ../shared/measured [--only open_01 open_02] [--jobs 2]

Each case is copied to a folder of its own without the answers. Prints a table; exits with 1 if a
case is wrong.
"""

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import yaml

from hydrotele.gap.find import find_gap
from hydrotele.gap.result import Gap
from hydrotele.logs.dataset import load_dataset
from hydrotele.machine.machine_file import load_machine

NAMES = {
    "higher viscous friction": "viscous_friction",
    "command transport delay": "command_delay",
    "larger valve dead band": "valve_deadband",
    "pressure transducer offset (measured = true + offset)": "pressure_offset",
    "lower main relief pressure": "relief_pressure",
    "more internal leakage": "internal_leakage",
    "extra payload mass": "payload",
    "resolver offset (measured = true + offset)": "angle_offset",
}
_SCORED = "position-dependent friction (scored bore zone)"
# which the answers, older than the effect, call out of the library
_VARYING = {"position_dependent_friction": "coulomb_friction_by_position"}
PLACES = {
    "all axes": "all", "stick valve": "stick", "boom head side": "boom.head",
    "boom cylinder (A to B)": "boom", "stick angle": "stick", "stick cylinder": "stick",
}  # fmt: skip


def right_names(effect: str) -> tuple[str, ...]:
    """Return the names that are right for an effect: its own, and that of the same law as a varying coefficient.

    >>> right_names("position_dependent_friction")
    ('position_dependent_friction', 'coulomb_friction_by_position')
    """
    return (effect, _VARYING[effect]) if effect in _VARYING else (effect,)


def _name(described: str) -> str:
    """The library's name of an effect as an answer describes it; empty if it has none."""
    if described.startswith(_SCORED):
        return "position_dependent_friction"
    return NAMES.get(described, "")


def expected(answer: dict) -> tuple[str, list[tuple[str, str, float, float]]]:
    """Verdict and (name, location, value, factor to SI) of the effects of an answer."""
    if answer["category"] == "clean":
        return "no_gap", []
    names = [_name(effect["effect"]) for effect in answer["effects"]]
    if not all(names):
        return "unknown", []
    effects = []
    for name, effect in zip(names, answer["effects"], strict=True):
        place = effect["location"]
        place = "tool" if place.startswith("stick tip") else PLACES.get(place, place)
        factor = 0.017453292519943295 if effect["unit"] == "deg" else 1.0
        effects.append((name, place, effect["value"] * factor, factor))
    return "named", effects


def right(gap: Gap, answer: dict) -> bool:
    """Whether verdict, names and locations are those of the answer."""
    verdict, effects = expected(answer)
    if verdict == "unknown":
        return gap.verdict == verdict
    found = {(e.name, e.location) for e in gap.effects}
    rest = [{(other, place) for other in right_names(name)} for name, place, _, _ in effects]
    return gap.verdict == verdict and len(found) == len(rest) and all(found & pairs for pairs in rest)


def described(gap: Gap) -> str:
    """What was found, in a table's cell."""
    parts = [f"{gap.unknown.law}: {gap.unknown.term or gap.unknown.channel}"] if gap.unknown else []
    for effect in gap.effects:
        for key, p in effect.parameters.items():
            parts.append(
                f"{effect.name} {effect.location} ({effect.probability:.3f}): {key} {p.value:.5g}"
                f" [{p.low:.5g}, {p.high:.5g}] {p.unit}"
            )
    return "; ".join(parts) or "-"


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("folder", type=Path)
parser.add_argument("--only", nargs="*", default=[])
parser.add_argument("--jobs", type=int, default=2)

if __name__ == "__main__":
    args = parser.parse_args()
    answers = yaml.safe_load((args.folder / "answers.yaml").read_text())
    machine = load_machine("cat215")
    print("| case | hidden effect | verdict | found | error before | after | perfect model | time [s] | correct |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    wrong = 0
    for case, answer in answers.items():
        if args.only and case not in args.only:
            continue
        with tempfile.TemporaryDirectory() as scratch:
            copy = Path(scratch, "data")
            shutil.copytree(args.folder / case, copy)
            gap = find_gap(load_dataset([copy], machine), jobs=args.jobs)
        good = right(gap, answer)
        wrong += not good
        truth = "; ".join(f"{n} {p} {v:.5g}" for n, p, v, _ in expected(answer)[1])
        size = gap.size
        floor = "-" if size.noise_floor is None else f"{size.noise_floor:.3f}"
        print(
            f"| {case} | {truth or answer['category']} | {gap.verdict} | {described(gap)} |"
            f" {size.before:.3f} | {size.after:.3f} | {floor} |"
            f" {gap.seconds:.0f} | {'yes' if good else 'NO'} |",
            flush=True,
        )
    sys.exit(1 if wrong else 0)
