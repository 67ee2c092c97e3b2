"""One page for a study: figure, what agrees with the paper and what does not, and why."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from lasercal_gtsam.io.calibration_file import program_version
from lasercal_gtsam.study.studies import Study

if TYPE_CHECKING:
    from jinja2 import Template

_TITLES = {
    "fig6": "Fig. 6: four calibration methods against the noise",
    "fig7": "Fig. 7: the focal length against the number of samples",
    "table2": "Table 2: four tests, their estimates and sigmas",
}
_LEADS = {
    "fig6": "Relative errors of f_u, R and T at multiples of Table 1's noise (1 px, 1 mm, "
    "0.05 deg), from 90 points or spots for each method. M4's R and T are those of the object in "
    "the hand, relative to a short lever: not comparable with the others in T.",
    "fig7": "Relative error of f_u from spots on one, two and three planes, with 1 px of pixel "
    "noise and none of the hand.",
    "table2": "Simulated cells of the paper's kind, as many spots as its tests had, and the pixel "
    "noise that gives its RMS. The columns truth, initial, refined and sigma are of the first "
    "capture; median and spread of all; printed is the paper's sigma.",
}
_CAPTIONS = {
    "fig6": "Mean error over the trials that did not fail, with its standard error; a point is "
    "left out where more than half failed.",
    "fig7": "Mean error of f_u with its standard error, closed forms on the left, refined on the "
    "right; a point is left out where more than half failed.",
    "table2": "Median sigma over the printed one, by row and test; the band is a factor of two.",
}
_REASONS = {
    "fig6": (
        "The paper's closed form is exact without noise, but its errors grow fast with it: it "
        "takes the scale from single pairs of groups. So the refinement does not start from it "
        "here; from the triangulation form it reaches the optimum at every level.",
        "The paper compares its refined method with closed forms. Refined as well, Ma's method is "
        "its equal in f_u and ahead in R, where rotations of many points help; the laser method "
        "stays ahead in T, and is ahead in both once the robot's noise is in the model, which is "
        "the same for all methods but is modelled for this one only.",
    ),
    "fig7": (
        "The spots on one plane determine one focal length well only if the plane is tilted; a_2 "
        "is seen nearly from above, a_1 is not, and the error differs by a factor of four. Two and "
        "three planes are equal from about 120 samples on.",
    ),
    "table2": (
        "The paper does not say how its hand moved, and its refined values are not at hand: the "
        "simulated cells are of its kind (a small camera, strong distortion, the beam near the "
        "tool's y axis), not its own. Sigmas of single axes depend on how camera and planes lie; "
        "sigmas of whole vectors do much less, so both are compared.",
    ),
}


def page_of(study: Study, command: str, svg: str | None = None) -> str:
    """Self-contained HTML.

    Parameters
    ----------
    study : what was found
    command : that repeats it
    svg : figure, as text; left out where None
    """
    from markupsafe import Markup

    figure = None if svg is None else Markup(svg[svg.index("<svg") :])
    return _template().render(
        title=_TITLES[study.name],
        lead=_LEADS[study.name],
        caption=_CAPTIONS[study.name],
        reasons=_REASONS[study.name],
        findings=study.findings,
        figure=figure,
        table=study.table(),
        command=command,
        runs=len(study.results.values),
        digest=study.results.digest,
        version=program_version(),
    )


@cache
def _template() -> Template:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("lasercal_gtsam.study", "templates")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template("page.html")
