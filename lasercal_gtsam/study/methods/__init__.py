"""The methods that the paper compares with, each on its own kind of data.

All calibrate a fixed camera against the robot base from points that the hand carries and the
camera sees (eye-to-hand), where the laser method sends a beam instead:

==============================  =========================================  =====================
method                          what the hand carries                      what it finds
==============================  =========================================  =====================
`calibrate_ma` (1996)           some points, nobody knows where; the hand  ``K``, camera in base,
                                translates along orthogonal directions     points in hand
`calibrate_malm_heyden`         a known planar pattern; the hand           ``K``, camera in base,
                                translates, a few orientations             pattern in hand
`calibrate_horaud_dornaika`     a known spatial object; any motions        ``K``, camera in base,
                                                                           object in hand
==============================  =========================================  =====================

Closed forms of the first two go on with `refine_views`, the reprojection error.
"""

from __future__ import annotations

from lasercal_gtsam.study.methods.horaud_dornaika import ObjectInHand, calibrate_horaud_dornaika
from lasercal_gtsam.study.methods.ma import calibrate_ma
from lasercal_gtsam.study.methods.malm_heyden import calibrate_malm_heyden
from lasercal_gtsam.study.methods.refine import refine_views
from lasercal_gtsam.study.methods.views import EyeToHand, HandViews

__all__ = [
    "EyeToHand",
    "HandViews",
    "ObjectInHand",
    "calibrate_horaud_dornaika",
    "calibrate_ma",
    "calibrate_malm_heyden",
    "refine_views",
]
