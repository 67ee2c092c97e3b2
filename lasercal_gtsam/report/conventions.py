"""Frames, units and orders: what every number of a calibration means to somebody who loads it."""

from __future__ import annotations

from typing import Any

_GROUPS: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = (
    (
        "Frames",
        (
            (
                "base",
                "The robot's base, which is the world here. All planes and cameras are in it.",
            ),
            (
                "hand",
                "What the controller reports as the pose: flange or tool, as it was set when the "
                "capture was taken. The beam is in it.",
            ),
            (
                "camera",
                "Optical frame: origin at the centre of projection, z forward, x right and y down "
                "in the picture.",
            ),
            (
                "plane",
                "normal . x = distance in base coordinates, unit normal, distance not negative. "
                "The table's vector a is distance times normal.",
            ),
            (
                "T_base_camera",
                "Maps camera coordinates into base coordinates: x_base = T x_camera.",
            ),
            ("T_base_hand", "Maps hand coordinates into base coordinates."),
        ),
    ),
    (
        "Units",
        (
            ("files and Python", "Metres, radians, pixels."),
            ("this report and the table", "Millimetres, degrees, pixels."),
            ("1", "A number without a unit: distortion terms, alpha_c."),
        ),
    ),
    (
        "Rotations",
        (
            ("matrix", "Columns are the camera's axes in base coordinates."),
            ("quat_wxyz", "w first. (ROS, SciPy and evo have w last.)"),
            (
                "theta, phi, psi",
                "Degrees, R = Rz(theta) Ry(phi) Rx(psi): the same as a URDF's rpy = (psi, phi, "
                "theta) and as KUKA's A, B, C.",
            ),
        ),
    ),
    (
        "Pictures",
        (
            (
                "pixel",
                "u to the right, v down; (0, 0) is the centre of the top-left pixel, as in OpenCV, "
                "ROS and mrcal.",
            ),
            (
                "projection",
                "x = X/Z, y = Y/Z; distorted by k1, k2 (radial) and p1, p2 (tangential); then "
                "u = fu xd + skew yd + u0, v = fv yd + v0. OpenCV's distCoeffs are k1, k2, p1, p2, "
                "0; it has no skew.",
            ),
            ("alpha_c", "skew / fu, without a unit. The file has the skew itself, in pixels."),
            ("residual", "Predicted minus seen pixel."),
        ),
    ),
    (
        "Beam",
        (
            ("direction_hand", "Unit vector along which the light runs, in the hand."),
            ("point_hand_m", "Any point on the beam, in the hand."),
            (
                "laser_theta, laser_phi",
                "Azimuth about the hand's z axis and angle from it. Where the beam runs along z "
                "the table has laser_tilt_x and laser_tilt_y.",
            ),
            (
                "laser_y, laser_z",
                "Where the beam crosses the hand's x = 0 plane; another plane, and so other "
                "letters, where it hardly crosses that one.",
            ),
        ),
    ),
    (
        "Uncertainty",
        (
            ("sigma", "One standard deviation, scaled by the residuals. 0 means held, not exact."),
            (
                "sigma0",
                "Sigma of a pixel coordinate where none was stated; else a factor on what was.",
            ),
            (
                "covariance",
                "Of all unknowns together, in metres, radians, pixels; rows are named by its "
                "labels. camera.rot_* and camera.trans_* are small turns and shifts in the "
                "camera's own frame, applied on the right of T_base_camera; turns come first.",
            ),
            (
                "slope, offset",
                "The beam's two small slopes and two shifts across itself, in the hand.",
            ),
            (
                "normal_1, normal_2, distance",
                "The plane's two small tilts, about two axes across its normal, and its distance.",
            ),
            (
                "expected error",
                "Root of the mean squared distance of a located point from the true one.",
            ),
            ("rms", "Root of the mean squared length of the residuals of the spots used (pixels)."),
        ),
    ),
)


def conventions_section() -> dict[str, Any]:
    """The page of conventions; the same for every calibration."""
    return {
        "heading": "Conventions",
        "words": [],
        "missing": None,
        "groups": [
            {
                "heading": heading,
                "items": [{"term": term, "words": words} for term, words in items],
            }
            for heading, items in _GROUPS
        ],
    }
