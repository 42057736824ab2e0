"""What is printed: our styles are styles, and names or paths with brackets are text."""

import time

import pytest

from hydrotele.cli import console
from hydrotele.cli.console import _Console, show_simulation_progress, show_stages


@pytest.mark.parametrize(
    "name",
    ["a[/]b", "[bold", "[link=file:///etc]x[/link]", "run [3]", "[red]", "\\[x]", "angle [deg]",
     ":smile:", "[/nothing]", "[@click=app.quit]x"],
)  # fmt: skip
def test_names_in_brackets_are_text(name):
    console = _Console(width=200, emoji=False, highlight=False)
    with console.capture() as seen:
        console.print(f"written to [bold]{name}[/]")
    if name in ("[red]", "\\[x]"):  # a style of ours styles, an escaped bracket is one
        assert "written to" in seen.get()
    else:
        assert name in seen.get()


def test_own_styles_are_styles():
    console = _Console(width=200, force_terminal=True, color_system="standard")
    with console.capture() as seen:
        console.print("[bold green]done[/] now")
    assert seen.get() == "\x1b[1;32mdone\x1b[0m now\n"


@pytest.mark.parametrize(("bar", "told"), [
    (show_stages, ("calibrate", 0.25, "job: 25 %, calibrate, 0 s")),
    (show_simulation_progress, (12.0, 60.0, "job: 12.0 of 60.0 s simulated, 0 s")),
])  # fmt: skip
def test_off_a_terminal_a_line_says_now_and_then_how_far_a_command_is(bar, told, monkeypatch, capsys):
    monkeypatch.setattr(console, "_STATUS_PERIOD", 0.02)
    with bar("job", False) as progress:
        progress(*told[:2])
        time.sleep(0.2)
    lines = capsys.readouterr().err.splitlines()
    assert lines and set(lines) == {told[2]}
    with bar("job", True) as progress:
        assert progress is None
        time.sleep(0.1)
    assert capsys.readouterr().err == ""
