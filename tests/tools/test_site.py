"""The reference of the documentation site is complete: files and keys, channels, effects, commands, Python names."""

import os
import re
import runpy
import shlex
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer.main
from pydantic import BaseModel

import hydrotele
from hydrotele.cli.main import app
from hydrotele.cli.program_help import COMMANDS
from hydrotele.core.datafile import StrictModel
from hydrotele.effects import EFFECTS
from hydrotele.machine.log_channels import MEASURED_KINDS, TRUTH_KINDS
from tools.site import api, channels, commands, effects, files, reference
from tools.site.effect_pictures import SETTINGS, choose_picture, load_scenario_machine

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


def list_subclasses(kind: type) -> set[type]:
    return {kind}.union(*(list_subclasses(inner) for inner in kind.__subclasses__()))


SECTIONS = {name: files.read_sections(kind) for name, kind in files.FILE_KINDS.items()}
NOT_FILES = {
    "InputMessage", "SwitchMessage", "ActionMessage",  # messages of the drive page
    "Soil",  # chosen by name
    "StrictModel",
}  # fmt: skip


def test_every_class_of_a_file_is_described():
    described = {section.name for sections in SECTIONS.values() for section in sections}
    models = {m.__name__ for m in list_subclasses(StrictModel) if m.__module__.startswith("hydrotele.")}
    assert models - described <= NOT_FILES


@pytest.mark.parametrize("name", SECTIONS)
def test_every_key_of_a_file_has_a_meaning(name):
    kind = files.FILE_KINDS[name]
    outermost = [key.name for key in SECTIONS[name][0].keys]
    assert outermost == [key for key in kind.model.model_fields if key not in kind.set_by_program]
    assert [f"{s.name}.{k.name}" for s in SECTIONS[name] for k in s.keys if not k.description] == []


def test_texts_on_keys_name_classes_and_keys_that_exist():
    models: dict[str, type[BaseModel]] = {model.__name__: model for model in list_subclasses(BaseModel)}
    for name, keys in files.KEYS.items():
        if name != "any":
            assert keys.keys() <= models[name].model_fields.keys(), name


def test_a_number_has_its_unit_range_and_default():
    (valve,) = (section for section in SECTIONS["machine_yaml"] if section.name == "Valve")
    values = {key.name: files.format_value(key) for key in valve.keys}
    assert values["rated_flow"] == "number [m^3/s], > 0; **required**"
    assert values["rated_pressure_drop"] == "number [Pa], > 0; default `7e+06`"
    assert values["deadband"] == "number [1], ≥ 0, < 1; default `0`"
    assert values["compensation"] == '`none`, `pressure`; default `"none"`'
    (servo,) = (section for section in SECTIONS["scenario_yaml"] if section.name == "Servo")
    assert {key.name: key.unit for key in servo.keys}["pressure_feedback"] == "1/s"


def test_every_channel_is_listed():
    page = channels.format_page()
    for prefix, kinds in (("", MEASURED_KINDS), ("truth.", TRUTH_KINDS)):
        assert [name for name in kinds if f"`{prefix}{name}" not in page] == []


def test_every_command_and_option_is_listed():
    found = typer.main.get_command(app).commands  # pyright: ignore[reportAttributeAccessIssue]
    pages = commands.list_pages()
    assert set(found) == set(COMMANDS) == {Path(page).stem for page in pages} - {"index"}
    for name, command in found.items():
        for inner in (command, *getattr(command, "commands", {}).values()):
            if not hasattr(inner, "commands"):
                options = [o for p in inner.params if p.param_type_name == "option" and not p.hidden for o in p.opts]
                assert [o for o in options if f"`{o}`" not in pages[f"commands/{name}.md"]] == []


def list_typed_commands(page: Path) -> list[list[str]]:
    """Return the words of every command `hydrotele ...` in the code of a page."""
    code = "\n".join(re.findall(r"^```(?:bash|console)\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S))
    lines = re.findall(r"^[$! ]*hydrotele (.*)", re.sub(r"\\\n", " ", code), re.M)
    return [shlex.split(re.split(r"\s[|>;&]", line)[0], comments=True) for line in lines]


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted(DOCS.glob("*.md"))], ids=lambda page: page.stem)
def test_commands_of_a_page_have_options_that_exist(page):
    for words in list_typed_commands(page):
        command, rest = typer.main.get_command(app), words
        while rest and rest[0] in getattr(command, "commands", {}):
            command, rest = command.commands[rest[0]], rest[1:]  # pyright: ignore[reportAttributeAccessIssue]
        assert words[0].startswith("-") or not hasattr(command, "commands"), words
        known = {o for p in command.params for o in (*p.opts, *p.secondary_opts)} | {
            "--help",
            "-h",
            "--version",
            "--quiet",
        }
        assert [w for w in rest if re.match(r"--?[a-z]", w) and w.split("=")[0] not in known] == [], words


