"""Outliers: found with a redescending loss, named, and left out of the final estimate.

A spot is an outlier if its whitened residual is longer than chance allows. Gross outliers pull
plain least squares, and a closed form, anywhere; so, once one is suspected, the Cauchy loss is
minimised from the starts themselves (and, without a given start, from closed forms of random parts
of the spots). The final estimate is plain least squares on the accepted spots, so that its sigmas
mean what they say. On clean data nothing of this runs, and nothing changes, not even a digit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from lasercal_factors.batch import Loss, SpotBatch

from lasercal_gtsam.calibration import NoiseLevel
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DegenerateError, LasercalError, SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import make_graph, state_from_cell
from lasercal_gtsam.holds import Holds
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.solve import Solution, solve
from lasercal_gtsam.start import Search, fits_distortion, typical_sigma

Mask = npt.NDArray[np.bool_]
Refine = Callable[[Search, Sequence[Cell]], Solution]


class Ways(NamedTuple):
    """Where to start, and how to go on from there.

    ``starts``: cells, the likeliest first. ``refine``: plain least squares from some of them.
    ``parts``: more starts, from parts of the spots (`random_parts.parts_of`). ``suspicious``: the
    starts were made without some of the spots.
    """

    starts: Sequence[Cell]
    refine: Refine
    parts: Iterator[tuple[Cell, int] | None] | None = None
    suspicious: bool = False


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


# threshold of the Cauchy loss while outliers are looked for; the usual one, 94 % efficient here
CAUCHY_THRESHOLD = 2.385
# probability that any spot of a clean capture is rejected
FALSE_ALARM = 1e-3
# relative standard error of the median of N Rayleigh lengths, times sqrt(N): 1 / (2 ln 2)
_MEDIAN_ERROR = float(1.0 / (2.0 * np.log(2.0)))
_MEDIAN_RAYLEIGH = float(np.sqrt(2.0 * np.log(2.0)))
_MIN_SCALE = 1e-6
_ROUNDS = 10
_MAX_SHARE = 0.5
# share of outliers up to which one good consensus ends the search; where more are left out, few
# spots may fit a wrong cell by its many unknowns
_UNSETTLED_SHARE = 1 / 3
# starts that the Cauchy loss is minimised from
_STARTS = 3
# how many random parts at least, and the probability that one without outliers is among them
_MIN_PARTS, _CONFIDENCE = 15, 0.99
# how many at least while no fit is credible: its residuals say nothing about the share of outliers
_MIN_PARTS_LOST = 30
# parts that lead to the same end, so that fewer are enough
_AGREED = 2
# residual scale, as a share of the image diagonal, above which a fit explains nothing
_CREDIBLE_SCALE = 0.01
# parts refused one after the other after which the data are at fault, not their outliers
_MAX_REFUSED = 4
# spots that a part of the cell must keep, of those it had
_FEWEST_KEPT = 3


def rejection_length(count: int) -> float:
    """Length (in robust scales) that the longest of ``count`` good residuals hardly ever exceeds.

    The quantile of the Rayleigh distribution, ``sqrt(-2 ln p)``, exceeded once in a thousand
    captures, with a margin of two standard errors for the scale, a median.
    """
    count = max(count, 1)
    quantile = math.sqrt(-2.0 * math.log(FALSE_ALARM / count))
    return quantile * (1.0 + 2.0 * _MEDIAN_ERROR / math.sqrt(count))


def robust_scale(lengths: Array, unknowns: int) -> float:
    """Scale of whitened residual lengths (N,) by their median, corrected for the unknowns."""
    rows = 2 * len(lengths)
    correction = float(np.sqrt(rows / max(rows - unknowns, 1)))
    return max(float(np.median(lengths)) / _MEDIAN_RAYLEIGH * correction, _MIN_SCALE)


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
    nobody = np.zeros(len(search.batch), dtype=np.bool_)
    accept = (None,) * len(search.batch)
    plain = None if ways.suspicious else _plain(search, ways, finish)
    if isinstance(plain, Finished):
        clean = _looks_clean(search, plain.lengths)
        if clean and plain.solution.plausible:
            return Accepted(plain, accept, ways.starts[0])
    found = [consensus(search, cell, cell) for cell in ways.starts[:_STARTS]]
    if isinstance(plain, Finished):
        found.append(consensus(search, ways.starts[0], plain.solution.cell))
    best = _best(found)
    sure = (isinstance(plain, Finished) and clean) or _settles_it(search, best)
    if ways.parts is not None and not sure:
        best = _sampled(search, ways.parts, best)
    if best is not None:
        answer = refit(search, best, ways.refine, finish)
        if answer is not None and answer[1].any():
            finished, rejected = answer
            return Accepted(
                finished, outlier_reasons(search, finished.lengths, rejected), best.start
            )
    plain = plain or _plain(search, ways, finish)
    if not isinstance(plain, Finished):
        raise plain
    count = int(_outliers(plain.lengths, _unknowns(search), nobody).sum())
    if count:
        trouble = (
            f"{count} of {len(accept)} spots do not fit the rest, and no half of the spots was "
            "found that fits"
        )
        solution = replace(plain.solution, troubles=(*plain.solution.troubles, trouble))
        plain = plain._replace(solution=solution)
    return Accepted(plain, accept, ways.starts[0])


def _plain(search: Search, ways: Ways, finish: Finish) -> Finished | LasercalError:
    try:
        solution = ways.refine(search, ways.starts)
        return finish(solution, np.zeros(len(search.batch), dtype=np.bool_))
    except (SolveError, DegenerateError) as error:
        return error


def lengths_of(search: Search, cell: Cell) -> Array:
    """Whitened residual length (sigmas) of every spot, (N,); infinite where no spot can be."""
    return lengths_in(search.batch, cell)


def lengths_in(batch: SpotBatch, cell: Cell) -> Array:
    """The same for the spots of a batch."""
    lengths = batch.whitened_lengths(state_from_cell(cell))
    return np.where(np.isnan(lengths), np.inf, lengths)


@dataclass(frozen=True)
class Consensus:
    """Where the Cauchy loss ended: the cell, the scale of its residuals and their lengths."""

    start: Cell
    cell: Cell
    scale: float
    lengths: Array
    iterations: int

    @property
    def share(self) -> float:
        """Share of the spots that fit."""
        return float(np.mean(self.lengths <= rejection_length(len(self.lengths)) * self.scale))


def consensus(search: Search, start: Cell, cell: Cell) -> Consensus | None:
    """Minimise the Cauchy loss from ``cell``, which came from ``start``.

    The threshold follows the scale of the residuals downwards. The distortion stays where it is
    until the rest fits, then comes in as in a staged start.
    """
    stages: list[Holds] = [search.holds]
    if fits_distortion(search.holds, len(search.observations.cameras)):
        held = search.holds.without_distortion
        stages = [held(), held(("k1",)), search.holds]
    cell = make_graph(search.observations, search.batch, search.holds, cell).start
    unknowns = _unknowns(search)
    lengths = lengths_of(search, cell)
    loss = Loss("cauchy", CAUCHY_THRESHOLD)
    iterations = 0
    for holds in stages:
        for _ in range(_ROUNDS):
            possible = np.isfinite(lengths)
            if possible.mean() < _MAX_SHARE:
                return None
            scale = robust_scale(lengths, unknowns)
            batch = search.batch if possible.all() else search.batch.weighted(possible)
            problem = make_graph(search.observations, batch, holds, cell, loss).rescaled(scale)
            try:
                found = solve(problem, search.options.max_iterations, find_scale=False)
            except LasercalError:
                return None
            cell, lengths = found.cell, lengths_of(search, found.cell)
            iterations += found.iterations
            if abs(robust_scale(lengths, unknowns) - scale) < 0.01 * scale:
                break
    return Consensus(start, cell, robust_scale(lengths, unknowns), lengths, iterations)


def _best(found: Sequence[Consensus | None]) -> Consensus | None:
    """The consensus with the smallest Cauchy loss at the smallest scale of all."""
    candidates = [c for c in found if c is not None]
    if not candidates:
        return None
    threshold = CAUCHY_THRESHOLD * min(c.scale for c in candidates)
    return min(candidates, key=lambda c: float(np.log1p((c.lengths / threshold) ** 2).sum()))


def _credible(search: Search, scale: float) -> bool:
    """Whether the residuals are as short as detected spots can make them."""
    diagonal = max(np.hypot(*size) for size in search.observations.image_size.values())
    return bool(scale * typical_sigma(search) < _CREDIBLE_SCALE * diagonal)


def _looks_clean(search: Search, lengths: Array, standard_errors: float = 4.0) -> bool:
    """No residual too long, no heavy tail, and a scale that detected spots can have.

    A tail shows where many outliers agree: none stands out, but the root mean square exceeds the
    scale that the median gives by more than chance (that many standard errors).
    """
    count, unknowns = len(lengths), _unknowns(search)
    scale = robust_scale(lengths, unknowns)
    if not lengths.max() <= rejection_length(count) * scale:
        return False
    tail = float(np.sqrt(lengths @ lengths / max(2 * count - unknowns, 1))) / scale
    bound = 1.0 + standard_errors * _MEDIAN_ERROR / np.sqrt(count)
    return tail < bound and _credible(search, scale)


def _settles_it(search: Search, found: Consensus | None) -> bool:
    """Whether most spots fit, with residuals as noise alone makes them: nothing better to find.

    In a wrong minimum the residuals of those that fit are not so: many small, some large.
    """
    if found is None:
        return False
    far = np.asarray(~(found.lengths <= rejection_length(len(found.lengths)) * found.scale))
    if far.mean() > _UNSETTLED_SHARE:
        return False
    out = _outliers(found.lengths, _unknowns(search), far)
    few = bool(out.mean() <= _UNSETTLED_SHARE)
    return few and _looks_clean(search, found.lengths[~out], 2.0)


def _sampled(
    search: Search,
    parts: Iterator[tuple[Cell, int] | None],
    best: Consensus | None,
) -> Consensus | None:
    """Best consensus over random parts, as many as the share of outliers asks for."""
    lowest, refused, agreed = np.inf, 0, 0
    for trial, part in enumerate(parts, start=1):
        if part is None:
            refused += 1
            if refused == trial >= _MAX_REFUSED:
                break
            continue
        cell, size = part
        start, found = search.holds.apply(cell), None
        middle = float(np.median(lengths_of(search, start)))
        if np.isfinite(middle) and middle <= 2.0 * lowest:
            lowest = min(lowest, middle)
            found = consensus(search, start, start)
            before, best = best, _best([best, found])
            if found is not None and best is not None and found.scale < 1.01 * best.scale:
                agreed = agreed + 1 if before and before.scale < 1.01 * best.scale else 1
        if best is None:
            continue
        if agreed >= _AGREED and _credible(search, best.scale):
            break
        if found is best and _settles_it(search, best):
            break
        clean = float(np.clip(best.share**size, 1e-12, 1.0 - 1e-12))
        least = _MIN_PARTS if _credible(search, best.scale) else _MIN_PARTS_LOST
        if trial >= max(least, np.log(1.0 - _CONFIDENCE) / np.log1p(-clean)):
            break
    return best


def refit(
    search: Search, best: Consensus, refine: Refine, finish: Finish
) -> tuple[Finished, Mask] | None:
    """Plain least squares without the outliers, until the same spots stay out.

    None where more than half do not fit, or the rest cannot be refined.

    Raises
    ------
    DegenerateError
        A camera, laser or plane would be left without spots.
    """
    unknowns = _unknowns(search)
    rejected = np.zeros(len(search.batch), dtype=np.bool_)
    found = _outliers(best.lengths, unknowns, rejected)
    cell, iterations = best.cell, best.iterations
    answer: tuple[Finished, Mask] | None = None
    for _ in range(_ROUNDS):
        if found.mean() > _MAX_SHARE:
            return None
        rejected = found
        _refuse_emptied(search.observations, rejected)
        kept = replace(search, batch=search.batch.weighted(~rejected))
        try:
            finished = finish(refine(kept, [cell]), rejected)
        except (SolveError, DegenerateError):
            return None
        iterations += finished.solution.iterations
        solution = replace(finished.solution, iterations=iterations)
        answer, cell = (finished._replace(solution=solution), rejected), solution.cell
        found = _outliers(finished.lengths, unknowns, rejected)
        if np.array_equal(found, rejected):
            break
    return answer


def _outliers(lengths: Array, unknowns: int, rejected: Mask) -> Mask:
    """Spots with residuals too long for the scale of the spots not rejected so far."""
    limit = rejection_length(len(lengths)) * robust_scale(lengths[~rejected], unknowns)
    return np.asarray(~(lengths <= limit))


def _unknowns(search: Search) -> int:
    return int((~search.holds.held).sum())


def outlier_reasons(search: Search, lengths: Array, rejected: Mask) -> tuple[str | None, ...]:
    """For each spot why it was rejected, None if it was not."""
    limit = rejection_length(len(lengths))
    scale = robust_scale(lengths[~rejected], _unknowns(search))
    words = [
        f"residual {x / scale:.1f} sigma, limit {limit:.1f}"
        if np.isfinite(x)
        else "no spot can be there"
        for x in lengths
    ]
    return tuple(w if out else None for w, out in zip(words, rejected, strict=True))


def _refuse_emptied(observations: Observations, rejected: Mask) -> None:
    for kind in ("camera", "laser", "plane"):
        names = getattr(observations, kind)
        for name in getattr(observations, kind + "s"):
            mine = names == name
            left = int((mine & ~rejected).sum())
            if left < min(_FEWEST_KEPT, int(mine.sum())):
                raise DegenerateError(
                    f"{kind} {name!r}: {int(mine.sum()) - left} of its {int(mine.sum())} spots do "
                    f"not fit the rest. Is every spot on the {kind} that it is said to be, and "
                    "did nothing move?"
                )
