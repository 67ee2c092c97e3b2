"""Unit factors used at the edges; inside everything is metres, radians and pixels."""

from __future__ import annotations

import math

MM_PER_M = 1000.0
M_PER_MM = 1e-3
DEG_PER_RAD = 180.0 / math.pi
RAD_PER_DEG = math.pi / 180.0
