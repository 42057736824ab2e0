"""The report is one file that needs nothing else, and holds the numbers of the Gap."""

import base64
import dataclasses
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from hydrotele.show import gap_report
from hydrotele.show.gap_report import write_report
from hydrotele.show.prediction_errors import channel_rms, find_gap_windows, find_most_improved_channels, windowed_errors

_VOID = {"meta", "img", "line", "circle", "rect", "i", "br"}


class _Page(HTMLParser):
    """Collects texts, pictures and links, and checks that elements nest."""

    def __init__(self, text: str):
        super().__init__()
        self.words, self.pictures, self.links, self.ids = [], [], [], []
        self._open = []
        self.feed(text)
        assert self._open == []
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        facts = dict(attrs)
        self.links += [v for k, v in attrs if k in ("href", "src", "srcset", "data")]
        if tag == "img":
            self.pictures.append(facts["src"])
        if tag not in _VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        if tag not in _VOID:
            assert self._open.pop() == tag

    def handle_data(self, data):
        if self._open and self._open[-1] != "style":
            self.words.append(data)


@pytest.fixture(scope="module")
def page_of(tmp_path_factory, gap_of):
    folder = tmp_path_factory.mktemp("reports")

    def page(verdict, rastered=True, **changes):
        """A page whose figures are drawn, and made pixels of where a test looks at those."""
        path = folder / "report.html"
        with pytest.MonkeyPatch.context() as patched:
            if not rastered:
                patched.setattr(gap_report, "figure_to_png", lambda figure: b"")
            write_report(dataclasses.replace(gap_of(verdict), **changes), path)
        return _Page(path.read_text(encoding="utf-8")), path.read_text(encoding="utf-8")

    return page


@pytest.fixture(scope="module")
def named(page_of):
    return page_of("named")


@pytest.mark.nightly
def test_it_needs_no_network(named):
    page, text = named
    assert page.links and all(link.startswith("data:image/png;base64,") for link in page.links)
    assert not re.search(r"https?://|@import|url\(|<script", text)


@pytest.mark.nightly
def test_every_picture_decodes(named):
    from PIL import Image

    page, _ = named
    assert len(page.pictures) == 5  # four channels and the heat map
    for source in page.pictures:
        data = base64.b64decode(source.partition(",")[2], validate=True)
        with Image.open(io.BytesIO(data)) as image:
            pixels = np.asarray(image.convert("RGB"), dtype=float)
        assert pixels.shape[1] > 2000 and pixels.std() > 10  # sharp on paper, not empty


@pytest.mark.nightly
def test_numbers_appear(named, gap_of):
    page, gap = named[0], gap_of("named")
    for piece in ("251.3", "247.9 to 254.6", f"{gap.size.before:.2f} × noise", "over 99.9 %"):
        assert piece in page.text
    for value in channel_rms(gap.before[0]):
        assert f"{value:.2f}" in page.text
    assert "8.4 ×" in page.text and "21 kN m" in page.text  # the force balance of the boom
    assert "81,222" in page.text and "autocorrelation" in page.text
    assert "fit_2: 1.0 % of the rows are missing." in page.text
    assert "--machine patched/" in page.text and "nan" not in page.text.lower().split()


def test_no_gap_has_no_patch_and_shows_one_model(page_of):
    page, _ = page_of("no_gap", rastered=False)
    assert "Model and machine agree" in page.text and "patched/" not in page.text
    assert "Effects that explain the difference" not in page.text


def test_an_unknown_has_its_section(page_of):
    page, _ = page_of("unknown", rastered=False)
    for piece in (
        "Unexplained difference",
        "3.0 to 4.6 s",
        "boom piston position",
        "balance of forces",
    ):
        assert piece in page.text


def test_a_partly_named_gap_shows_calibration_laws_and_what_is_left(page_of):
    page, _ = page_of("partly")
    for piece in (
        "Partly identified", "63 %", "Calibrated parameters", "valve gain of the boom: ratio",
        "103.5", "Laws learned from the data", "Force on the boom drive over position",
        "-3e+05 above(position, 0.55)", "31 % of the gap", "Residual forces", "2.1 kN",
        "Noise of the measurements", "not stated", "1.20",
    ):  # fmt: skip
        assert piece in page.text, piece
    assert len(page.pictures) == 6  # the law's besides those of every report


def test_an_ambiguity_has_its_alternatives_and_experiment(page_of):
    page, _ = page_of("ambiguous", rastered=False)
    for piece in ("pin offset of the boom", "37 %", "Next experiment:", "commands: {boom: 0.2}"):
        assert piece in page.text


def test_texts_are_escaped(page_of):
    page, text = page_of("named", rastered=False, notes=("<b>x</b> & 1 < 2",))
    assert "<b>x</b> & 1 < 2" in page.text and "&lt;b&gt;x&lt;/b&gt; &amp; 1 &lt; 2" in text


@pytest.mark.nightly
def test_missing_readings_and_channels_are_shown_as_such(page_of, gap_of):
    def holed(prediction):
        measured, whitened = prediction.measured.copy(), prediction.whitened.copy()
        for array in (measured, whitened):
            array[::7] = np.nan
            array[:, 1] = np.nan
        return dataclasses.replace(prediction, measured=measured, whitened=whitened)

    gap = gap_of("named")
    page, _ = page_of("named", before=(holed(gap.before[0]),), after=(holed(gap.after[0]),))
    assert "not measured" in page.text and len(page.pictures) == 5


def test_no_data_beside_the_verdict_is_enough(page_of):
    page, _ = page_of("no_gap", ranking=(), laws={}, tests={}, notes=(), before=(), after=())
    assert "Model and machine agree" in page.text and page.pictures == []


def test_windows_find_what_is_planted(gap_of):
    gap = gap_of("named")
    before, after = gap.before[0], gap.after[0]
    found = windowed_errors(before)
    total = np.nansum(found.rms**2 * found.count)
    assert total == pytest.approx(np.nansum(before.whitened**2), rel=1e-12)  # rounding
    loud = find_gap_windows(before, 1.0)
    # six deviations are added from 3.0 to 4.6 s with a wave that is loud all through
    assert any(w.start <= 3.0 and w.stop >= 4.6 and w.channel.endswith(".boom") for w in loud)
    assert find_gap_windows(after, 1.0) == []
    assert {name.partition(".")[2] for name in find_most_improved_channels(before, after, 4)} == {"boom"}
