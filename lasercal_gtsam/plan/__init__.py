"""Hand poses for a cell that is known roughly: where to point the laser for the best calibration.

`plan` picks poses by what they take off the millimetre error on the working planes; `procedure` is
the paper's way (groups of translations without rotation) within the same limits; `next_poses` goes
on from a calibration that has spots already.
"""

from __future__ import annotations

from lasercal_gtsam.plan.limits import Limits
from lasercal_gtsam.plan.planner import Plan, limits_of, next_poses, plan, procedure

__all__ = ["Limits", "Plan", "limits_of", "next_poses", "plan", "procedure"]
