"""What is built is complete: code, machines and scenarios in the wheel, everything in the sdist."""

import os
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tools.release.build_wheel import add_compiled_code

ROOT = Path(__file__).resolve().parent.parent

pytest.importorskip("hatchling", reason="the test extra is not installed")


def run(*command: str | Path, **options) -> str:
    """Run a command and return its output; the output is also the message when it fails."""
    done = subprocess.run(
        [str(part) for part in command],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        **options,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def pip(*arguments: str | Path) -> None:
    run(sys.executable, "-m", "pip", "--no-input", *arguments, cwd=ROOT)


def shipped(folder: str) -> set[str]:
    """Files under a folder of the repository, as paths relative to the repository root."""
    return {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    pip("wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, ".")
    (built,) = folder.glob("*.whl")
    return built


def test_wheel_has_the_package_machines_and_scenarios_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    data = {f"hydrotele/{name}" for name in shipped("models") | shipped("scenarios")}
    assert "hydrotele/models/cat215/machine.yaml" in data
    assert names == shipped("hydrotele") | data


def test_every_machine_folder_has_its_numbers():
    folders = {path.name for path in (ROOT / "models").iterdir() if path.is_dir()}
    assert folders
    numbers = [
        *(ROOT / "models").glob("*/machine.yaml"),
        *(ROOT / "models").glob("*/joystick.yaml"),
        *(ROOT / "models").glob("*/iwr.yaml"),
    ]
    plain = {name for name in folders if (ROOT / "models" / name / f"{name}.xml").is_file()}
    assert list((ROOT / "models/robots").glob("*.yaml"))
    # A plain MJCF, such as PaLiDA's, holds its numbers itself.
    named = {path.parent.name for path in numbers}
    assert named <= folders
    assert folders - named - plain == {"robots"}


def test_installed_wheel_finds_its_machines_from_any_folder(wheel, tmp_path):
    site = tmp_path / "site"
    pip("install", "--quiet", "--no-deps", "--no-index", "--target", site, wheel)
    script = (
        "from hydrotele.core import files\n"
        "print(files.__file__)\n"
        "print(*sorted(p.name for p in files.models_folder().glob('*/machine.yaml')))\n"
        "print(files.models_folder())\n"
    )
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(site)}
    lines = run(sys.executable, "-c", script, cwd=elsewhere, env=environment).splitlines()
    assert lines == [
        str(site / "hydrotele" / "core" / "files.py"),
        " ".join(["machine.yaml"] * len(list((ROOT / "models").glob("*/machine.yaml")))),
        str(site / "hydrotele" / "models"),
    ]
    assert (site / "bin" / "hydrotele").is_file()


def test_wheel_with_compiled_code_can_be_installed(wheel, tmp_path):
    folder = tmp_path / "compiled" / "hydrotele.module_0123456789abcdef"
    folder.mkdir(parents=True)
    (folder / "law-5.fedcba9876543210.code").write_bytes(b"code")
    (folder / "law-5.python.lock").touch()
    (tmp_path / "compiled" / "complete_0123").touch()
    tag = f"cp{sys.version_info.major}{sys.version_info.minor}"
    made = add_compiled_code(wheel, tmp_path / "compiled", tag, tmp_path)
    pip("install", "--quiet", "--no-deps", "--no-index", "--target", tmp_path / "site", made)
    installed = tmp_path / "site" / "hydrotele" / "compiled_code"
    names = {path.relative_to(installed).as_posix() for path in installed.rglob("*") if path.is_file()}
    assert names == {"complete_0123", f"{folder.name}/law-5.fedcba9876543210.code"}
    assert (tmp_path / "site/hydrotele/models/cat215/machine.yaml").is_file()


@pytest.mark.nightly
def test_sdist_is_complete_and_builds_the_same_wheel(wheel, tmp_path):
    run(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", tmp_path, cwd=ROOT)
    (built,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(built) as archive:
        archive.extractall(tmp_path, filter="data")
    (unpacked,) = (path for path in tmp_path.iterdir() if path.is_dir())
    for folder in ("hydrotele", "models", "scenarios", "tests", "tools", ".ci"):
        missing = {name for name in shipped(folder) if not (unpacked / name).is_file()}
        assert missing == set()
    for name in ("LICENSE", "README.md", "CHANGELOG.md", "pyproject.toml", "uv.lock"):
        assert (unpacked / name).is_file()
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", cwd=unpacked)
    (again,) = (unpacked / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as first, zipfile.ZipFile(again) as second:
        assert set(first.namelist()) == set(second.namelist())


@pytest.fixture(scope="module")
def lock() -> dict[str, list[dict]]:
    """Packages of uv.lock by name; several where different Pythons get different versions."""
    found: dict[str, list[dict]] = {}
    for package in tomllib.loads((ROOT / "uv.lock").read_text(encoding="utf-8"))["package"]:
        found.setdefault(package["name"], []).append(package)
    return found


def test_lock_holds_every_declared_dependency(lock):
    # tools/setup refuses a lock that is behind pyproject.toml, and then nothing can be set up.
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    texts = list(project["project"]["dependencies"])
    texts += [text for extra in project["project"]["optional-dependencies"].values() for text in extra]
    declared = {canonicalize_name(Requirement(text).name) for text in texts}
    texts += [text for group in project["dependency-groups"].values() for text in group]
    stale = []
    for text in texts:
        wanted = Requirement(text)
        versions = [p["version"] for p in lock.get(canonicalize_name(wanted.name), [])]
        if not versions or not all(map(wanted.specifier.contains, versions)):
            stale.append(f"{text}: {versions} in uv.lock; run tools/setup --lock")
    assert stale == []
    (own,) = lock["hydrotele"]
    assert {one["name"] for one in own["metadata"]["requires-dist"]} == declared


def test_lock_names_the_public_index_only(lock):
    (own,) = lock["hydrotele"]
    assert own["source"] == {"editable": "."}
    for name in lock.keys() - {"hydrotele"}:
        for package in lock[name]:
            assert package["source"] == {"registry": "https://pypi.org/simple"}
            files = [package["sdist"]] if "sdist" in package else []
            for file in files + package.get("wheels", []):
                assert file["url"].startswith("https://files.pythonhosted.org/")
                assert file["hash"].startswith("sha256:")
