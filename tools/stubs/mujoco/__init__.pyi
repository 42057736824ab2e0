# mujoco's functions and classes live in compiled modules without type information; to pyright they
# are untyped instead of missing.
from typing import Any

def __getattr__(name: str) -> Any: ...
