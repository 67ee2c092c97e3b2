"""The account of a capture's rows: which gave a spot, from where, and why others did not."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from lasercal_gtsam.frozen import Array, FrozenData, set_array
from lasercal_gtsam.io.files import write_text

SPOT_COLUMNS = ("id", "u", "v", "sigma_u", "sigma_v", "rho_uv", "verdict", "reason")


class FoundSpot(Protocol):
    """What a detector returns for one picture (`lasercal_gtsam.detect.Detection`)."""

    @property
    def uv(self) -> Array:
        """(2,) pixel; NaN where nothing was found."""

    @property
    def cov_uv(self) -> Array:
        """(2, 2) covariance, px^2."""

    @property
    def verdict(self) -> str:
        """``used``, or a word for what is wrong."""

    @property
    def reason(self) -> str:
        """A sentence behind the verdict."""

    @property
    def usable(self) -> bool:
        """Whether the spot may go into a calibration."""


@dataclass(frozen=True)
class RowSpot:
    """What became of one row.

    ``verdict`` is ``used`` if it gave a spot; else the detector's verdict, or ``missing`` for a
    row with neither a pixel nor a picture. ``source`` is the path of the picture that was looked
    at, ``table`` where a table said what to do, or "".
    """

    id: str
    verdict: str
    reason: str
    source: str
    uv: tuple[float, float]


@dataclass(frozen=True, eq=False)
class SpotAccount(FrozenData):
    """All rows of a capture in their order; iterating gives `RowSpot`.

    Attributes
    ----------
    ids, verdict, reason, source : N words each, see `RowSpot`
    uv, cov_uv : (N, 2) px and (N, 2, 2) px^2; NaN where there is none. A spot that was found but
        is not to be used keeps its pixel here
    detections : what the detector said, for rows with pictures, else None
    notes : how the pictures were looked at, where that needs a word; sentences
    """

    ids: tuple[str, ...]
    verdict: tuple[str, ...]
    reason: tuple[str, ...]
    source: tuple[str, ...]
    uv: Array
    cov_uv: Array
    detections: tuple[FoundSpot | None, ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.ids)
        set_array(self, "uv", self.uv, (count, 2), finite=False)
        set_array(self, "cov_uv", self.cov_uv, (count, 2, 2), finite=False)

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, k: int) -> RowSpot:
        uv = (float(self.uv[k, 0]), float(self.uv[k, 1]))
        return RowSpot(self.ids[k], self.verdict[k], self.reason[k], self.source[k], uv)

    def __iter__(self) -> Iterator[RowSpot]:
        return (self[k] for k in range(len(self)))

    @property
    def usable(self) -> tuple[bool, ...]:
        """Whether each row gave a spot that may be used."""
        return tuple(verdict == "used" for verdict in self.verdict)

    @property
    def skipped(self) -> Mapping[str, str]:
        """Rows that gave no spot: id to ``verdict: reason``."""
        return {
            row.id: f"{row.verdict}: {row.reason}" if row.reason else row.verdict
            for row in self
            if row.verdict != "used"
        }

    @property
    def counts(self) -> Mapping[str, int]:
        """How many rows have each verdict, ``used`` first, then by frequency."""
        words = sorted(set(self.verdict), key=lambda w: (w != "used", -self.verdict.count(w), w))
        return {word: self.verdict.count(word) for word in words}


def write_spots(path: str | Path, account: SpotAccount) -> None:
    """Write ``spots.csv``: one line for each row, also for those that gave no spot.

    ``load_capture`` takes the rows with verdict ``used`` and keeps the others in the account.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(SPOT_COLUMNS)
    for row, cov in zip(account, account.cov_uv, strict=True):
        writer.writerow(
            [row.id, *number_cells(row.uv), *covariance_cells(cov), row.verdict, row.reason]
        )
    write_text(path, text.getvalue())


def number_cells(values: Array | tuple[float, ...]) -> list[str]:
    """Shortest text that reads back to the same number; empty for NaN."""
    return ["" if np.isnan(value) else repr(float(value)) for value in values]


def covariance_cells(cov: Array) -> list[str]:
    """``sigma_u, sigma_v, rho_uv`` of a 2x2 covariance; empty where it is NaN."""
    if np.isnan(cov).any():
        return ["", "", ""]
    su, sv = np.sqrt(np.diag(cov))
    return number_cells((su, sv, cov[0, 1] / (su * sv)))
