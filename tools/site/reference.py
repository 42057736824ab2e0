"""Write the reference pages of the documentation site, from the program itself, in docs/reference.

    python -m tools.site.reference

The pages are those of files and their keys, log channels, effects, commands, machines and the Python API. tools/docs
calls this command before Sphinx. A page that has not changed keeps its time, so that Sphinx does not build it again.
"""

import argparse
import os
import re
from pathlib import Path

from tools.site import api, channels, commands, effects, files
from tools.site.effect_pictures import write_pictures
from tools.site.repository_pages import PAGES, ROOT

LINK = re.compile(r"\]\((?!https?:|#)(?P<path>[^)#\s]+)(?P<anchor>#[^)\s]*)?\)")

INDEX = """# Reference

These pages define every key of a file, column of a log, effect, option of a command and function of the Python API.
The pages are generated from the program, so they hold for the version in the footer.
`hydrotele --version` prints yours. If it differs, use the texts of `hydrotele COMMAND --help`.

| page | content |
| --- | --- |
| [Files and their keys](files/index.md) | all keys of machines, scenarios, sweeps and other YAML files |
| [Log channels](channels.md) | all columns that a log may have, and units |
| [Effects](effects/index.md) | physical phenomena that can be simulated, and found in logs, with equations |
| [Commands](commands/index.md) | all commands of `hydrotele` with their options |
| [Python API](python.md) | functions and classes |
| [Machines](machines/index.md) | the models that hydrotele contains, with the sources of their parameters |
| [Example of a package with plug-ins](plugin_example.md) | your own effects, tasks, pilots and importers as a package |
| [Scripts](tools.md) | scripts of the source code that repeat studies and tests |
| [Changelog](changelog.md), [contributing](contributing.md) | for developers |

```{toctree}
:hidden:

files/index
channels
effects/index
commands/index
python
machines/index
plugin_example
tools
changelog
contributing
```
"""


MODELS = {
    "cat215": "Caterpillar 215, excavator with bucket or log grapple (hydraulic)",
    "cat325": "Caterpillar 325, feller-buncher: a machine that fells trees (hydraulic)",
    "ec20": "Volvo EC20, mini excavator (hydraulic)",
    "rig": "test rig: one cylinder that pushes a mass (hydraulic)",
    "calibrator": "CAT 215 with the external calibrator of Khoshzaban 1992",
    "eha": "electro-hydraulic actuator: a cylinder with its own pump",
    "emps": "electric positioning system, without hydraulics",
    "joystick": "magnetically levitated joystick with force reflection",
    "palida": "PaLiDA, electric hexapod (parallel robot) of Abdellatif 2008",
    "iwr": "serial-parallel robot of Wang 2012",
    "panda": "Franka Panda, robot arm of a public record",
    "robots": "geometry of robot arms, for `hydrotele calibrate mukca`",
}
"""Folder in models/ -> what it is."""


def copy_page(file: Path, page: Path) -> str:
    """Return the text of a Markdown file of the repository, with its relative links valid at another place."""

    def move(match: re.Match) -> str:
        target = os.path.relpath((file.parent / match["path"]).resolve(), page.parent)
        return f"]({target}{match['anchor'] or ''})"

    return LINK.sub(move, file.read_text(encoding="utf-8"))


def list_repository_pages(folder: Path) -> dict[str, str]:
    """Return {path of the page: its text} of the machines' READMEs and of pages in the root of the repository."""
    pages = {page: copy_page(ROOT / file, folder / page) for file, page in PAGES.items()}
    names = "\n".join(Path(page).stem for page in pages if page.startswith("machines/"))
    pages["machines/index.md"] = (
        "# Machines\n\nModels that hydrotele contains. Each page describes a model and the sources of its"
        " parameters. `hydrotele list machines` lists the machines that commands accept.\n\n"
        "| page | model |\n| --- | --- |\n"
        + "\n".join(f"| [{name}]({name}.md) | {text} |" for name, text in MODELS.items())
        + f"\n\n```{{toctree}}\n:hidden:\n\n{names}\n```\n"
    )
    return pages


def list_file_index() -> dict[str, str]:
    """Return the index of the pages on files."""
    rows = "\n".join(f"| [{kind.title}]({name}.md) | {kind.content} |" for name, kind in files.FILE_KINDS.items())
    text = (
        "# Files and their keys\n\nhydrotele reads YAML files. Each page lists all keys of one kind of file with type,"
        " unit, valid values and default. `hydrotele validate FILE` checks machines, joysticks, scenarios and sweeps,"
        f" and reports errors with their line.\n\n| file | content |\n| --- | --- |\n{rows}\n\n"
    )
    names = "\n".join(files.FILE_KINDS)
    return {"files/index.md": f"{text}```{{toctree}}\n:hidden:\n\n{names}\n```\n"}


def write_pages(pages: dict[str, str], folder: Path) -> int:
    """Write pages whose text has changed and remove those that no longer exist; return the number of pages."""
    for path, text in pages.items():
        file = folder / path
        if file.is_file() and file.read_text(encoding="utf-8") == text:
            continue
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    for file in folder.rglob("*.md"):
        if file.relative_to(folder).as_posix() not in pages:
            file.unlink()
    return len(pages)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "reference")
    folder = parser.parse_args().out
    pages = {"index.md": INDEX}
    for module in (files, channels, effects, commands, api):
        pages |= module.list_pages()
    pages |= list_file_index() | list_repository_pages(folder)
    count = write_pages(pages, folder)
    drawn = write_pictures(folder / "effects")
    print(f"reference: {count} pages, {drawn} new pictures in {folder}")


if __name__ == "__main__":
    main()
