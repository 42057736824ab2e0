"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer


def _load(files: list[Path] | None) -> list[Path] | None:
    """Load the files before anything looks for an effect or a law."""
    if files:
        from hydrotele.effects import load_effects

        for file in files:
            load_effects(file)
    return files


EffectFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--effects",
        metavar="FILE.py",
        callback=_load,
        help="Python file with effects or laws of your own, which is run; may be repeated.",
    ),
]
