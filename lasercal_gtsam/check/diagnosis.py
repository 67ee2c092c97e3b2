"""The doctor's judgement over the readings that were tried, and what to tell the user."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

Stage = Literal["refined", "closed form", "screened"]
Verdict = Literal["consistent", "other", "unclear", "none"]

FAR_BETTER = 2.0
"""Ratio of the residuals from which on another reading is proposed."""
AS_GOOD = 1.05
"""Ratio of the residuals up to which two readings cannot be told apart."""
SIDE_DECIDES = 1.25
"""The same between a reading that needs a camera behind the plane and one that does not."""
CREDIBLE = 0.01
"""Residual, as a share of the image diagonal, above which a reading explains nothing."""


@dataclass(frozen=True)
class Judged:
    """A reading and how well the spots agree with it.

    Attributes
    ----------
    words : the reading, for a human
    change : what to change in the capture so that it is read this way; () for the declared one
    residual_px : robust sigma of a pixel coordinate that the reading leaves; of a ``screened`` one
        what its groups of translations alone leave; infinite where nothing could be solved
    fitting : number of spots that agree, within the noise of the best reading
    stage : how far it was followed
    wrong_side : camera and laser would be on opposite sides of a working plane
    off_centre_px : distance of the principal points from the middle of their pictures, the largest
    harmless : the difference to the declared reading only turns the camera's own axes
    trouble : why it could not be solved, if it could not
    """

    words: str
    change: tuple[str, ...]
    residual_px: float
    fitting: int
    stage: Stage
    wrong_side: bool = False
    off_centre_px: float = 0.0
    harmless: bool = False
    trouble: str = ""

    @property
    def declared(self) -> bool:
        """Whether this is how the capture says that it is to be read."""
        return not self.change

    def fits_like(self, other: Judged, ratio: float = AS_GOOD) -> bool:
        """Whether the residual is at most ``ratio`` times that of the other."""
        return self.residual_px <= ratio * other.residual_px


@dataclass(frozen=True)
class Diagnosis:
    """What the doctor found.

    Attributes
    ----------
    verdict : ``consistent``: no other reading fits better; ``other``: another one fits far better;
        ``unclear``: another one fits better, but not by enough; ``none``: no reading explains the
        spots
    declared, best : how the declared and the best reading fared (the same where ``consistent``)
    alike : other readings that fit as well as ``best``
    readings : all of them, best first
    n_spots : number of spots that all readings were tried on
    """

    verdict: Verdict
    declared: Judged
    best: Judged
    alike: tuple[Judged, ...]
    readings: tuple[Judged, ...]
    n_spots: int


def judge(judged: Sequence[Judged], n_spots: int, diagonal_px: float) -> Diagnosis:
    """Compare the readings; see `Diagnosis`.

    Among readings that fit alike, one with the camera on the laser's side of the planes is better
    than one without; then the one that changes less, then the one with the principal point nearer
    to the middle of the picture.
    """
    declared = next(j for j in judged if j.declared)
    solved = [j for j in judged if j.stage != "screened"]
    lowest = min(solved, key=lambda j: j.residual_px)
    if lowest.wrong_side:
        possible = [j for j in solved if not j.wrong_side and j.fits_like(lowest, SIDE_DECIDES)]
        lowest = min(possible, key=lambda j: j.residual_px, default=lowest)
    alike = [j for j in solved if j.fits_like(lowest) and j.wrong_side == lowest.wrong_side]
    alike.sort(key=lambda j: (len(j.change), round(j.off_centre_px)))
    best = alike[0] if alike else lowest
    verdict: Verdict
    if not best.residual_px <= CREDIBLE * diagonal_px:
        verdict, alike = "none", []
    elif best.declared:
        verdict = "consistent"
    elif not declared.fits_like(best, FAR_BETTER) or (declared.wrong_side and not best.wrong_side):
        verdict = "other"
    else:
        verdict = "unclear"
    ranked = sorted(judged, key=lambda j: (j.stage == "screened", j is not best, j.residual_px))
    others = tuple(j for j in alike if j is not best)
    return Diagnosis(verdict, declared, best, others, tuple(ranked), n_spots)


def sentences(diagnosis: Diagnosis) -> list[str]:
    """What the diagnosis means, in plain words, the most important first."""
    declared, best = diagnosis.declared, diagnosis.best
    fit = f"{best.words} leaves {_px(best)} ({best.fitting} of {diagnosis.n_spots} spots fit)"
    if diagnosis.verdict == "none":
        return [
            f"No usual reading of the numbers explains the spots: the declared one, "
            f"{declared.words}, leaves {_px(declared)}, the best, {best.words}, {_px(best)}. "
            "Something else is wrong: do the pictures belong to these poses, are the plane names "
            "right, and are most spots those of the laser?"
        ]
    if diagnosis.verdict == "consistent":
        lines = [f"The declared reading agrees with the spots: {fit}."]
    elif diagnosis.verdict == "other":
        lines = [
            f"The declared reading, {declared.words}, leaves {_px(declared)}; {fit}: it is "
            "probably the right one.",
            "To read the capture that way: " + "; ".join(best.change) + ".",
        ]
        if declared.wrong_side and not best.wrong_side:
            lines.append(
                "As declared, the camera would look at a plane from behind, where the laser is "
                "not: right only if the plane is translucent."
            )
    else:
        lines = [
            f"{fit}, the declared reading {_px(declared)}: not enough to say that it is wrong. "
            "More hand orientations would tell them apart.",
        ]
    same = [j.words for j in diagnosis.alike if not j.harmless]
    if same:
        lines.append(f"These spots cannot tell {best.words} from: {'; '.join(same)}.")
    if any(j.harmless for j in diagnosis.alike):
        lines.append(
            "A picture turned by 180 deg cannot be told from one that is not; it only turns the "
            "camera's own axes."
        )
    lines.append(
        "The unit of the positions cannot be seen from spots: a wrong one scales the whole cell. "
        "Compare the hand's reach with the robot."
    )
    return lines


def _px(judged: Judged) -> str:
    if not np.isfinite(judged.residual_px):
        return "no solution"
    more = " or more" if judged.stage == "screened" else ""
    return f"{judged.residual_px:.2g} px{more}"
