"""Which unknowns are held, known, tied or weakly prior-ed, resolved from the options.

Everything here is words and booleans over the tangent coordinates of `report_map`; no solving.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.cell import INTRINSIC_NAMES, Camera, Cell, Intrinsics
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import DISTORTION_NAMES, CalibrationOptions
from lasercal_gtsam.report_map import BEAM_TANGENT, CAMERA_TANGENT, PLANE_TANGENT, BeamChart
from lasercal_gtsam.report_map import row_names as table_rows

# method 6.2: what one plane is told when nobody says more (units of the table rows)
ONE_PLANE_PRIORS: dict[str, tuple[float, float]] = {
    "aspect": (1.0, 0.01),
    "k1": (0.0, 1.0),
    "k2": (0.0, 3.0),
    "p1": (0.0, 0.03),
    "p2": (0.0, 0.03),
}
# below this sine of its angle to the hand's z axis a beam's polar angle is rounding
_LEAST_SIN_PHI = 1e-3


@dataclass(frozen=True)
class Holds:
    """What is not free.

    Attributes
    ----------
    held : (n,) booleans over the tangent coordinates: kept at the start's value
    known : camera -> intrinsic name -> value that replaces the start's
    aspect : camera -> fu / fv, where tied (``fu`` follows ``fv``)
    fu_leads : cameras where ``fu`` is held, so that the tied ``fv`` is held at ``fu / aspect``
    priors : name -> (mean, sigma) in table units; names prefixed as in the table
    words : one sentence for each, for the report
    """

    held: npt.NDArray[np.bool_]
    known: dict[str, dict[str, float]]
    aspect: dict[str, float]
    fu_leads: frozenset[str]
    priors: dict[str, tuple[float, float]]
    words: tuple[str, ...]

    def apply(self, cell: Cell) -> Cell:
        """Put the known values (and tied focal lengths) into a start."""
        if not self.aspect and not any(self.known.values()):
            return cell
        cameras: dict[str, Camera] = {}
        for name, camera in cell.cameras.items():
            values = dict(zip(INTRINSIC_NAMES, camera.intrinsics.vector, strict=True))
            values |= self.known.get(name, {})
            if name in self.fu_leads:
                values["fv"] = values["fu"] / self.aspect[name]
            elif name in self.aspect:
                values["fu"] = self.aspect[name] * values["fv"]
            intrinsics = Intrinsics(**{k: float(v) for k, v in values.items()})
            cameras[name] = Camera(intrinsics, camera.T_base_camera, camera.image_size)
        return Cell(cameras, cell.lasers, cell.planes)

    def without_distortion(self, keep: tuple[str, ...] = ()) -> Holds:
        """Hold the distortion terms too, except those named (for staged starts, method 6.2)."""
        held = self.held.copy()
        for c in range(len(self.known)):
            for term in DISTORTION_NAMES:
                if term not in keep:
                    held[c * len(CAMERA_TANGENT) + CAMERA_TANGENT.index(term)] = True
        return replace(self, held=held)

    def leaving_out(self, terms: Mapping[str, tuple[str, ...]]) -> Holds:
        """Hold distortion terms of cameras at the start's values; their priors go with them.

        Parameters
        ----------
        terms : camera -> terms; as in "auto", where they were found not to be needed
        """
        held, words, dropped = self.held.copy(), list(self.words), set[str]()
        for c, camera in enumerate(self.known):
            left_out = terms.get(camera, ())
            prefix = f"{camera}." if len(self.known) > 1 else ""
            for term in left_out:
                held[c * len(CAMERA_TANGENT) + CAMERA_TANGENT.index(term)] = True
                dropped.add(prefix + term)
            if left_out:
                names = ", ".join(prefix + term for term in left_out)
                words.append(f"{names} held at the start's value (distortion='auto')")
        priors = {name: prior for name, prior in self.priors.items() if name not in dropped}
        return replace(self, held=held, priors=priors, words=tuple(words))


def resolve_holds(
    observations: Observations, options: CalibrationOptions, initial: Cell | None = None
) -> Holds:
    """Turn the options into masks and values for the parts that were observed.

    One plane seen by a camera: its skew and its principal point are held and weak priors are set,
    as in section 3.3 of the paper. The principal point is the known one, or that of a given
    ``initial`` cell, or the image centre (half width, half height).

    Raises
    ------
    DataError
        A name in ``known``, ``fixed`` or ``priors`` does not exist (lists those that do); something
        is fixed at a start that was not given; two wishes contradict each other.
    """
    builder = _Builder(observations)
    builder.distortion(options.distortion)
    for key, value in options.known.items():
        builder.known_value(key, value)
    for key in options.fixed:
        builder.fix(key, initial is not None)
    fu_leads = builder.tied_focal_lengths()
    builder.one_plane(options, initial)
    builder.user_priors(options.priors)
    return Holds(
        builder.held,
        builder.known,
        builder.aspect,
        fu_leads,
        builder.priors,
        tuple(builder.words),
    )


class _Builder:
    def __init__(self, observations: Observations) -> None:
        self.observations = observations
        self.cameras, self.lasers = observations.cameras, observations.lasers
        self.planes = observations.planes
        n_camera, n_laser = len(self.cameras), len(self.lasers)
        self.first_laser = n_camera * len(CAMERA_TANGENT)
        self.first_plane = self.first_laser + n_laser * len(BEAM_TANGENT)
        size = self.first_plane + len(self.planes) * len(PLANE_TANGENT)
        self.held = np.zeros(size, dtype=np.bool_)
        self.known: dict[str, dict[str, float]] = {c: {} for c in self.cameras}
        self.aspect: dict[str, float] = {}
        self.priors: dict[str, tuple[float, float]] = {}
        self.words: list[str] = []

    def hold(self, camera: str, *names: str) -> None:
        first = self.cameras.index(camera) * len(CAMERA_TANGENT)
        for name in names:
            self.held[first + CAMERA_TANGENT.index(name)] = True

    def distortion(self, wanted: str | tuple[str, ...]) -> None:
        if wanted in ("all", "auto"):  # `lens_choice` decides later
            return
        keep: tuple[str, ...] = () if isinstance(wanted, str) else tuple(wanted)
        held = [term for term in DISTORTION_NAMES if term not in keep]
        for camera in self.cameras:
            self.hold(camera, *held)
        if held:
            self.words.append(
                f"{', '.join(held)} held at the start's value (distortion={wanted!r})"
            )

    def split(self, key: str, option: str) -> tuple[tuple[str, ...], str]:
        """Cameras meant by ``name`` or ``<camera>.name``, and the name."""
        camera, dot, name = key.rpartition(".")
        if not dot:
            return self.cameras, key
        if camera not in self.cameras:
            raise DataError(
                f"options.{option}: {key!r} names the camera {camera!r}; observed: {self.cameras}"
            )
        return (camera,), name

    def known_value(self, key: str, value: Any) -> None:
        cameras, name = self.split(key, "known")
        for camera in cameras:
            for term, number in _known_terms(name, value).items():
                if term == "aspect":
                    self.aspect[camera] = number
                else:
                    self.known[camera][term] = number
                    self.hold(camera, term)
        self.words.append(f"{key} held at the known value {value}")

    def is_held(self, camera: str, name: str) -> bool:
        first = self.cameras.index(camera) * len(CAMERA_TANGENT)
        return bool(self.held[first + CAMERA_TANGENT.index(name)])

    def fix(self, key: str, started: bool) -> None:
        kind, colon, name = key.partition(":")
        names: tuple[str, ...] = ()
        if colon:
            groups = {"camera": self.cameras, "laser": self.lasers, "plane": self.planes}
            if kind not in groups or name not in groups[kind]:
                raise DataError(
                    f"options.fixed: {key!r} is no part that was observed; there are "
                    + ", ".join(f"{k}:{n}" for k, names in groups.items() for n in names)
                )
            i = groups[kind].index(name)
            first, size = {
                "camera": (i * len(CAMERA_TANGENT), len(CAMERA_TANGENT)),
                "laser": (self.first_laser + i * len(BEAM_TANGENT), len(BEAM_TANGENT)),
                "plane": (self.first_plane + i * len(PLANE_TANGENT), len(PLANE_TANGENT)),
            }[kind]
            self.held[first : first + size] = True
        else:
            cameras, name = self.split(key, "fixed")
            groups_of = {
                "intrinsics": INTRINSIC_NAMES,
                "T_base_camera": CAMERA_TANGENT[:6],
                "distortion": DISTORTION_NAMES,
                "principal_point": ("u0", "v0"),
                "alpha_c": ("skew",),
            }
            names = groups_of.get(name, (name,))
            if names[0] not in CAMERA_TANGENT or (names == (name,) and name not in INTRINSIC_NAMES):
                raise DataError(
                    f"options.fixed: unknown name {key!r}; allowed: "
                    + ", ".join([*INTRINSIC_NAMES, *groups_of])
                    + ", camera:<name>, laser:<name>, plane:<name>"
                )
            for camera in cameras:
                self.hold(camera, *names)
        # without a given start the distortion starts at zero; all else at a crude estimate
        if not started and not (names and set(names) <= set(DISTORTION_NAMES)):
            raise DataError(
                f"options.fixed: {key!r} is to be held at the start's value, but no start is "
                "given; give one (initial), or the value itself (options.known)"
            )
        self.words.append(f"{key} held at the start's value (fixed)")

    def tied_focal_lengths(self) -> frozenset[str]:
        """Hold both focal lengths where one is held and they are tied; cameras where fu leads."""
        leads: list[str] = []
        for camera, aspect in self.aspect.items():
            fu, fv = (self.is_held(camera, name) for name in ("fu", "fv"))
            values = [self.known[camera].get(name, np.nan) for name in ("fu", "fv")]
            if fu and fv and not np.isclose(values[0], aspect * values[1]):
                raise DataError(
                    f"options.known: camera {camera!r} has its aspect tied to {aspect:g}, and fu "
                    "and fv are both held; leave one of the three out"
                )
            if fu:
                self.hold(camera, "fv")
                leads.append(camera)
            elif fv:
                self.hold(camera, "fu")
        return frozenset(leads)

    def one_plane(self, options: CalibrationOptions, initial: Cell | None) -> None:
        """Assumptions of the paper's section 3.3 for every camera that sees one plane only."""
        index = self.observations
        for c, camera in enumerate(self.cameras):
            if len(np.unique(index.plane_index[index.camera_index == c])) > 1:
                continue
            first = c * len(CAMERA_TANGENT)
            width, height = index.image_size[camera]
            free = {t: not self.held[first + CAMERA_TANGENT.index(t)] for t in INTRINSIC_NAMES}
            fixed: list[str] = []
            values = {"u0": width / 2, "v0": height / 2, "skew": 0.0}
            if initial is not None and camera in initial.cameras:
                values = {t: getattr(initial.cameras[camera].intrinsics, t) for t in values}
            for term, value in values.items():
                row = self.prefix(camera) + {"skew": "alpha_c"}.get(term, term)
                if free[term] and row not in options.priors:
                    self.known[camera][term] = value
                    self.hold(camera, term)
                    fixed.append(f"{term} = {value:g}")
            if fixed:
                self.words.append(
                    f"camera {camera!r} sees one plane only: {', '.join(fixed)} assumed and held"
                )
            weak: list[str] = []
            for term, (mean, sigma) in ONE_PLANE_PRIORS.items():
                name = self.prefix(camera) + term
                if term == "aspect":
                    wanted = camera not in self.aspect and free["fu"] and free["fv"]
                else:
                    wanted = free[term]
                if wanted and name not in options.priors and term not in options.priors:
                    self.priors[name] = (mean, sigma)
                    weak.append(f"{term.replace('aspect', 'fu/fv')} {mean:g} +- {sigma:g}")
            if weak:
                self.words.append(
                    f"camera {camera!r} sees one plane only: weak priors {', '.join(weak)}"
                )

    def prefix(self, camera: str) -> str:
        return f"{camera}." if len(self.cameras) > 1 else ""

    def user_priors(self, priors: Mapping[str, tuple[float, float]]) -> None:
        for name, pair in priors.items():
            try:
                mean, sigma = (float(x) for x in pair)
            except (TypeError, ValueError):
                raise DataError(
                    f"options.priors[{name!r}]: expected (mean, sigma), got {pair!r}"
                ) from None
            if not (np.isfinite(mean) and 0 < sigma < np.inf):
                raise DataError(
                    f"options.priors[{name!r}]: expected a finite mean and a sigma > 0, got "
                    f"{pair!r}"
                )
            self.refuse_held(name, mean)
            self.priors[name] = (mean, sigma)
            self.words.append(f"prior {name} = {mean:g} +- {sigma:g}")

    def refuse_held(self, key: str, mean: float) -> None:
        """A prior on what is held would say nothing: one of the two is a mistake."""
        camera, dot, name = key.rpartition(".")
        if (not dot and len(self.cameras) > 1) or (dot and camera not in self.cameras):
            return  # no camera's row; unknown names are refused by `check_prior_names`
        camera = camera or self.cameras[0]
        row = {"alpha_c": "skew", "aspect": "fu"}.get(name, name)
        if name == "aspect" and not mean > 0:
            raise DataError(f"options.priors[{key!r}]: the mean must be positive, got {mean:g}")
        tied = name == "aspect" and camera in self.aspect
        if tied or (row in CAMERA_TANGENT and self.is_held(camera, row)):
            raise DataError(
                f"options.priors[{key!r}]: {name} is held (known, fixed, tied, or left out of the "
                "distortion), so that a prior on it has no meaning; leave one of the two out"
            )


