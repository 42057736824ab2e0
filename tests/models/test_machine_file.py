"""Machine files: what is read, what is refused and in which words, and writing back."""

import math
import re
import shutil

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hydrotele.core import datafile
from hydrotele.core.datafile import read_yaml, split_unit, suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder
from hydrotele.core.units import KEY_SUFFIXES, PSI, si_unit_and_factor
from hydrotele.kinematics.drive_linkage import check_strokes
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import (
    find_machine_file,
    load_machine,
    save_machine,
    shipped_machines,
)
from hydrotele.simulate.mechanism import assemble_mjcf, mjcf_document
from hydrotele.simulate.plant import build_plant, rest_state

ANY = settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)

CRANE = """\
name: crane
links:
  post: {mass: 900, inertia: [90, 80, 70]}
  jib:
    parent: post
    position: [0.0, 0.0, 2.0]
    joint: {name: jib, axis: [0, -1, 0], range_deg: [-20, 60]}
    mass: 200
    com: [1.5, 0.0, 0.0]
    inertia: [5, 150, 150]
axes:
  jib:
    joint: jib
    cylinder:
      base_pin: {link: post, position: [0.3, 0.0, 1.0]}
      rod_pin: {link: jib, position_mm: [1000, 0, 0]}
      closed_length: 0.9
      stroke: 0.85
      area_head_in2: 10
      area_rod_cm2: 40
      dead_volume: 1.0e-3
      leakage: 0
      tube: {mass: 20, com: 0.3, inertia: [1, 2, 2]}
      rod: {mass: 15, com: 0.3, inertia: [1, 2, 2]}
    valve: {rated_flow_l_min: 60, bandwidth_hz: 8}
supply: {relief_pressure_bar: 200, tank_pressure_psi: 50, pump_flow: 28.0e-4, bulk_modulus: 0.9e9}
sensors:
  simple: {angle: {accuracy_deg: 0.5}, length: {accuracy_mm: 2}}
home: {jib: 0.3}
tools:
  none: {}
  hook:
    links: {hook: {parent: jib, position: [3, 0, 0], mass: 20, inertia: [1, 1, 1]}}
"""

