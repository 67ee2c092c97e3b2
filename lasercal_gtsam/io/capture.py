"""A capture on disk: ``capture.yaml`` beside its tables and pictures, read into SI units."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lasercal_gtsam.errors import DataError, DetectionError
from lasercal_gtsam.frozen import Array, FrozenData, set_array
from lasercal_gtsam.io.files import sha256_of
from lasercal_gtsam.io.pictures import OptionalPaths, Picture, find_pictures, read_picture
from lasercal_gtsam.io.spot_account import FoundSpot, SpotAccount
from lasercal_gtsam.io.stand_in import StandIns
from lasercal_gtsam.io.wording import at_most, some
from lasercal_gtsam.observations import Names, Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.units import MM_PER_M, RAD_PER_DEG

if TYPE_CHECKING:
    from lasercal_gtsam.io.capture_head import CaptureHead
    from lasercal_gtsam.io.capture_rows import Rows
    from lasercal_gtsam.io.yaml_text import Lines

CAPTURE_FILE = "capture.yaml"

Detector = Callable[[Picture, Picture | None], FoundSpot]
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class CaptureNoise:
    """What the user says about the noise, 1 sigma; None or 0 where he says nothing.

    ``estimate``: as ``CalibrationOptions.estimate_noise``.
    """

    sigma_px: float | None = None
    hand_sigma_m: float = 0.0
    hand_sigma_rad: float = 0.0
    estimate: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Capture(FrozenData):
    """N rows of a capture: hand poses in SI units, with given pixels or with pictures.

    Attributes
    ----------
    path : ``capture.yaml``
    image_size : camera name to (width, height), pixels
    ids, planes, cameras, lasers : (N,) arrays of str
    T_base_hand : (N, 4, 4), metres; hand coordinates into base coordinates
    uv, cov_uv : (N, 2) px and (N, 2, 2) px^2 as given by the user; NaN where nothing is given
    verdict, reason : what the spot table says about each row: ``used`` where its pixel is given,
        another word where it must not be used, "" where nothing is said
    images_on, images_off : picture of each row with the laser on, and off; None where there is none
    saturation : pixel value from which a pixel is saturated, if the user gave it
    noise, known : as given by the user; ``known`` in the form of ``CalibrationOptions.known``
    provenance : file name to SHA-256 of ``capture.yaml`` and the tables
    warnings : what was found odd but not wrong, one sentence each
    stops : as of `Observations`; None where the table has no such column
    """

    path: Path
    image_size: Mapping[str, tuple[int, int]]
    ids: Names
    planes: Names
    cameras: Names
    lasers: Names
    T_base_hand: Array
    uv: Array
    cov_uv: Array
    verdict: tuple[str, ...]
    reason: tuple[str, ...]
    images_on: OptionalPaths
    images_off: OptionalPaths
    saturation: float | None
    noise: CaptureNoise
    known: Mapping[str, Any]
    provenance: Mapping[str, str]
    warnings: tuple[str, ...]
    stops: Names | None = None

    def __post_init__(self) -> None:
        count = len(set_array(self, "T_base_hand", self.T_base_hand, (None, 4, 4)))
        set_array(self, "uv", self.uv, (count, 2), finite=False)
        set_array(self, "cov_uv", self.cov_uv, (count, 2, 2), finite=False)
        for name in ("ids", "planes", "cameras", "lasers", "stops"):
            if name == "stops" and self.stops is None:
                continue
            values = np.array(getattr(self, name), dtype=np.str_)
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(self.ids)

    def detections(
        self, detector: Detector | None = None, progress: Progress | None = None
    ) -> SpotAccount:
        """Account for every row: given pixels as they are, pictures through the detector.

        Rows without a laser-off picture get the median of their scene's laser-on pictures in its
        place, where five or more of one camera and plane can give one (`StandIns`); the account's
        notes and the rows' reasons say so.

        Parameters
        ----------
        detector : ``(on, off or None) -> detection``; None: `lasercal_gtsam.detect.detect_spot`
            with its defaults and the capture's saturation value
        progress : called with (rows done, rows to do) after each picture

        Raises
        ------
        DataError
            Pictures that are missing, unreadable or of the wrong size; all of them are named.
        """
        todo = [k for k, image in enumerate(self.images_on) if not self.verdict[k] and image]
        found: dict[int, FoundSpot] = {}
        problems: list[str] = []
        stand_ins = self._stand_ins(todo)
        if todo and detector is None:
            detector = self._default_detector()
        for done, k in enumerate(todo, start=1):
            on, off = self._read_pictures(k, problems)
            if detector is not None and not problems:
                try:
                    found[k] = detector(on, stand_ins.frame(k, on) if off is None else off)
                except (DataError, DetectionError) as error:
                    problems.append(f"id {self.ids[k]}: {self.images_on[k]}: {error}")
            if progress is not None:
                progress(done, len(todo))
        if problems:
            raise DataError(*at_most(problems))
        return self._account(found, stand_ins)

    def observations(
        self,
        detector: Detector | None = None,
        progress: Progress | None = None,
        *,
        account: SpotAccount | None = None,
    ) -> Observations:
        """Return the usable spots as observations.

        Rows without a usable spot are left out; `detections` names them with reasons. Give its
        result as ``account`` to look at the pictures only once.

        Raises
        ------
        DataError
            As in `detections`; and if no row is usable.
        """
        if account is None:
            account = self.detections(detector, progress)
        elif list(account.ids) != self.ids.tolist():
            raise DataError(f"{self.path}: the account is that of another capture (other ids)")
        rows = np.flatnonzero(account.usable)
        if not len(rows):
            reasons = [f"id {name}: {why}" for name, why in account.skipped.items()]
            raise DataError(
                f"{self.path}: none of the {len(self)} rows gives a spot", *at_most(reasons)
            )
        return Observations(
            uv=account.uv[rows],
            cov_uv=account.cov_uv[rows],
            T_base_hand=self.T_base_hand[rows],
            camera=self.cameras[rows],
            laser=self.lasers[rows],
            plane=self.planes[rows],
            id=self.ids[rows],
            image_size=self.image_size,
            stop=None if self.stops is None else self.stops[rows],
        )

    def options(self, **overrides: Any) -> CalibrationOptions:
        """Options with the noise and the known values that the capture states.

        ``overrides`` are fields of `CalibrationOptions` and win over the capture; ``known`` is
        merged name by name.
        """
        return stated_options(self.noise, self.known, overrides)

    def _default_detector(self) -> Detector:
        from lasercal_gtsam.detect.options import DetectionOptions
        from lasercal_gtsam.detect.pipeline import detect_spot

        options = DetectionOptions(saturation_level=self.saturation)
        return lambda on, off: detect_spot(on, off, options)

    def _read_pictures(self, k: int, problems: list[str]) -> list[Any]:
        """Pictures of a row, on and off; what is wrong with them is added to ``problems``."""
        size, where = self.image_size[str(self.cameras[k])], f"id {self.ids[k]}"
        pictures: list[Picture | None] = []
        for path in (self.images_on[k], self.images_off[k]):
            try:
                pictures.append(None if path is None else read_picture(path, size, where))
            except DataError as error:
                problems += error.problems
                pictures.append(None)
        return pictures

    def _stand_ins(self, todo: list[int]) -> StandIns:
        """Stand-ins for the laser-off pictures that rows do not have."""
        images = {k: path for k in todo if not self.images_off[k] and (path := self.images_on[k])}

        def read(k: int) -> Picture:
            size = self.image_size[str(self.cameras[k])]
            return read_picture(images[k], size, f"id {self.ids[k]}")

        scenes = {k: (str(self.cameras[k]), str(self.planes[k])) for k in images}
        return StandIns(scenes, read, self.saturation)

    def _account(self, found: Mapping[int, FoundSpot], stand_ins: StandIns) -> SpotAccount:
        uv, cov = self.uv.copy(), self.cov_uv.copy()
        verdict, reason, source = list(self.verdict), list(self.reason), ["table"] * len(self)
        for k, image in enumerate(self.images_on):
            spot = found.get(k)
            if spot is not None:
                uv[k], cov[k] = spot.uv, spot.cov_uv
                verdict[k] = "used" if spot.usable else spot.verdict
                reason[k], source[k] = spot.reason, str(image)
                if k in stand_ins.remarks:
                    reason[k] = "; ".join(filter(None, [spot.reason, stand_ins.remarks[k]]))
            elif not verdict[k]:
                verdict[k], reason[k] = "missing", "the row has neither a pixel nor a picture"
                source[k] = ""
        return SpotAccount(
            ids=tuple(str(i) for i in self.ids),
            verdict=tuple(verdict),
            reason=tuple(reason),
            source=tuple(source),
            uv=uv,
            cov_uv=cov,
            detections=tuple(found.get(k) for k in range(len(self))),
            notes=tuple(stand_ins.notes),
        )


def load_capture(path: str | Path) -> Capture:
    """Read a capture: ``capture.yaml``, or the folder it lies in.

    Pictures are not opened yet; that they exist is checked.

    Raises
    ------
    DataError
        With all problems of a file at once, each with file, line, key or column, what was found
        and what is allowed.
    """
    from lasercal_gtsam.io.capture_head import read_head
    from lasercal_gtsam.io.capture_rows import read_rows

    path = capture_file(Path(path))
    folder = path.parent
    head, lines = read_head(path)
    rows = read_rows(head, folder)
    if not rows.has_spots and head.images is None:
        raise DataError(
            f"{path.name}: there are no spots: give columns u, v in {head.poses.file}, "
            "spots: {file: spots.csv}, or images: images/{id}.png"
        )
    on, off, image_warnings = _pictures(head, rows, folder, path.name, lines)
    noise, noise_warnings = stated_noise(head, path.name)
    files = [head.poses.file, *([head.spots.file] if head.spots else [])]
    return Capture(
        path=path,
        image_size={camera.name: (camera.width, camera.height) for camera in head.camera},
        ids=np.array(rows.ids, dtype=np.str_),
        planes=np.array(rows.planes, dtype=np.str_),
        cameras=np.array(rows.cameras, dtype=np.str_),
        lasers=np.array(rows.lasers, dtype=np.str_),
        T_base_hand=rows.T_base_hand,
        uv=rows.uv,
        cov_uv=rows.cov_uv,
        verdict=tuple(rows.verdict),
        reason=tuple(rows.reason),
        images_on=on,
        images_off=off,
        saturation=head.images.saturation if head.images else None,
        noise=noise,
        known=known_values(head),
        provenance={path.name: sha256_of(path), **{f: sha256_of(folder / f) for f in files}},
        warnings=(
            *rows.warnings,
            *_repeated_rows(rows, head.poses.file),
            *image_warnings,
            *noise_warnings,
        ),
        stops=None if rows.stops is None else np.array(rows.stops, dtype=np.str_),
    )


def stated_options(
    noise: CaptureNoise, known: Mapping[str, Any], overrides: Mapping[str, Any] | None = None
) -> CalibrationOptions:
    """Options with stated noise and known values; see `Capture.options`."""
    stated = {
        "sigma_px": noise.sigma_px,
        "hand_sigma_m": noise.hand_sigma_m,
        "hand_sigma_rad": noise.hand_sigma_rad,
        "estimate_noise": noise.estimate,
    }
    chosen = dict(overrides or {})
    merged = {**known, **chosen.pop("known", {})}
    return CalibrationOptions(**{**stated, **chosen, "known": merged})


def capture_file(path: Path) -> Path:
    """``capture.yaml`` of a path, which is that file or its folder."""
    if not path.is_dir():
        return path
    if (path / CAPTURE_FILE).is_file():
        return path / CAPTURE_FILE
    others = sorted(p.name for pattern in ("*.yaml", "*.yml") for p in path.glob(pattern))
    hint = f"; it has {some(others)}: give one of them" if others else ""
    raise DataError(f"{path}: there is no {CAPTURE_FILE} in this folder{hint}")


def _pictures(
    head: CaptureHead, rows: Rows, folder: Path, name: str, lines: Lines
) -> tuple[OptionalPaths, OptionalPaths, list[str]]:
    none = (None,) * len(rows.ids)
    if head.images is None:
        return none, none, []
    keys = ("on", "off", "background")
    patterns = {key: getattr(head.images, key) for key in keys}
    places = {key: f"{name}:{lines.of(('images', key))}: images.{key}" for key in keys}
    columns = {"id": rows.ids, "plane": rows.planes, "camera": rows.cameras, "laser": rows.lasers}
    needed = [not verdict for verdict in rows.verdict]
    return find_pictures(patterns, folder, columns, needed, places)


def known_values(head: CaptureHead) -> dict[str, Any]:
    """What ``capture.yaml`` holds fixed, in the form of `CalibrationOptions.known`."""
    return {
        key: tuple(value) if isinstance(value, list) else value for key, value in head.known.items()
    }


def stated_noise(head: CaptureHead, name: str) -> tuple[CaptureNoise, list[str]]:
    """The noise that ``capture.yaml`` states, and warnings about it."""
    from lasercal_gtsam.io.capture_head import HAND_KEYS

    said = head.noise
    if said is None:
        return CaptureNoise(), []
    warnings = []
    twice = [key for key in said.estimate if getattr(said, key)]
    if twice:
        raise DataError(
            f"{name}: noise.estimate: {twice[0]} is to be estimated, but also stated; leave one out"
        )
    if said.pixel == 0:
        warnings.append(
            f"{name}: noise.pixel is 0, which cannot weigh anything; it is taken as not stated and "
            "estimated from the residuals"
        )
    noise = CaptureNoise(
        sigma_px=said.pixel or None,
        hand_sigma_m=said.hand_translation_mm / MM_PER_M,
        hand_sigma_rad=said.hand_rotation_deg * RAD_PER_DEG,
        estimate=tuple(HAND_KEYS[key] for key in said.estimate),
    )
    return noise, warnings


def _repeated_rows(rows: Rows, name: str) -> list[str]:
    """Rows that repeat pose and pixel to the last digit: copies, not second measurements."""
    first: dict[tuple[bytes, ...], str] = {}
    pairs = []
    for k in np.flatnonzero(np.isfinite(rows.uv).all(axis=1)):
        names = "\0".join([rows.planes[k], rows.cameras[k], rows.lasers[k]])
        key = (rows.T_base_hand[k].tobytes(), rows.uv[k].tobytes(), names.encode())
        if key in first:
            pairs.append(f"{first[key]} = {rows.ids[k]}")
        first.setdefault(key, rows.ids[k])
    if not pairs:
        return []
    return [
        f"{name}: {len(pairs)} rows repeat pose and pixel of another row exactly ({some(pairs)}); "
        "they are kept and count twice"
    ]
