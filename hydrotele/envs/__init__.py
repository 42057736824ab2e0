"""Gymnasium environments of heavy hydraulic machines, single and batched, and the same for dm_env.

`gymnasium.make("hydrotele/TrackTrajectory-v0")` finds them by itself once hydrotele is installed;
`gymnasium.make_vec(..., num_envs=1024, vectorization_mode="vector_entry_point")` gives them batched
in native code. `hydrotele.tasks.catalogue.TASKS` says what the tasks are.
"""

NAMESPACE = "hydrotele"
TASK_NAMES = (
    "TrackTrajectory",
)  # fmt: skip


def register_envs() -> None:
    """Register the environments with gymnasium, which calls this when it is imported."""
    from gymnasium.envs.registration import register, registry

    for name in TASK_NAMES:
        if f"{NAMESPACE}/{name}-v0" not in registry:
            register(
                id=f"{NAMESPACE}/{name}-v0",
                entry_point="hydrotele.envs.single:MachineEnv",
                vector_entry_point="hydrotele.envs.vector:MachineVectorEnv",
                kwargs={"task": name},
            )