CRANE_MJCF = """\
<mujoco>
  <default><joint axis="0 -1 0" damping="3"/></default>
  <worldbody>
    <body name="post">
      <inertial pos="0 0 0" mass="900" diaginertia="90 80 70"/>
      <body name="jib" pos="0 0 2"><joint name="jib" range="-20 60"/></body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def write(tmp_path):
    """Write a machine file, and an MJCF beside it if given; returns its path."""

    def written(text: str = CRANE, mjcf: str | None = None, name: str = "crane.yaml"):
        if mjcf is not None:
            (tmp_path / "crane.xml").write_text(mjcf)
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return written


def edited(*pairs: tuple[str, str]) -> str:
    """CRANE with pieces of text replaced."""
    text = CRANE
    for old, new in pairs:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


def with_mjcf(*pairs: tuple[str, str]) -> str:
    """CRANE that leaves the post's inertia and the jib's place and joint to the MJCF."""
    return edited(
        ("name: crane", "name: crane\nmjcf: crane.xml"),
        ("post: {mass: 900, inertia: [90, 80, 70]}", "post: {}"),
        ("    parent: post\n    position: [0.0, 0.0, 2.0]\n", ""),
        ("    joint: {name: jib, axis: [0, -1, 0], range_deg: [-20, 60]}\n", ""),
        *pairs,
    )


def refusal(path, tool=None) -> str:
    """The message with which a file is refused."""
    with pytest.raises(InputError) as caught:
        load_machine(path, tool)
    return str(caught.value)


def test_units_become_si(write):
    """Every suffix is converted by its exact factor."""
    machine = load_machine(write())
    cylinder, valve = machine.axes["jib"].cylinder, machine.axes["jib"].valve
    assert machine.joints["jib"].range == pytest.approx((math.radians(-20), math.radians(60)))
    assert cylinder.area_head == pytest.approx(10 * 0.0254**2)
    assert cylinder.area_rod == pytest.approx(40e-4)
    assert cylinder.rod_pin.position == pytest.approx((1.0, 0.0, 0.0))
    assert valve.rated_flow == pytest.approx(1e-3)
    assert valve.bandwidth == pytest.approx(16 * math.pi)
    assert machine.supply.relief_pressure == pytest.approx(20e6)
    assert machine.supply.tank_pressure == pytest.approx(50 * 6894.757293168361)
    assert machine.sensors["simple"].angle.accuracy == pytest.approx(math.radians(0.5))
    assert machine.sensors["simple"].length.accuracy == pytest.approx(0.002)


def test_yaml_reads_floats_as_yaml_1_2_does(write):
    """PyYAML reads 0.9e9 and 28.0e-4 without help as strings or numbers by their sign; not here."""
    supply = load_machine(write()).supply
    assert (supply.bulk_modulus, supply.pump_flow) == (0.9e9, 28.0e-4)
    data, _ = read_yaml(write("a: 1e5\nb: 28.0e6\nc: -3E-2\nd: 12e\n"))
    assert data == {"a": 1e5, "b": 28.0e6, "c": -3e-2, "d": "12e"}


def test_unit_suffixes_have_their_definitions():
    """Independent definitions; 1 psi = 0.45359237 kg x 9.80665 m/s^2 / (0.0254 m)^2."""
    assert PSI == pytest.approx(0.45359237 * 9.80665 / 0.0254**2, rel=1e-15)
    expected = {
        "_deg": math.pi / 180, "_mm": 1e-3, "_in2": 6.4516e-4, "_cm2": 1e-4, "_psi": PSI,
        "_bar": 1e5, "_hz": 1.0, "_l_min": 1 / 60000, "_ms": 1e-3,
    }  # fmt: skip
    assert pytest.approx(expected) == {key: split_unit("a" + key)[1] for key in KEY_SUFFIXES}


@given(st.sampled_from(list(KEY_SUFFIXES)), st.from_regex(r"[a-z]{1,8}", fullmatch=True))
def test_split_unit_takes_the_suffix_off(suffix, stem):
    """Any stem, any suffix."""
    assert split_unit(stem + suffix) == (stem, si_unit_and_factor(KEY_SUFFIXES[suffix])[1])
    assert split_unit(stem) == (stem, None)


def test_hertz_of_an_angular_frequency_counts_two_pi():
    """A spool's bandwidth is in rad/s, a sensor's rate in Hz."""
    assert split_unit("bandwidth_hz") == ("bandwidth", math.tau)
    assert split_unit("rate_hz") == ("rate", 1.0)


def test_tool_adds_its_parts(write):
    """A tool's links exist with it and are removed without it."""
    path = write()
    assert "hook" not in load_machine(path).links
    assert load_machine(path).removed_bodies == ("hook",)
    assert load_machine(path, "hook").links["hook"].mass == 20
    assert load_machine(path, "hook").tools == ("hook", "none")


def test_runs_without_mjcf(write):
    """Numbers alone make a machine: bodies, cylinder and pins are built from them."""
    plant = build_plant(load_machine(write()))
    data = rest_state(plant)
    assert data.qpos[plant.qpos[0]] == pytest.approx(0.3)
    assert 0 < data.qpos[plant.rod_qpos[0]] < 0.65


def test_mjcf_completes_the_links(write):
    """Place, inertia and joint from the MJCF, with its default classes and in its angle unit."""
    plain = load_machine(write())
    machine = load_machine(write(with_mjcf(), CRANE_MJCF))
    assert machine.links["post"] == plain.links["post"]
    assert machine.links["jib"].position == plain.links["jib"].position
    joint = machine.joints["jib"]
    assert joint.axis == (0.0, -1.0, 0.0) and joint.damping == 3.0
    assert joint.range == pytest.approx(plain.joints["jib"].range)
    radians = CRANE_MJCF.replace("<default>", '<compiler angle="radian"/><default>')
    joint = load_machine(write(with_mjcf(), radians)).joints["jib"]
    assert joint.range == (-20.0, 60.0)


