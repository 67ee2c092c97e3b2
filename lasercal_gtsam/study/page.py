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
    "0.05 deg). The methods that are compared have 90 points each, the laser method as many spots "
    "in the paper's setting. M4's R and T are those of the object in "
    "the hand, relative to a short lever: not comparable with the others in T.",
    "fig7": "Relative error of f_u from spots on one, two and three planes, with 1 px of pixel "
    "noise and none of the hand.",
    "table2": "Simulated cells of the paper's kind, as many spots as its tests had, and the pixel "
    "noise that gives its RMS. The columns truth, initial, refined and sigma are of the first "
    "capture; median and spread of all; printed is the paper's sigma.",
}
_CAPTIONS = {
    "fig6": "Mean error over the trials that did not fail, with its standard error; solid: "
    "refined, dashed: closed form. A point is left out where more than half failed, or "
    "without noise.",
    "fig7": "Mean error of f_u with its standard error, closed forms on the left, refined on the "
    "right; a point is left out where more than half failed.",
    "table2": "Median sigma over the printed one, by row and test; the band is a factor of two.",
}
_REFERENCE = (
    "The reference are the means of an independent implementation with as many trials as the "
    "default here; the paper prints curves only."
)
_REASONS = {
    "fig6": (
        "The paper's closed form is exact without noise, but its errors grow fast with it. So "
        "the laser method's refinement starts from the best of several closed forms; the rows of "
        "one that starts from the paper's alone show the difference.",
        "The paper compares its refined method with closed forms only, so the others are refined "
        "here as well. The robot's noise is the same for all methods; it is modelled in one row "
        "of the laser method and in none of the others, which could gain from it too.",
        _REFERENCE,
    ),
    "fig7": (
        "Spots on one plane determine the focal length well only if the plane is tilted to the "
        "image, which a_1 is more than a_2.",
        _REFERENCE,
    ),
    "table2": (
        "The paper does not say how its hand moved, and its refined values are not at hand: the "
        "simulated cells are of its kind (a small camera, strong distortion, the beam near the "
        "tool's y axis), not its own. Sigmas of single axes depend on how camera and planes lie; "
        "sigmas of whole vectors do much less, so both are compared.",
    ),
}

_OTHER_SETTINGS = (
    "Cell, motions or noise are not the paper's here: its numbers say little about these results."
)


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
        reasons=_REASONS[study.name] if study.as_paper else (_OTHER_SETTINGS,),
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
