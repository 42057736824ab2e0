"""Terms in a model that MuJoCo reads: what does not fit into one of its elements."""

import mujoco
import numpy as np

from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.plant import build_plant
from hydrotele.terms.term import Term


def moved(*forces: float) -> np.ndarray:
    """Where a rig's slide is after half a second with constant forces [N] on it."""
    terms = tuple(
        Term(name=f"force_{k}", axis="slide", balance="force", law="constant",
             parameters={"value": size})
        for k, size in enumerate(forces)
    )  # fmt: skip
    plant = build_plant(load_machine("rig").model_copy(update={"terms": terms}))
    data = mujoco.MjData(plant.model)
    while data.time < 0.5:
        mujoco.mj_step(plant.model, data)
    return data.qpos.copy()


def test_a_long_table_of_terms_is_in_several_elements():
    """Sixty terms are as one that adds as much; numbers of the last ones count."""
    sizes = [20.0] * 55 + [400.0] * 5
    many = moved(*sizes)
    assert np.max(np.abs(many - moved(sum(sizes)))) < 1e-9
    assert np.max(np.abs(many - moved(sum(sizes[:55])))) > 1e-6