REFUSALS = {
    "unknown key": (
        (("closed_length: 0.9", "closed_lenght: 0.7"),),
        r":14: axes.jib.cylinder.*'closed_lenght'.*did you mean 'closed_length'",
    ),
    "unknown section": ((("home:", "hoem:"),), r"'hoem'.*did you mean 'home'.*supply"),
    "bad unit": (
        (("closed_length: 0.9", "closed_length_psy: 0.7"),),
        r"'closed_length_psy'.*valid",
    ),
    "unit twice": (
        (("stroke: 0.85", "stroke: 0.85\n      stroke_mm: 850"),),
        r"'stroke' is given twice",
    ),
    "unknown link of a pin": (
        (("base_pin: {link: post,", "base_pin: {link: pots,"),),
        r"axes.jib.cylinder.base_pin.link: 'pots'.*did you mean 'post'.*jib",
    ),
    "unknown parent": (
        (("parent: post", "parent: pole"),),
        r"links.jib.parent: 'pole'.*post, world",
    ),
    "own parent": ((("parent: post", "parent: jib"),), r"links.jib.parent: 'jib' is not known"),
    "cycle": ((("post: {mass", "post: {parent: jib, mass"),), r"cycle.*(post|jib)"),
    "unknown joint of an axis": (
        (("    joint: jib\n", "    joint: jab\n"),),
        r"axes.jib.joint: 'jab'.*'jib'",
    ),
    "unknown joint at home": (
        (("home: {jib:", "home: {jub:"),),
        r"home: 'jub'.*did you mean 'jib'",
    ),
    "impossible inertia": (
        (("inertia: [5, 150, 150]", "inertia: [5, 150, 160]"),),
        r":4: links.jib: inertia .* impossible for a rigid body",
    ),
    "negative mass": ((("mass: 200", "mass: -200"),), r":8: links.jib.mass: .*greater than 0"),
    "text for a number": ((("mass: 200", "mass: heavy"),), r":8: links.jib.mass: .*number"),
    "no number": ((("mass: 200", "mass: .nan"),), r":8: links.jib.mass: .*finite"),
    "missing number": ((("    mass: 200\n", ""),), r"links.jib.mass: .*required"),
    "integer beyond floats": ((("mass: 200", "mass: 1" + "0" * 400),), r":8: links.jib.mass"),
    "axis of no unit length": (
        (("[0, -1, 0]", "[0, -1, 1]"),),
        r"links.jib.joint: axis .* unit length",
    ),
    "range upside down": ((("[-20, 60]", "[60, -20]"),), r"low < high"),
    "two drives": (
        (("    valve:", "    force: {gain: 3}\n    valve:"),),
        r"axes.jib: needs exactly one of cylinder, motor, force; has \['cylinder', 'force'\]",
    ),
    "no drive": ((("    cylinder:\n", "    valve_of:\n"),), r"'valve_of'.*cylinder"),
    "valve missing": (
        (("    valve: {rated_flow_l_min: 60, bandwidth_hz: 8}\n", ""),),
        r"axes.jib: a cylinder or motor needs either a valve",
    ),
    "supply missing": ((("supply: {", "description: |\n  {"),), r"valves need a supply"),
    "link named world": ((("post: {mass", "world: {mass"),), r"links.world"),
    "one joint on two links": (
        (("post: {mass", "post: {joint: {name: jib}, mass"),),
        r"links.jib.joint: 'jib' is already the joint of link 'post'",
    ),
    "links no mapping": ((("home: {jib: 0.3}", "home: 3"),), r"home: .*dictionary"),
    "name in capitals": ((("name: crane", "name: Crane"),), r":1: name: .*pattern"),
    "tools no mapping": ((("  none: {}\n", "  none: [1]\n"),), r":31: tools.none: must map"),
    "link of a tool stands twice": (
        (("links: {hook:", "links: {jib:"),),
        r":33: tools.hook.links.jib: already exists in the machine",
    ),
    "duplicate key": (
        (("    mass: 200\n", "    mass: 200\n    mass: 210\n"),),
        r":9: .*'mass' occurs twice",
    ),
    "bad YAML": ((("links:\n  post", "links: ]\n  post"),), r":2: is not valid YAML"),
    "tabs": ((("  post:", "\tpost:"),), r":3: is not valid YAML"),
    "polar pin from no link": (
        (("{link: post, position: [0.3, 0.0, 1.0]}", "{link: post, from: job, distance: 1}"),),
        r":15: axes.jib.cylinder.base_pin: from: 'job' is not a link; did you mean 'jib'",
    ),
    "polar pin without number": (
        (("{link: post, position: [0.3, 0.0, 1.0]}", "{link: post, distance: far}"),),
        r":15: axes.jib.cylinder.base_pin.distance: must be a finite number, not 'far'",
    ),
    "missing MJCF": ((("name: crane", "name: crane\nmjcf: crain.xml"),), r":2: mjcf: .*crain.xml"),
}


