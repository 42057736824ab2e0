"""Write the page that lists the environments with their observations, actions and rewards.

python tools/release/environments_page.py --out docs/environments.md
"""

from hydrotele.envs.episode import ACTIONS
from hydrotele.envs.episode_batch import make_task_setup
from hydrotele.envs.task import Options, Task
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.envs.task_setup import TaskSetup
from tools.studies.study import options, publish

COMMON = """\
The command above writes this page. Every environment is `gymnasium.make("hydrotele/NAME-v0", **options)` after `import
hydrotele.envs`, batched with `gymnasium.make_vec(..., vectorization_mode="vector_entry_point")`,
and for dm_control `hydrotele.envs.dm.load("NAME", **options)`.

**Observation**: a `Box` of float32 in SI; each number is named in
`env.unwrapped.core.setup.fields`. Readings saturate at the ends of the box.
`gymnasium.wrappers.RescaleObservation(env, -1, 1)` brings all to the same size.

**Action**: a `Box` from -1 to 1 per driven axis; beyond it counts as full. `action="valve"`
commands the valves; `"joint_rate"` asks for rates of the axes, `"resolved_motion"` for rates of
the tip (r, theta, z, attitude, head), both followed by the joint servo at 200 Hz with bounded
acceleration.

**Episode**: `truncated` when its duration is over; `terminated` at an end condition of the task, or if the
simulation became unstable (`info["fault"]`, never seen in ten million random steps). A step of a
single environment after the end is an error: call `reset` first.
`reset(seed=...)` gives the same bits again, alone, batched, on any number of threads; a batch's
environment i has the seed of the first one plus i. `env.unwrapped.get_state()` returns the complete
state, and `set_state(state)` continues from it with the same bits.

**Info**: the task's figures, below; `variant`: which machine and start of those drawn
(`env.unwrapped.core.setup.variants`).

**Options** of all:
"""

NOTES = {
    "HoldForce": """\
`force` is the reading of a load cell under the plate: the force in its spring and damper, positive if
the plate is pressed down. The reward uses the true force.""",
    "Grade": """\
`soil` is 0 for soft, 1 for loamy, 2 for firm soil. `profile_error.0` to `.19` are the mean heights
of the ground above the plane in 20 equal sections from r = 3.8 to 5.8 m; negative: too low.""",
    "LoadTruck": """\
Volumes are loose; `removed_volume` = `loaded_volume` + `carried_volume` + `spilled_volume` (at the start
of `haul` and `dump` the bucket holds soil that was never in the bank). `energy` is the hydraulic energy that
the valves have taken from the pump; `truck_force` is the largest sum of the normal forces on the truck within
the step. The bank is a strip as wide as the bucket, at `bank_bearing` from the bucket's edge. Next to it,
the ground only resists a bucket that swings sideways through it. `bank_height.0` to `.19` are mean heights
in 20 equal sections from r = 4.5 to 8.5 m. `load_height.0` to `.9` are those of the load above the floor of
the bed, from the tailgate on. Soil falls at once, and the load does not push on the bucket.
[Results](validation/load_truck.md).""",
}


def main() -> None:
    publish(page(), "Environments", options(__doc__))


def page() -> str:
    sections = [_section(task) for task in TASKS.values()]
    return "\n\n".join([COMMON + _options(), *sections]) + "\n"


def _options() -> str:
    """The attributes of Options in its docstring, as a list."""
    lines = (Options.__doc__ or "").partition("Attributes:\n")[2].rstrip().splitlines()
    joined: list[str] = []
    for line in lines:
        if line.startswith(" " * 8 + " "):
            joined[-1] += " " + line.strip()
        elif line.strip():
            joined.append(line.strip())
    defaults = Options()
    items = (line.partition(": ") for line in joined)
    rows = [f"| `{name}` | {what} | `{getattr(defaults, name)!r}` |" for name, _, what in items]
    return "\n| option | what | default |\n| --- | --- | --- |\n" + "\n".join(rows)


def _section(task: Task) -> str:
    setup = make_task_setup(task, Options(variants=1))
    lines = [
        f"## {task.name}",
        "",
        f"{task.description} {task.reward}",
        "",
        f"Machine `{task.machine}`, tool `{setup.machine.tool}`, {setup.options.duration:g} s,"
        f' `action="{setup.options.action}"` by default. Another machine needs {", ".join(_needs(task))}.',
        f"Info: {', '.join(f'`{name}` [{unit}]' for name, unit in task.measures)}.",
        "",
        *((NOTES[task.name], "") if task.name in NOTES else ()),
        f"Actions: {'; '.join(_actions(setup, kind) for kind in ACTIONS)}.",
        "",
        "| observation | unit | from | to |",
        "| --- | --- | --- | --- |",
    ]
    lines += [f"| {field.name} | {field.unit} | {field.low:.4g} | {field.high:.4g} |" for field in setup.fields]
    return "\n".join(lines)


def _needs(task: Task) -> list[str]:
    """Joints of the arm, names of joints and axes."""
    return [f"`{name}`" for name in dict.fromkeys((*task.needs, *task.extra_axes))]


def _actions(setup: TaskSetup, kind: str) -> str:
    names = list(setup.axes)
    if kind == "resolved_motion":
        names[: setup.arm_axes] = ["r", "theta", "z", "attitude", "head"][: setup.arm_axes]
        return f"`{kind}` {', '.join(names)}"
    return f"`{kind}` {', '.join(names)}"


if __name__ == "__main__":
    main()
