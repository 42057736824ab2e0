"""Release of the OpenGL context; `envs/test_render.py` tests the images."""

import sys
from types import SimpleNamespace

import pytest

from hydrotele.show.offscreen_renderer import _release_context


@pytest.mark.parametrize("driver", ["osmesa", "cgl"])
def test_drivers_that_are_not_installed_here_release_the_context(monkeypatch, driver):
    calls = []

    def record(name):
        return lambda *given: calls.append((name, *given))

    api = {
        "osmesa": SimpleNamespace(OSMesaMakeCurrent=record("make current")),
        "cgl": SimpleNamespace(CGLUnlockContext=record("unlock"), CGLSetCurrentContext=record("set current")),
    }
    module = SimpleNamespace(GL=SimpleNamespace(GL_FLOAT=5126), **{driver: api[driver]})
    monkeypatch.setitem(sys.modules, "fake_driver", module)
    context = type("GLContext", (), {"__module__": "fake_driver", "_context": "own"})()
    _release_context(context)
    assert (
        calls
        == {
            "osmesa": [("make current", None, None, 5126, 0, 0)],
            "cgl": [("unlock", "own"), ("set current", None)],
        }[driver]
    )
