"""The conversation on standard input: every line gets one line of JSON as its answer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from lasercal_gtsam.cli.live import update_document
from lasercal_gtsam.errors import DataError, LasercalError
from lasercal_gtsam.io.spot_lines import LineError, Reset, Sizes, SpotLines
from lasercal_gtsam.observations import Observations

if TYPE_CHECKING:
    from lasercal_gtsam.cli.keeper import Keeper

_CAMERA = "camera"


class Answers:
    """Takes lines; an answer for a spot comes when the journal has it on the disk."""

    def __init__(self, keeper: Keeper, lines: SpotLines) -> None:
        self._keeper, self._lines = keeper, lines
        self._number = 0
        self._waiting: list[tuple[int, Observations]] = []

    def take(self, lines: Sequence[bytes]) -> None:
        """Answer lines that came together; their spots go to the disk together."""
        for line in lines:
            self._number += 1
            if not line.strip():
                continue
            try:
                self._take(line)
            except LineError as error:
                self._flush()
                self._refuse(self._number, error.id, str(error))
            except LasercalError as error:
                self._refuse(self._number, None, str(error))
        self._flush()

    def _take(self, line: bytes) -> None:
        item = self._lines.read(line)
        if isinstance(item, Observations):
            name = str(item.id[0])
            if any(name == str(spot.id[0]) for _, spot in self._waiting):
                self._flush()
            known = self._keeper.session.known
            if name not in known:
                self._waiting.append((self._number, item))
            elif known.same(item)[0]:
                self._flush()
                self._keeper.print({"id": name, "status": "known", **self._state()})
            else:
                raise LineError(
                    f"id: {name!r} is in {known.where(name)} already with other values; a new spot "
                    "needs an id of its own",
                    name,
                )
            return
        self._flush()
        if isinstance(item, Sizes):
            self._set_sizes(item)
            return
        session = self._keeper.session
        if isinstance(item, Reset):
            update = session.reset(item.part, item.name)
            self._keeper.print({"reset": {item.part: item.name}, **update_document(update)})
        else:
            update = session.dismiss()
            self._keeper.print({"dismiss": True, **update_document(update)})
        self._keeper.said(update)

    def _flush(self) -> None:
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        try:
            self._keeper.take([spot for _, spot in waiting])
        except DataError as error:  # not on the disk: none of them counts
            for number, spot in waiting:
                self._refuse(number, str(spot.id[0]), str(error))

    def _refuse(self, number: int, name: str | None, text: str) -> None:
        words = f"line {number}: {text}"
        self._keeper.print({"id": name, "error": words, "line": number})
        self._keeper.screen.warn(f"Warning: standard input: {words}")

    def _set_sizes(self, said: Sizes) -> None:
        session, lines = self._keeper.session, self._lines
        sizes = dict(said.image_size)
        if "" in sizes:
            names = list(lines.image_size) or [_CAMERA]
            if len(names) > 1:
                raise LineError(f"image_size: there are cameras {', '.join(names)}: say by camera")
            sizes[names[0]] = sizes.pop("")
        session.check_sizes({**sizes})
        for name, size in lines.image_size.items():
            if sizes.get(name, size) != size:
                raise LineError(f"image_size: camera {name!r} has {list(size)}")
        lines.image_size.update(sizes)
        self._keeper.print({"image_size": lines.image_size, **self._state()})

    def _state(self) -> dict[str, Any]:
        calibrator = self._keeper.session.calibrator
        return {"phase": calibrator.phase, "n_spots": calibrator.n_spots}