@pytest.mark.parametrize("kind", REFUSALS)
def test_refusal_says_where_and_what(write, kind):
    """Each names the file, the line or key path, and the valid names where there are such."""
    pairs, expected = REFUSALS[kind]
    path = write(edited(*pairs))
    message = refusal(path, "hook" if "tool stands" in kind else None)
    assert message.startswith(str(path))
    assert re.search(expected, message.removeprefix(str(path)), re.DOTALL), message


MJCF_REFUSALS = {
    "number in both": (
        ("    mass: 200\n", "    mass: 200\n    position: [0, 0, 2]\n"),
        None,
        r"links.jib: position is also given in crane.xml",
    ),
    "joint number in both": (
        ("    mass: 200\n", "    mass: 200\n    joint: {range_deg: [-3, 3]}\n"),
        None,
        r"links.jib: joint.range_deg is also given in crane.xml",
    ),
    "not XML": (None, ("<worldbody>", "<worldbody"), r"mjcf: .*crane.xml: is not XML"),
    "not MJCF": (None, ("<worldbody>", "<worldboddy>"), r"mjcf: .*crane.xml: is not XML"),
    "joint without name": (
        None,
        ('name="jib" range', "range"),
        r"body 'jib' of crane.xml: needs exactly one named joint",
    ),
    "two joints": (
        None,
        ('<joint name="jib"', '<joint name="yaw"/><joint name="jib"'),
        r"has 2 joints",
    ),
    "ball joint": (
        None,
        ('<joint name="jib" range="-20 60"', '<joint name="jib" type="ball"'),
        r"links.jib.joint.type: .*'hinge' or 'slide'",
    ),
    "turned inertia": (
        None,
        ('pos="0 0 0" mass', 'pos="0 0 0" quat="1 1 0 0" mass'),
        r"body 'post' of crane.xml: the inertia must be a diaginertia",
    ),
}


@pytest.mark.parametrize("kind", MJCF_REFUSALS)
def test_refusal_of_an_mjcf_says_where_and_what(write, kind):
    """A number stands in one place; what this schema cannot say is refused, not dropped."""
    of_yaml, of_mjcf, expected = MJCF_REFUSALS[kind]
    mjcf = CRANE_MJCF.replace(*of_mjcf) if of_mjcf else CRANE_MJCF
    path = write(with_mjcf(*([of_yaml] if of_yaml else [])), mjcf)
    message = refusal(path)
    assert message.startswith(str(path))
    assert re.search(expected, message, re.DOTALL), message


def test_unknown_tool_lists_the_valid_ones(write):
    """By argument and by the file's own `tool`."""
    path = write()
    message = refusal(path, "hok")
    assert message.startswith(str(path))
    assert re.search(r"tools: no tool 'hok'; did you mean 'hook'\? valid: hook, none", message)
    assert "no tool 'gripper'" in refusal(write(CRANE + "tool: gripper\n"))
    assert "no tool [1]" in refusal(write(CRANE + "tool: [1]\n"))


def test_unknown_machine_lists_the_shipped_ones(tmp_path):
    """Name, folder without a machine file, and file that is not there."""
    for name in ("cat21", tmp_path):
        with pytest.raises(InputError, match="cat215.*ec20.*emps.*rig"):
            find_machine_file(name)
    with pytest.raises(InputError, match="no such machine file"):
        find_machine_file(tmp_path / "gone.yaml")
    assert {"cat215", "ec20", "emps", "rig"} <= set(shipped_machines())


def test_folder_and_file_are_both_machines(write, tmp_path):
    """A folder holds machine.yaml; a file may have any name."""
    assert load_machine(write()).name == "crane"
    write(name="machine.yaml")
    assert load_machine(tmp_path) == load_machine(write()).model_copy()


CASES = [(name, tool) for name in shipped_machines() for tool in load_machine(name).tools]


