"""Options of `hydrotele bench`; its figures depend on the computer and are not tested."""

import pytest

from hydrotele.cli.bench_command import run_benchmarks
from hydrotele.core.errors import InputError


def test_comparison_is_refused_with_json_instead_of_ignored(tmp_path):
    with pytest.raises(InputError, match="--compare: cannot be combined with --json"):
        run_benchmarks(None, tmp_path / "earlier.json", quick=True, as_json=True)
