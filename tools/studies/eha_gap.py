"""Run `hydrotele gap` on the published parameters of the electro-hydraulic actuator.

    python tools/studies/eha_gap.py ../shared/real/eha --group 3

The machine is `models/eha` with every number as its authors publish it; the runs are those of one
load group. Prints what the search names, calibrates and learns, where it puts each number that
`docs/validation/eha.md` lists, and how far free runs of the held-out run are off before and after.
"""

import argparse
from pathlib import Path

from hydrotele.effects.effect import with_value
from hydrotele.gap.find import find_gap
from hydrotele.gap.result import Gap
from hydrotele.logs.dataset import load_dataset
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine
from tools.studies.eha_fit import free_run
from tools.studies.eha_published import PUBLISHED, as_published
from tools.studies.eha_runs import LOADS, differences, load_run

# relative: figures of data sheets and drawings that nobody checked on the stand
_UNCERTAINTY = {
    "area.piston.area_rod": 0.1, "pump_displacement": 0.05, "pump_leakage": 0.5,
    "motor_constant": 0.2, "motor_inertia": 0.5, "accumulator_pressure": 0.2, "load_relief": 0.2,
    "mass": 0.5, "viscous_friction": 30.0,
    # what no data sheet has: relative to what is typical of a drive of this size
    "coulomb_friction": 1.0, "stribeck_friction": 1.0, "load_friction": 1.0,
    "pump_torque_loss": 1.0, "motor_drag": 1.0, "motor_viscous_drag": 1.0, "line_compliance": 2.0,
    "pressure_offset": 1.0,
}  # fmt: skip


def published(group: int) -> Machine:
    """The machine with all numbers as the authors say, and how far they may be off."""
    machine = load_machine("eha", LOADS[group])
    for what in [*PUBLISHED, "pressure zeros of the calibration", "load table"]:
        machine = as_published(machine, group, what)
    if group > 1:  # packings and the pressure of the return are nothing that the authors have
        bare = {"friction": 0.0, "return_force": 0.0}
        load = machine.loads["piston"].model_copy(update=bare)
        machine = with_value(machine, "loads", {"piston": load})
    return with_value(machine, "uncertainty", _UNCERTAINTY)


def tell(gap: Gap, fitted: Machine) -> None:
    """Print what was found."""
    floor = "none" if gap.size.noise_floor is None else f"{gap.size.noise_floor:.2f}"
    print(f"{gap.verdict}; RMS of the errors over noise, held-out run: {gap.size.before:.2f} ->"
          f" {gap.size.after:.2f} (perfect model: {floor}); {gap.seconds:.0f} s")  # fmt: skip
    for effect in gap.effects:
        values = ", ".join(
            f"{k} {e.value:.4g} ({e.low:.4g} .. {e.high:.4g}) {e.unit}" for k, e in effect.parameters.items()
        )
        print(f"named: {effect.name} at {effect.location}, probability {effect.probability:.2f},"
              f" share {effect.share:.2f}: {values}")  # fmt: skip
    for law in gap.learned:
        print(f"learned: {law.balance} of {law.axis}, share {law.share:.2f}: {law.description}")
    for lack in gap.lacks:
        print(f"lacking: {lack.balance} of {lack.axis}: {lack.size:.3g} {lack.unit}")
    for key, found in gap.calibration.items():
        print(f"calibrated: {key}: {found.nominal:.4g} -> {found.value:.4g} {found.unit}"
              f" ({found.low:.4g} .. {found.high:.4g})")  # fmt: skip
    for note in gap.notes:
        print(f"note: {note}")
    now, best = gap.patched.axes["piston"], fitted.axes["piston"]
    assert now.cylinder and best.cylinder and now.pump and best.pump
    assert now.pump.motor and best.pump.motor
    print("after / fitted by tools/studies/eha_fit.py:")
    for what, value, target in [
        ("rod side area", now.cylinder.area_rod, best.cylinder.area_rod),
        ("displacement", now.pump.displacement, best.pump.displacement),
        ("motor constant", now.pump.motor.torque_constant, best.pump.motor.torque_constant),
        ("inertia", now.pump.motor.inertia, best.pump.motor.inertia),
        ("drag", now.pump.motor.drag, best.pump.motor.drag),
        ("coulomb friction", now.drive.friction.coulomb, best.drive.friction.coulomb),
        *(
            ("load relief", load.relief_pressure, fitted.loads[axis].relief_pressure)
            for axis, load in gap.patched.loads.items()
        ),
    ]:
        print(f"  {what}: {value:.4g} / {target:.4g}")


def tell_free_runs(path: Path, machines: dict[str, Machine]) -> None:
    """Print RMS differences of free runs over the judged 25 s, by pump speed and by duty."""
    run = load_run(path)
    print(f"free run {run.name}: by pump speed mm, head, rod bar; by duty mm, head, rod bar")
    for what, machine in machines.items():
        pair = [differences(run, free_run(machine, run, by_speed)) for by_speed in (True, False)]
        print("  " + "   ".join(" ".join(f"{x:6.2f}" for x in row) for row in pair), what)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with run_<group>_<stroke>.parquet")
    parser.add_argument("--group", type=int, default=3, help="load group, 1 to 5")
    parser.add_argument("--fitted", action="store_true", help="look at the fitted machine instead")
    words = parser.parse_args()
    fitted_machine = load_machine("eha", LOADS[words.group])
    machine = fitted_machine if words.fitted else published(words.group)
    runs = sorted(words.folder.glob(f"run_{words.group}_*.parquet"))
    found = find_gap(load_dataset(runs, machine), lambda what, share: print(f"{share:4.0%} {what}", flush=True))
    tell(found, fitted_machine)
    machines = {"given": machine, "patched": found.patched, "fitted": fitted_machine}
    tell_free_runs(runs[-1], machines)
