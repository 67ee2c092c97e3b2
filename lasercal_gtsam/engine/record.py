"""The journal of finished chunks: what a study that was killed has already."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from lasercal_gtsam.engine.work import Done, Work
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.calibration_file import program_version
from lasercal_gtsam.io.journal import Journal, JournalReader

_CHUNK = "chunk"


class Record:
    """Finished chunks of one work in a file; each is on the disk when `keep` returns.

    Attributes
    ----------
    found : dict of run -> result, of the chunks that were there already
    repaired : what opening had to cut off, as a sentence; None if nothing

    Raises
    ------
    DataError
        The file is another work's, or made by another version, or another process writes to it,
        or it cannot be read or written.
    """

    def __init__(self, path: str | Path, work: Work) -> None:
        about = {"work": work.name, "version": program_version(), "spec": dict(work.spec)}
        self._journal = Journal.open(path, about)
        try:
            _refuse_others(self._journal, about)
            self.repaired = self._journal.repaired
            self.found: dict[int, Any] = {}
            for record in JournalReader(path):
                if record.kind == _CHUNK:
                    self._take(record.payload)
        except BaseException:
            self._journal.close()
            raise

    def keep(self, done: Done) -> None:
        """Write one chunk."""
        payload = {"first": done.first, "seconds": done.seconds, "results": done.results}
        self._journal.append(_CHUNK, payload)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._journal.close()

    def _take(self, payload: Mapping[str, Any]) -> None:
        with suppress(KeyError, TypeError):
            self.found.update(enumerate(payload["results"], payload["first"]))
            return
        raise DataError(f"{self._journal.path}: a record of finished runs is not one")


def _refuse_others(journal: Journal, about: Mapping[str, Any]) -> None:
    """Results of other settings, or of another version, must not be mixed in."""
    there = journal.about
    different = [
        f"{name}: {there.get(name)!r} there, {wanted!r} here"
        for name, wanted in about.items()
        if name != "spec" and there.get(name) != wanted
    ]
    old, new = there.get("spec") or {}, about["spec"]
    different += [
        f"{key}: {old.get(key)!r} there, {new.get(key)!r} here"
        for key in sorted({*old, *new})
        if old.get(key) != new.get(key)
    ]
    if different:
        raise DataError(
            f"{journal.path}: holds the runs of another study ({'; '.join(different)}); ask for "
            "the same, or give this one a file of its own"
        )
