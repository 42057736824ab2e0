"""Devices: what their axes, keys and buttons ask for; what is wrong with a script, and where."""

import sys

import pytest

from hydrotele.core.errors import InputError
from hydrotele.machine.joystick import AXES
from hydrotele.run.devices import (
    CENTRE_KEY,
    KEYS,
    LAYOUTS,
    QUIT_KEY,
    SWITCH_KEYS,
    JoystickDevice,
    Keyboard,
    SwitchedCommands,
    load_script,
    open_device,
)


class Stick:
    """A stick as pygame has it."""

    def __init__(self, axes=6, buttons=11, hats=1):
        self.axes, self.buttons, self.hat = [0.0] * axes, [0] * buttons, (0, 0)
        self._hats = hats

    def get_numaxes(self):
        return len(self.axes)

    def get_axis(self, number):
        return self.axes[number]

    def get_numbuttons(self):
        return len(self.buttons)

    def get_button(self, number):
        return self.buttons[number]

    def get_numhats(self):
        return self._hats

    def get_hat(self, number):
        return self.hat


class Sticks:
    """What pygame would find, with a cable that can be pulled."""

    def __init__(self, stick):
        self.stick, self.news, self.closed = stick, False, False

    def find(self, kind):
        return self.stick

    def poll_connections(self):
        news, self.news = self.news, False
        return news

    def plug(self, stick):
        self.stick, self.news = stick, True

    def close(self):
        self.closed = True


def asked(reading):
    return dict(zip(AXES, reading.axes, strict=True))


def test_keys_nudge_until_the_space_bar_centres():
    keys = Keyboard(2)
    up, down = (code for code, (_, axis, _) in KEYS.items() if axis == "x")
    for _ in range(3):
        keys.press(up)
    keys.press(down)
    keys.press(57)
    assert asked(keys.read(0.0)) == dict.fromkeys(AXES, 0.0) | {"x": 0.5}
    assert keys.read(1.0).commands == (0.0, 1.0)  # and stays
    for _ in range(9):
        keys.press(up)
    assert asked(keys.read(1.0))["x"] == 1.0
    keys.press(CENTRE_KEY)
    assert keys.read(1.0) == Keyboard(2).read(0.0)
    keys.press(QUIT_KEY)
    assert keys.read(1.0).quit


def test_every_key_is_there_once_and_both_ways():
    codes = [*KEYS, *SWITCH_KEYS, CENTRE_KEY, QUIT_KEY]
    assert len(codes) == len(set(codes))
    ways = {(axis, way) for _, axis, way in KEYS.values()}
    assert ways == {(axis, way) for axis in ("x", "y", "z", "rx", "ry") for way in (-1.0, 1.0)}


def test_gamepad_has_a_dead_zone_and_goes_all_the_way():
    stick = Stick()
    pad = JoystickDevice("gamepad", Sticks(stick), 2)
    stick.axes[1], stick.axes[0] = -0.11, 1.0
    reading = asked(pad.read(0.0))
    assert reading["x"] == 0.0 and reading["y"] == -1.0  # left is positive
    stick.axes[1] = -0.56
    assert asked(pad.read(0.0))["x"] == 0.5  # half of what lies outside 0.12
    stick.buttons[4] = 1
    assert asked(pad.read(0.0))["rx"] == 1.0


def test_gamepad_switches_once_for_each_press():
    stick = Stick()
    pad = JoystickDevice("gamepad", Sticks(stick), 2)
    stick.hat = (0, 1)
    assert [pad.read(0.0).commands for _ in range(3)] == [(1.0, 0.0)] * 3  # held, not repeated
    stick.hat = (-1, 0)
    assert pad.read(0.0).commands == (1.0, -1.0)
    stick.buttons[1] = 1
    assert pad.read(0.0).commands == (0.0, 0.0)
    stick.buttons[7] = 1
    assert pad.read(0.0).quit


def test_spacemouse_turns_a_command_on_off_and_back():
    stick = Stick(buttons=2, hats=0)
    mouse = JoystickDevice("spacemouse", Sticks(stick), 1)
    seen = []
    for pressed in (1, 0, 1, 0, 1, 0):
        stick.buttons[0] = pressed
        seen.append(mouse.read(0.0).commands[0])
    assert seen == [1.0, 1.0, 0.0, 0.0, -1.0, -1.0]
    stick.buttons[:] = 1, 1
    assert mouse.read(0.0).commands == (0.0,)
    stick.axes[2] = -1.0
    assert asked(mouse.read(0.0))["z"] == 1.0  # pulled up


