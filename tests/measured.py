"""Where tests find measured logs.

`MEASURED` lies in this repository: an independent simulator's logs of the CAT 215, nominal and with
one thing changed in each of ten folders. `REAL` does not, as its sets belong to others: logs of
real machines beside the checkout, without which their tests are not collected.
"""

from pathlib import Path

import pytest

MEASURED = Path(__file__).resolve().parent / "data" / "measured"
TRUTH = MEASURED / "nominal_truth"
REAL = Path(__file__).resolve().parents[2] / "shared" / "real"
needs_real = pytest.mark.real
