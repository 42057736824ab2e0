"""Run the gap search on cases with known answers: public benchmark cases and series of blind trials.

    python tools/validation/gap_cases.py --open ../shared/measured --out runs/cases
    python tools/validation/blind_world.py --out runs/world --kinds near:5,noise:4,clean:3 --seed 61 --make-only
    python tools/validation/gap_cases.py --series runs/world --out runs/cases

`--open` is the folder of the public benchmark cases, `--series` a series of blind trials of the independent simulator
whose logs are made. Every case is searched in a copy that holds the logs only. Results that are there are kept. Prints
a Markdown table: named effects, whether every hidden effect is named, effects named falsely, processor time; then the
number of right answers per kind, with Wilson intervals.
"""

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from scipy.stats import binomtest

from hydrotele.core.errors import InputError
from hydrotele.gap.find import find_gap
from hydrotele.gap.result import LIKELY, gap_document
from hydrotele.logs.dataset import load_dataset
from hydrotele.machine.machine_file import load_machine
from tools.validation.blind.judge import is_among
from tools.validation.blind.trials import Place, write_json
from tools.validation.blind.world_trials import load_world_series
from tools.validation.open_cases import expected, right_names

_NAMING = ("named", "partly", "ambiguous")


@dataclass(frozen=True)
class Case:
    """Logs with a known answer.

    Attributes:
        name: of the case.
        logs: folder of its logs.
        machine: name of the machine.
        hidden: per hidden effect the names and locations that are right; empty for an unchanged machine.
        is_known: whether the library holds the hidden effects.
    """

    name: str
    logs: Path
    machine: str
    hidden: tuple[tuple[tuple[str, str], ...], ...]
    is_known: bool = True


def list_open_cases(folder: Path) -> Iterator[Case]:
    """Yield the public benchmark cases."""
    for name, answer in yaml.safe_load((folder / "answers.yaml").read_text()).items():
        verdict, effects = expected(answer)
        hidden = tuple(tuple((one, place) for one in right_names(effect)) for effect, place, _, _ in effects)
        yield Case(name, folder / name, "cat215", hidden, verdict != "unknown")


def list_trials(out: Path) -> Iterator[Case]:
    """Yield the trials of a series whose logs are made."""
    series = load_world_series(out)
    for name in series.names():
        place = Place(out, name)
        if not place.data.is_dir():
            continue
        key = json.loads(place.key.read_text())
        hidden = tuple(tuple((n, p) for n, p in part["right"]) for part in key["planted"])
        yield Case(f"{key['kind']} {name}", place.data, series.machine, hidden, key["kind"] != "outside")


def search_case(case: Case, jobs: int) -> dict[str, Any]:
    """Search a case and return its `gap.json` document with the processor time [s]."""
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch, "data")
        shutil.copytree(case.logs, copy)
        data = load_dataset([copy], load_machine(case.machine))
        start = time.process_time()

        def tell(text: str, share: float) -> None:
            print(f"{time.process_time() - start:6.0f} s {100 * share:3.0f} % {text}", file=sys.stderr, flush=True)

        gap = find_gap(data, tell, jobs=jobs)
    return gap_document(gap) | {"processor_seconds": time.process_time() - start}


def judge_case(case: Case, document: dict[str, Any]) -> dict[str, Any]:
    """Compare a document with the hidden effects.

    Returns:
        `named`: effects above one half in a naming verdict; `found`: whether every hidden effect is among them (of an
        unchanged machine or an unmodelled effect: whether nothing is named); `false`: number of wrong ones.
    """
    naming = document["effects"] if document["verdict"] in _NAMING else []
    named = [(e["name"], e["location"]) for e in naming if e["probability"] > LIKELY]
    right = {pair for pairs in case.hidden for pair in pairs}
    false = sum(not is_among(*pair, right) for pair in named)
    if case.is_known and case.hidden:
        found = all(any(is_among(*pair, pairs) for pair in named) for pairs in case.hidden)
    else:
        found = not named
    return {"named": named, "found": found, "false": false}


def format_row(case: Case, document: dict[str, Any]) -> str:
    """Return a row of the table."""
    verdict = judge_case(case, document)
    hidden = ", ".join(" ".join(pairs[0]) for pairs in case.hidden if pairs)
    hidden = hidden or ("none" if case.is_known else "unmodelled")
    named = ", ".join(" ".join(pair) for pair in verdict["named"]) or "-"
    size, answers = document["gap"], document.get("answers") or []
    sure = "; ".join(" / ".join(a["sure"]) or "-" for a in answers) or "-"
    return (
        f"| {case.name} | {hidden} | {document['verdict']} | {named} | {sure} | {size['before']:.2f} |"
        f" {size['after']:.2f} | {'yes' if verdict['found'] else 'no'} | {verdict['false']} |"
        f" {document['processor_seconds']:.0f} |"
    )


def print_summary(right: Mapping[str, Sequence[bool]]) -> None:
    """Print the number of right answers per kind, with 95 % Wilson intervals."""
    print("\n| kind | right answers | 95 % interval |\n| --- | --- | --- |")
    for kind, answers in {**right, "all": [one for each in right.values() for one in each]}.items():
        interval = binomtest(sum(answers), len(answers)).proportion_ci(method="wilson")
        print(
            f"| {kind} | {sum(answers)} of {len(answers)} | {100 * interval.low:.0f} to {100 * interval.high:.0f} % |"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the arguments, search what is missing, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--open", type=Path, help="folder of the public benchmark cases")
    parser.add_argument("--series", type=Path, help="folder of a series of blind trials")
    parser.add_argument("--only", nargs="+", default=[], metavar="CASE")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--jobs", type=int, default=1, help="processors that one search may use")
    args = parser.parse_args(arguments)
    cases = [*(list_open_cases(args.open) if args.open else ()), *(list_trials(args.series) if args.series else ())]
    cases = [case for case in cases if not args.only or case.name in args.only]
    if not cases:
        print(InputError("--open, --series", "hold no case: give one of them, and --only with its cases"))
        return 2
    args.out.mkdir(parents=True, exist_ok=True)
    print("| case | hidden | verdict | named | sure level | error before | after | found | false | time [s] |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    right: dict[str, list[bool]] = {}
    for case in cases:
        file = args.out / f"{case.name.replace(' ', '_')}.json"
        if not file.is_file():
            write_json(file, search_case(case, args.jobs))
        document = json.loads(file.read_text())
        print(format_row(case, document), flush=True)
        found = judge_case(case, document)
        right.setdefault(case.name.partition(" ")[0], []).append(found["found"] and not found["false"])
    print_summary(right)
    return 0


if __name__ == "__main__":
    sys.exit(main())
