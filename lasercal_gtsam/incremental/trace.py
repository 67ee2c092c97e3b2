"""How a running calibration went: the table at moments that grow rarer."""

from __future__ import annotations

import math

from lasercal_gtsam.history import HistoryRow
from lasercal_gtsam.incremental.update import Update

# a row for each spot up to the first number, then at this growth
_EVERY_SPOT, _GROWTH = 200, 1.01


class Trace:
    """Updates worth remembering; their tables are made when somebody asks."""

    def __init__(self) -> None:
        self._updates: list[Update] = []
        self._next = 0

    def record(self, update: Update) -> None:
        """Remember an update with an estimate, if it is time or something has happened."""
        if update.phase == "collecting" or not (update.events or update.n_spots >= self._next):
            return
        grown = math.ceil(_GROWTH * update.n_spots)
        self._next = update.n_spots + 1 if update.n_spots < _EVERY_SPOT else grown
        self._updates.append(update)

    def rows(self, last: Update) -> tuple[HistoryRow, ...]:
        """All rows, and the last update."""
        updates = list(self._updates)
        if updates and updates[-1].n_spots < last.n_spots:
            updates.append(last)
        return tuple(
            HistoryRow(
                u.n_spots, u.rms_px, u.sigma0, u.parameters, tuple(e.words for e in u.events)
            )
            for u in updates
        )