# One tool of each kind of machine; the others nightly.
DAILY = {("cat215", "bucket"), ("cat215", "grapple_claw"), ("cat325", "none"), ("emps", "none"),
         ("eha", "load_30_bar"), ("rig", "none")}  # fmt: skip
assert set(CASES) >= DAILY


@pytest.mark.daily("rig-none", "cat325-none")
@pytest.mark.parametrize(
    ("name", "tool"),
    [c if c in DAILY else pytest.param(*c, marks=pytest.mark.nightly) for c in CASES],
)
def test_round_trip(tmp_path, name, tool):
    """A saved machine is the same machine: same facts, same MJCF to the last digit."""
    machine = load_machine(name, tool)
    path = tmp_path / "saved.yaml"
    save_machine(machine, path)
    again = load_machine(path)
    moved = {"folder": "", "mjcf": None, "attached": {}, "tools": ()}
    assert again.model_copy(update=moved) == machine.model_copy(update=moved)
    assert mjcf_document(assemble_mjcf(again)) == mjcf_document(assemble_mjcf(machine))
    save_machine(again, tmp_path / "twice.yaml")
    assert (tmp_path / "twice.yaml").read_text() == path.read_text()


def test_machine_is_frozen():
    """Facts do not change; a changed machine is a new one."""
    machine = load_machine("rig")
    with pytest.raises(ValueError, match="frozen"):
        machine.name = "other"


def test_more_than_eight_valves_are_refused(write):
    """The native circuit has room for eight valves on one supply."""
    data = yaml.safe_load(CRANE)
    for k in range(9):
        data["links"][f"jib{k}"] = data["links"]["jib"] | {"joint": {"name": f"jib{k}"}}
        data["axes"][f"jib{k}"] = data["axes"]["jib"] | {"joint": f"jib{k}"}
    assert "at most 8 valves" in refusal(write(yaml.safe_dump(data)))


SCALARS = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8),
    st.sampled_from(["world", "jib", "post", "none", "hinge", "../x.xml", "1e5"]), st.dates(),
)  # fmt: skip
KEYS = st.one_of(
    st.sampled_from(sorted({*Machine.model_fields, "joint", "mass", "inertia", "position_mm"})),
    st.sampled_from(["jib", "post", "none", "cylinder", "valve", "base_pin", "distance", "from"]),
    st.integers(), st.text(max_size=5),
)  # fmt: skip
TREES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(KEYS, inner, max_size=5)),
    max_leaves=25,
)


def load_or_refuse(path) -> None:
    """Load; the only error allowed is InputError."""
    try:
        assert isinstance(load_machine(path), Machine)
    except InputError as error:
        assert str(error).startswith(str(path))


@ANY
@given(st.text(max_size=200))
def test_any_text_is_read_or_refused(write, text):
    """Garbage gives InputError and nothing else."""
    path = write("", name="any.yaml")
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    load_or_refuse(path)


@ANY
@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(write, data):
    """Not even text gives InputError and nothing else."""
    path = write("", name="any.yaml")
    path.write_bytes(data)
    load_or_refuse(path)


@ANY
@given(st.dictionaries(KEYS, TREES, max_size=6))
def test_any_tree_is_read_or_refused(write, tree):
    """Valid YAML of any shape, with known keys in wrong places."""
    load_or_refuse(write(yaml.safe_dump(tree, allow_unicode=True)))


