"""Outliers found, named, and left out of the final estimate.

A spot is an outlier if its whitened residual is longer than chance allows. Gross outliers pull
plain least squares anywhere; so, once one is suspected, the Cauchy loss is minimised from the
starts themselves. The final estimate is plain least squares on the accepted spots, so that its
sigmas mean what they say. On clean data nothing of this runs, and nothing changes, not even a
digit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lasercal_gtsam.calibration import NoiseLevel
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DegenerateError, LasercalError, SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.robust.consensus import (
    MOST_OUTLIERS,
    Consensus,
    best_of,
    consensus,
    credible,
    looks_clean,
    not_by_chance,
    settles_it,
)
from lasercal_gtsam.robust.parts import Parts, best_of_parts
from lasercal_gtsam.robust.scale import (
    Mask,
    outlier_reasons,
    outliers,
    refuse_emptied,
    robust_scale,
    unknowns_of,
)
from lasercal_gtsam.solve import Solution
from lasercal_gtsam.start import Search, typical_sigma

Refine = Callable[[Search, Sequence[Cell]], Solution]


class Ways(NamedTuple):
    """Where to start, and how to go on from there.

    ``starts``: cells, the likeliest first. ``refine``: plain least squares from some of them.
    ``parts``: more starts, from parts of the spots (`parts.parts_of`). ``agreed``: the spots that
    the starts were made from, where they are not all.
    """

    starts: Sequence[Cell]
    refine: Refine
    parts: Parts | None = None
    agreed: Mask | None = None


class Finished(NamedTuple):
    """A solution, and how it judges the spots.

    ``lengths`` (N,): whitened residual length (sigmas) of every spot, those left out too; infinite
    where no spot can be. ``sigma_px``: pixel sigma found on the way, if one was missing. ``noise``,
    ``words``: noise levels that were to be estimated, and what must be said of them.
    """

    solution: Solution
    lengths: Array
    sigma_px: float | None = None
    noise: tuple[NoiseLevel, ...] = ()
    words: tuple[str, ...] = ()


Finish = Callable[[Solution, Mask], Finished]


class Accepted(NamedTuple):
    """The answer: finished, for each spot None or why it was rejected, and where it began.

    ``weights`` (N,): with which spots count; None: all that were not rejected fully.
    """

    finished: Finished
    reasons: tuple[str | None, ...]
    start: Cell
    weights: Array | None = None

    @property
    def rejected(self) -> Mask:
        """(N,) True for the spots that were left out."""
        return np.array([reason is not None for reason in self.reasons], dtype=np.bool_)


_ROUNDS = 10
# starts that the Cauchy loss is minimised from
_STARTS = 3
# share of outliers up to which the first consensus that settles it needs no second
_FEW = 1 / 3
# residual scale, as a share of the image diagonal, that no answer may have
_ABSURD_SCALE = 0.02


def refine_without_outliers(search: Search, ways: Ways, finish: Finish) -> Accepted:
    """Refine, and leave out the spots that do not fit, if there are any.

    Parameters
    ----------
    search : observations, whitening, holds and options
    ways : starts, and how they are refined
    finish : what follows, given the spots left out; tells how long the residuals are

    Raises
    ------
    SolveError, DegenerateError
        What refining or finishing raised, if leaving spots out did not help; or too many spots of
        one camera, laser or plane do not fit.
    """
    accept = (None,) * len(search.batch)
    plain = _plain(search, ways, finish) if ways.agreed is None else None
    clean = isinstance(plain, Finished) and looks_clean(search, plain.lengths)
    if isinstance(plain, Finished) and clean and plain.solution.plausible:
        return Accepted(plain, accept, ways.starts[0])
    best = _from_starts(search, ways, plain)
    settled = settles_it(search, best)
    if best is not None and plain is None and settled and not _named(search, best).any():
        plain = _plain(search, ways, finish)  # all spots agree after all
        clean = isinstance(plain, Finished) and looks_clean(search, plain.lengths)
        if isinstance(plain, Finished) and clean and plain.solution.plausible:
            return Accepted(plain, accept, ways.starts[0])
    if ways.parts is not None and not clean and not settled:
        best = best_of_parts(search, ways.parts, best)
    if best is not None:
        answer = refit(search, best, ways.refine, finish, ways.starts)
        if answer is not None and answer[1].any():
            finished, rejected = answer
            reasons = outlier_reasons(search, finished.lengths, rejected)
            return Accepted(_doubted(search, finished, rejected), reasons, best.start)
    plain = plain or _plain(search, ways, finish)
    if not isinstance(plain, Finished):
        raise _in_doubt(plain, len(accept))
    nobody = np.zeros(len(accept), dtype=np.bool_)
    return Accepted(_doubted(search, plain, nobody), accept, ways.starts[0])


def _plain(search: Search, ways: Ways, finish: Finish) -> Finished | LasercalError:
    try:
        solution = ways.refine(search, ways.starts)
        return finish(solution, np.zeros(len(search.batch), dtype=np.bool_))
    except (SolveError, DegenerateError) as error:
        return error


def _from_starts(
    search: Search, ways: Ways, plain: Finished | LasercalError | None
) -> Consensus | None:
    """Best consensus from the starts, and from where plain least squares ended."""
    begins = [(start, start) for start in ways.starts[:_STARTS]]
    if isinstance(plain, Finished):
        begins.append((ways.starts[0], plain.solution.cell))
    best = None
    for start, cell in begins:
        best = best_of([best, consensus(search, start, cell, ways.agreed)])
        if best is not None and best.share >= 1.0 - _FEW and settles_it(search, best):
            break
    return best


def _named(search: Search, found: Consensus) -> Mask:
    """Spots that a consensus takes for outliers at first sight."""
    nobody = np.zeros(len(found.lengths), dtype=np.bool_)
    return outliers(found.lengths, unknowns_of(search), nobody)


def _doubted(search: Search, finished: Finished, rejected: Mask) -> Finished:
    """The answer, with a trouble where it is not one that half of the spots fit."""
    unknowns = unknowns_of(search)
    out = outliers(finished.lengths, unknowns, rejected)
    scale = robust_scale(finished.lengths[~rejected], unknowns)
    if not credible(search, scale, _ABSURD_SCALE):
        trouble = (
            f"the spots are off by {scale * typical_sigma(search):.0f} px: no cell was found that "
            f"half of the {len(out)} spots fit. {_CAUSES}"
        )
    elif out.mean() > MOST_OUTLIERS or (
        out.any() and not not_by_chance(search, finished.lengths, out)
    ):
        trouble = (
            f"{int(out.sum())} of {len(out)} spots do not fit the rest, and no half of the spots "
            f"was found that fits. {_CAUSES}"
        )
    else:
        return finished
    troubles = (trouble, *finished.solution.troubles)
    return finished._replace(solution=replace(finished.solution, troubles=troubles))


_CAUSES = (
    "Are the pose convention, the units and the plane names right, did nothing move, and are half "
    "of the spots the laser's?"
)


def _in_doubt(error: LasercalError, count: int) -> LasercalError:
    """The error in words that leave both causes open: the poses, or the spots."""
    if isinstance(error, DegenerateError):
        return error
    return SolveError(f"no cell was found that half of the {count} spots fit. {_CAUSES} ({error})")


def refit(
    search: Search, best: Consensus, refine: Refine, finish: Finish, starts: Sequence[Cell] = ()
) -> tuple[Finished, Mask] | None:
    """Plain least squares without the outliers, until the same spots stay out.

    First from where the spots stand, then, once they are settled, in full: ``refine`` from there
    and from ``starts``. None where more than half do not fit, or the rest cannot be refined.

    Raises
    ------
    DegenerateError
        A camera, laser or plane would be left without spots.
    """
    unknowns = unknowns_of(search)
    found = _named(search, best)
    cell, iterations, full = best.cell, best.iterations, False
    answer: tuple[Finished, Mask] | None = None
    for _ in range(2 * _ROUNDS):
        if found.mean() > MOST_OUTLIERS:
            return None
        rejected = found
        refuse_emptied(search.observations, rejected)
        kept = replace(search, batch=search.batch.weighted(~rejected))
        solution = None if full else kept.solve_from(cell)
        full = solution is None
        try:
            finished = finish(solution or refine(kept, [cell, *starts]), rejected)
        except (SolveError, DegenerateError):
            return None
        iterations += finished.solution.iterations
        solution = replace(finished.solution, iterations=iterations)
        answer, cell = (finished._replace(solution=solution), rejected), solution.cell
        found = outliers(finished.lengths, unknowns, rejected)
        if np.array_equal(found, rejected):
            if full:
                break
            full = True
    return answer
