"""Fill a truck with the reference controller: volumes, cycle times, energy, spill, and what limits the cycle.

    python tools/validation/load_truck.py --episodes 24 --picture docs/load_truck.png

Every episode has its own soil, bank and start. `--picture FILE` renders trench and load.
"""

import time
from pathlib import Path

import numpy as np
from PIL import Image

from hydrotele.envs.controllers.catalogue import make_controller
from hydrotele.envs.controllers.load_truck import DUMP, HAUL, LoadTruckController
from hydrotele.envs.episode import DISABLED
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.evaluation import evaluate_controller
from hydrotele.envs.load_truck import LOAD_SOILS, PHASES
from hydrotele.envs.rendering import TaskRenderer
from hydrotele.envs.soil_bed import SOIL_PARAMETER_COUNT, TERRAIN_SIZE
from hydrotele.envs.task import Options
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.show.offscreen_renderer import Canvas
from hydrotele.soil.parameters import DENSITY, SOILS
from tools.studies.study import options, publish

TASK = TASKS["LoadTruck"]
LOADED, CARRIED, SPILLED, REMOVED, ENERGY, FORCE, LOADS, SUCCESS = range(8)
PHASE_NAMES = ("move to the bank", "enter", "draw", "curl", "lift and swing", "dump")
FULL_RATE = 0.95  # share of the rate limit above which an axis counts as limited
STRUCK, HEAPED = 0.59, 0.91  # m^3 that the bucket holds, see hydrotele.soil.parameters.CAT215
SIZE = (760, 480)  # pixel
INTRODUCTION = """\
How well does the hand-written reference controller load a truck, and how realistic are the cycles? In the
environment `hydrotele/LoadTruck-v0`, a CAT 215 fills a truck with 5 m3 of loose soil.

The bank is 0.5 to 1 m high, the swing 70 to 110 deg, the walls of the truck 1.9 m high
([task](../environments.md#loadtruck)). Actions are joint rates, sensors are ideal, and every episode has its own
soil, bank and start.

![Trench and load](../load_truck.png)

The trench and the load in the truck after five bucket loads.

Each row is a kind of soil (`sandy_loam` is the loamy soil); "all" includes the trucks that were not filled. Force on
the truck: contact force, without the weight of the soil. Loads: bucket loads in all episodes. Fill:
volume of a load relative to the heaped bucket (0.91 m3). A larger return (sum of rewards) is better.

"""
CONCLUSION = """
## What limits the cycle

For a truck on the floor of the excavation next to the soil, the Caterpillar Performance Handbook
([edition 47, page 7-246](https://cld.bz/bookdata/S232Z0r/basic-html/page-575.html)) calls cycles of 10 to 17 s
practical; 15 to 20 s are typical. The 17.8 s of the filled trucks are slower than the practical and within the
typical cycles, because of:

- Swing: both swings cover 2 x 1.6 rad at 0.6 rad/s, the rate of the joint servo (0.8 of the valve's rated flow).
- Pump: 300 L/min feed all four axes, so lifting and swinging slow each other down.
- Bucket: the joint servo opens it with 0.48 rad/s, the rate that is possible over the whole range.

## Limits

- In firm soil the controller works for about six loads only. Then the boom cannot press the cutting edge into the
  bottom of the trench,
  and the controller repeats the same cut with little soil. Most trucks are not full after 240 s there.
- The load in the bucket has no inertia, falls at once and does not push on the bucket.
- Outside the strip that is dug, the ground resists sideways motion only.
"""


def main() -> None:
    asked = options(__doc__, episodes=24, seed=0, speed_steps=300, picture="")
    core = TaskCore(TASK, Options(variants=asked.episodes), asked.episodes, 0, DISABLED)
    core.reset(asked.seed + np.arange(asked.episodes))
    found = run_reference(core)
    text = [describe_fills(core, found), describe_phases(core, found)]
    text += ["## Single phases\n", describe_single_phases(asked.seed), "## Speed\n", describe_speed(asked.speed_steps)]
    if asked.picture:
        draw_picture(Path(asked.picture))
    publish(INTRODUCTION + "\n".join(text) + CONCLUSION, "Loading a truck", asked)


