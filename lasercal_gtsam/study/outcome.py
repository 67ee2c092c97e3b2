"""Errors of several methods along an axis (noise, samples), and their statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.frozen import Array, FrozenData
from lasercal_gtsam.study.errors import QUANTITIES


@dataclass(frozen=True, eq=False)
class ErrorCurves(FrozenData):
    """Relative errors by place on the axis, method, trial and quantity.

    Attributes
    ----------
    name : of the curves, for a heading
    axis : what varies, with its unit
    at : (X,) its values
    methods : (M,) names
    errors : (X, M, N, 3) relative errors of f_u, R, T; NaN where a method failed or was not asked
    asked : (X, M) whether a method was run there
    """

    name: str
    axis: str
    at: tuple[float, ...]
    methods: tuple[str, ...]
    errors: Array
    asked: npt.NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        name: str,
        axis: str,
        at: Sequence[float],
        methods: Sequence[str],
        runs: Mapping[tuple[int, int], Mapping[str, Sequence[float] | None]],
        trials: int,
    ) -> ErrorCurves:
        """From what the runs returned: (place, trial) -> method -> errors or None."""
        errors = np.full((len(at), len(methods), trials, len(QUANTITIES)), np.nan)
        asked = np.zeros((len(at), len(methods)), dtype=np.bool_)
        for (x, trial), found in runs.items():
            for m, method in enumerate(methods):
                if method in found:
                    asked[x, m] = True
                    if (values := found[method]) is not None:
                        errors[x, m, trial] = values
        return cls(name, axis, tuple(at), tuple(methods), errors, asked)

    @property
    def trials(self) -> int:
        """Trials at each place."""
        return int(self.errors.shape[2])

    @property
    def failures(self) -> npt.NDArray[np.int64]:
        """(X, M) trials without an acceptable estimate."""
        return np.asarray(np.isnan(self.errors[..., 0]).sum(axis=2) * self.asked, dtype=np.int64)

    @property
    def mean(self) -> Array:
        """(X, M, 3) mean over the trials that did not fail; NaN where none is left."""
        count = (~np.isnan(self.errors)).sum(axis=2)
        total = np.nansum(self.errors, axis=2)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    @property
    def median(self) -> Array:
        """(X, M, 3) median over all trials, a failure being worse than any number.

        Infinite where half of them failed; NaN where the method was not run.
        """
        found = np.median(np.where(np.isnan(self.errors), np.inf, self.errors), axis=2)
        return np.where(self.asked[..., None], found, np.nan)

    @property
    def standard_error(self) -> Array:
        """(X, M, 3) standard error of `mean`; NaN below two trials."""
        count = (~np.isnan(self.errors)).sum(axis=2)
        centred = self.errors - self.mean[:, :, None]
        spread = np.nansum(centred**2, axis=2) / np.maximum(count - 1, 1)
        return np.where(count > 1, np.sqrt(spread / np.maximum(count, 1)), np.nan)

    def row(self, method: str) -> int:
        """Number of a method."""
        return self.methods.index(method)

    def records(self) -> list[dict[str, Any]]:
        """One record for each place, method and quantity: what a CSV holds."""
        mean, median, error, failures = (
            self.mean,
            self.median,
            self.standard_error,
            self.failures,
        )
        return [
            {
                "case": self.name,
                self.axis: at,
                "method": method,
                "quantity": quantity,
                "mean": finite_or_none(mean[x, m, q]),
                "standard_error": finite_or_none(error[x, m, q]),
                "median": finite_or_none(median[x, m, q]),
                "failed": int(failures[x, m]),
                "trials": self.trials,
            }
            for x, at in enumerate(self.at)
            for m, method in enumerate(self.methods)
            if self.asked[x, m]
            for q, quantity in enumerate(QUANTITIES)
        ]

    def table(self, quantity: str) -> str:
        """Text: a line for each method, mean/median in per cent and the failures in brackets."""
        q = QUANTITIES.index(quantity)
        mean, median, failures = self.mean[..., q], self.median[..., q], self.failures
        head = [self.axis, *(f"{at:g}" for at in self.at)]
        lines = [head]
        for m, method in enumerate(self.methods):
            if not self.asked[:, m].any():
                continue
            cells = [
                _cell(mean[x, m], median[x, m], int(failures[x, m])) if self.asked[x, m] else "-"
                for x in range(len(self.at))
            ]
            lines.append([method, *cells])
        widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
        texts = [
            "  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]).rstrip()
            for line in lines
        ]
        title = f"{self.name}: error of {quantity} in %, mean/median (failed of {self.trials})"
        return "\n".join([title, *texts])


def _cell(mean: float, median: float, failed: int) -> str:
    text = f"{_percent(mean)}/{_percent(median)}"
    return f"{text} ({failed})" if failed else text


def _percent(value: float) -> str:
    if np.isnan(value):
        return "-"
    if np.isinf(value):
        return "inf"
    return "0" if value < 1e-9 else f"{100 * value:.3g}"


def finite_or_none(value: float) -> float | None:
    """The number; None, for JSON, where it is none."""
    return float(value) if np.isfinite(value) else None
