"""What stands around a machine: plates are springs, trees stand, are cut, held and let go."""

import mujoco
import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.run.run import prepare_run, run_scenario, start_session
from hydrotele.scenario.scenario import Scenario, load_scenario
from hydrotele.simulate.contact_forces import mark_surrounding_bodies, total_contact_force

PLATE = {"kind": "plate", "position": [6.0, -0.11, 0.3], "size": [0.8, 0.9]}
TREE = {"kind": "tree", "position": [8.0, 0.0]}


def bits(log):
    return {name: column.tobytes() for name, column in log.columns.items()}


def press(**plate) -> Scenario:
    """The bucket goes down on a plate and stays there."""
    return Scenario.model_validate({
        "name": "press", "machine": "cat215", "tool": "bucket", "duration": 5.0,
        "surroundings": [PLATE | plate],
        "start": {"pose": {"r": 6.0, "z": 0.36, "attitude": -1.745}},
        "pilot": {
            "kind": "teleop", "reflection": "none", "force": "true", "mount": "table",
            "coordinates": {"z": {"speed": 0.3}},
            "operator": {"kind": "follow", "time": [0.0, 0.3, 1.3, 1.5, 5.0],
                         "path": {"z": [0.0, -0.0024, -0.0024, 0.0, 0.0]}},
        },
    })  # fmt: skip


def test_a_plate_is_a_spring():
    """At rest the force is stiffness times the way of its face; 0.2 % of it still creeps.

    Contact itself is firm: the bucket sinks less than 1 mm into the face.
    """
    session = start_session(press(stiffness=1.0e6))
    while session.tick < session.scenario.tick_count:
        session.advance()
    plant, data = session.plant, session.data
    force = total_contact_force(plant.model, data, mark_surrounding_bodies(plant))
    depth = -data.joint("plate_0").qpos[0]
    assert force[2] > 5e3
    assert force[2] == pytest.approx(1.0e6 * depth, rel=2e-3)
    assert -1e-3 < min(data.contact[k].dist for k in range(data.ncon)) < 0.0
    assert not data.warning.number.any()


@pytest.mark.nightly
def test_the_force_that_is_felt_is_the_plates():
    """Of the pressures, against the simulator's: a tenth, for seals and for the tip's lever."""
    scenario = press()
    pilot = scenario.pilot.model_copy(update={"force": "dynamic"})
    run = run_scenario(scenario.model_copy(update={"pilot": pilot}))
    felt = run.measured["tip_force.z"][-25:].mean()
    assert felt == pytest.approx(run.truth["truth.contact_force.z"][-25:].mean(), rel=0.1)
    for c in "xyz":  # the plate is all that the machine touches
        single = run.truth[f"truth.object_contact.plate_0_{c}"]
        np.testing.assert_array_equal(single, run.truth[f"truth.contact_force.{c}"])


@pytest.mark.nightly
def test_a_plate_far_away_changes_nothing():
    """Not bit for bit: the constraint solver sums over one more joint. 1e-10 is far above that."""
    alone = load_scenario("zhu_in", {"duration": "2"})
    far = press(position=[-8.0, 0.0, 0.3]).surroundings
    with_plate = run_scenario(alone.model_copy(update={"surroundings": far}))
    without = run_scenario(alone)
    for name in without.truth.columns:
        if name.startswith(("angle.", "pressure_")):
            scale = np.abs(without.truth[name]).max()
            off = np.abs(with_plate.truth[name] - without.truth[name]).max()
            assert off < 1e-10 * max(scale, 1.0), name


def test_a_start_in_the_plate_is_refused():
    with pytest.raises(InputError, match="would penetrate the ground or an object by"):
        prepare_run(press(position=[6.0, -0.11, 0.6]))


def fell(duration, buttons, r=7.4, times=(0.0, 5.5), points=None) -> Scenario:
    """The feller-buncher in front of a tree, spinning its saw up before it goes there."""
    return Scenario.model_validate({
        "name": "fell", "machine": "cat325", "duration": duration,
        "servo": {"axis_gains": {"swing": 1.0}}, "surroundings": [TREE],
        "start": {"pose": {"r": r, "z": 0.75, "attitude": 0.0}, "joints": {"grab": 0.0}},
        "pilot": {
            "kind": "teleop", "gains": "feller", "reflection": "none", "force": "true",
            "coordinates": {"r": {"speed": 0.2}, "z": {"speed": 0.4}},
            "operator": {"kind": "steer", "time": list(times),
                         "points": points or {"r": [r, 8.0], "z": [0.75, 0.75]}},
            "buttons": [{"start": t, "axis": a, "command": c} for t, a, c in buttons],
        },
    })  # fmt: skip


