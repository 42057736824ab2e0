"""Importers as plug-ins: they read further formats; mapping, units and messages are those of every import."""

import importlib.metadata

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.importers import plugin_importers
from hydrotele.importers.conversion import import_log
from hydrotele.importers.plugin_importers import Importer, make_recording
from hydrotele.machine.log_columns import LogColumn

COLUMNS = {"lift": LogColumn(channel="angle.boom")}


def read_acme(path):
    time = np.arange(30) / 10.0
    return make_recording(path, time, {"lift": 10.0 * time, "other": time}, {"lift": "deg"})


def read_short(path):
    return make_recording(path, np.arange(30) / 10.0, {"lift": np.zeros(3)})


def read_badly(path):
    return [][3]


ACME, SHORT, BAD = (Importer((".acme",), read) for read in (read_acme, read_short, read_badly))
WRONG = read_acme


@pytest.fixture
def provide(monkeypatch, tmp_path):
    def provide(name):
        entry = importlib.metadata.EntryPoint("acme", f"{__name__}:{name}", plugin_importers.PLUGIN_GROUP)
        monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [entry])
        monkeypatch.setattr("hydrotele.core.plugins.Plugin.load", lambda plugin: globals()[name])
        (tmp_path / "run.ACME").write_text("")
        return tmp_path / "run.ACME"

    return provide


def test_a_plugin_reads_a_further_format(provide):
    log, report = import_log([provide("ACME")], COLUMNS)
    assert log["angle.boom"][-1] == pytest.approx(np.radians(29.0)) and len(log) == 30
    assert report.ignored == {"other": 30}


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("SHORT", r"plug-in acme .*returned \(3,\) values of lift for 30 times"),
        ("BAD", "plug-in acme of the package .* cannot read it: IndexError"),
        ("WRONG", "is not a hydrotele.Importer"),
    ],
)
def test_a_broken_plugin_is_named(provide, name, said):
    with pytest.raises(InputError, match=said):
        import_log([provide(name)], COLUMNS)


def test_files_of_known_formats_do_not_load_plugins(provide, tmp_path):
    provide("WRONG")
    (tmp_path / "log.csv").write_text("time,angle.boom\n" + "\n".join(f"{0.1 * i},{0.01 * i}" for i in range(20)))
    assert len(import_log([tmp_path / "log.csv"], {})[0]) == 20
    (tmp_path / "log.xyz").write_text("")
    with pytest.raises(InputError, match="is not a hydrotele.Importer"):
        import_log([tmp_path / "log.xyz"], {})
