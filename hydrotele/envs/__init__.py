"""Gymnasium and dm_env environments for hydraulic machines, single and batched.

Importing this package registers the environments.
`gymnasium.make("hydrotele/TrackTrajectory-v0")` makes a single environment, and
`gymnasium.make_vec(..., num_envs=1024, vectorization_mode="vector_entry_point")` makes a batch that
runs in native code. `gymnasium.make("hydrotele.envs:hydrotele/TrackTrajectory-v0")` also imports
the package. `hydrotele.envs.task_catalogue.TASKS` lists the tasks.
"""

from gymnasium.envs.registration import register

TASK_NAMES = (
    "TrackTrajectory", "StraightLine", "HoldForce", "ReachFeller", "Grade",
    "PlaceLog", "LoadTruck",
)  # fmt: skip

for _name in TASK_NAMES:
    register(
        id=f"hydrotele/{_name}-v0",
        entry_point="hydrotele.envs.gymnasium_env:MachineEnv",
        vector_entry_point="hydrotele.envs.gymnasium_env:MachineVectorEnv",
        kwargs={"task": _name},
    )
