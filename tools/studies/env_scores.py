"""Score the reference controller, zero actions and random actions in the control tasks.

With ideal and real sensors, on the nominal machine and on machines of `typical_variation`.
"""

import sys

import numpy as np

from hydrotele.envs.controllers.catalogue import (
    CONTROLLER_NAMES,
    REFERENCE_CONTROLLERS,
    make_controller,
)
from hydrotele.envs.episode import DISABLED
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.evaluation import SUCCESS, Scores, evaluate_controller
from hydrotele.envs.task import REAL_SENSORS, Options
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.envs.variants import typical_variation
from hydrotele.machine.machine_file import load_machine
from tools.studies.study import options, publish

HEAD = """A learned controller should be compared with these scores. Three simple controllers run in every control task:
`reference` (a hand-written controller), `zero` (no action) and `random` (random actions). A useful controller
is far better than `zero` and `random`; a good one reaches `reference`. The reference nearly always succeeds on
nominal machines. On randomised machines its errors are mostly larger, so a learned controller can be better
there. Tasks, rewards and the ends of episodes: [environments](../environments.md).

Each table is one task. A row is one combination of:

- actions: what the controller commands (`valve` openings, `joint_rate` joint velocities, `resolved_motion`
  velocities of the tip);
- sensors: `ideal` (exact) or `real` (with noise and quantisation);
- machine: `nominal`, or `randomised` with valve overlap, flow and bandwidth, Coulomb friction, oil stiffness,
  command delay and payload that differ between machines (`hydrotele.envs.variants.typical_variation`);
- controller. All controllers run the same episodes (same seeds and machines). The reference knows the nominal
  machine and the observation only.

Cells are mean ± standard error over the episodes, with the unit in brackets ([1] has no unit). A standard error
of 1e-16 is a rounding error: all episodes have the same value.

- return: sum of rewards, larger is better; `success`: fraction of successful episodes, larger is better;
- a name with RMS: root mean square over an episode. Where the name says error or distance, it includes the way
  to the goal and is not the final error. In tasks with `success`, success ends the episode. A successful
  episode is then shorter, and its RMS may be larger than that of a failed one that stays near the goal. Compare
  `success` and return there; in the other tasks a smaller error is better. Other names describe the episode, such
  as `soil` (0 soft, 1 loamy, 2 firm);
- a name with `final`: fraction of episodes in which the condition holds at the end. `contact` is good;
  `overload`, `off_plate` (the tip has left the plate) and `spoiled` (the bucket went too far below the target
  plane) are failures; `held` is 1 if the log is still in the grapple.

Limit: all machines are simulated; randomised scores hold for this distribution only.
"""

TASK_LINES = {
    "TrackTrajectory": "All axes of an excavator follow moving references. `tip_error`: distance of the tip from its "
    "reference.",
    "StraightLine": "The tip of the bucket moves along a straight line. `cross_track_error`: distance from the line; "
    "`along_track_error`: distance ahead or behind along it; `attitude_error`: error of the bucket's "
    "angle.",
    "HoldForce": "The bucket presses on a plate with a given force of 10 to 35 kN. `force_error`: difference from it; "
    "`contact`: the bucket touches the plate; `overload`: more than 100 kN.",
    "ReachFeller": "A feller-buncher moves its head to a pose. `distance` and `attitude_error`: distance and angle "
    "from the pose.",
    "Grade": "A bucket cuts a low bank of soil down to a plane. `profile_rms`: error of the profile; "
    "`carried_mass`: soil in the bucket; `soil_force`: force of the soil.",
    "PlaceLog": "A grapple picks up a log and lays it down at a goal. `log_distance` and `yaw_error`: from log to "
    "goal; `swing_angle`: of the freely swinging grapple.",
    "LoadTruck": "An excavator fills a truck with soil. Volumes are loaded into the truck, carried in the bucket, "
    "spilled, and removed from the bank; `energy`: hydraulic; `truck_force`: contact with the truck; "
    "`loads`: bucket loads.",
}


def names(scores: Scores) -> list[str]:
    """Return the column names: RMS of continuous measures, final value of flags."""
    found = ["return"]
    for name in scores.results:
        measure, _, what = name.rpartition(" ")
        flag = scores.units[name] == "1" and np.isin(scores.results[name], (0.0, 1.0)).all()
        if what == "final" and flag:
            found.append(name)
        elif what == "final":
            found.append(f"{measure} RMS")
    return found + [name for name in (SUCCESS,) if name in scores.results]


def row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def table(name: str, asked) -> list[str]:
    """Lines of the table of a task."""
    task = TASKS[name]
    lines = [f"\n## {name}\n", *([TASK_LINES[name], ""] if name in TASK_LINES else [])]
    spread = typical_variation(load_machine(task.machine, task.tool))
    actions = asked.actions.split(",") if asked.actions else [task.action]
    columns: list[str] = []
    for action in actions:
        for sensors in ("ideal", REAL_SENSORS):
            for machine, randomise in (("nominal", ()), ("randomised", spread)):
                choices = Options(action=action, sensors=sensors, randomise=randomise, variants=asked.variants)
                core = TaskCore(task, choices, min(asked.episodes, asked.batch), 0, DISABLED)
                for kind in CONTROLLER_NAMES:
                    if kind == "reference" and name not in REFERENCE_CONTROLLERS:
                        continue
                    controller = make_controller(kind, core.setup)
                    scores = evaluate_controller(core, controller, asked.episodes, asked.seed)
                    if not columns:
                        columns = names(scores)
                        heads = [f"{column} [{scores.units[column]}]" for column in columns]
                        heads = ["actions", "sensors", "machine", "controller", *heads]
                        lines += [row(heads), row(["---"] * len(heads))]
                    cells = [f"{scores.mean(c):.4g} ± {scores.standard_error(c):.2g}" for c in columns]
                    lines.append(row([action, sensors, machine, kind, *cells]))
                core.close()
    return lines


def main() -> None:
    asked = options(__doc__, tasks="all", actions="", episodes=64, batch=64, variants=32, seed=10**6)
    chosen = list(TASKS) if asked.tasks == "all" else asked.tasks.split(",")
    if strange := sorted(set(chosen) - set(TASKS)):
        raise SystemExit(f"--tasks {strange[0]}: choose of {', '.join(TASKS)}")
    lines = [HEAD]
    for name in chosen:
        print(name, file=sys.stderr, flush=True)
        lines += table(name, asked)
    publish("\n".join(lines) + "\n", "Scores of controllers in the control tasks", asked)


if __name__ == "__main__":
    main()
