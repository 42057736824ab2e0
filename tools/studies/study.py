"""Options, parallel trials and page writing that the studies share."""

import argparse
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

_ASIDE = ("jobs", "out")  # options that change no result


def options(doc: str | None, *folders: str, **defaults: Any) -> argparse.Namespace:
    """Options of a study from the command line.

    Args:
        doc: its description.
        folders: names of the folders that it asks for.
        defaults: option -> its default, which tells its type.

    Returns:
        The options, with `out`, the file to write, or None.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawTextHelpFormatter)
    for folder in folders:
        parser.add_argument(folder, type=Path)
    for name, default in defaults.items():
        parser.add_argument(f"--{name}", type=type(default), default=default)
    parser.add_argument("--out", type=Path)
    return parser.parse_args()


def side_by_side(trial: Callable, asked: argparse.Namespace, *more: Any) -> list[Any]:
    """All trials, each `trial(seed, number, *more)`, with a line for every tenth."""
    found, many = [], asked.trials
    with ProcessPoolExecutor(asked.jobs) as pool:
        rest = [[one] * many for one in more]
        for result in pool.map(trial, [asked.seed] * many, range(many), *rest):
            found.append(result)
            if len(found) % 10 == 0:
                print(f"{len(found)} of {many}", file=sys.stderr, flush=True)
    return found


def publish(text: str, title: str, asked: argparse.Namespace) -> None:
    """Print a result; write it where a file was asked for, with its command after the first paragraph."""
    print(text)
    if not asked.out:
        return
    script = Path(sys.argv[0]).resolve()
    words = ["python", f"tools/{script.parent.name}/{script.name}"]
    for name, value in vars(asked).items():
        if isinstance(value, Path):
            words += [] if name in _ASIDE else [f"../shared/{value.name}"]
        elif name not in _ASIDE and value not in (None, ""):
            words += [f"--{name}", f"{value}"]
    command = f"Command: `{' '.join(words)}`"
    first, _, rest = text.partition("\n\n")
    page = [command, text] if first.startswith(("#", "|", "-", "!")) else [first, command, rest]
    asked.out.write_text("\n\n".join([f"# {title}", *page]), encoding="utf-8")
