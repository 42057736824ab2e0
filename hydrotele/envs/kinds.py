"""The tasks in native code by their names: each is a file of its own and compiles by itself."""

from hydrotele.core.compiled import Callback
from hydrotele.envs import force, grade, line, place, reach, track

KINDS: dict[str, Callback] = {
    "track": track.code, "line": line.code, "force": force.code, "reach": reach.code,
    "grade": grade.code, "place": place.code,
}  # fmt: skip
"""Kind of task -> its code, see `world`."""
