"""The paper's Table 2: the sigmas it prints, by test and row (method note 9.3).

Lengths in mm, angles in degrees, pixels; rows that are not known here, or that the test holds
fixed, are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

PRINTED_SIGMAS: dict[str, dict[str, float]] = {
    "Test 1": {"fu": 109.0, "fv": 193.0},
    "Test 2": {
        "fu": 53.7,
        "fv": 73.8,
        "k1": 0.282,
        "k2": 1.74,
        "p1": 0.0114,
        "p2": 0.0158,
        "theta": 0.33,
        "phi": 1.72,
        "psi": 2.07,
        "Tx": 13.1,
        "Ty": 4.39,
        "Tz": 48.6,
        "laser_theta": 0.03,
        "laser_phi": 0.02,
        "laser_y": 0.56,
        "laser_z": 0.36,
        "a_1_x": 0.69,
        "a_1_y": 1.06,
        "a_1_z": 3.26,
    },
    "Test 3": {
        "fu": 30.0,
        "fv": 31.1,
        "alpha_c": 0.01,
        "u0": 31.6,
        "v0": 31.3,
        "k1": 0.171,
        "k2": 0.94,
        "p1": 0.0084,
        "p2": 0.0056,
        "theta": 0.92,
        "phi": 1.58,
        "psi": 1.61,
        "Tx": 5.81,
        "Ty": 3.80,
        "Tz": 30.7,
        "laser_theta": 0.04,
        "laser_phi": 0.02,
        "laser_y": 0.69,
        "laser_z": 0.44,
        "a_1_x": 0.79,
        "a_1_y": 0.95,
        "a_1_z": 3.78,
        "a_2_x": 5.20,
        "a_2_y": 3.75,
        "a_2_z": 3.98,
    },
    "Test 4": {
        "fu": 25.9,
        "fv": 26.1,
        "alpha_c": 0.01,
        "u0": 28.1,
        "v0": 29.6,
        "k1": 0.117,
        "k2": 0.61,
        "p1": 0.0081,
        "p2": 0.0048,
        "theta": 0.74,
        "phi": 1.37,
        "psi": 1.47,
        "Tx": 4.46,
        "Ty": 2.70,
        "Tz": 25.2,
        "laser_theta": 0.03,
        "laser_phi": 0.02,
        "laser_y": 0.46,
        "laser_z": 0.32,
        "a_1_x": 0.69,
        "a_1_y": 0.71,
        "a_1_z": 3.28,
        "a_2_x": 3.88,
        "a_2_y": 2.41,
        "a_2_z": 2.87,
    },
}

PRINTED_RMS_PX = 2.5
"""Of all four tests, about; the pixel noise of the simulated tests gives it."""


@dataclass(frozen=True)
class Reason:
    """Why a row may differ from the printed one, and how far: the ratio's range it covers.

    A ratio (ours over printed) outside of ``low`` to ``high`` is not explained by it.
    """

    why: str
    low: float = 0.25
    high: float = 4.0

    def covers(self, ratio: float) -> bool:
        """Whether the ratio is in the range."""
        return self.low <= ratio <= self.high


_BEAM = Reason(
    "printed in hundredths of a degree, 0.02 to 0.04; the hand poses are not known, and how far "
    "the beam reaches decides it"
)
_PLANE = Reason(
    "how a plane's uncertainty spreads over x, y and z depends on how the plane lies, and the "
    "simulated planes lie otherwise than the paper's"
)
_POSITION = Reason(
    "printed about three times larger than here, and T_z more so; we do not know why", 0.2, 1.0
)
EXPLAINED: dict[str, Reason] = {
    # 0.005 to 0.015 are all printed as 0.01
    "alpha_c": Reason("printed to 0.01: one digit", 0.25, 3.0),
    "theta": Reason(
        "the paper's refined pose is not known to us: how the camera's rotation shares its "
        "uncertainty among three angles depends on how camera and planes lie"
    ),
    "Tx": _POSITION,
    "Ty": _POSITION,
    "Tz": Reason(
        "printed four to seven times larger than any of our motions gives; we do not know why",
        0.1,
        1.0,
    ),
    "laser_theta": _BEAM,
    "laser_phi": _BEAM,
    **dict.fromkeys(("a_1_x", "a_1_y", "a_1_z", "a_2_x", "a_2_y", "a_2_z"), _PLANE),
}
"""Rows of two planes that may differ from the printed ones by more than a factor of two: why."""

ONE_PLANE = (
    "with one plane its tilt alone separates f_u from f_v, so that the sigmas depend on how it "
    "lies, and the paper's lies otherwise: our simulated one is tilted to both axes and gives "
    "smaller sigmas; one whose normal lies near a coordinate plane of the camera gave an "
    "independent implementation five to eight times the printed ones for f_u and f_v"
)
"""What holds of all rows of one plane."""