def run_reference(core: TaskCore) -> dict[str, np.ndarray]:
    """Run the reference controller until all episodes have ended and return figures per episode and phase."""
    controller = make_controller("reference", core.setup)
    assert isinstance(controller, LoadTruckController)
    controller.begin(core.count)
    n, step = core.count, 1.0 / core.setup.options.control_rate
    times, flows, limited = np.zeros((n, 6)), np.zeros((n, 6)), np.zeros((n, 6, 4))
    force, total, loads, before = np.zeros(n), np.zeros(n), [], np.zeros(n, int)
    while (alive := core.episodes["over"] == 0).any():
        action, rows = controller(core.observation), np.flatnonzero(alive)
        phase = controller.phase
        loads += core.measures[alive & (before == HAUL) & (phase == DUMP), CARRIED].tolist()
        before = phase.copy()
        core.step(action)
        times[rows, phase[rows]] += step
        flows[rows, phase[rows]] += step * (controller.flow_demand[rows] >= 1.0)
        limited[rows, phase[rows]] += step * (np.abs(action[rows]) > FULL_RATE)
        force = np.maximum(force, core.measures[:, FORCE])
        total += np.where(alive, core.reward, 0.0)
    return {"times": times, "flows": flows, "limited": limited, "force": force, "return": total,
            "loads": np.array(loads)}  # fmt: skip


def describe_fills(core: TaskCore, found: dict[str, np.ndarray]) -> str:
    """Return the table of filled trucks by soil."""
    density = core.terrain[:, TERRAIN_SIZE - SOIL_PARAMETER_COUNT + DENSITY]
    rows = [
        "| soil | episodes | truck filled | loads | m3 per load | fill of heaped bucket | s per cycle | m3 per minute"
        " | MJ per m3 | spilled [% of loaded] | largest force on the truck [kN] | return |",
        "| --- |" + " ---: |" * 11,
    ]
    for name in (*LOAD_SOILS, "all"):
        some = np.ones(core.count, bool) if name == "all" else density == SOILS[name].density
        m, time_taken = core.measures[some], core.episodes["step"][some] / core.setup.options.control_rate
        loaded, loads = m[:, LOADED].sum(), max(1.0, m[:, LOADS].sum())
        rows.append(
            f"| {name} | {some.sum()} | {m[:, SUCCESS].sum():.0f} | {loads:.0f} | {loaded / loads:.2f} |"
            f" {loaded / loads / HEAPED:.2f} | {time_taken.sum() / loads:.1f} |"
            f" {60.0 * loaded / time_taken.sum():.2f} | {m[:, ENERGY].sum() / loaded / 1e6:.2f} |"
            f" {100.0 * m[:, SPILLED].sum() / loaded:.1f} | {found['force'][some].max() / 1e3:.0f} |"
            f" {found['return'][some].mean():.1f} |"
        )
    m, done = core.measures, core.measures[:, SUCCESS] > 0.0
    cycle = core.episodes["step"][done] / core.setup.options.control_rate / np.maximum(1.0, m[done, LOADS])
    error = np.abs(m[:, REMOVED] - m[:, LOADED] - m[:, CARRIED] - m[:, SPILLED]).max()
    rows.append(
        f"\nOf the {done.sum()} filled trucks: {core.episodes['step'][done].mean() / 50.0:.0f} s and"
        f" {m[done, LOADS].mean():.1f} loads per truck, {cycle.mean():.1f} s per cycle ({cycle.min():.1f} to"
        f" {cycle.max():.1f} s). Loads of the bucket: {found['loads'].min():.2f} to {found['loads'].max():.2f} m3"
        f" (struck {STRUCK}, heaped {HEAPED} m3).\n\nNo soil is lost: removed = loaded + carried + spilled within"
        f" {error:.1e} m3.\n"
    )
    return "\n".join(rows)