SAW, CLOSE, OPEN = (0.0, "saw", 1.0), (8.5, "grab", 0.8), (14.5, "grab", -0.8)


def gone(scenario):
    """Session after its last tick, and the way of the stem's foot (n, 3) [m] by tick."""
    session, way = start_session(scenario), []
    places = [session.plant.model.joint(f"tree_0_{c}").qposadr[0] for c in "xyz"]
    while session.tick < scenario.tick_count:
        session.advance()
        way.append(session.data.qpos[places].copy())
    assert not session.data.warning.number.any()
    return session, np.array(way)


@pytest.mark.nightly
def test_a_tree_stands_still_and_an_empty_grab_holds_nothing():
    """1 mm is what a root may give; the grab closes well in front of it."""
    buttons = [SAW, (0.2, "grab", 0.8)]
    session, way = gone(fell(3.0, buttons, r=6.6, points={"r": [6.6, 6.6]}))
    assert np.abs(way).max() < 1e-3 and session.events == []


@pytest.mark.nightly
def test_a_saw_that_stands_does_not_cut():
    """The head runs against the stem: it stays where it is, and nothing is cut."""
    session, way = gone(fell(4.0, [], times=(0.0, 0.2)))
    assert session.events == [] and np.abs(way).max() < 0.05
    assert session.data.ncon > 0


def test_a_saw_above_the_kerf_does_not_cut():
    scenario = fell(9.0, [SAW])
    data = scenario.model_dump(mode="json")
    data["surroundings"][0]["cut_height"] = 0.8
    session, _ = gone(Scenario.model_validate(data))
    assert not any("cut" in said for _, said in session.events)


def test_cut_held_lifted_and_let_go():
    """In this order; lifted by half a metre with the tip, and on the ground again at the end."""
    points = {"r": [7.4, 8.0, 8.0], "z": [0.75, 0.75, 1.2]}
    scenario = fell(17.0, [SAW, CLOSE, OPEN], times=(0.0, 5.5, 11.0), points=points)
    session, way = gone(scenario)
    assert [said for _, said in session.events] == [
        "the tree is cut", "the grab holds the tree", "the grab lets the tree go",
    ]  # fmt: skip
    held = way[: round(14.4 / 0.005), 2]
    assert 0.35 < held.max() < 0.55  # 0.45 m by the tip; the foot swings as the stem rocks
    assert way[-1, 2] < 0.1
    model = session.plant.model
    stiff = model.jnt_stiffness[model.joint("tree_0_z").id]
    session.finish()
    assert stiff == 0.0 < model.jnt_stiffness[model.joint("tree_0_z").id]
    assert model.geom_contype[model.geom("tree_0").id] == 3


@pytest.mark.nightly
def test_felling_again_gives_the_same_bits():
    first, again = (run_scenario(fell(12.0, [SAW])) for _ in range(2))
    assert any("the tree is cut" in note for note in first.summary["notes"])
    assert bits(first.truth) == bits(again.truth) and bits(first.measured) == bits(again.measured)


@pytest.mark.parametrize(("key", "value"), [("saw", "chain"), ("grab", "claw")])
def test_a_tree_needs_saw_and_grab(key, value):
    data = fell(3.0, []).model_dump(mode="json")
    data["surroundings"][0][key] = value
    with pytest.raises(InputError, match=f"no axis '{value}'.*valid: ") as error:
        prepare_run(Scenario.model_validate(data))
    assert error.value.where == f"surroundings.0.{key}"


def test_a_tree_is_no_work_for_an_excavator():
    data = press().model_dump(mode="json")
    data["surroundings"] = [TREE]
    with pytest.raises(InputError, match="no axis 'saw'"):
        prepare_run(Scenario.model_validate(data))


def test_a_tilted_plate_looks_its_way():
    """Its slide joint runs along the normal, and its face stands at the position."""
    plant = prepare_run(press(normal="-x", position=[9.0, 0.0, 1.0])).plant
    data = mujoco.MjData(plant.model)
    mujoco.mj_kinematics(plant.model, data)
    geom = plant.model.geom("plate_0")
    np.testing.assert_allclose(plant.model.joint("plate_0").axis, [-1, 0, 0])
    assert data.geom_xpos[geom.id, 0] - geom.size[0] == pytest.approx(9.0)
