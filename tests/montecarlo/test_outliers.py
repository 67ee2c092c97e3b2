"""What the issue promises of outliers, from the data alone; figures in `outlier_study`."""

from __future__ import annotations

import pytest
from outlier_study import KINDS, outlier_study, table_row


def test_the_study_runs():
    """Two captures, so that it does not break unnoticed."""
    for share, kind in ((0.0, "uniform"), (0.1, "ghost")):
        tally = outlier_study(90, share, kind, range(1))
        assert tally.reached == tally.precision == tally.recall == 1.0
        assert tally.silent == 0
        assert "reached 100.0 %" in table_row(share, kind, tally, range(1))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("spots", "seeds", "robust"), [(90, 40, "auto"), (90, 40, "gnc-tls"), (900, 10, "auto")]
)
def test_a_fifth_of_outliers_without_a_start(spots, seeds, robust, kind):
    tally = outlier_study(spots, 0.2, kind, range(seeds), robust)
    print(table_row(0.2, kind, tally, range(seeds)))
    assert tally.reached >= 0.99
    assert tally.precision >= 0.98
    assert tally.recall >= 0.98
    assert tally.silent == 0
