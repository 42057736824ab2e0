"""Functions and files that the pages "How it works" name exist in the code."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "hydrotele"
PAGES = sorted((ROOT / "docs" / "how_it_works").glob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_code_that_a_page_names_exists(page):
    text = page.read_text(encoding="utf-8")
    files = re.findall(r"`([a-z_0-9]+/[a-z_0-9]+\.py)`", text)
    missing = [name for name in files if not (PACKAGE / name).is_file()]
    for path, name in re.findall(r"`((?:[a-z_0-9]+\.)+)(\w+)`", text):
        modules = list(PACKAGE.rglob(path.rstrip(".").replace(".", "/") + ".py"))
        if name in ("py", "yaml", "json", "md", "csv"):
            continue
        if not any(re.search(rf"^(?:def|class) {name}\b", file.read_text(encoding="utf-8"), re.M) for file in modules):
            missing.append(f"{path}{name}")
    assert missing == []
