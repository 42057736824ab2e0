"""The page about the environments says what they are."""

from pathlib import Path

from tools.release.environments_page import page

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_is_that_of_the_present_tasks():
    written = (ROOT / "docs" / "environments.md").read_text(encoding="utf-8")
    command = "Command: `python tools/release/environments_page.py`\n\n"  # which `publish` inserts
    assert command in written
    assert written.replace(command, "").endswith(page()), f"{command.strip()} --out docs/environments.md"