def prior_charts(name: str, cell: Cell) -> dict[str, BeamChart]:
    """How beams are written for a prior on that row: so that there is such a row, if possible.

    The table writes a beam in the way that suits it, which may be another one for the start than
    for the estimate; a prior keeps its meaning.
    """
    row = name.rpartition(".")[2]
    return {laser: BeamChart.having(row, beam) for laser, beam in cell.lasers.items()}


def check_prior_names(holds: Holds, cell: Cell) -> None:
    """Raise `DataError` where a prior names no row of the table, or one that is not defined."""
    aspects = [f"{c}.aspect" for c in cell.cameras] if len(cell.cameras) > 1 else ["aspect"]
    for name in holds.priors:
        charts = prior_charts(name, cell)
        rows = [row for row, _ in table_rows(cell, charts)]
        if name not in (*rows, *aspects):
            allowed = ", ".join((*rows, *aspects))
            raise DataError(f"options.priors: unknown name {name!r}; allowed: {allowed}")
        for laser, beam in cell.lasers.items():
            mine = len(cell.lasers) == 1 or name.startswith(f"{laser}.")
            along = float(np.hypot(*beam.direction_hand[:2]))
            if mine and name.endswith("laser_theta") and along < _LEAST_SIN_PHI:
                raise DataError(
                    f"options.priors: {name!r} is not defined for a beam along the hand's z axis; "
                    "give laser_tilt_x and laser_tilt_y instead"
                )


def _known_terms(name: str, value: Any) -> dict[str, float]:
    try:
        if name == "principal_point":
            u0, v0 = value
            return _known_terms("u0", u0) | _known_terms("v0", v0)
        if name in ("aspect", *INTRINSIC_NAMES):
            number = float(value)
            if name in ("aspect", "fu", "fv") and not number > 0:
                raise DataError(f"options.known: {name} must be positive, got {value!r}")
            if not np.isfinite(number):
                raise ValueError
            return {name: number}
    except (TypeError, ValueError):
        wanted = "(u0, v0)" if name == "principal_point" else "a finite number"
        raise DataError(f"options.known: {name} must be {wanted}, got {value!r}") from None
    raise DataError(
        f"options.known: unknown name {name!r}; allowed: principal_point, aspect, "
        + ", ".join(INTRINSIC_NAMES)
    )
