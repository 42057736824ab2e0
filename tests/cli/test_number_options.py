"""Numbers of the command line: each has a declared range, and infinity and NaN are refused everywhere."""

import pytest
from typer.testing import CliRunner

from hydrotele.cli import main as cli
from hydrotele.core.errors import InputError


@pytest.mark.parametrize("number", ["nan", "inf", "-inf", "1e400"])
@pytest.mark.parametrize(
    "words",
    [
        ["haptic-device", "--port", "0", "--duration"],
        ["drive", "--no-viewer", "--speed"],
        ["analyse", "teleop", "--delay"],
        ["calibrate", "hybrid", "--simulate", "x", "--noise"],
    ],
)
def test_infinity_and_nan_are_refused(words, number):
    result = CliRunner().invoke(cli.app, [*words, number])
    error = result.exception
    if isinstance(error, SystemExit):  # not above the declared minimum
        assert error.code == 2 and number in ("nan", "-inf") and "greater than or equal to" in result.output
    else:
        assert isinstance(error, InputError)
        assert str(error) == f"{words[-1]}: must be a finite number, not {float(number)}"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["haptic-device", "--duration", "0"], "greater than or equal to 0.001"),
        (["drive", "--speed", "-1"], "greater than or equal to 0"),
        (["replay", "a.csv", "--timestep", "0"], "greater than or equal to"),
        (["sweep", "a.yaml", "--jobs", "100000"], "less than or equal to 1024"),
        (["review", "a", "--port", "70000"], "less than or equal to 65535"),
        (["identify", "--data", "a", "--truncate", "2"], "less than or equal to 1"),
    ],
)
def test_numbers_out_of_their_range_are_refused(words, said):
    result = CliRunner().invoke(cli.app, words, env={"COLUMNS": "200"})
    assert result.exit_code == 2 and said in " ".join(result.output.replace("│", "").split())


def test_arguments_that_are_not_utf8_are_refused():
    with pytest.raises(InputError, match=r"^a\\udcff: is not valid UTF-8: rename the file or folder$"):
        cli._check_utf8_arguments(["run", "--out", "a\udcff"])
    cli._check_utf8_arguments(["run", "--out", "é"])
