"""Score the reference controller, zero actions and random actions in the control tasks.

With ideal and real sensors, on the nominal machine and on machines of `typical_variation`.
"""

import sys

import numpy as np

from hydrotele.envs.controllers.catalogue import CONTROLLERS, REFERENCES, make_controller
from hydrotele.envs.core import TaskCore
from hydrotele.envs.episode import DISABLED
from hydrotele.envs.evaluation import SUCCESS, Scores, evaluate
from hydrotele.envs.making import TASKS
from hydrotele.envs.task import REAL, Options
from hydrotele.envs.variants import typical_variation
from hydrotele.machine.machine_file import load_machine
from tools.studies.study import options, publish

HEAD = """Mean ± standard error over episodes that all controllers share (same seeds and machines);
`reference` knows the nominal machine and what the observation says. Randomised machines have the
effects of `hydrotele.envs.variants.usual_spread`: other dead bands, flows and bandwidths of the
valves, friction, stiffness of the oil, delay of the commands, payload.
"""


def names(scores: Scores) -> list[str]:
    """The figures worth a column: the RMS of what varies, the end of what is 0 or 1."""
    found = ["return"]
    for name in scores.figures:
        measure, _, what = name.rpartition(" ")
        flag = scores.units[name] == "1" and np.isin(scores.figures[name], (0.0, 1.0)).all()
        if what == "final" and flag:
            found.append(name)
        elif what == "final":
            found.append(f"{measure} RMS")
    return found + [name for name in (SUCCESS,) if name in scores.figures]


def row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def table(name: str, asked) -> list[str]:
    """Lines of the table of a task."""
    task = TASKS[name]
    lines = [f"\n## {name}\n\n{task.sentence} Reward: {task.reward}\n"]
    spread = typical_variation(load_machine(task.machine, task.tool))
    actions = asked.actions.split(",") if asked.actions else [task.action]
    columns: list[str] = []
    for action in actions:
        for sensors in ("ideal", REAL):
            for machine, randomise in (("nominal", ()), ("randomised", spread)):
                choices = Options(
                    action=action, sensors=sensors, randomise=randomise, variants=asked.variants
                )
                core = TaskCore(task, choices, min(asked.episodes, asked.batch), 0, DISABLED)
                for kind in CONTROLLERS:
                    if kind == "reference" and name not in REFERENCES:
                        continue
                    controller = make_controller(kind, core.setup)
                    scores = evaluate(core, controller, asked.episodes, asked.seed)
                    if not columns:
                        columns = names(scores)
                        heads = [f"{column} [{scores.units[column]}]" for column in columns]
                        heads = ["actions", "sensors", "machine", "controller", *heads]
                        lines += [row(heads), row(["---"] * len(heads))]
                    cells = [f"{scores.mean(c):.4g} ± {scores.error(c):.2g}" for c in columns]
                    lines.append(row([action, sensors, machine, kind, *cells]))
                core.close()
    return lines


def main() -> None:
    asked = options(
        __doc__, tasks="all", actions="", episodes=64, batch=64, variants=32, seed=10**6
    )
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
