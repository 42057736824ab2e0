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

Everything on these pages is generated from the program.

```{toctree}
:maxdepth: 1

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
        "# Machines\n\nModels that hydrotele contains, with the sources of their parameters. `hydrotele list"
        " machines` lists those that"
        f" commands accept.\n\n```{{toctree}}\n:maxdepth: 1\n\n{names}\n```\n"
    )
    return pages


def list_file_index() -> dict[str, str]:
    """Return the index of the pages on files."""
    names = "\n".join(files.FILE_KINDS)
    return {"files/index.md": f"# Files and their keys\n\n```{{toctree}}\n:maxdepth: 1\n\n{names}\n```\n"}


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
