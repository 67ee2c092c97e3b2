"""A capture that grows, as a stream of new spots: rows and pictures as they come, each used once.

Rows are known by their id. A row that is wrong, or whose picture is not there yet, keeps nobody
waiting: it is named, and looked at again when it changes. Nothing is used twice: a row that says
something else after it was used is reported and stays as it was.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.capture import capture_file
from lasercal_gtsam.io.capture_head import read_head
from lasercal_gtsam.io.capture_rows import USED, Rows, rows_of, spot_pixels
from lasercal_gtsam.io.files import sha256_of
from lasercal_gtsam.io.follow_pictures import Detector, Fault, PictureDesk, Wait
from lasercal_gtsam.io.follow_tables import CaptureTables, NewRow, at_line, without_repeats
from lasercal_gtsam.io.growing import Clock
from lasercal_gtsam.io.known_spots import KnownSpots
from lasercal_gtsam.io.tables import Row, Table
from lasercal_gtsam.observations import Observations

# Spots given at once, so that whoever takes them can stop between.
BATCH = 256
# Lines said one by one at a look; the rest is counted.
_MOST_NOTICES = 20

NoticeKind = Literal["file", "wrong", "changed", "skipped", "note"]


@dataclass(frozen=True)
class Notice:
    """Something to be said, once.

    ``file``: a table cannot be read as it is, so nothing in it; ``wrong``: a row or a line;
    ``changed``: a row says something else than when it was used; ``skipped``: its picture gave no
    spot; ``note``: neither good nor bad. ``id`` is "" where it is about no row.
    """

    kind: NoticeKind
    id: str
    words: str


@dataclass
class _Open:
    """What the tables say of a row that has given no spot yet."""

    pose: Row | None = None
    spot: Row | None = None


class _Pictured(NamedTuple):
    """A good row without a pixel."""

    words: Mapping[str, str]
    T_base_hand: Array


class CaptureFollower:
    """Reads a capture again and again; `poll` gives what is new.

    Parameters
    ----------
    path : ``capture.yaml`` or its folder; the tables need not be there yet
    known : spots that were taken already; those given by `poll` are added
    where : where spots given from now on are, for messages ("this journal")
    prefix : put before every id
    sigma_px : given to spots without a covariance of their own; None: they are left without
    detector : as in `Capture.detections`
    clock : seconds, for how long files have not changed

    Attributes
    ----------
    path, head : ``capture.yaml`` and what it says
    image_size : camera name to (width, height), pixels
    waiting : after a `poll`: each good row that gave no spot yet (or place in a file), and why
    soon : after a `poll`: whether some of it may be settled by the next one

    Raises
    ------
    DataError
        ``capture.yaml`` is wrong, or its pictures cannot be followed.
    """

    def __init__(
        self,
        path: str | Path,
        known: KnownSpots,
        *,
        where: str = "use",
        prefix: str = "",
        sigma_px: float | None = None,
        detector: Detector | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        self.path = capture_file(Path(path))
        self.head, _ = read_head(self.path)
        self._head_digest = sha256_of(self.path)
        self._head_seen = self._head_status()
        self.image_size = {c.name: (c.width, c.height) for c in self.head.camera}
        self.waiting: dict[str, str] = {}
        self.soon = False
        self._known, self._where, self._prefix = known, where, prefix
        self._sigma_px = sigma_px
        folder, name = self.path.parent, self.path.name
        self._desk = None
        if self.head.images is not None:
            self._desk = PictureDesk(self.head, folder, name, detector, clock)
        self._tables = CaptureTables(self.head, self.path, clock)
        self._open: dict[str, _Open] = {}
        self._unjudged: dict[str, None] = {}
        self._pictured: dict[str, _Pictured] = {}
        self._raw: dict[tuple[str, str], int] = {}
        self._said: set[str] = set()

    def poll(self) -> Iterator[Observations | Notice]:
        """Look once: new spots, at most `BATCH` at a time, and what there is to say.

        A spot counts as taken when it was given.
        """
        self.waiting, self.soon = {}, False
        left = _MOST_NOTICES
        for item in self._look():
            left -= isinstance(item, Notice)
            if left >= 0 or not isinstance(item, Notice):
                yield item
        if left < 0:
            yield Notice("note", "", f"... and {-left} more lines like these")

    def _look(self) -> Iterator[Observations | Notice]:
        yield from self._look_at_head()
        news = self._tables.read()
        for text in news.broken:
            yield from self._say("file", "", text)
        for text in news.wrong:
            yield from self._say("wrong", "", text)
        for name in news.missing:
            self.waiting[name] = "the file is not there yet"
        for name in news.again:
            self._forget_open_rows(name)
        if news.new_header:
            self._raw.clear()
        if self._tables.usable:
            yield from self._sort(news.rows)
            yield from self._judge()
            yield from self._look_at_pictures()
        for label in self._unjudged:
            self.waiting[label] = f"it has no row in {self._tables.poses_file} yet"
        for place, long in self._tables.unfinished():
            text = "the last line has no line end yet, and waits for it"
            self.waiting[place] = text
            if long:
                yield from self._say("note", "", f"{place}: {text}")

    def _forget_open_rows(self, name: str) -> None:
        for label, entry in list(self._open.items()):
            self._raw.pop((name, label), None)
            self._pictured.pop(label, None)
            if name == self._tables.poses_file:
                entry.pose = None
            else:
                entry.spot = None
            if entry == _Open():
                del self._open[label]
                self._unjudged.pop(label, None)
            else:
                self._unjudged[label] = None

    # --- rows -----------------------------------------------------------------------------------

    def _sort(self, new: Sequence[NewRow]) -> Iterator[Observations | Notice]:
        """Enter new rows under their ids; those of spots already taken are compared with them."""
        taken: dict[str, list[tuple[str, Row]]] = {}
        for name, label, row in new:
            digest = hash(tuple(cell.strip() for cell in row[1]))
            if self._raw.get((name, label)) == digest:
                continue
            if label in self._unjudged and self._has(name, label):
                yield from self._judge()  # the first of two rows comes first
            self._raw[name, label] = digest
            if self._prefix + label in self._known:
                taken.setdefault(name, []).append((label, row))
                continue
            entry = self._open.setdefault(label, _Open())
            if name == self._tables.poses_file:
                entry.pose = row
            else:
                entry.spot = row
            self._pictured.pop(label, None)
            self._unjudged[label] = None
        for name, rows in taken.items():
            for part in without_repeats(rows):
                yield from self._compare(name, part)

    def _has(self, name: str, label: str) -> bool:
        entry = self._open[label]
        return (entry.pose if name == self._tables.poses_file else entry.spot) is not None

    def _judge(self) -> Iterator[Observations | Notice]:
        """Take rows that are good, name those that are wrong; the rest waits for its picture."""
        labels = [label for label in self._unjudged if self._open[label].pose is not None]
        for start in range(0, len(labels), BATCH):
            some = labels[start : start + BATCH]
            for label in some:
                del self._unjudged[label]
            yield from self._judge_some(some)

    def _judge_some(self, labels: Sequence[str]) -> Iterator[Observations | Notice]:
        entries = [self._open[label] for label in labels]
        poses = self._tables.poses([entry.pose for entry in entries if entry.pose])
        spots = self._tables.spots([entry.spot for entry in entries if entry.spot])
        rows = rows_of(self.head, poses, spots)
        wrong: dict[str, list[str]] = {}
        for table in (poses, spots):
            if table is None:
                continue
            label_of = dict(zip(table.lines, table.columns["id"], strict=True))
            for line, texts in table.problems_by_line().items():
                found = [at_line(table.name, line, text) for text in texts]
                wrong.setdefault(label_of.get(line, ""), []).extend(found)
        yield from self._say_warnings(rows.warnings)
        good = []
        for k, label in enumerate(labels):
            if label in wrong:
                yield from self._say("wrong", label, "; ".join(wrong[label]))
            elif rows.verdict[k] == USED:
                good.append(k)
            elif rows.verdict[k]:
                why = f"{rows.verdict[k]}: {rows.reason[k]}"
                yield from self._say("skipped", label, f"id {label}: {why}")
            else:
                self._pictured[label] = _Pictured(_words(rows, k), rows.T_base_hand[k])
        if good:
            yield self._take([labels[k] for k in good], rows, good)

    def _take(self, labels: Sequence[str], rows: Rows, which: Sequence[int]) -> Observations:
        taken = self._observations(rows, which, rows.uv[which], rows.cov_uv[which])
        for label in labels:
            del self._open[label]
        self._known.add(taken, self._where)
        return taken

    def _observations(
        self, rows: Rows, which: Sequence[int], uv: Array, cov_uv: Array
    ) -> Observations:
        cov = np.array(cov_uv)
        if self._sigma_px is not None:
            cov[np.isnan(cov).any(axis=(1, 2))] = self._sigma_px**2 * np.eye(2)
        return Observations(
            uv=uv,
            cov_uv=cov,
            T_base_hand=rows.T_base_hand[which],
            camera=np.array([rows.cameras[k] for k in which], dtype=np.str_),
            laser=np.array([rows.lasers[k] for k in which], dtype=np.str_),
            plane=np.array([rows.planes[k] for k in which], dtype=np.str_),
            id=np.array([self._prefix + rows.ids[k] for k in which], dtype=np.str_),
            image_size=self.image_size,
            stop=None
            if rows.stops is None
            else np.array([rows.stops[k] for k in which], dtype=np.str_),
        )

    # --- rows that were taken already -----------------------------------------------------------

    def _compare(self, name: str, labelled: Sequence[tuple[str, Row]]) -> Iterator[Notice]:
        """Say which rows say something else than when they were taken."""
        labels, rows = [label for label, _ in labelled], [row for _, row in labelled]
        if name == self._tables.poses_file:
            table = self._tables.poses(rows)
            same = self._same_poses(table)
        else:
            spots = self._tables.spots(rows)
            assert spots is not None
            table, same = spots, self._same_pixels(spots, labels)
        wrong = table.problems_by_line()
        verdicts = table.columns.get("verdict", [""] * len(table))
        for label, line, agrees, verdict in zip(labels, table.lines, same, verdicts, strict=True):
            if agrees and line not in wrong:
                continue
            full = self._prefix + label
            taken_back = verdict.lower() not in ("", USED)
            other = f"verdict {verdict!r}" if taken_back else "other values"
            what = "; ".join(wrong.get(line, [other]))
            text = (
                f"id {label!r}: {what}, but this spot is in {self._known.where(full)} already and "
                "stays there as it is; a new spot needs an id of its own"
            )
            yield from self._say("changed", full, at_line(name, line, text))

    def _same_poses(self, table: Table) -> list[bool]:
        rows = rows_of(self.head, table, None)
        which = [k for k in range(len(table)) if table.lines[k] not in table.problems_by_line()]
        same = [False] * len(table)
        if not which:
            return same
        uv = np.nan_to_num(rows.uv[which])
        found = self._observations(rows, which, uv, rows.cov_uv[which])
        poses = self._known.same_poses(found)
        pixels = self._known.same_pixels(found.id.tolist(), found.uv, found.cov_uv)
        for i, k in enumerate(which):
            given = rows.verdict[k] == USED
            same[k] = poses[i] and (pixels[i] or not given)
            if self._desk is not None and not given:
                self._desk.remember(_words(rows, k))
        return same

    def _same_pixels(self, table: Table, labels: Sequence[str]) -> list[bool]:
        uv, cov = spot_pixels(table, [None] * len(table))
        if self._sigma_px is not None:
            cov[np.isnan(cov).any(axis=(1, 2))] = self._sigma_px**2 * np.eye(2)
        names = [self._prefix + label for label in labels]
        same = self._known.same_pixels(names, np.nan_to_num(uv), cov)
        verdicts = table.columns.get("verdict", [""] * len(table))
        # without a pixel and a verdict a row says nothing
        return [
            agrees if verdict.lower() == USED else not verdict and (agrees or np.isnan(pixel).any())
            for agrees, verdict, pixel in zip(same, verdicts, uv, strict=True)
        ]

    # --- pictures, ends, words ------------------------------------------------------------------

    def _look_at_pictures(self) -> Iterator[Observations | Notice]:
        before = len(self._pictured)
        for label, row in list(self._pictured.items()):
            if self._desk is None:
                self.waiting[label] = "there is no pixel u, v for it yet"
                continue
            found = self._desk.look(row.words)
            for text in self._desk.take_notes():
                yield from self._say("note", "", text)
            if isinstance(found, Wait):
                self.waiting[label], self.soon = found.why, self.soon or found.soon
            elif isinstance(found, Fault):
                self.waiting[label] = found.why
                kind: NoticeKind = "skipped" if found.seen else "wrong"
                yield from self._say(kind, label, f"id {label}: {found.why}")
            else:
                del self._pictured[label], self._open[label]
                self._desk.done_with(row.words)
                taken = Observations(
                    uv=found.uv[None],
                    cov_uv=found.cov_uv[None],
                    T_base_hand=row.T_base_hand[None],
                    camera=np.array([row.words["camera"]]),
                    laser=np.array([row.words["laser"]]),
                    plane=np.array([row.words["plane"]]),
                    id=np.array([self._prefix + label]),
                    image_size=self.image_size,
                )
                self._known.add(taken, self._where)
                yield taken
        # a picture may have been the last one that others waited for
        self.soon = self.soon or 0 < len(self._pictured) < before

    def _look_at_head(self) -> Iterator[Notice]:
        status = self._head_status()
        if status != self._head_seen:
            self._head_seen = status
            if status and sha256_of(self.path) != self._head_digest:
                text = f"{self.path.name} has changed, which counts from the next start on"
                yield from self._say("note", "", text)

    def _head_status(self) -> tuple[int, ...]:
        try:
            status = self.path.stat()
        except OSError:
            return ()
        return (status.st_ino, status.st_size, status.st_mtime_ns)

    def _say_warnings(self, warnings: Iterable[str]) -> Iterator[Notice]:
        """Warnings about units and rounding: once, whatever numbers are in them."""
        for text in warnings:
            key = re.sub(r"[-+.\de]*\d", "#", text)
            if key not in self._said:
                self._said.add(key)
                yield Notice("note", "", text)

    def _say(self, kind: NoticeKind, name: str, words: str) -> Iterator[Notice]:
        if words not in self._said:
            self._said.add(words)
            yield Notice(kind, name, words)


def _words(rows: Rows, k: int) -> dict[str, str]:
    """What the placeholders of a picture pattern stand for in a row."""
    return {
        "id": rows.ids[k],
        "plane": rows.planes[k],
        "camera": rows.cameras[k],
        "laser": rows.lasers[k],
    }
