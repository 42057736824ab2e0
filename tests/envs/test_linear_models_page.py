"""The regulator of docs/linear_models.md in the environment, as printed."""

import re
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "linear_models.md"


def test_the_regulator_of_the_page_tracks_better_than_a_proportional_controller(capsys):
    first, second = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    values = {}
    exec(first, values)
    assert values["response"].shape == (3, 1, 1)
    exec(second.replace("range(6)", "range(1)"), values)
    values["env"].close()
    proportional, quadratic = map(float, re.findall(r"tip error ([\d.]+) mm", capsys.readouterr().out))
    assert quadratic < 0.5 * proportional  # 6 and 32 mm over six episodes
