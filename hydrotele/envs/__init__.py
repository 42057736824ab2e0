"""Gymnasium and dm_env environments for hydraulic machines, single and batched.

Importing this package registers the environments.
`gymnasium.make("hydrotele/TrackTrajectory-v0")` makes a single environment, and
`gymnasium.make_vec(..., num_envs=1024, vectorization_mode="vector_entry_point")` makes a batch that
runs in native code. `gymnasium.make("hydrotele.envs:hydrotele/TrackTrajectory-v0")` also imports
the package. `hydrotele.envs.task_catalogue.TASKS` lists the shipped tasks. Tasks of installed packages
(entry points of the group `hydrotele.tasks`) are registered likewise, and loaded when they are made.
`gymnasium.make("hydrotele/Custom-v0", task=MyTask)` makes a task from a class.
"""

from gymnasium.envs.registration import register

from hydrotele.core.errors import InputError
from hydrotele.core.plugins import find_plugins

PLUGIN_GROUP = "hydrotele.tasks"

TASK_NAMES = (
    "TrackTrajectory", "StraightLine", "HoldForce", "ReachFeller", "Grade",
    "PlaceLog", "LoadTruck",
)  # fmt: skip


def _register(name: str, **kwargs: str | None) -> None:
    register(
        id=f"hydrotele/{name}-v0",
        entry_point="hydrotele.envs.gymnasium_env:MachineEnv",
        vector_entry_point="hydrotele.envs.gymnasium_env:MachineVectorEnv",
        kwargs=kwargs,
    )


for _name in TASK_NAMES:
    _register(_name, task=_name)
_register("Custom", task=None)  # its task is an argument of `make`
for _plugin in find_plugins(PLUGIN_GROUP).values():
    if _plugin.name in (*TASK_NAMES, "Custom"):
        raise InputError(_plugin.source, f"task {_plugin.name} exists already; choose another name")
    _register(_plugin.name, task=_plugin.name)
