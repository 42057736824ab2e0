"""`hydrotele run`: a scenario into a folder."""

from pathlib import Path
from typing import Any

from hydrotele.cli.console import notes, out, print_json, progress_bar, table, write_json
from hydrotele.core.output import check_target, whole_folder
from hydrotele.logs.log import save_log
from hydrotele.machine.machine_file import save_machine
from hydrotele.run.run import Run, run_scenario, scenario_model
from hydrotele.scenario.scenario import load_scenario, save_scenario
from hydrotele.simulate.native import stop_profiling_clock


def run_to_folder(
    name: str, target: Path | None, overrides: dict[str, str], review: bool, as_json: bool
) -> Path:
    """Run a scenario and write everything into a folder, whole or not at all.

    Args:
        name: scenario name or file.
        target: folder, default `runs/<scenario>`.
        overrides: key path -> YAML text.
        review: whether to write the rerun recording.
        as_json: print the summary as JSON instead of a table.

    Returns:
        The folder.

    Raises:
        InputError: scenario, machine or target are not usable.
        SimulationFailed: the simulation left the finite numbers.
    """
    stop_profiling_clock()
    scenario = load_scenario(name, overrides)
    target = target or Path("runs", scenario.name)
    check_target(target, "run")
    with progress_bar(f"run {scenario.name}", quiet=as_json) as progress:
        result = run_scenario(scenario, progress)
    with whole_folder(target, "run") as folder:
        write_run(result, folder, review)
    if as_json:
        print_json({**result.summary, "folder": str(target)})
    else:
        print_summary(result.summary)
        out.print(f"written to [bold]{target}[/]")
    return target


def write_run(result: Run, folder: Path, review: bool = True) -> None:
    """Write logs, summary, scenario, machine, MJCF and recording of a run into a folder.

    `machine.yaml` is the model, without the effects that the scenario planted: what they are is
    truth, which a replay must not know. `machine.xml` is what was simulated.
    """
    save_log(result.measured, folder / "measured.parquet")
    save_log(result.truth, folder / "truth.parquet")
    save_scenario(result.scenario, folder / "scenario.yaml")
    result.plant.document.save(folder / "machine.xml")
    save_machine(scenario_model(result.scenario), folder / "machine.yaml")
    if review:
        from hydrotele.show.recording import write_recording

        notes.print("writing review.rrd ...", style="dim")
        write_recording(folder / "review.rrd", {"truth": (result.plant.machine, result.truth)})
    write_json(folder / "summary.json", result.summary)


def print_summary(summary: dict[str, Any]) -> None:
    """Print the figures of a run as a table, and its notes."""
    rows = table(f"{summary['scenario']} ({summary['machine']}, tool {summary['tool']})", "", "")
    rows.show_header = False
    rows.add_row("simulated", f"{summary['simulated_seconds']:g} s")
    rows.add_row("real-time factor", f"{summary['realtime_factor']:.0f}")
    if summary["effects"]:
        rows.add_row("planted effects", ", ".join(e["name"] for e in summary["effects"]))
    rows.add_row("largest pin opening", f"{summary['largest_pin_opening_mm']:.4f} mm")
    rows.add_row("largest contact force", f"{summary['largest_contact_force_N'] / 1e3:.1f} kN")
    for key, label in (("flow_balance", "flow balance"), ("energy_balance", "energy balance")):
        value = summary["balance"][key]
        rows.add_row(label, "-" if value is None else f"{value:.1e}")
    if station := summary.get("teleoperation"):
        gone, least = station["handle_energy_J"], station["handle_least_energy_J"]
        rows.add_row("energy into the handle", f"{gone:.2f} J, least {least:.2f} J")
    for name, error in summary["tracking"].items():
        unit, factor = ("mm", 1e3) if error["unit"] == "m" else ("deg", 57.29577951308232)
        rms, largest = error["rms"] * factor, error["max"] * factor
        rows.add_row(f"tracking {name}", f"rms {rms:.2f}, max {largest:.2f} {unit}")
    out.print(rows)
    for note in summary["notes"]:
        out.print(f"[yellow]note[/] {note}")
