"""The result of a calibration: estimates, sigmas, residuals, and how they came about."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.frozen import Array, FrozenData, set_array
from lasercal_gtsam.observations import Names, Observations
from lasercal_gtsam.options import DISTORTION_NAMES, HAND_NOISE_NAMES, CalibrationOptions
from lasercal_gtsam.prediction import CellUncertainty, locate, only, predict

if TYPE_CHECKING:
    from lasercal_gtsam.plot.plots import Plots


@dataclass(frozen=True)
class Parameter:
    """One row of the result table, in the paper's parameterisation and units (mm, deg, px).

    ``initial`` is NaN where the start does not define it; ``sigma`` is 0 for a value held fixed.
    """

    name: str
    initial: float
    refined: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class NoiseLevel:
    """A noise level that was estimated from the residuals, 1 sigma per axis.

    Attributes
    ----------
    name : ``sigma_px`` (px), ``hand_sigma_m`` (metres) or ``hand_sigma_rad`` (radians)
    value : the estimate; 0 where the residuals show nothing of it
    standard_error : of ``value``; NaN where it is 0
    low, high : 95 % interval; ``high`` is infinite where the spots say nothing about it
    """

    name: str
    value: float
    standard_error: float
    low: float
    high: float


@dataclass(frozen=True)
class Fit:
    """How the fit went.

    Attributes
    ----------
    rms_px : root of the mean squared distance between seen and predicted spot (the paper's RMS),
        over the spots that were not rejected, by their weights
    sigma0 : a-posteriori scale: pixel sigma (px) where none was given, else a factor on the given
    dof : degrees of freedom behind ``sigma0`` (0: no sigma can be stated)
    iterations : Levenberg-Marquardt iterations of the last solve
    converged : whether every check passed
    status : one sentence for a human
    n_spots, n_rejected : spots used and spots left out as outliers
    noise : the noise levels that were estimated (``CalibrationOptions.estimate_noise``)
    """

    rms_px: float
    sigma0: float
    dof: float
    iterations: int
    converged: bool
    status: str
    n_spots: int
    n_rejected: int
    noise: tuple[NoiseLevel, ...] = ()


@dataclass(frozen=True)
class SpotResult:
    """The account of one spot.

    Attributes
    ----------
    residual_px : ``predicted - seen`` (px)
    weight : with which it counts in the fit, 0 to 1; the loss's where one was asked for
    rejected : why it was left out; None if it was not
    leverage : how much of the spot's two coordinates the fit takes from the spot itself, 0 to 2
        (the diagonal of the hat matrix, summed over both); near 2 nothing checks the spot. Summed
        over all spots it is the number of unknowns that the spots determine; 0 for a spot left
        out, NaN where it is not known
    """

    id: str
    plane: str
    camera: str
    laser: str
    residual_px: tuple[float, float]
    weight: float
    rejected: str | None
    leverage: float = float("nan")


@dataclass(frozen=True, eq=False)
class SpotResults(FrozenData):
    """All spots as columns; iterating or indexing gives `SpotResult`."""

    id: Names
    plane: Names
    camera: Names
    laser: Names
    residual_px: Array
    weight: Array
    rejected: tuple[str | None, ...]
    leverage: Array | None = None

    def __post_init__(self) -> None:
        n = len(set_array(self, "residual_px", self.residual_px, (None, 2), finite=False))
        set_array(self, "weight", self.weight, (n,))
        leverage = np.full(n, np.nan) if self.leverage is None else self.leverage
        set_array(self, "leverage", leverage, (n,), finite=False)

    def __len__(self) -> int:
        return len(self.residual_px)

    def __getitem__(self, k: int) -> SpotResult:
        return SpotResult(
            id=str(self.id[k]),
            plane=str(self.plane[k]),
            camera=str(self.camera[k]),
            laser=str(self.laser[k]),
            residual_px=(float(self.residual_px[k, 0]), float(self.residual_px[k, 1])),
            weight=float(self.weight[k]),
            rejected=self.rejected[k],
            leverage=float("nan") if self.leverage is None else float(self.leverage[k]),
        )

    def __iter__(self) -> Iterator[SpotResult]:
        return (self[k] for k in range(len(self)))


@dataclass(frozen=True)
class WeakDirection:
    """A combination of parameters the data hardly determine.

    ``strength`` is the information along it in units of the plausible range (below 1: the data
    say less than plain common sense); ``words`` says what moves together, in units.
    """

    strength: float
    words: str


@dataclass(frozen=True)
class Observability:
    """Weak directions (weakest first), what was held fixed or tied, and remarks."""

    weak: tuple[WeakDirection, ...] = ()
    held: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Inputs:
    """What went in, so that a result can be recomputed."""

    observations: Observations
    options: CalibrationOptions


@dataclass(frozen=True, eq=False)
class Calibration(FrozenData):
    """A calibrated cell with its joint covariance and the account of every spot.

    Attributes
    ----------
    cell, initial : the estimate and the start it came from
    parameters : rows of the paper's Table 2, in its order
    covariance : (n, n) joint covariance in the tangent space, SI units; rows as in ``labels``
    labels : names of the tangent coordinates
    fit, spots, observability, inputs : see their classes
    """

    cell: Cell
    initial: Cell
    parameters: tuple[Parameter, ...]
    covariance: Array
    labels: tuple[str, ...]
    fit: Fit
    spots: SpotResults
    observability: Observability
    inputs: Inputs

    def __post_init__(self) -> None:
        n = len(self.labels)
        set_array(self, "covariance", self.covariance, (n, n), finite=False)

    def __getitem__(self, name: str) -> Parameter:
        """Return the row of that name; KeyError lists the names."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(f"{name!r}; there are {', '.join(p.name for p in self.parameters)}")

    @property
    def options_used(self) -> CalibrationOptions:
        """The options with what was found (hand noise, "auto" distortion) as if it was stated."""
        options = with_levels(self.inputs.options, self.fit.noise)
        if options.distortion != "auto":
            return options
        at = {label: i for i, label in enumerate(self.labels)}
        left_out = {
            f"{name}.{term}": getattr(camera.intrinsics, term)
            for name, camera in self.cell.cameras.items()
            for term in DISTORTION_NAMES
            if (i := at.get(f"{name}.{term}")) is not None and self.covariance[i, i] == 0.0
        }
        return replace(options, distortion="all", known={**left_out, **options.known})

    def table(self) -> str:
        """Text of the paper's Table 2: Initial | Refined | sigma | Unit, RMS row last."""
        lines = [("", "Initial", "Refined", "sigma", "Unit")]
        lines += [table_row(p) for p in self.parameters]
        lines.append(("RMS", "", f"{self.fit.rms_px:.4g}", "", "px"))
        return text_table(lines)

    def predict(
        self,
        T_base_hand: npt.ArrayLike,
        *,
        plane: str | None = None,
        camera: str | None = None,
        laser: str | None = None,
    ) -> tuple[Array, Array]:
        """Where the spot will be seen (1)-(9), and how well that is known.

        Parameters
        ----------
        T_base_hand : (N, 4, 4) or (4, 4), metres
        plane, camera, laser : names; may be left out where the cell has only one

        Returns
        -------
        (N, 2) and (N, 2, 2) arrays
            Pixels and their covariance (px^2) from the calibration alone: add the noise of a spot
            to judge one that was seen. NaN where no spot can be.

        Raises
        ------
        DataError
            A name is unknown, left out where there are several, or was not calibrated.
        """
        names = self._parts(plane, camera, laser)
        known = CellUncertainty(self.cell, self.covariance, self.labels)
        return predict(known, np.asarray(T_base_hand, dtype=np.float64), *names)

    def locate(
        self,
        uv: npt.ArrayLike,
        *,
        plane: str | None = None,
        camera: str | None = None,
        sigma_px: float = 0.0,
    ) -> tuple[Array, Array]:
        """Point of a working plane that is seen at a pixel (12), and how well that is known.

        Parameters
        ----------
        uv : (N, 2) or (2,) px
        plane, camera : names; may be left out where the cell has only one
        sigma_px : noise of the pixels themselves, added to the calibration's

        Returns
        -------
        (N, 3) and (N, 3, 3) arrays
            Base points (metres) and their covariance (m^2). NaN where the ray misses the plane.

        Raises
        ------
        DataError
            As in `predict`.
        """
        on, by, _ = self._parts(plane, camera, next(iter(self.cell.lasers)))
        known = CellUncertainty(self.cell, self.covariance, self.labels)
        return locate(known, np.asarray(uv, dtype=np.float64), on, by, sigma_px)

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Confidence interval of a row from the likelihood, in its unit; see `lc.intervals`.

        Raises
        ------
        DataError, SolveError
            As for `lasercal_gtsam.intervals`.
        """
        from lasercal_gtsam.confidence import intervals

        return intervals(self, [name], level=level)[name]

    def _parts(
        self, plane: str | None, camera: str | None, laser: str | None
    ) -> tuple[str, str, str]:
        return (
            only(tuple(self.cell.planes), plane, "plane"),
            only(tuple(self.cell.cameras), camera, "camera"),
            only(tuple(self.cell.lasers), laser, "laser"),
        )

    def save(self, path: str | Path) -> None:
        """Write ``calibration.json`` atomically: the old file stays until the new one is whole."""
        from lasercal_gtsam.io.calibration_file import save_calibration

        save_calibration(self, path)

    def report(self, path: str | Path, *, document: str | Path | None = None) -> None:
        """Write the uncertainty report as one HTML file; ``document``: its content, as JSON too."""
        from lasercal_gtsam.report.file import report

        report(self, path, document=document)

    @property
    def plot(self) -> Plots:
        """Figures with Matplotlib: ``plot.residuals()``, ``.coverage()``, ``.error_map()`` ..."""
        from lasercal_gtsam.plot.plots import Plots

        return Plots(self)

    def to_dict(self) -> dict[str, Any]:
        """The content of ``calibration.json``."""
        from lasercal_gtsam.io.calibration_file import to_dict

        return to_dict(self)


def with_levels(options: CalibrationOptions, noise: Sequence[NoiseLevel]) -> CalibrationOptions:
    """Options that state the hand's noise which was found, instead of asking for it."""
    found: dict[str, Any] = {n.name: n.value for n in noise if n.name in HAND_NOISE_NAMES}
    return replace(options, estimate_noise=(), **found) if found else options


def table_row(p: Parameter) -> tuple[str, str, str, str, str]:
    """Cells of a row: decimals follow the sigma (two significant digits), as metrologists print."""
    decimals = table_decimals(p)
    if not np.isfinite(p.sigma):
        sigma = "unknown"
    else:
        sigma = f"{p.sigma:.{decimals}f}" if p.sigma > 0 else "held"
    return (
        p.name,
        plain_number(p.initial, decimals),
        plain_number(p.refined, decimals),
        sigma,
        p.unit,
    )


def table_decimals(p: Parameter) -> int:
    """How many decimals a row is printed with."""
    return sigma_decimals(p.sigma)


def sigma_decimals(sigma: float) -> int:
    """Decimals that show two digits of a sigma; 4 where it is not known or 0."""
    if not (np.isfinite(sigma) and sigma > 0):
        return 4
    return int(np.clip(1 - np.floor(np.log10(sigma)), 0, 9))


def plain_number(value: float, decimals: int) -> str:
    """Number with that many decimals, never "-0.00"; empty where it is not finite."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}" if np.isfinite(value) else ""


def measured(value: float, sigma: float) -> str:
    """``203 +- 73``: the sigma to two significant digits, the value to the same place."""
    if not (np.isfinite(sigma) and sigma > 0):
        return f"{value:.4g} +- {'0' if sigma == 0 else 'unknown'}"
    place = 1 - int(np.floor(np.log10(float(f"{sigma:.1e}"))))
    decimals = max(place, 0)
    return f"{plain_number(round(value, place), decimals)} +- {round(sigma, place):.{decimals}f}"


def text_table(lines: Sequence[tuple[str, ...]]) -> str:
    """Columns with bars between them: heading first, totals last; first and last column left."""
    last = len(lines[0]) - 1
    widths = [max(len(line[i]) for line in lines) for i in range(last + 1)]
    rows = [
        " | ".join(
            f"{cell:<{w}}" if i in (0, last) else f"{cell:>{w}}"
            for i, (cell, w) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    ]
    rule = "-+-".join("-" * w for w in widths)
    return "\n".join([rows[0], rule, *rows[1:-1], rule, rows[-1]])


def rms_px(residual_px: Array) -> float:
    """Table 2's RMS: root of the mean squared residual length, px."""
    return float(np.sqrt(np.mean(np.sum(residual_px**2, axis=1)))) if len(residual_px) else 0.0
