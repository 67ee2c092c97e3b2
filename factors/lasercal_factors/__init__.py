"""GTSAM factors for laser-spot calibration, usable in anybody's own graph. Loaded lazily."""

from __future__ import annotations