def test_each_axis_has_its_own_cycle():
    switches = SwitchedCommands(2)
    seen = []
    for _ in range(5):
        for number in (0, 1):
            switches.cycle_command(number)
        seen.append(tuple(switches.commands))
    assert seen == [(1.0, 1.0), (0.0, 0.0), (-1.0, -1.0), (0.0, 0.0), (1.0, 1.0)]


def test_unplugged_pad_lets_go_says_so_once_and_comes_back():
    stick = Stick()
    sticks = Sticks(stick)
    pad = JoystickDevice("gamepad", sticks, 1)
    stick.axes[1], stick.hat = -1.0, (0, 1)
    assert asked(pad.read(0.0))["x"] == 1.0
    sticks.plug(None)
    gone = pad.read(0.1)
    assert gone.axes == (0.0,) * 6 and gone.commands == (0.0,) and "unplugged" in gone.user_message
    assert pad.read(0.2).user_message == ""
    sticks.plug(stick)
    back = pad.read(0.3)
    assert asked(back)["x"] == 1.0 and "is connected again" in back.user_message
    pad.close()
    assert sticks.closed


def test_small_pad_lacks_what_it_lacks():
    """A pad of two axes and one button asks for no more than it can."""
    stick = Stick(axes=2, buttons=1, hats=0)
    stick.axes[:] = 0.0, -1.0
    assert asked(JoystickDevice("gamepad", Sticks(stick), 1).read(0.0))["x"] == 1.0


@pytest.mark.parametrize("kind", LAYOUTS)
def test_nothing_plugged_in(kind):
    sticks = Sticks(None)
    with pytest.raises(InputError, match=f"--device {kind}: is not connected"):
        JoystickDevice(kind, sticks, 0)
    assert sticks.closed


def test_missing_pygame_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(InputError, match=r"pip install 'hydrotele\[drive\]'"):
        open_device("gamepad", ())


def test_unknown_device():
    with pytest.raises(InputError, match="did you mean 'gamepad'"):
        open_device("gamepda", ())


def test_script_holds_or_runs_evenly(tmp_path):
    path = tmp_path / "s.csv"
    path.write_text("time,x,saw\n0,0.5,0\n\n1,-1,1\n2,0,0\n")
    device = open_device(f"scripted:{path}", ("grab", "saw"))
    assert asked(device.read(0.99))["x"] == 0.5 and device.read(1.0).commands == (0.0, 1.0)
    assert not device.read(1.99).quit and device.read(2.0).quit
    path = tmp_path / "s.yaml"
    path.write_text("time: [0, 2]\naxes: {z: [0, 1]}\ninterpolate: linear\n")
    assert asked(open_device(f"scripted:{path}", ()).read(0.5))["z"] == 0.25


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("s.csv", "time,x\n0,0\n1,up\n", r"s\.csv, line 3, column 'x': 'up' is not a number"),
        ("s.csv", "time,x\n0,0\n1,nan\n", "line 3, column 'x': nan is not between -1 and 1"),
        ("s.csv", "time,x\n0,1.5\n", "line 2, column 'x': 1.5 is not between"),
        ("s.csv", "time,x\n0.5,1\n", "line 2, column 'time': time must start at 0"),
        ("s.csv", "time,x\n0,1\n0,1\n", "line 3, column 'time': time must increase"),
        ("s.csv", "time,x\n0,1,2\n", "line 2: has 3 cells, not 2"),
        ("s.csv", "x\n0\n", "line 1: has no column 'time'"),
        ("s.csv", "time,x,x\n0,1,1\n", "line 1: repeats the columns x"),
        ("s.csv", "", "line 1: has no column 'time'"),
        ("s.csv", "time\n", "time must start at 0"),
        ("s.csv", "time,sew\n0,1\n", "'sew' is not one of the axes.*did you mean 'saw'"),
        ("s.yaml", "time: [0, 1]\naxes: {x: [0]}\n", "x has 1 values, time has 2"),
        ("s.yaml", "time: [0, 1]\naxes:\n  w: [0, 0]\n", r"s\.yaml:3: axes\.w"),
        ("s.yaml", "time: [0, 1]\naxes:\n  x: [0, 2]\n", r"s\.yaml:3: axes\.x\.1"),
        ("s.yaml", "tiem: [0]\n", "did you mean 'time'"),
        ("s.txt", "", "must be a .csv or a .yaml file"),
    ],
)
def test_bad_scripts(name, text, message, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=f"(?s){message}"):
        open_device(f"scripted:{tmp_path / name}", ("grab", "saw"))


def test_script_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_script(tmp_path / "none.csv")
