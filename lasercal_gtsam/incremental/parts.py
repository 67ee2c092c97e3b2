"""Parts that are new, or that were moved: found from their spots and taken into the estimate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lasercal_gtsam.cell import Beam, Camera, Cell, Plane
from lasercal_gtsam.incremental.beginning import holds_of
from lasercal_gtsam.incremental.belief import MOVABLE, Named, Part, part_offset
from lasercal_gtsam.incremental.filter import Filter
from lasercal_gtsam.incremental.relocate import (
    locate_camera,
    locate_laser,
    locate_plane,
    missing_for,
)
from lasercal_gtsam.incremental.update import Missing
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import DISTORTION_NAMES, CalibrationOptions
from lasercal_gtsam.report_map import CAMERA_TANGENT, tangent_labels

KINDS: tuple[Part, ...] = ("camera", "laser", "plane")


def parts_of(cell: Cell, kind: Part) -> dict[str, Camera] | dict[str, Beam] | dict[str, Plane]:
    """The cell's parts of one kind, by name."""
    found: dict[str, Camera] | dict[str, Beam] | dict[str, Plane] = getattr(cell, f"{kind}s")
    return found


def with_part(cell: Cell, part: Named, value: Camera | Beam | Plane) -> Cell:
    """The cell with that part in it, in its old place or at the end."""
    kind, name = part
    changed: dict[str, Any] = {f"{kind}s": {**parts_of(cell, kind), name: value}}
    return replace(cell, **changed)


def without_parts(cell: Cell, parts: Iterable[Named]) -> Cell:
    """The cell without those parts."""
    gone = set(parts)
    return Cell(
        *(
            {name: part for name, part in parts_of(cell, kind).items() if (kind, name) not in gone}
            for kind in KINDS
        )  # type: ignore[arg-type]
    )


class Found(NamedTuple):
    """A part where its spots say it is."""

    part: Named
    value: Camera | Beam | Plane


def find_part(
    cell: Cell, unknown: list[Named], waiting: Observations | None
) -> Found | list[Missing]:
    """The first of the unknown parts that the waiting spots determine, else all that is missing."""
    missing: list[Missing] = []
    for part in unknown:
        kind, name = part
        known = without_parts(cell, [other for other in unknown if other != part])
        if waiting is None:
            words = f"{kind} {name!r} was freed and has no spots yet"
            missing.append(Missing(kind, name, 0, MOVABLE[kind], words))
            continue
        lacking = missing_for(kind, name, waiting, known)
        if not lacking:
            return Found(part, _located(part, waiting, known))
        missing += lacking
    return missing


def relaid(
    old: Filter, cell: Cell, part: Named, options: CalibrationOptions
) -> tuple[Filter, tuple[str, ...] | None]:
    """The same knowledge in the chart of a cell with a part more, or with one elsewhere.

    ``cell`` is the old filter's template with the part put in. Also what is held then, in words,
    where that has changed: assumptions for a camera that saw one plane go with the second.
    """
    kind, name = part
    labels = tangent_labels(cell)
    where = {label: i for i, label in enumerate(labels)}
    columns = np.array([where[label] for label in tangent_labels(old.template)])
    n, everything = len(labels), np.append(columns, len(labels))
    prior, start = np.zeros((n + 1, n + 1)), np.zeros(n)
    prior[np.ix_(everything, everything)] = old.prior
    held, still_open = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    start[columns], held[columns], still_open[columns] = old.z, old.held, old.open
    at = part_offset(cell, kind, name)
    found = slice(at, at + MOVABLE[kind])
    start[found], still_open[found] = 0.0, False
    holds = holds_of(old.store, options, cell)
    priors, words = old.priors, None
    if not old.prior_rows:
        lens = np.array([label.rpartition(".")[2] in DISTORTION_NAMES for label in labels])
        held = holds.held | (held & lens)
        priors, words = holds.priors, holds.words
    elif kind == "camera" and name not in old.template.cameras:
        mine = slice(at, at + len(CAMERA_TANGENT))
        held[mine] = holds.held[mine]
    aspects = dict(zip(old.template.cameras, old.chart.aspects, strict=True))
    new = Filter(
        old.store,
        cell,
        held,
        tuple(aspects.get(c, holds.aspect.get(c)) for c in cell.cameras),
        prior=prior,
        prior_rows=old.prior_rows,
        priors=priors,
        weighing=old.weighing,
        start=start,
        open=still_open,
        end=old.end,
        scale=old.scale,
        robust=old.robust,
    )
    new.folded, new.fallbacks = old.folded, old.fallbacks
    return new, words


def _located(part: Named, waiting: Observations, cell: Cell) -> Camera | Beam | Plane:
    """The part from its spots whose other parts are in the cell (see `relocate`)."""
    kind, name = part
    good = getattr(waiting, kind) == name
    for other in KINDS:
        if other != kind:
            good &= np.isin(getattr(waiting, other), list(parts_of(cell, other)))
    spots = waiting[good]
    if kind == "camera":
        return locate_camera(cell, spots)
    return locate_laser(cell, spots) if kind == "laser" else locate_plane(cell, spots)