SCREENLESS = """\
hydrotele() {
  case "$*" in
    *my_panda* | train*) ;;  # needs a file of the reader; needs torch
    review*) python -m hydrotele "$@" --plot review.png ;;
    *) python -m hydrotele "$@" ;;
  esac
}
"""


@pytest.mark.nightly
def test_commands_of_the_readme_run(tmp_path):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = [b for b in re.findall(r"^```bash\n(.*?)^```", text, re.M | re.S) if "hydrotele " in b]
    script = SCREENLESS + re.sub(r"^source .*\n", "", "".join(blocks), flags=re.M)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PATH": path}
    command = ["bash", "-ec", script]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "deadband 5.5006 %" in done.stdout + done.stderr  # as in the README


def test_every_effect_has_an_equation_that_names_its_parameters():
    assert sorted(SETTINGS) == sorted(EFFECTS)
    for name, effect in EFFECTS.items():
        picture = choose_picture(name)
        parameters = effect.parameters(load_scenario_machine(picture.scenario), picture.location)
        assert [key for key in parameters if f"`{key}`" not in SETTINGS[name]["symbols"]] == [], name
        assert any(picture.values[key] != parameters[key].nominal for key in picture.values), name


def test_every_public_name_is_on_the_page_of_the_python_api():
    (page,) = api.list_pages().values()
    assert [name for name in hydrotele.__all__ if f":: hydrotele.{name}\n" not in page] == []


def test_every_page_of_the_reference_is_in_an_index(tmp_path):
    pages = {"index.md": reference.INDEX} | reference.list_repository_pages(tmp_path) | reference.list_file_index()
    for module in (files, channels, effects, commands, api):
        pages |= module.list_pages()
    listed = set()
    for path, text in pages.items():
        for block in re.findall(r"^```\{toctree\}\n(.*?)^```", text, re.M | re.S):
            names = [line for line in block.splitlines() if line and not line.startswith(":")]
            listed |= {(Path(path).parent / f"{name}.md").as_posix() for name in names}
    assert listed == pages.keys() - {"index.md"}


@pytest.mark.parametrize("index", [DOCS / "index.md", DOCS / "validation" / "index.md"], ids=["all", "validation"])
def test_every_written_page_is_in_the_contents(index):
    blocks = re.findall(r"^```\{toctree\}\n(.*?)^```", index.read_text(encoding="utf-8"), re.M | re.S)
    entries = [line for block in blocks for line in block.split()]
    pages = {page.stem for page in index.parent.glob("*.md")} - {"index"}
    assert [p for p in sorted(pages) if not any(fnmatch(p, entry) for entry in entries)] == []


def test_links_out_of_the_pages_lead_to_pages_of_the_site():
    rewrite_links = runpy.run_path(str(DOCS / "conf.py"))["rewrite_links"]
    app = SimpleNamespace(env=SimpleNamespace(doc2path=lambda name: DOCS / f"{name}.md"))
    links = {
        "[a](../../models/cat215/README.md#pins)": "[a](/reference/machines/cat215.md#pins)",
        "[b](../../tools/plugin_example)": "[b](/reference/plugin_example.md)",
        "[c](../../tools/studies)": "c",
        "[d](../gap.md)": "[d](../gap.md)",
        "[e](../../LICENSE)": "[e](../../LICENSE)",
    }
    for before, after in links.items():
        text = [before]
        rewrite_links(app, "validation/eha", text)
        assert text == [after]


def test_links_of_copied_pages_stay_valid():
    page = DOCS / "reference" / "machines" / "cat325.md"
    text = reference.copy_page(ROOT / "models" / "cat325" / "README.md", page)
    targets = [m["path"] for m in reference.LINK.finditer(text)]
    assert targets and [t for t in targets if not (page.parent / t).resolve().exists()] == []