def paths_of(tree, path=()):
    """Paths of all values of a tree of dicts and lists."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in items:
        yield (*path, key)
        if isinstance(value, (dict, list)):
            yield from paths_of(value, (*path, key))


CRANE_TREE = yaml.safe_load(CRANE)


@ANY
@given(st.sampled_from(list(paths_of(CRANE_TREE))), TREES)
def test_any_value_in_any_place_is_read_or_refused(write, place, value):
    """A right file with one wrong value."""
    tree = yaml.safe_load(CRANE)
    inner = tree
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    load_or_refuse(write(yaml.safe_dump(tree, allow_unicode=True)))


@ANY
@given(st.integers(0, len(CRANE) - 1), st.text("{}[]:,&*!?|-'\"#%\n\t ae0.", max_size=6))
def test_any_damage_is_read_or_refused(write, place, piece):
    """A right file with a few characters overwritten."""
    load_or_refuse(write(CRANE[:place] + piece + CRANE[place + len(piece) :]))


@pytest.mark.parametrize(
    "text",
    [
        "&a [*a]",
        "&a {x: *a}",
        "x: &b {c: *b}",
        "? [1]\n: 2",
        "!!int ''",
        "!!bool no such",
        "!!timestamp x",
        "!!map [1]",
        "!!seq {a: b}",
        "<<: 3",
        "--- 1\n--- 2",
        "!!python/object:os.system x",
        "a: 9" + "9" * 5000,
        "[" * 5000,
    ],
)
def test_yaml_traps_are_refused(write, text):
    """Aliases inside their own anchor, tags that do not suit, bombs of depth and of digits."""
    assert "not valid YAML" in refusal(write(text))


def test_suggest_takes_names_of_any_type():
    """A YAML key may be a number."""
    assert suggest_valid_name(3, [30, "a"]) == "did you mean '30'? valid: 30, a"
    assert suggest_valid_name("x", []) == "valid: (none)"


def test_line_numbers_are_those_of_the_keys(write):
    """Key path -> line, through lists and aliases."""
    _, lines = read_yaml(write("a: &x\n  b: 1\nc:\n  - 1\n  - 2\nd: *x\n"))
    assert {k: lines[k] for k in (("a",), ("a", "b"), ("c", 1), ("d",))} == {
        ("a",): 1, ("a", "b"): 2, ("c", 1): 5, ("d",): 6,
    }  # fmt: skip


def test_doctests_run():
    """The examples of datafile."""
    import doctest

    assert doctest.testmod(datafile).failed == 0


def test_facts_refuse_infinity(write):
    """Numbers in a machine are finite."""
    assert np.isfinite(load_machine(write()).links["jib"].mass)
    assert "finite" in refusal(write(edited(("mass: 200", "mass: .inf"))))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("area_rod_cm2: 40", "area_rod_cm2: 70"), "area_rod 0.007 exceeds area_head 0.0064516"),
        (("stroke: 0.85", "stroke: 0.91"), "a stroke of 0.91 m does not fit into a closed_length"),
        (("relief_pressure_bar: 200", "relief_pressure: 200"), "is not below relief_pressure 200"),
        (("bulk_modulus: 0.9e9", "bulk_modulus: 900"), "greater than or equal to 10000000"),
        (("home: {jib: 0.3}", "home: {jib: 1.3}"), "home.jib: 1.3 is outside its range"),
        (("stroke: 0.85", "stroke: 1.0e+200"), "less than or equal to 100000000000000000000"),
    ],
)
def test_impossible_machines_are_refused(write, change, said):
    """Slips of unit and sign that would simulate nonsense."""
    assert said in refusal(write(edited(change)))


def test_a_drive_without_gain_is_refused(tmp_path):
    shutil.copytree(models_folder() / "emps", tmp_path / "emps")
    file = tmp_path / "emps/machine.yaml"
    file.write_text(file.read_text().replace("gain: 35.150651882", "gain: 0"))
    with pytest.raises(InputError, match="with 0 no command moves the drive"):
        load_machine(str(tmp_path / "emps"))


def test_stroke_must_span_the_range_of_the_joint(write):
    """The piston would leave its tube at an end of the joint's range."""
    check_strokes(load_machine(write(edited(("range_deg: [-20, 60]", "range_deg: [-10, 30]")))))
    with pytest.raises(InputError, match="at jib = 1.047 its piston would be at .* outside its str"):
        check_strokes(load_machine(write(edited(("range_deg: [-20, 60]", "range_deg: [-10, 60]")))))


def test_a_chain_of_too_many_links_is_refused(write):
    data = yaml.safe_load(CRANE)
    first = next(iter(data["links"]))
    body = {"mass": 1.0, "com": [0.0, 0.0, 0.0], "inertia": [0.1, 0.1, 0.1]}
    data["links"] |= {f"q{k}": body | {"parent": f"q{k - 1}" if k else first} for k in range(1500)}
    message = refusal(write(yaml.safe_dump(data)))
    assert f"links: {len(data['links'])} links of a machine, at most 200; HYDROTELE_MAX_LINKS=" in message