def describe_phases(core: TaskCore, found: dict[str, np.ndarray]) -> str:
    """Return the table of the time that each phase takes, and of what limits it."""
    loads, axes = core.measures[:, LOADS].sum(), core.setup.axes
    rows = [
        "The next table shows where the time of a cycle goes and what limits the speed: the fraction of the time in"
        " which the pump flow, or the rate limit of an axis' servo, is reached.\n",
        f"| phase | s per cycle | pump flow limits [%] | {' | '.join(f'{axis} at its rate [%]' for axis in axes)} |",
        "| --- |" + " ---: |" * (2 + len(axes)),
    ]
    for p, name in enumerate(PHASE_NAMES):
        spent = found["times"][:, p].sum()
        shares = [100.0 * value / spent for value in found["limited"][:, p].sum(0)]
        rows.append(
            f"| {name} | {spent / loads:.2f} | {100.0 * found['flows'][:, p].sum() / spent:.0f} |"
            f" {' | '.join(f'{share:.0f}' for share in shares)} |"
        )
    return "\n".join(rows) + "\n"


def describe_single_phases(seed: int) -> str:
    """Return the table of the single phases: success and return of reference controller, zero and random actions."""
    rows = [
        "Each phase of the cycle is also a separate environment. Mean return ± standard error of the reference"
        " controller, of no action (zero) and of random actions; success is a fraction of episodes.\n",
        "| phase | reference: success | return | zero: return | random: return |",
        "| --- |" + " ---: |" * 4,
    ]
    for phase in PHASES[1:]:
        core = TaskCore(TASK, Options(variants=32, phase=phase), 32, 0, DISABLED)
        scores = [
            evaluate_controller(core, make_controller(name, core.setup), 32, seed)
            for name in ("reference", "zero", "random")
        ]
        rows.append(
            f"| {phase} | {scores[0].mean('success'):.2f} | "
            + " | ".join(f"{one.mean('return'):.1f} ± {one.standard_error('return'):.1f}" for one in scores)
            + " |"
        )
        core.close()
    return "\n".join(rows) + "\n"


def describe_speed(steps: int) -> str:
    """Return the table of the speed with the actions of the reference controller, in processor time."""
    rows = [
        'Speed of the environment by number of environments and threads. A step is 20 ms. "With controller" includes'
        " the reference controller.\n",
        "| environments | threads | processor time per step [us] | with controller [us] | steps/s per core | times real"
        " time per core | elapsed time: steps/s |",
        "| ---: |" + " ---: |" * 6,
    ]
    for count, threads in ((1, 1), (64, 1), (64, 2)):
        core = TaskCore(TASK, Options(variants=4), count, threads, DISABLED)
        core.reset(np.arange(count))
        controller = make_controller("reference", core.setup)
        controller.begin(count)
        alone = both = elapsed = 0.0
        number = steps * (4 if count == 1 else 1)
        for _ in range(number):
            begin = time.process_time()
            action = controller(core.observation)
            middle, clock = time.process_time(), time.perf_counter()
            core.step(action)
            elapsed += time.perf_counter() - clock
            alone += time.process_time() - middle
            both += time.process_time() - begin
        each = alone / number / count
        rows.append(
            f"| {count} | {threads} | {1e6 * each:.0f} | {1e6 * both / number / count:.0f} | {1.0 / each:,.0f} |"
            f" {1.0 / core.setup.options.control_rate / each:.0f} | {number * count / elapsed:,.0f} |"
        )
        core.close()
    return "\n".join(rows) + "\n"


def draw_picture(path: Path) -> None:
    """Render the trench and the load after five loads of one episode."""
    core = TaskCore(TASK, Options(variants=1), 1, 1, DISABLED)
    core.reset(np.zeros(1, int))
    controller = make_controller("reference", core.setup)
    controller.begin(1)
    while core.measures[0, LOADS] < 6 or controller.phase[0] != DUMP:  # pyright: ignore[reportAttributeAccessIssue]
        core.step(controller(core.observation))
    stage = TaskRenderer(core)
    stage.update()
    canvas, camera = Canvas(stage.model, *SIZE), stage.find_camera()
    camera.azimuth, camera.elevation, camera.distance, camera.lookat[:] = 150.0, -32.0, 14.0, (2.6, 2.4, 0.4)
    picture = Image.fromarray(canvas.draw(stage.model, stage.data, camera, stage.make_markers()))
    picture.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)
    canvas.close()


if __name__ == "__main__":
    main()
