"""Plug-ins: found by name, loaded when used, and errors that name plug-in and package."""

import importlib.metadata

import pytest

from hydrotele.core.errors import InputError
from hydrotele.core.plugins import find_plugins, load_object

GROUP = "hydrotele.tests"


def provide(monkeypatch, *values: tuple[str, str]) -> None:
    entries = [importlib.metadata.EntryPoint(name, value, GROUP) for name, value in values]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: entries if group == GROUP else [])


def test_plugins_are_found_without_being_loaded(monkeypatch):
    provide(monkeypatch, ("good", "math:pi"), ("broken", "no_such_module:thing"))
    plugins = find_plugins(GROUP)
    assert list(plugins) == ["good", "broken"] and plugins["good"].load() == pytest.approx(3.14159, abs=1e-5)
    with pytest.raises(InputError, match="plug-in broken of the package .*cannot be loaded: ModuleNotFoundError"):
        plugins["broken"].load()


def test_two_packages_cannot_provide_the_same_name(monkeypatch):
    provide(monkeypatch, ("one", "math:pi"), ("one", "math:e"))
    with pytest.raises(InputError, match="same name"):
        find_plugins(GROUP)
    provide(monkeypatch, ("one", "math:pi"), ("one", "math:pi"))  # found twice on the path
    assert list(find_plugins(GROUP)) == ["one"]


def test_objects_of_modules_and_files(tmp_path):
    (tmp_path / "mine.py").write_text("class A:\n    number = 3\n", encoding="utf-8")
    assert load_object("mine.py:A.number", tmp_path) == 3
    assert load_object("math:pi") > 3.0
    for reference, said in (
        ("mine.py:B", "has no B; it has A"), ("other.py:A", "does not exist"), ("math", "module:object"),
        ("no_such_module:x", "cannot be imported: ModuleNotFoundError"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=said):
            load_object(reference, tmp_path)


def test_a_file_that_raises_names_its_error(tmp_path):
    (tmp_path / "bad.py").write_text("1 / 0\n", encoding="utf-8")
    for _ in range(2):  # a failed module is not kept
        with pytest.raises(InputError, match="ZeroDivisionError"):
            load_object("bad.py:x", tmp_path)
