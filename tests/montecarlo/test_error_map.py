"""Is the map of expected error right? Located points against the truth over many captures."""

from __future__ import annotations

import pytest
from error_map_study import POINTS, error_map_study, report_lines

from lasercal_gtsam.simulate import Noise


@pytest.mark.slow
def test_located_points_scatter_as_the_map_says():
    """25 points of each plane within 10 %; 1200 captures know a root mean square to 2 %."""
    found = error_map_study("paper", Noise(pixel_px=0.2), range(1200))
    print("\n".join(report_lines(found)))
    assert found.captures == 1200
    assert len(found.planes) == 3
    assert all(plane.inside.sum() == POINTS for plane in found.planes)
    ratios = found.ratios()
    assert ratios.min() > 0.9 and ratios.max() < 1.1
