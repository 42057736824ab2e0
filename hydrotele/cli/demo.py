"""`hydrotele demo`: an excavator digs, draws straight lines, and its log is replayed."""

from pathlib import Path

from hydrotele.cli.catalogue import export_machine
from hydrotele.cli.console import notes, out
from hydrotele.cli.replaying import replay_logs
from hydrotele.cli.running import run_to_folder
from hydrotele.core.errors import InputError


def run_demo(target: Path) -> None:
    """Run three scenarios, replay one, draw the machine; everything lands in one folder.

    Args:
        target: folder to write into.

    Raises:
        InputError: the folder cannot be written.
    """
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(target, f"cannot be made: {error.strerror}") from None
    _say(1, "the bucket goes straight up at 0.5 m/s (Zhu 1994, Fig. 6.45)")
    run_to_folder("zhu_up", target / "zhu_up", {}, True, False)
    _say(2, "the bucket digs")
    run_to_folder("dig", target / "dig", {}, True, False)
    _say(3, "all axes move together, logged as the sensors of Khoshzaban 1992 see them")
    run_to_folder("excitation", target / "excitation", {}, True, False)
    _say(4, "the model is driven with that log's commands: how far is it off?")
    log = target / "excitation" / "measured.parquet"
    replay_logs([log], None, None, 1.0e-3, target / "replay", False)
    _say(5, "a picture of the machine")
    try:
        export_machine("cat215", "bucket", None, target / "cat215.png", "overview")
    except InputError as error:
        notes.print(f"[yellow]no picture[/] {error}")
    out.print(f"\n[bold green]done[/] Everything is in [bold]{target}[/]. Look at it with")
    out.print("  source .venv/bin/activate             (in a checkout, once per shell)")
    out.print(f"  hydrotele review {target}/dig             (rerun viewer)")
    out.print(f"  hydrotele review {target}/dig --serve     (web viewer)")
    out.print(f"and see measured against replayed in {target}/replay/measured.png")


def _say(step: int, text: str) -> None:
    out.print(f"\n[bold]{step}/5[/] {text}")
