"""The help of groups is drawn as typer draws it, without rich."""

import pytest
import typer
from rich.text import Text
from typer import rich_utils
from typer.core import TyperGroup

from hydrotele.cli import help_page
from hydrotele.cli.main import app

ROOT = typer.main.get_command(app)
GROUPS = {"hydrotele": ROOT, **{n: c for n, c in ROOT.commands.items() if hasattr(c, "commands")}}


@pytest.fixture(autouse=True)
def no_settings(monkeypatch):
    for name in help_page.SETTINGS:
        monkeypatch.delenv(name, raising=False)


def context(name):
    return typer.Context(GROUPS[name], info_name=name, **ROOT.context_settings)


def by_typer(name, capsys) -> str:
    TyperGroup.format_help(GROUPS[name], context(name), None)
    return capsys.readouterr().out


def cells(text: str) -> list[tuple[str, str]]:
    """Every visible character with the style that it has."""
    styled = Text.from_ansi(text)
    looks = [""] * len(styled)
    for span in styled.spans:
        for place in range(span.start, min(span.end, len(looks))):
            looks[place] = str(span.style)
    return [(c, look) for c, look in zip(styled.plain, looks, strict=True) if not c.isspace()]


@pytest.mark.parametrize("name", GROUPS)
def test_page_is_typers(name, monkeypatch, capsys):
    drawn = 0
    for width in (40, 62, 80, 97, 120, 200):
        monkeypatch.setenv("COLUMNS", str(width))
        page = help_page.help_page(GROUPS[name], context(name), width)
        assert page is not None or width < 80
        drawn += page is not None
        GROUPS[name].format_help(context(name), None)
        assert capsys.readouterr().out == by_typer(name, capsys)
    assert drawn >= 4


@pytest.mark.parametrize("name", GROUPS)
def test_styles_are_typers(name, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "90")
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setattr(rich_utils, "FORCE_TERMINAL", True)
    page = help_page.help_page(GROUPS[name], context(name), 90)
    assert page and cells(page) == cells(by_typer(name, capsys))


@pytest.mark.parametrize("setting", help_page.SETTINGS)
def test_typer_draws_what_settings_ask_for(setting, monkeypatch):
    monkeypatch.setenv(setting, "1")
    monkeypatch.setattr(help_page, "help_page", None)  # must not be reached
    GROUPS["hydrotele"].format_help(context("hydrotele"), None)


def test_a_page_with_what_is_not_drawn_is_typers():
    group = TyperGroup(name="a", help="one\n\ntwo", commands={})
    assert help_page.help_page(group, typer.Context(group), 80) is None
