"""What the change detector remembers: plain arrays, their start, growth and copy by name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from lasercal_factors.change_arrays import SLOTS, WINDOW, Bank, Watch

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array

PartKind = Literal["cameras", "lasers", "planes"]
KINDS: tuple[PartKind, PartKind, PartKind] = ("cameras", "lasers", "planes")

# Expected changes, 1 sigma of the whole turn (deg) and shift (mm); what lies between or somewhat
# beyond is found with either neighbour.
MAGNITUDES = ((0.2, 1.0), (0.8, 4.0), (3.2, 16.0))
# variances of all residuals, in units of the declared
SPREADS = (2.0, 6.0)
# prior weights of the causes: a shift of each kind, a run of outliers in each kind, the spread;
# the weights of one spot's camera, laser and plane sum to one
_SHIFT_SHARE = {"cameras": 0.22, "lasers": 0.18, "planes": 0.18}
_RUN_SHARE, _SPREAD_SHARE = 0.1, 0.12


def change_covariance(kind: PartKind, turn_deg: float, shift_mm: float) -> Array:
    """Covariance (d, d) of a change by about that much in a random direction, SI units.

    Total turn and shift are spread evenly over the axes; a turn about the beam shows nothing, and
    neither does a shift along it. Planes: the shift is along the normal.
    """
    turn, shift = math.radians(turn_deg), shift_mm / 1000
    sigmas = {
        "cameras": [turn / math.sqrt(3)] * 3 + [shift / math.sqrt(3)] * 3,
        "lasers": [turn / math.sqrt(3)] * 2 + [shift / math.sqrt(3)] * 2,
        "planes": [turn / math.sqrt(2)] * 2 + [shift],
    }
    return np.diag(np.square(sigmas[kind]))


def quiet(count: int) -> Array:
    """Simple statistics (count, 3) that have seen nothing: see `Bank.run`."""
    return np.tile([-np.inf, 0.0, 0.0], (count, 1))


def empty_watch(cameras: int, lasers: int, planes: int, outliers: float, spots: float) -> Watch:
    """Nothing seen yet but the numbers of outliers and of all spots of an earlier calibration."""
    return Watch(
        cameras=_empty_bank("cameras", cameras),
        lasers=_empty_bank("lasers", lasers),
        planes=_empty_bank("planes", planes),
        middle=np.zeros((planes, 3)),
        spread=quiet(len(SPREADS)),
        spread_factor=np.array(SPREADS),
        spread_share=np.full(len(SPREADS), _SPREAD_SHARE / len(SPREADS)),
        outliers=np.array([outliers, spots], dtype=np.float64),
        recent=np.full((WINDOW, 4), np.nan),
        number=np.zeros(1, dtype=np.int64),
    )


def covering(watch: Watch, cameras: int, lasers: int, planes: int) -> Watch:
    """Return the same with at least so many parts; new ones have seen nothing."""
    return watch._replace(
        cameras=_extended(watch.cameras, "cameras", cameras),
        lasers=_extended(watch.lasers, "lasers", lasers),
        planes=_extended(watch.planes, "planes", planes),
        middle=np.concatenate([watch.middle, np.zeros((planes, 3))[len(watch.middle) :]]),
    )


def forget_evidence(watch: Watch) -> None:
    """Drop every onset, in place; counts of outliers stay."""
    for kind in KINDS:
        bank: Bank = getattr(watch, kind)
        bank.log_weight[:] = -np.inf
        bank.log_total[:] = -np.inf
        bank.used[:] = 0
        bank.run[:] = quiet(1)
    watch.spread[:] = quiet(1)


def to_arrays(watch: Watch) -> dict[str, npt.NDArray[Any]]:
    """Copies by name: ``cameras.mean``, ..., ``number``."""
    out: dict[str, npt.NDArray[Any]] = {}
    for name, value in watch._asdict().items():
        if isinstance(value, Bank):
            out |= {f"{name}.{key}": array.copy() for key, array in value._asdict().items()}
        else:
            out[name] = value.copy()
    return out


def from_arrays(arrays: Mapping[str, npt.NDArray[Any]]) -> Watch:
    """Undo `to_arrays`, to the last bit.

    Raises
    ------
    DataError
        An array is missing, or has not the type and shape it must have beside the others.
    """
    like = empty_watch(0, 0, 0, 0.0, 0.0)
    parts: dict[str, Any] = {}
    for name, value in like._asdict().items():
        if isinstance(value, Bank):
            fields = value._asdict().items()
            parts_seen = len(_like(arrays, f"{name}.seen", value.seen, None))
            bank = {key: _like(arrays, f"{name}.{key}", a, parts_seen) for key, a in fields}
            parts[name] = Bank(**bank)
        else:
            count = len(parts["planes"].seen) if name == "middle" else None
            parts[name] = _like(arrays, name, value, count)
    return Watch(**parts)


def _like(
    arrays: Mapping[str, npt.NDArray[Any]], name: str, like: npt.NDArray[Any], count: int | None
) -> npt.NDArray[Any]:
    """Copy of an array, held against one of the same kind; without parts ``like`` is empty."""
    if name not in arrays:
        raise DataError(f"detector: the saved state has no array {name!r}")
    array = np.array(arrays[name])
    wanted = like.shape if len(like) else (len(array) if count is None else count, *like.shape[1:])
    if array.dtype != like.dtype or array.shape != wanted:
        raise DataError(
            f"detector: the saved array {name!r} is {array.dtype} {array.shape}, "
            f"expected {like.dtype} {wanted}"
        )
    return array


def _empty_bank(kind: PartKind, count: int) -> Bank:
    prior = np.array([change_covariance(kind, *magnitude) for magnitude in MAGNITUDES])
    M, d = prior.shape[:2]
    return Bank(
        log_weight=np.full((count, M, SLOTS), -np.inf),
        first=np.zeros((count, M, SLOTS), dtype=np.int64),
        age=np.zeros((count, M, SLOTS), dtype=np.int64),
        mean=np.zeros((count, M, d, SLOTS)),
        cov=np.zeros((count, M, d, d, SLOTS)),
        used=np.zeros((count, M), dtype=np.int64),
        seen=np.zeros(count, dtype=np.int64),
        log_total=np.full(count, -np.inf),
        prior=np.tile(prior, (count, 1, 1, 1)),
        share=np.full(M, _SHIFT_SHARE[kind] / M),
        run=quiet(count),
        run_share=np.array([_RUN_SHARE]),
        outliers=np.zeros((count, 2)),
    )


def _extended(bank: Bank, kind: PartKind, count: int) -> Bank:
    """Append empty parts up to ``count``; what is common to all parts stays."""
    have = len(bank.seen)
    fresh = _empty_bank(kind, max(count - have, 0))
    joined = {
        name: old if name in ("share", "run_share") else np.concatenate([old, new])
        for (name, old), new in zip(bank._asdict().items(), fresh, strict=True)
    }
    return Bank(**joined)
