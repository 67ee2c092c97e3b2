"""The running estimate: square-root information about one point, renewed in the background.

Every spot adds two rows, linearised at one point of the cell's chart, to the information; a
Cholesky decomposition gives estimate and sigmas. Once the estimate has moved away from that point,
a *pass* goes over the stored spots again, some at each update, and linearises them at the newer
estimate; when it has caught up, it takes over. So an update costs the same however many spots there
are, and the estimate is that of the batch problem to some thousandths of a sigma. A pass also
decides again which spots are outliers, as the batch solution does, and compares the errors: a step
that made things worse is taken back, and a damped solution takes over.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from lasercal_factors import kernels, stream_kernels
from lasercal_factors.arrays import State
from lasercal_factors.chart import BEAM_DIM, CAMERA_DIM, PLANE_DIM, CellChart
from lasercal_factors.stream_kernels import View, Weighing

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import state_from_cell
from lasercal_gtsam.incremental.belief import POSE, Mask, marginalised
from lasercal_gtsam.incremental.estimate import Estimate
from lasercal_gtsam.incremental.innovation import Innovation
from lasercal_gtsam.incremental.soft_priors import Priors, soft_priors
from lasercal_gtsam.incremental.store import LEFT_OUT, USED, SpotStore
from lasercal_gtsam.robust import rejection_length

Marks = npt.NDArray[np.uint8]
Index = npt.NDArray[np.int64]

# spots that a pass takes at each update, and the same where the hand is noisy (slower by far)
SLICE, SLICE_HAND = 200, 150
# up to this many spots, all are relinearised within the update; with a noisy hand
FEW, FEW_HAND = 1000, 250
# joint distance in sigmas from the point of linearisation at which a pass begins
_MOVED = 0.05
# where a pass is done within the update: distance at which the estimate has settled
_SETTLED, _ROUNDS = 0.01, 8
# a pass begins also when this many more spots are there than at the last (outliers are judged anew)
_GROWN = 1.25
# by how much (squared sigmas) an accepted step may raise the error: in the background marks are
# stale, within an update there is rounding only
_WORSE, _ROUNDING = 1.0, 1e-6
# residual (sigmas) that a spot counts with where it cannot be, if none is an outlier
_FAR = 1e4
_LEVENBERG, _STIFF, _RESTED = 40, 1e6, 1.1
# weight below which a fading spot is forgotten, and the least residual scale (exact data)
_FADED, _MIN_SCALE = 1e-9, 1e-7


@dataclass
class _Linear:
    """Spots linearised at a point of the chart.

    ``H`` (n+1, n+1): their information; ``soft``: that of the priors which are not quadratic;
    ``sums`` (4,): as `stream_kernels.accumulate` gives them.
    """

    z: Array
    view: View
    H: Array
    soft: Array
    sums: Array


@dataclass
class _Pass:
    """A linearisation on its way, done up to spot ``at``; ``marks`` wait until it takes over."""

    linear: _Linear
    at: int
    marks: list[tuple[int, Marks]] = field(default_factory=list)


class Filter:
    """Square-root information filter over a `SpotStore`.

    Parameters
    ----------
    store : the spots; those marked `USED` count
    cell : reference of the chart, all parts known
    held : (n,) constants
    aspects : tied ``fu / fv`` for each camera, or None
    prior : (n+1, n+1) quadratic about the chart's origin, in a-priori sigmas: older spots, or a
        calibration; ``prior_rows``: how many residuals are behind its corner
    priors : on rows of the table: name to (mean, sigma) in the table's units
    weighing : noise of the hand, and fading
    start : where to begin (n,); the reference if left out
    scale : a-posteriori scale to begin with
    robust : whether outliers are left out
    open : (n,) coordinates that are not determined yet
    end : spots before this one are there already; marks count once `relinearise` has run
    """

    def __init__(
        self,
        store: SpotStore,
        cell: Cell,
        held: Mask,
        aspects: tuple[float | None, ...],
        *,
        prior: Array | None = None,
        prior_rows: float = 0.0,
        priors: Priors | None = None,
        weighing: Weighing | None = None,
        start: Array | None = None,
        scale: float = 1.0,
        robust: bool = True,
        open: Mask | None = None,
        end: int | None = None,
    ) -> None:
        self.store, self.template = store, cell
        self.chart = CellChart(state_from_cell(cell), aspects)
        n = self.chart.n
        self.held = held.copy()
        self.open = np.zeros(n, np.bool_) if open is None else open
        self.weighing = weighing or Weighing(np.zeros(6), 1.0)
        self.prior = np.zeros((n + 1, n + 1)) if prior is None else prior
        self.prior_rows = prior_rows
        self.priors = priors or {}
        self._soft = soft_priors(self.chart, cell, held, self.priors)
        tied = np.flatnonzero(~np.isnan(self.chart.aspect_array))
        self._ties = (15 * tied + 6, 15 * tied + 7, self.chart.aspect_array[tied])
        self._noisy = bool(np.any(self.weighing.hand > 0))
        self._slice, self._few = (SLICE_HAND, FEW_HAND) if self._noisy else (SLICE, FEW)
        self._paths, self._offsets = np.empty((0, 3), np.int64), np.empty((0, 4), np.int64)
        self._pass: _Pass | None = None
        self._judged = 0
        self.end = store.first if end is None else end
        self.folded = np.zeros(2)
        self.scale = scale
        self.robust = robust
        self.fallbacks = 0
        self._rest_until = 0.0
        self._constraints = self._constrain()
        self._about = self._about_from = np.empty((0, 0))
        self._about_of: _Linear | None = None
        self._linear = self._at(np.zeros(n) if start is None else start)
        self._unknowns = self._count_unknowns()
        self._solve()

    # --- what is known --------------------------------------------------------------------------

    @property
    def estimate(self) -> Estimate:
        """The state of things, to be kept."""
        cost = float(self._R[-1, -1] ** 2)
        there = float(self._linear.H[-1, -1] + self._about[-1, -1])
        weight, square = self._linear.sums[:2]
        square *= cost / there if there > 0 else 1.0
        weight, square = weight + self.folded[0], square + self.folded[1]
        return Estimate(
            self.chart, self.template, self.held, self.open, self.z, self._R,
            cost, self.dof, float(weight), float(square),
        )  # fmt: skip

    @property
    def dof(self) -> float:
        """Residuals minus the unknowns that they determine."""
        return 2.0 * float(self._linear.sums[0]) + self.prior_rows - self._unknowns

    @property
    def limit(self) -> float:
        """Whitened residual length (a-priori sigmas) beyond which a spot is an outlier."""
        return rejection_length(self.count) * self.scale if self.robust else float("inf")

    @property
    def count(self) -> int:
        """Spots taken in and still stored."""
        return self.end - self.store.first

    @property
    def moved(self) -> float:
        """Distance (joint sigmas) of the estimate from its point of linearisation."""
        return float(np.linalg.norm(self._R[:-1, -1])) / self.scale

    def expect(self, number: int) -> Innovation:
        """How a stored spot compares with the estimate."""
        record, path = self.store.record(number)
        where = (self._view(self._linear), self.now, self._R)
        return Innovation(
            *stream_kernels.expect(
                record, path, *where, self.weighing, self.scale, *self._constraints
            )
        )

    # --- spots ----------------------------------------------------------------------------------

    def use(self, begin: int, end: int, seen: Innovation | None = None) -> None:
        """Count the spots begin ... end-1, the newest, as they are marked; then estimate anew.

        ``seen``: what `expect` gave for it, where it is one spot.
        """
        self.end = end
        if self.weighing.fade < 1.0:
            self._fade(self.weighing.fade ** (end - begin))
        if seen is None or self._noisy:
            self._add(self._linear, begin, end)
        else:
            self._add_row(begin, seen)
        self._solve()

    def settle(self) -> None:
        """Relinearise: at once where there are few spots, else a bounded share of it."""
        if self.count < self._rest_until:
            return
        if self.count <= self._few:
            self.relinearise(_SETTLED)
            return
        if not self._possible:
            self._pass = None
            self._damped()
        if self._pass is None and (self.moved > _MOVED or self._grown()):
            self._pass = self._new_pass(self.z)
        if self._pass is not None:
            self._advance(self._pass)
            if self._pass.at >= self.end and not self._take_over(self._pass, _WORSE):
                self._damped()

    def relinearise(self, settled: float | None = None) -> None:
        """Gauss-Newton over all spots until the estimate has settled (sigmas); cost linear.

        Without a limit once at least, whatever it was before: the marks have been changed.
        """
        self._pass = None
        if settled is None:
            self._accept(self._whole_pass(self.z))
        for _ in range(_ROUNDS):
            if self.moved <= (settled or _SETTLED) and not self._grown():
                return
            if not (self._possible and self._take_over(self._whole_pass(self.z), _ROUNDING)):
                break
        if self.moved > (settled or _SETTLED):
            self._damped()

    def take_out(self, begin: int, end: int, mark: int) -> None:
        """Take the spots begin ... end-1 out of the estimate and mark them."""
        self._subtract(begin, end)
        self.store.mark(begin, end, mark)
        self._pass = None
        self._solve()

    def fold(self, end: int) -> None:
        """Turn the spots before ``end`` into prior knowledge and let them go."""
        part = self._subtract(self.store.first, end)
        self.prior = self.prior + about_origin(part.H, self._linear.z)
        self.prior_rows += 2.0 * float(part.sums[0])
        self.folded = self.folded + part.sums[:2]
        self.store.forget(end)
        self._pass = None
        self._solve()

    def forget_part(self, columns: slice) -> None:
        """What the prior knows of these coordinates is forgotten; they are open from now on."""
        prior, (held, *ties) = self.prior.copy(), self._constraints
        kernels.constrain(prior, held, *ties)
        prior[:-1, :-1][held, held] = 0.0
        self.prior = marginalised(prior, columns, np.append(held, False))
        part = np.zeros_like(held)
        part[columns] = True
        self.prior_rows -= float((part & ~held).sum())
        self.open = self.open | part
        self._constraints = self._constrain()
        self._unknowns = self._count_unknowns()
        self._pass = None
        self._solve()

    def _subtract(self, begin: int, end: int) -> _Linear:
        """Take spots out of the linearisation as they are marked; what they were."""
        linear = self._linear
        part = replace(linear, H=np.zeros_like(linear.H), sums=np.zeros_like(linear.sums))
        self._add(part, begin, end)
        linear.H, linear.sums = linear.H - part.H, linear.sums - part.sums
        return part

    # --- inside ---------------------------------------------------------------------------------

    def _constrain(self) -> tuple[Mask, Index, Index, Array]:
        """What `kernels.constrain` takes: constants, open coordinates and ties."""
        held = self.held | self.open
        held[self._ties[0]] = True
        return (held, *self._ties)

    def _learn_paths(self) -> None:
        """Keep the tables of paths up to date with the store; the parts are in the chart."""
        if len(self._paths) == len(self.store.paths):
            return
        cell = self.template
        cameras, lasers, planes = list(cell.cameras), list(cell.lasers), list(cell.planes)
        first_laser = CAMERA_DIM * len(cameras)
        first_plane = first_laser + BEAM_DIM * len(lasers)
        index, offsets = [], []
        for camera, laser, plane, _ in self.store.paths:
            # a path to a part that is not known yet belongs to spots that are held back
            c, l, p = (  # noqa: E741
                names.index(name) if name in names else 0
                for names, name in ((cameras, camera), (lasers, laser), (planes, plane))
            )
            index.append((c, l, p))
            pose, laser_at = CAMERA_DIM * c, first_laser + BEAM_DIM * l
            offsets.append((pose, pose + POSE, laser_at, first_plane + PLANE_DIM * p))
        self._paths, self._offsets = np.array(index, np.int64), np.array(offsets, np.int64)

    def _view(self, linear: _Linear) -> View:
        """Where it is linearised, with all the paths there are by now."""
        self._learn_paths()
        if len(linear.view.paths) != len(self._paths):
            linear.view = linear.view._replace(paths=self._paths, offsets=self._offsets)
        return linear.view

    def _at(self, z: Array) -> _Linear:
        """No spots yet, linearised at ``z``."""
        size = self.chart.n + 1
        about = (self.chart.aspect_array, self.chart.reference)
        view: View = stream_kernels.view_at(z, *about, self._paths, self._offsets)
        soft = np.zeros((size, size))
        if self._soft is not None:
            soft = self.scale**2 * self._soft(z)
        return _Linear(z, view, np.zeros((size, size)), soft, np.zeros(4))

    def _grown(self) -> bool:
        return self.count > _GROWN * self._judged

    def _new_pass(self, z: Array) -> _Pass:
        self._judged = self.count
        return _Pass(self._at(z), self.store.first)

    def _whole_pass(self, z: Array) -> _Pass:
        done = self._new_pass(z)
        while done.at < self.end:
            self._advance(done)
        return done

    def _fade(self, factor: float) -> None:
        self.prior = factor * self.prior
        self.prior_rows *= factor
        self.folded = factor * self.folded
        running = [self._pass.linear] if self._pass else []
        for linear in [self._linear, *running]:
            linear.H = factor * linear.H
            linear.sums = factor * linear.sums
        horizon = int(np.log(_FADED) / np.log(self.weighing.fade))
        if self._pass is None and self.count > 2 * horizon:
            self.store.forget(self.end - horizon)

    def _add(
        self, linear: _Linear, begin: int, end: int, judge: bool = False
    ) -> list[tuple[int, Marks]]:
        """Add spots to a linearisation; where they are judged anew, their marks, not yet set."""
        view, found = self._view(linear), []
        for first, (records, path, mark) in self.store.slices(begin, end):
            marks = mark.copy() if judge else mark
            age = self.end - 1 - first
            H, sums = stream_kernels.accumulate(
                records, path, marks, view, self.weighing, self.limit, judge, age
            )
            linear.H = linear.H + H
            linear.sums = linear.sums + sums
            found.append((first, marks))
        return found

    def _add_row(self, number: int, seen: Innovation) -> None:
        """As `_add` for one spot, whose rows are there already."""
        linear, mark = self._linear, self.store.mark_of(number)
        if mark == USED:
            linear.H = linear.H + seen.row.T @ seen.row
            e, f = seen.row[:, -1].tolist()
            linear.sums = linear.sums + np.array([1.0, seen.square, e * e + f * f, 0.0])
        elif mark == LEFT_OUT:
            linear.sums = linear.sums + np.array([0.0, 0.0, 0.0, 1.0])

    def _advance(self, running: _Pass) -> None:
        end = min(running.at + self._slice, self.end)
        running.marks += self._add(running.linear, running.at, end, judge=True)
        running.at = end

    def _take_over(self, running: _Pass, slack: float) -> bool:
        """Make the pass the linearisation; False where it is worse by ``slack`` squared sigmas."""
        self._pass = None
        before, after = self._loss(self._linear), self._loss(running.linear)
        if not after <= before + slack * (self.scale**2 + 1e-3 * before):
            return False
        self._accept(running)
        return True

    def _accept(self, done: _Pass) -> None:
        for first, marks in done.marks:
            self.store.mark_each(first, marks)
        self._linear = done.linear
        self._unknowns = self._count_unknowns()
        self._solve()

    def _damped(self) -> None:
        """Levenberg's way down from the point of linearisation, over all spots (cost linear)."""
        self.fallbacks += 1
        n = self.chart.n
        damping = 1e-4
        for _ in range(_LEVENBERG):
            linear = self._linear
            extra = np.zeros_like(linear.H)
            extra[range(n), range(n)] = damping * np.diag(linear.H)[:n]
            prior = about_point(self.prior, linear.z) + linear.soft + extra
            _, z = stream_kernels.estimate(linear.H, prior, linear.z, *self._constraints)
            trial = self._whole_pass(z)
            if self._loss(trial.linear) < self._loss(linear):
                damping /= 10.0
                self._accept(trial)
                if self.moved <= _SETTLED:
                    return
            else:
                damping *= 10.0
                if damping > _STIFF:
                    break
        # no way down from here: where there are many spots, wait for some more before trying again
        if self.count > self._few:
            self._rest_until = _RESTED * self.count

    def _loss(self, linear: _Linear) -> float:
        """Truncated loss, by one limit for all linearisations that are compared."""
        if not np.isfinite(linear.H[0, 0]):
            return float("inf")
        prior = about_point(self.prior, linear.z)[-1, -1] + linear.soft[-1, -1]
        # where all spots count, those left out are the ones that cannot be: no step may lead there
        limit = self.limit if self.robust else _FAR * self.scale
        return float(linear.sums[2] + limit**2 * linear.sums[3] + prior)

    def _solve(self) -> None:
        linear = self._linear
        if linear is not self._about_of or self.prior is not self._about_from:
            self._about = about_point(self.prior, linear.z) + linear.soft
            self._about_of, self._about_from = linear, self.prior
        self._R, z = stream_kernels.estimate(linear.H, self._about, linear.z, *self._constraints)
        state: State = self.chart.state(z)
        # a step too long for the linearisation may end where no camera can be
        focal = state.cam_K[:, :2].ravel().tolist()
        self._possible = math.isfinite(float(z @ z)) and all(f > 0.0 for f in focal)
        self.z = z if self._possible else linear.z
        self.now = state if self._possible else self.chart.state(linear.z)
        if self.dof >= 1:
            self.scale = max(float(self._R[-1, -1]) / math.sqrt(self.dof), _MIN_SCALE)

    def _count_unknowns(self) -> float:
        """Unknowns that spots (not soft priors) determine."""
        held = self._constraints[0]
        free = np.flatnonzero(~held)
        if self._soft is None:
            return float(len(free))
        linear = self._linear
        data = linear.H + about_point(self.prior, linear.z)
        total = data + linear.soft
        for H in (data, total):
            kernels.constrain(H, *self._constraints)
        where = np.ix_(free, free)
        return float(np.trace(np.linalg.lstsq(total[where], data[where], rcond=None)[0]))


def about_point(quadratic: Array, z: Array) -> Array:
    """The augmented information of ``|J x + r|^2`` about ``x = z`` instead of the origin."""
    n = len(z)
    out = quadratic.copy()
    A, b = quadratic[:n, :n], quadratic[:n, n]
    Az = A @ z
    out[:n, n] = out[n, :n] = b + Az
    out[n, n] = quadratic[n, n] + z @ (2.0 * b + Az)
    return out


def about_origin(quadratic: Array, z: Array) -> Array:
    """The inverse of `about_point`."""
    return about_point(quadratic, -z)
