"""Pages of docs/from_the_documents: each function, scenario and model that they name exists."""

import ast
import re
from pathlib import Path

import pytest

from hydrotele.scenario.scenario import shipped_scenarios

ROOT = Path(__file__).parent.parent
PAGES = sorted((ROOT / "docs" / "from_the_documents").glob("*.md"))


def defined_names(body: list[ast.stmt]) -> dict[str, list[ast.stmt]]:
    """Names that a module or class body defines, with their own bodies."""
    found = {}
    for node in body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found[node.name] = node.body
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found[node.target.id] = []
    return found


def is_defined(name: str) -> bool:
    place, parts = ROOT / "hydrotele", name.split(".")
    while parts and (place / parts[0]).is_dir():
        place /= parts.pop(0)
    file = place / f"{parts.pop(0)}.py" if parts else place
    if not file.is_file():
        return False
    body = ast.parse(file.read_text(encoding="utf-8")).body
    for part in parts:
        names = defined_names(body)
        if part not in names:
            return False
        body = names[part]
    return True


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_the_named_functions_scenarios_and_models_exist(page):
    text = page.read_text(encoding="utf-8")
    functions = re.findall(r"`([a-z_]+\.[a-z_]\w*(?:\.\w+)*)`", text)
    packages = {folder.name for folder in (ROOT / "hydrotele").iterdir()}
    missing = [name for name in functions if name.partition(".")[0] in packages and not is_defined(name)]
    assert not missing
    scenarios = {name for line in re.findall(r"\| scenarios? (`.*`) \|", text) for name in re.findall(r"`(\w+)`", line)}
    assert scenarios <= set(shipped_scenarios())
    links = [link for link in re.findall(r"\]\(([^)#]+)", text) if "://" not in link]
    assert [link for link in links if not (page.parent / link).exists()] == []


def test_all_four_documents_have_a_page():
    assert {"abdellatif2008", "conventions", "khoshzaban1992", "wang2012", "zhu1994"} <= {page.stem for page in PAGES}
