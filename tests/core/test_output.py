"""Folders appear whole or not at all, replace only their own kind, and clean up after the dead."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hydrotele.core.errors import InputError
from hydrotele.core.files import resolve_path
from hydrotele.core.output import atomic_file, atomic_folder, check_output_folder


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def write(target: Path, text: str = "{}") -> None:
    with atomic_folder(target, "run") as folder:
        (folder / "measured.parquet").write_text(text)
        (folder / "summary.json").write_text('{"kind": "run"}')


def test_appears_at_the_end(tmp_path):
    with atomic_folder(tmp_path / "deep" / "run", "run") as folder:
        (folder / "summary.json").write_text("{}")
        assert not (tmp_path / "deep" / "run").exists()
    assert names(tmp_path / "deep") == ["run"]
    assert (tmp_path / "deep" / "run").stat().st_mode & 0o055 == 0o055  # others may read it


def test_replaces_its_own_kind_wholly(tmp_path):
    write(tmp_path / "run", "1")
    (tmp_path / "run" / "truth.parquet").write_text("left over")
    write(tmp_path / "run", "2")
    assert names(tmp_path / "run") == ["measured.parquet", "summary.json"]
    assert (tmp_path / "run" / "measured.parquet").read_text() == "2" and names(tmp_path) == ["run"]


def test_keeps_what_no_run_wrote(tmp_path):
    """Notes in a run folder, and a run folder where a replay should go, are left alone."""
    write(tmp_path / "run", "1")
    with pytest.raises(InputError, match="was not written by a replay; choose another --out"):
        check_output_folder(tmp_path / "run", "replay")
    (tmp_path / "run" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="contains notes.txt, not written by a run"):
        write(tmp_path / "run", "2")
    assert names(tmp_path / "run") == ["measured.parquet", "notes.txt", "summary.json"]
    assert (tmp_path / "run" / "measured.parquet").read_text() == "1"


def test_empty_folder_may_be_used(tmp_path):
    (tmp_path / "run").mkdir()
    write(tmp_path / "run")
    assert names(tmp_path) == ["run"]


def test_refuses_what_is_not_its_own(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    (tmp_path / "file").write_text("x")
    for target in ("mine", "file"):
        with pytest.raises(InputError, match="not written by a run; choose another --out"):
            write(tmp_path / target)
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years of work"
    assert names(tmp_path) == ["file", "mine"]


def test_a_link_in_a_loop_is_refused(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    for target in ("a", "a/run"):
        with pytest.raises(InputError, match=f"{target}: cannot be created: {tmp_path}/[ab] is not a writable folder"):
            check_output_folder(tmp_path / target, "run")
    assert resolve_path(tmp_path / "a") == tmp_path / "a"


def test_a_folder_that_is_not_of_the_kind_is_not_searched(monkeypatch):
    """`--out /` would list all files of the computer."""
    monkeypatch.setattr(Path, "rglob", lambda *_: pytest.fail("searched"))
    with pytest.raises(InputError, match="^/: exists and was not written by a run; choose another --out$"):
        check_output_folder("/", "run")


def test_link_is_followed(tmp_path):
    """The folder behind a link is replaced, the link stays."""
    write(tmp_path / "run", "1")
    (tmp_path / "latest").symlink_to("run")
    write(tmp_path / "latest", "2")
    assert (tmp_path / "latest").is_symlink() and (tmp_path / "run" / "measured.parquet").read_text() == "2"
    assert names(tmp_path) == ["latest", "run"]


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), RuntimeError("x"), SystemExit(1)])
def test_failure_leaves_nothing_and_the_old_one(failure, tmp_path):
    write(tmp_path / "run", "1")
    for target in ("run", "new"):
        with pytest.raises(type(failure)), atomic_folder(tmp_path / target, "run") as folder:
            (folder / "measured.parquet").write_text("half")
            raise failure
    assert names(tmp_path) == ["run"] and (tmp_path / "run" / "measured.parquet").read_text() == "1"


def test_full_disk_is_an_error_of_the_user(tmp_path):
    write(tmp_path / "run", "1")
    with pytest.raises(InputError, match="run: cannot be written, output removed: .*No space left"):
        with atomic_folder(tmp_path / "run", "run") as folder:
            (folder / "measured.parquet").write_text("half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert names(tmp_path) == ["run"] and (tmp_path / "run" / "measured.parquet").read_text() == "1"


def test_failing_rename_keeps_the_old_one(tmp_path, monkeypatch):
    """Whatever happens while changing places, no half folder has the final name."""
    write(tmp_path / "run", "1")
    real = Path.rename

    def fail(self, target):
        if Path(target).name == "run" and "old" not in self.name:
            raise OSError(errno.EIO, "I/O error")
        return real(self, target)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(InputError, match="cannot be written"):
        write(tmp_path / "run", "2")
    monkeypatch.undo()
    assert (tmp_path / "run" / "measured.parquet").read_text() == "1"
    assert names(tmp_path) == ["run"]


def test_place_where_nothing_can_be_made(tmp_path):
    (tmp_path / "file").write_text("x")
    for target in (tmp_path / "file" / "run", tmp_path / "file" / "a" / "run"):
        with pytest.raises(InputError, match="cannot be created: .*file is not a writable folder"):
            check_output_folder(target, "run")
        with pytest.raises(InputError, match="cannot be created"):
            write(target)


def test_folder_without_permission(tmp_path, monkeypatch):
    """Seen before the simulation where the system tells, else when the folder is made."""
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(InputError, match=f"cannot be created: {tmp_path} is not a writable folder"):
        check_output_folder(tmp_path / "run", "run")
    monkeypatch.undo()

    def refuse(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("hydrotele.core.output.tempfile.mkdtemp", refuse)
    with pytest.raises(InputError, match="run: cannot be created: Permission denied"):
        write(tmp_path / "run")


def test_left_over_parts_of_the_dead_are_removed(tmp_path):
    """Parts of killed runs of this name go, those of running ones and of other names stay."""
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    here = os.getppid()
    keep = [f".run.{here}.abcd_123.part", f".other.{dead.pid}.abcd_123.part", ".run.part"]
    for name in (*keep, f".run.{dead.pid}.abcd_123.part", f".run.{dead.pid}.abcd_123.old.part"):
        (tmp_path / name).mkdir()
    write(tmp_path / "run")
    assert names(tmp_path) == sorted([*keep, "run"])


def test_odd_names(tmp_path):
    """A name is a name, not a pattern."""
    (tmp_path / f".other.{2**22}.abc.part").mkdir()
    for name in ("*", "[a]", "a b", "ä", ".hidden", "-x"):
        write(tmp_path / name)
        assert (tmp_path / name / "measured.parquet").is_file()
    assert (tmp_path / f".other.{2**22}.abc.part").is_dir()


def test_file_appears_whole_or_not_at_all(tmp_path):
    (tmp_path / "measured.parquet").write_text("old")
    with pytest.raises(RuntimeError), atomic_file(tmp_path / "measured.parquet", "") as part:
        part.write_text("half")
        raise RuntimeError
    assert names(tmp_path) == ["measured.parquet"] and (tmp_path / "measured.parquet").read_text() == "old"
    with atomic_file(tmp_path / "measured.parquet", ".parquet") as part:
        part.write_text("new")
    assert names(tmp_path) == ["measured.parquet"] and (tmp_path / "measured.parquet").read_text() == "new"
    for path, suffix, message in (
        ("measured.parquet", ".png", "ends in .png"), ("no/measured.parquet", "", "not a folder"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message), atomic_file(tmp_path / path, suffix):
            pass


def test_a_users_own_hidden_folder_is_not_removed(tmp_path):
    """Only what a killed run of that name left behind is."""
    own, left = tmp_path / ".a.mine.part", tmp_path / ".a.999999999.abcd_123.part"
    for folder in (own, left):
        folder.mkdir()
        (folder / "notes.txt").write_text("kept")
    with atomic_folder(tmp_path / "a", "run") as part:
        (part / "summary.json").write_text('{"kind": "run"}')
    assert (own / "notes.txt").is_file() and not left.exists()
