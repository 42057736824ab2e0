"""Files of the repository outside docs/ that the documentation site shows as pages."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = {f"models/{file.parent.name}/README.md": f"machines/{file.parent.name}.md"
         for file in sorted(ROOT.glob("models/*/README.md"))} | {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "tools/README.md": "tools.md",
    "tools/plugin_example/README.md": "plugin_example.md",
}  # fmt: skip
"""File -> its page in docs/reference."""


def find_page(file: Path) -> str | None:
    """Return the page that shows a file, or the README of a folder, relative to docs/; None without one."""
    path = file.relative_to(ROOT).as_posix()
    if path == "README.md":
        return "get_started.md"
    page = PAGES.get(path) or PAGES.get(f"{path}/README.md")
    return page and f"reference/{page}"
