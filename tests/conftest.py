"""What every test shares: a renderer that needs no display, and hypothesis settings."""

import ctypes
import os
import sys
import time

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


def pytest_terminal_summary(terminalreporter):
    """Say what tools/test did besides pytest here, so that pytest has the last word."""
    started = os.environ.get("HYDROTELE_TEST_STARTED")
    if started:
        terminalreporter.write_line(f"tools/test took {time.time() - float(started):.0f} s in all")
    if failed := os.environ.get("HYDROTELE_TEST_FAILED"):
        terminalreporter.write_line(f"FAILED before pytest: {failed}", red=True)
