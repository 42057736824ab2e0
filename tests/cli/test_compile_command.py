"""Child processes of `hydrotele compile`."""

from hydrotele.cli.compile_command import read_last_error_line, start_python


def test_a_process_with_many_warnings_ends_and_tells_its_error(tmp_path):
    code = "import sys; sys.stderr.write('warning\\n' * 50_000); raise SystemExit('no compiler')"
    process = start_python(code, tmp_path / "job")
    assert process.wait(timeout=60) == 1  # 400 KB would block a pipe that nobody reads
    assert read_last_error_line(process, tmp_path / "job") == "no compiler"


def test_a_process_that_ends_without_a_word_states_its_exit_status(tmp_path):
    process = start_python("raise SystemExit(3)", tmp_path / "job")
    process.wait(timeout=60)
    assert read_last_error_line(process, tmp_path / "job") == "exit status 3"
