"""Measure time and memory of an identification against the length of the log.

    python tools/release/identify_speed.py [--minutes 60] [--out docs/validation/identify_speed.md]

One log of the CAT 215 at 50 Hz is simulated and cut to growing lengths; time and memory are those
of a process of its own that runs `hydrotele identify`. The regressor's throughput is compared in
one process with a Python loop over Pinocchio's regressor of the same spanning tree, closed by hand:
that one yields the tree's columns only, without projection on the drives and without friction.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from hydrotele.identify.regressor_setup import machine_setup
from hydrotele.logs.log import Log, save_log
from hydrotele.machine.machine_file import load_machine
from hydrotele.multibody.inverse_dynamics import project_on_drives
from hydrotele.multibody.regressor import make_regressor
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.simulate.closed_loops import load_closed_chain
from tools.studies.study import options, publish

CHILD = """
import resource, sys, time
from hydrotele.cli import main as cli
started = time.perf_counter()
sys.argv = ["hydrotele", *sys.argv[1:]]
try:
    cli.main()
except SystemExit:
    pass
print(time.perf_counter() - started, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def cut(log: Log, seconds: float) -> Log:
    """The first seconds of a log."""
    rows = log.time < seconds
    columns = {name: values[rows] for name, values in log.columns.items()}
    return Log(log.time[rows], columns, log.units, log.metadata, "hour")


def lengths(log: Log, minutes: float, folder: Path) -> list[tuple[float, float, float, float]]:
    """(minutes, seconds that the identification states, seconds in all, MB) by length."""
    out = []
    for part in (1 / 8, 1 / 4, 1 / 2, 1.0):
        file = folder / "log.parquet"
        save_log(cut(log, 60.0 * minutes * part), file)
        command = [sys.executable, "-c", CHILD, "identify", "--machine", "cat215", "--data",
                   str(file), "--out", str(folder / "found"), "--json"]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        head, _, last = done.stdout.rstrip().rpartition("\n")
        whole, memory = map(float, last.split())
        out.append((minutes * part, json.loads(head)["seconds"], whole, memory))
    return out


def throughput(rows: int) -> list[tuple[str, float]]:
    """Microseconds per row of our regressor and of a loop over Pinocchio's."""
    import pinocchio

    machine = load_machine("cat215")
    setup = machine_setup(machine, load_closed_chain(machine))
    t = 0.02 * np.arange(rows)[:, None]
    wave = np.array([0.5, 0.2, 0.3]), np.array([0.9, 0.7, 1.1])
    motion = [
        np.array([0.0, 0.4, -1.6]) + wave[0] * np.sin(wave[1] * t),
        wave[0] * wave[1] * np.cos(wave[1] * t), -wave[0] * wave[1] ** 2 * np.sin(wave[1] * t),
    ]  # fmt: skip
    project_on_drives(setup.chain, setup.given_joints, *(m[:10] for m in motion))  # compiled code is loaded
    started = time.perf_counter()
    found = project_on_drives(setup.chain, setup.given_joints, *motion)
    middle = time.perf_counter()
    make_regressor(setup.chain, found, bodies=setup.bodies, friction=setup.friction_terms)
    ours = time.perf_counter() - started
    model = pinocchio.Model()
    tree, parents = setup.chain.tree, {}
    for b in range(1, len(tree.parent)):
        place = pinocchio.SE3(tree.rotation[b], tree.offset[b])
        parent = parents.get(int(tree.parent[b]), (0, pinocchio.SE3.Identity()))
        place = parent[1] * place
        joint = parent[0]
        for j in range(tree.first_joint[b], tree.first_joint[b + 1]):
            kind = pinocchio.JointModelPrismaticUnaligned if tree.is_slide[j] else (
                pinocchio.JointModelRevoluteUnaligned)  # fmt: skip
            joint = model.addJoint(joint, kind(tree.axis[j]), place, setup.chain.joints[j])
            place = pinocchio.SE3.Identity()
        parents[b] = (joint, place)
    data = model.createData()
    begin = time.perf_counter()
    for q, v, a in zip(found.position, found.rate, found.acceleration, strict=True):
        pinocchio.computeJointTorqueRegressor(model, data, q, v, a)
    loop = time.perf_counter() - begin
    per = 1e6 / rows
    return [
        ("loop closure, accelerations, inertial columns of all bodies, projected on the drives",
         (middle - started) * per),
        ("the same with friction and offsets", ours * per),
        ("Pinocchio, called row by row from Python: inertial columns for a given motion of all joints", loop * per),
    ]  # fmt: skip


def main() -> None:
    """Measure and print."""
    asked = options(__doc__, minutes=60.0)
    log = run_scenario(load_scenario("excitation", {"duration": str(60 * asked.minutes)})).measured
    lines = [
        "How long does `hydrotele identify` take for long logs? Each row is a CAT 215 log of this length at "
        "50 Hz in its own process; smaller is better. Each time is from a single run, so that rows can be "
        "compared only roughly. 'Identification' is the computation alone, 'whole process' includes start "
        "and reading.",
        "",
        "| log [min] | identification [s] | whole process [s] | peak memory [MB] |",
        "| ---: | ---: | ---: | ---: |",
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as place:
        for minutes, seconds, whole, memory in lengths(log, asked.minutes, Path(place)):
            lines.append(f"| {minutes:g} | {seconds:.1f} | {whole:.1f} | {memory:.0f} |")
    lines += [
        "",
        "A main step builds the regressor, the matrix that relates parameters to forces. The next table "
        "compares its time per row of the log with Pinocchio, a library for robot dynamics. Pinocchio's row "
        "does less work: it receives the motion of all joints, so that it closes no loops, and it has neither "
        "projection on the drives nor friction.",
        "",
        "| regressor, 20 000 rows | us per row |",
        "| --- | ---: |",
    ]
    lines += [f"| {name} | {value:.1f} |" for name, value in throughput(20_000)]
    text = "\n".join(lines) + "\n"
    publish(text, "Speed of identification", asked)


if __name__ == "__main__":
    main()
