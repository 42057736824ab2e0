"""The list of scripts in tools/README.md, and the paths of scripts that other files name."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ROOT / "tools"
LINE = re.compile(r"^\| `([a-z0-9_/]+(?:\.py)?)` \|", re.M)
# Not what follows another folder (tests/tools/..., ../shared/tools/...).
SCRIPT = re.compile(r"(?<![\w/])tools/[\w/]+\.py\b")
MODULE = re.compile(r"-m (tools(?:\.\w+)+)")


def scripts(folder: Path) -> set[str]:
    found = (path for path in folder.rglob("*") if path.is_file())
    return {
        path.relative_to(folder).as_posix()
        for path in found
        if path.suffix in ("", ".py") and path.name != "__init__.py"
    }


@pytest.fixture(scope="module")
def sections() -> dict[str, list[str]]:
    """Scripts listed in each section of the README."""
    parts = (TOOLS / "README.md").read_text(encoding="utf-8").split("\n## ")[1:]
    return {part.splitlines()[0]: LINE.findall(part) for part in parts}


@pytest.mark.parametrize("folder", ["studies", "validation", "release", "site"])
def test_every_script_is_listed_once(folder, sections):
    assert sorted(sections[f"{folder}/"]) == sorted(scripts(TOOLS / folder))


def test_every_command_at_the_top_level_is_listed(sections):
    commands = [p.name for p in TOOLS.iterdir() if p.is_file() and p.name != "README.md"]
    assert sorted(sections["Top level"]) == sorted(commands)


def test_scripts_that_files_name_exist():
    files = [
        path
        for pattern in ("**/*.md", "**/*.py", "**/*.yaml", "**/*.yml", "*.toml", "tools/**/*")
        for path in ROOT.glob(pattern)
        if path.is_file() and path.suffix in ("", ".md", ".py", ".yaml", ".yml", ".toml")
        and not {".venv", "runs", "demo"} & set(path.relative_to(ROOT).parts)
    ]  # fmt: skip
    missing = []
    for path in files:
        text = path.read_text(encoding="utf-8")
        named = set(SCRIPT.findall(text))
        named |= {f"{module.replace('.', '/')}.py" for module in MODULE.findall(text)}
        # tests/conftest.py names tests by their path below tests/.
        absent = [n for n in named if not (ROOT / n).is_file() and not (ROOT / "tests" / n).is_file()]
        missing += [f"{path.relative_to(ROOT)}: {name}" for name in sorted(absent)]
    assert missing == []


def test_pages_that_the_readme_names_exist():
    named = set(re.findall(r"`((?:docs|models)/[\w/*.]+)`", (TOOLS / "README.md").read_text()))
    assert [name for name in sorted(named) if not list(ROOT.glob(name))] == []
