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
This page is the reference of the control tasks: goal, reward, end of an episode, observation, actions and options of
each. [Train and compare controllers](train.md) describes how to use them. The command writes this page from the
source code.

Each task is a [gymnasium](https://gymnasium.farama.org) environment: `gymnasium.make("hydrotele/NAME-v0", **options)`
after `import hydrotele.envs`. `gymnasium.make_vec(..., vectorization_mode="vector_entry_point")` makes a batch, and
`hydrotele.envs.dm.load("NAME", **options)` a `dm_env` environment for dm_control.

**Observation**: a `Box` of float32 in SI units. The tables list its values in their order, with the bounds at which
readings saturate; `env.unwrapped.core.setup.fields` has the same list.
`gymnasium.wrappers.RescaleObservation(env, -1, 1)` scales all values to the same range.

**Action**: a `Box` from -1 to 1 for each driven axis; larger values are limited. `action="valve"` commands the
valves. `"joint_rate"` commands rates of the axes, `"resolved_motion"` rates of the tip (r, theta, z, attitude, head).
A joint servo at 200 Hz with limited acceleration tracks these rates.

**Episode**: it is `truncated` after its duration. It is `terminated` at an end condition of the task, or if the
simulation became unstable (`info["fault"]`, which did not occur in ten million random steps). A further step of a
single environment is an error: call `reset` first. `reset(seed=...)` gives bit-identical episodes, alone, batched,
and on any number of threads. Environment i of a batch has the seed of the first one plus i.
`env.unwrapped.get_state()` returns the complete state, and `set_state(state)` continues from it with bit-identical
results.

**Variants**: when an environment is made, it draws `variants` start positions, each with its own machine. The machines
differ only with the option `randomise`. Every episode uses one variant, which the seed of `reset` selects;
`env.unwrapped.core.setup.variants` lists them.

**Info**: the dictionary `info` has true values of the task, listed for each task, and `variant`, the number of the
variant.

## Names in the observation

`<axis>` is the name of a driven axis. `tip` is the tip of the tool: r is the distance from the swing axis [m], theta
the azimuth [rad], z the height [m], attitude the pitch of the tool [rad], head the angle of the head [rad]
([conventions](from_the_documents/conventions.md)).
"""

QUANTITIES = {
    "`angle.<axis>`, `rate.<axis>`": "measured position of the axis and its difference quotient",
    "`pressure_head.<axis>`, `pressure_rod.<axis>`": (
        "measured pressures of the two chambers; of a hydraulic motor, ports A and B"
    ),
    "`pressure_supply`": "measured pressure of the pump; `pressure_supply.<pump>` with several pumps",
    "`tip.*`": "pose of the tip, computed from the measured positions",
    "`command.<axis>`": "last valve command",
    "`reference.*`, `reference_rate.*`": "pose or position to follow at present, and its rate",
    "`reference_in_100_ms.*`": "the same 0.1 s ahead; also 0.2 and 0.4 s",
    "`along_track_error`, `cross_track_error`": "error of the tip along the line and perpendicular to it",
    "`force`, `reference_force`, `time_since_change`": (
        "measured and reference force on the plate, and time since the reference changed"
    ),
    "`distance`, `held` (`ReachFeller`)": (
        "distance of the tip to the goal, and time for which the pose has been held"
    ),
    "`profile_error.<n>`": "mean height of the ground above the plane in section n; negative: too low",
    "`edge_height`, `carried_mass`": "height of the cutting edge of the bucket, and mass of the soil in the bucket",
    "`plane_height`, `plane_slope`": "plane to grade: its height in the middle of the graded range, and its slope",
    "`log.*`, `goal.*`": (
        "pose of the log and its goal. A log has no front end, so its yaw is given by sine and cosine of "
        "twice the angle"
    ),
    "`held` (`PlaceLog`)": "1 if the grapple holds the log",
    "`pendulum.*`, `pendulum_rate.*`": "angles and rates of the two free joints from which the grapple hangs",
    "`bank_bearing`, `truck_bearing`": "azimuth of the bank and of the truck relative to the edge of the bucket",
    "`bank_height.<n>`, `load_height.<n>`": (
        "mean height of the bank, and of the load above the floor of the truck bed, in section n"
    ),
}
"""Names in the observation, with their meanings."""

OPTIONS = """\
## Options of all environments

A default of `None` means the value of the task.
"""

MEASURES = {
    "tip_error": "distance of the tip from its reference",
    "cross_track_error": "distance of the tip from the line",
    "along_track_error": "distance of the tip from its reference, along the line",
    "attitude_error": "error of the attitude; for `ReachFeller`, the larger error of attitude and head angle",
    "force_error": "true minus reference force",
    "contact": "1 if the bucket presses on the plate",
    "overload": "1 if the force is above 100 kN",
    "off_plate": "1 if the tip is no longer over the plate",
    "distance": "distance of the head from the pose",
    "success": "1 in the step in which the goal is reached",
    "profile_rms": "RMS error of the ground profile",
    "carried_mass": "mass of the soil in the bucket",
    "soil_force": "force of the soil on the bucket",
    "soil": "kind of soil: 0 soft, 1 loamy, 2 firm",
    "spoiled": "1 if the edge is 0.5 m below the plane",
    "log_distance": "distance of the log from its goal",
    "yaw_error": "difference between the yaw of the log and that of its goal",
    "held": "1 if the grapple holds the log",
    "swing_angle": "angle between the grapple and the vertical",
    "loaded_volume": "loose soil in the truck",
    "carried_volume": "loose soil in the bucket",
    "spilled_volume": "loose soil that was lost outside the truck",
    "removed_volume": (
        "loose soil that was taken from the bank; equals the sum of the three volumes above. At the start of"
        " `haul` and `dump`, the bucket holds soil that was never in the bank"
    ),
    "energy": "hydraulic energy that the valves have taken from the pump",
    "truck_force": "largest sum of the normal forces on the truck within the step",
    "loads": "number of times that the bucket was filled to more than half and emptied",
}
"""Values of `info`, with their meanings."""

NOTES = {
    "HoldForce": """\
`force` is the reading of a load cell under the plate: the force in its spring and damper, positive if
the plate is pressed down. The reward uses the true force.""",
    "Grade": """\
`profile_error.0` to `.19` belong to 20 equal sections from r = 3.8 to 5.8 m.""",
    "LoadTruck": """\
The bank is a strip as wide as the bucket. Next to it,
the ground only resists a bucket that swings sideways through it. `bank_height.0` to `.19` belong to 20 equal sections
from r = 4.5 to 8.5 m; `load_height.0` to `.9` to ten sections of the bed, from the tailgate on.
Simplifications: soil falls at once, and the load does not push on the bucket.
[Results](validation/load_truck.md).""",
}


def main() -> None:
    publish(page(), "Environments", options(__doc__))


def page() -> str:
    sections = [_section(task) for task in TASKS.values()]
    names = [f"| {name} | {meaning} |" for name, meaning in QUANTITIES.items()]
    common = "\n".join([COMMON, "| name | meaning |", "| --- | --- |", *names, "", OPTIONS])
    return "\n\n".join([common + _options(), *sections]) + "\n"


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
    return "\n| option | meaning | default |\n| --- | --- | --- |\n" + "\n".join(rows)


def _section(task: Task) -> str:
    setup = make_task_setup(task, Options(variants=1))
    lines = [
        f"## {task.name}",
        "",
        f"{task.description} {task.reward}",
        "",
        f"Defaults: machine `{task.machine}`, tool `{setup.machine.tool}`, duration {setup.options.duration:g} s,"
        f' `action="{setup.options.action}"`. Another machine must have the joints {", ".join(_needs(task))}.',
        "",
        "| value of `info` | unit | meaning |",
        "| --- | --- | --- |",
        *(f"| `{name}` | {unit} | {MEASURES[name]} |" for name, unit in task.measures),
        "",
        *((NOTES[task.name], "") if task.name in NOTES else ()),
        f"Order of the actions: {'; '.join(_actions(setup, kind) for kind in ACTIONS)}.",
        "",
        "| observation | unit | lower bound | upper bound |",
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
