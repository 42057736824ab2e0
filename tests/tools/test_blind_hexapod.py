"""What the trials on the hexapod hide is what their keys say."""

import mujoco
import numpy as np
import pytest

from tools.validation.blind import hexapod


def test_a_load_lies_where_the_key_says():
    rng, spec = np.random.default_rng(0), hexapod.hexapod()
    given, sensors = spec.copy().compile(), hexapod.draw_sensors(rng)
    numbers = {"mass": 2.0, "x": 0.08, "y": -0.02, "z": 0.1}
    hexapod.plant(spec, sensors, hexapod.Planted("payload", "platform", numbers))
    moments = []
    for model in (given, spec.compile()):
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_forward(model, data)
        frame = data.body("platform").xmat.reshape(3, 3), data.body("platform").xpos
        moments.append(sum(
            model.body_mass[b] * frame[0].T @ (data.xipos[b] - frame[1])
            for b in range(model.nbody) if model.body(b).name in ("platform", "load")
        ))  # fmt: skip
    np.testing.assert_allclose(moments[1] - moments[0], [0.16, -0.04, 0.2], atol=1e-9)


@pytest.mark.nightly
def test_a_faint_effect_is_less_visible_than_a_strong_one(monkeypatch):
    seen = []
    for offset in (0.5, 50.0):
        planted = hexapod.Planted("force_offset", "slide_2", {"offset": offset})
        monkeypatch.setattr(hexapod, "draw_single", lambda rng, p=planted: p)
        key, _ = hexapod.make("single", 0, np.random.default_rng(3), 1.0)
        noise, rows = key["noise"]["force"][1], 3000
        seen.append(key["effects"][0]["visibility"]["total_fit_runs"])
        np.testing.assert_allclose(seen[-1], offset / noise * rows**0.5, rtol=0.01)
    assert seen[1] > 90.0 * seen[0]
