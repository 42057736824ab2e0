"""PNG files: of the asked size, not empty, nothing left of failures."""

import os
import struct

import numpy as np
import pytest
from matplotlib.text import Text

from hydrotele.core.errors import InputError
from hydrotele.machine.machine_file import load_machine
from hydrotele.show.log_plots import _png_figure, plot_log, plot_overlay
from hydrotele.show.machine_image import render_machine
from hydrotele.show.recording import write_recording
from hydrotele.show.report_html import figure_to_png, open_report_figure, svg
from hydrotele.show.rerun_viewer import serve_web_viewer, take_screenshot


def _pixels(path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), dtype=float)


def _size(path) -> tuple[int, int]:
    return struct.unpack(">II", path.read_bytes()[16:24])


@pytest.fixture(scope="module")
def recording(tmp_path_factory, machine, log):
    """A small recording."""
    path = tmp_path_factory.mktemp("recording") / "small.rrd"
    write_recording(path, {"measured": (machine, log)})
    return path


def _drawn(function, *arguments, **options):
    """Call a function that needs a driver; skip where this machine has none."""
    try:
        return function(*arguments, **options)
    except InputError as error:
        if "apt-get" in str(error) or "Debian" in str(error):
            pytest.skip(str(error))
        raise


@pytest.mark.daily("overview")
@pytest.mark.parametrize("camera", ["overview", "free"])
def test_a_picture_shows_a_yellow_machine(tmp_path, camera):
    path = tmp_path / "machine.png"
    machine = load_machine("cat215", tool="none")
    _drawn(render_machine, machine, path, {"boom": 0.6}, camera=camera, size=(320, 200))
    assert _size(path) == (320, 200)
    red, green, blue = np.moveaxis(_pixels(path), -1, 0)
    yellow = (red > 120) & (green > 0.5 * red) & (blue < 0.4 * red)
    assert 0.02 < yellow.mean() < 0.6


def test_an_unknown_camera_is_refused_with_the_valid_ones(tmp_path, machine):
    with pytest.raises(InputError, match="overview.*free"):
        render_machine(machine, tmp_path / "x.png", camera="drone")


@pytest.mark.nightly
def test_a_screenshot_shows_the_recording_without_complaints(tmp_path, recording):
    path = tmp_path / "review.png"
    assert _drawn(take_screenshot, recording, path, size=(800, 600), displayed_time=0.5) == ()
    assert _size(path) == (800, 600)
    pixels = _pixels(path)
    assert pixels[:, :400].std() > 20 and pixels[:, 450:].std() > 10  # machine and plots


def test_a_broken_recording_is_refused(tmp_path):
    broken = tmp_path / "broken.rrd"
    broken.write_bytes(b"nothing of use" * 100)
    with pytest.raises(InputError, match="viewer cannot show it"):
        _drawn(take_screenshot, broken, tmp_path / "x.png", size=(400, 300))
    assert [file.name for file in tmp_path.iterdir()] == ["broken.rrd"]


def test_without_a_driver_it_says_what_to_install(tmp_path, recording, monkeypatch):
    monkeypatch.setitem(os.environ, "VK_ICD_FILENAMES", "/nowhere")
    monkeypatch.setitem(os.environ, "VK_DRIVER_FILES", "/nowhere")
    with pytest.raises(InputError, match="mesa-vulkan-drivers"):
        take_screenshot(recording, tmp_path / "x.png", size=(400, 300))
    assert not list(tmp_path.iterdir())


def test_the_web_viewer_is_served_while_wanted(recording):
    import urllib.error
    import urllib.request

    with serve_web_viewer(recording) as url:
        with urllib.request.urlopen(url, timeout=10) as answer:
            assert b"rerun" in answer.read().lower()
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(url, timeout=10)


@pytest.mark.nightly
def test_an_overlay_has_the_asked_size(tmp_path, log, make):
    path = tmp_path / "overlay.png"
    plot_overlay(log, make(log.time, offset=0.05), path, size=(900, 700))
    assert _size(path) == (900, 700)
    assert len(np.unique(_pixels(path).reshape(-1, 3), axis=0)) > 20
    plot_overlay(log, log, path, size=(500, 400))  # nothing differs, and the old file gives way
    assert _size(path) == (500, 400)


def test_logs_without_a_common_channel_are_refused(tmp_path, log):
    with pytest.raises(InputError, match="in common"):
        plot_overlay(log, log, tmp_path / "x.png", kinds=("torque",))
    assert not list(tmp_path.iterdir())


@pytest.mark.nightly
def test_a_log_is_drawn_at_a_glance(tmp_path, log):
    plot_log(log, tmp_path / "log.png", size=(800, 600))
    assert _size(tmp_path / "log.png") == (800, 600)


@pytest.mark.nightly
def test_a_name_with_dollar_signs_is_no_formula(tmp_path):
    """Matplotlib raises an error for a formula that is not complete; labels of powers of ten stay formulas."""
    path = tmp_path / "log.png"
    with _png_figure(path, (200, 100)) as figure:
        figure.text(0.1, 0.5, r"$\frac{1}{$")
    assert path.stat().st_size > 1000
    with open_report_figure(2.0) as figure:
        axes = figure.subplots()
        axes.loglog([1.0, 1e3], [1.0, 1e3], label=r"$\frac{1}{$")
        axes.legend()
        axes.set_title(r"a$b$")
        assert figure_to_png(figure) and svg(figure)
        labels = axes.get_xticklabels() + axes.get_yticklabels()
        formulas = {t for t in figure.findobj(Text) if "$" in t.get_text() and t.get_parse_math()}
        assert formulas and formulas <= set(labels)
