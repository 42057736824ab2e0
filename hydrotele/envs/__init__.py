"""Gymnasium environments of heavy hydraulic machines, single and batched, and the same for dm_env.

Importing this package registers them: `gymnasium.make("hydrotele/TrackTrajectory-v0")` makes one,
`gymnasium.make_vec(..., num_envs=1024, vectorization_mode="vector_entry_point")` many in native
code. `gymnasium.make("hydrotele.envs:hydrotele/TrackTrajectory-v0")` imports it on the way.
`hydrotele.envs.making.TASKS` says what the tasks are.
"""

from gymnasium.envs.registration import register

TASK_NAMES = (
    "TrackTrajectory", "StraightLine", "HoldForce", "ReachFeller", "Grade",
    "PlaceLog",
)  # fmt: skip

for _name in TASK_NAMES:
    register(
        id=f"hydrotele/{_name}-v0",
        entry_point="hydrotele.envs.making:MachineEnv",
        vector_entry_point="hydrotele.envs.making:MachineVectorEnv",
        kwargs={"task": _name},
    )
