"""Create a machine from a robot description: URDF, xacro or MJCF."""
