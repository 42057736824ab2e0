"""What every test shares: a renderer that needs no display, and hypothesis settings."""

import ctypes
import os
import sys
import time
from pathlib import Path

import hypothesis

# Has to be settled before the first import of mujoco or dm_control.
if sys.platform == "linux" and "MUJOCO_GL" not in os.environ:
    for _name, _library in (("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8")):
        try:
            ctypes.CDLL(_library)
        except OSError:
            continue
        os.environ["MUJOCO_GL"] = _name
        break

# No deadline: the first example pays for numba's compilation. The same examples each time, so
# that a red run can be repeated.
hypothesis.settings.register_profile("hydrotele", deadline=None, derandomize=True)
hypothesis.settings.load_profile("hydrotele")


# Files that take ten seconds or more, the longest first: two processes then end together. A file
# that is missing here costs at most its own length at the end.
LONG = ()


def pytest_collection_modifyitems(items):
    """Put the files that take long first; inside a file nothing changes."""
    place = {name: k for k, name in enumerate(LONG)}
    root = Path(__file__).parent
    items.sort(key=lambda item: place.get(_inside(item.path, root), len(LONG)))


def _inside(path, root):
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else ""


def pytest_terminal_summary(terminalreporter):
    """Say what tools/test did beside pytest here, so that pytest has the last word."""
    folder = os.environ.get("HYDROTELE_CHECKS")
    if folder and Path(folder, "output").exists():
        done = Path(folder, "done")
        while not done.exists():
            time.sleep(0.1)
        terminalreporter.write_line(Path(folder, "output").read_text().rstrip())
        if failed := done.read_text().strip():
            terminalreporter.write_line(f"FAILED beside pytest: {failed}", red=True)
    if started := os.environ.get("HYDROTELE_TEST_STARTED"):
        terminalreporter.write_line(f"tools/test took {time.time() - float(started):.0f} s in all")
