"""Intrinsics from elsewhere in a calibration: as known values, as priors, or as a start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from lasercal_gtsam.cell import INTRINSIC_NAMES, Camera, Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.intrinsics import GivenIntrinsics
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions

How = Literal["known", "prior", "start"]
# names of the table's rows, which priors are on
ROWS = tuple("alpha_c" if name == "skew" else name for name in INTRINSIC_NAMES)


def with_intrinsics(
    options: CalibrationOptions,
    observations: Observations,
    given: Mapping[str, GivenIntrinsics],
    how: How,
    sigmas: Mapping[str, float] | None = None,
) -> tuple[CalibrationOptions, tuple[str, ...]]:
    """Options with lenses held at what files say (``"known"``), or with priors on them.

    A prior is on each number for itself; how a file's covariance says that they go together cannot
    be used, and `prior_sigmas` widens the sigmas so that nothing is claimed that the file does not
    say. What the options hold already stays held. A number without a sigma, in the file or in
    ``sigmas``, cannot have a prior; one that was held where the file was made (sigma 0) is held
    here. ``"start"`` changes no options: see `start_with_intrinsics`.

    Parameters
    ----------
    options, observations : of the calibration
    given : camera name to its lens
    how : what is done with them
    sigmas : sigma of rows of the table (`ROWS`), wins over the files'; px, alpha_c without unit

    Returns
    -------
    the options, and words on what could not be used

    Raises
    ------
    DataError
        Unknown cameras, pictures of another size, no sigmas for priors.
    """
    check_given(observations, given, how)
    words: list[str] = []
    for name, lens in given.items():
        prefix = _prefix(observations, name)
        if how == "known":
            options = _held(options, prefix, lens)
        elif how == "prior":
            options, more = _with_priors(options, prefix, lens, sigmas or {})
            words += more
    return options, tuple(words)


def _held(options: CalibrationOptions, prefix: str, lens: GivenIntrinsics) -> CalibrationOptions:
    # what names the same numbers in other words must go
    other = {prefix + "principal_point", prefix + "aspect"}
    known = {name: value for name, value in options.known.items() if name not in other}
    known |= {prefix + name: float(getattr(lens.intrinsics, name)) for name in INTRINSIC_NAMES}
    return replace(options, known=known)


def _with_priors(
    options: CalibrationOptions, prefix: str, lens: GivenIntrinsics, sigmas: Mapping[str, float]
) -> tuple[CalibrationOptions, list[str]]:
    from_file, factor = prior_sigmas(lens)
    found = {**from_file, **sigmas}
    stated = _stated(options, prefix)
    wanted = {
        row: term for row, term in zip(ROWS, INTRINSIC_NAMES, strict=True) if term not in stated
    }
    if missing := [row for row in wanted if row not in found]:
        raise DataError(
            f"{lens.path}: a {lens.form} file without a covariance: a prior needs a sigma for "
            f"{', '.join(missing)} (--intrinsics-sigma NAME=SIGMA); or take it as known, or as a "
            "start"
        )
    known, priors = dict(options.known), dict(options.priors)
    for row, term in wanted.items():
        if found[row] > 0:
            mean = getattr(lens.intrinsics, "alpha_c" if row == "alpha_c" else term)
            priors.setdefault(prefix + row, (float(mean), found[row]))
        else:
            known[prefix + term] = float(getattr(lens.intrinsics, term))
    words = []
    if unused := [row for row in ROWS if row not in wanted]:
        words.append(f"{lens.path}: {', '.join(unused)} not used: known already")
    if factor > 1:
        words.append(
            f"{lens.path}: the priors are independent, so that the file's sigmas are widened "
            f"{factor:.2g} times: together they claim no more than its covariance"
        )
    return replace(options, known=known, priors=priors), words


def start_with_intrinsics(
    observations: Observations,
    options: CalibrationOptions,
    given: Mapping[str, GivenIntrinsics],
    initial: Cell | None = None,
) -> Cell:
    """A start with these lenses: ``initial`` with them, or the best cell while they are held.

    Raises
    ------
    DataError, DegenerateError, SolveError
        As `calibrate` does.
    """
    check_given(observations, given, "start")
    if initial is not None:
        cameras = {
            name: Camera(
                given[name].intrinsics if name in given else camera.intrinsics,
                camera.T_base_camera,
                camera.image_size,
            )
            for name, camera in initial.cameras.items()
        }
        return replace(initial, cameras=cameras)
    from lasercal_gtsam.api import calibrate

    held, _ = with_intrinsics(options, observations, given, "known")
    # a prior on what is held means nothing
    rows = {_prefix(observations, name) + row for name in given for row in (*ROWS, "aspect")}
    priors = {k: v for k, v in options.priors.items() if k not in rows}
    return calibrate(observations, options=replace(held, priors=priors)).cell


def prior_sigmas(lens: GivenIntrinsics) -> tuple[dict[str, float], float]:
    """Sigmas of independent priors on the table's rows, and the factor they were widened by.

    With ``D`` the variances and ``w`` the largest eigenvalue of the correlations, ``w D`` is the
    smallest multiple of ``D`` that is nowhere tighter than the file's covariance. Rows that were
    held have 0; without a covariance there are none.
    """
    if lens.covariance is None:
        return {}, 1.0
    # alpha_c = skew / fu
    J = np.eye(9)
    J[2, 0] = -lens.intrinsics.skew / lens.intrinsics.fu**2
    J[2, 2] = 1 / lens.intrinsics.fu
    held = np.diag(lens.covariance) <= 0
    covariance = J @ lens.covariance @ J.T
    sigmas = np.where(held, 0.0, np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    free = np.flatnonzero(sigmas > 0)
    factor = 1.0
    if free.size:
        scale = np.outer(sigmas[free], sigmas[free])
        correlation = covariance[np.ix_(free, free)] / scale
        factor = float(np.sqrt(max(1.0, np.linalg.eigvalsh(correlation)[-1])))
    return dict(zip(ROWS, (factor * sigmas).tolist(), strict=True)), factor


def check_given(observations: Observations, given: Mapping[str, GivenIntrinsics], how: How) -> None:
    """Raise `DataError` where a lens cannot belong to the camera it is given for."""
    if how not in get_args(How):
        raise DataError(f"intrinsics: expected one of {', '.join(get_args(How))}, got {how!r}")
    problems = []
    for name, lens in given.items():
        if name not in observations.cameras:
            problems.append(
                f"{lens.path}: given for camera {name!r}; observed: "
                f"{', '.join(observations.cameras)}"
            )
        elif lens.image_size not in (None, observations.image_size[name]):
            problems.append(
                f"{lens.path}: the intrinsics are of pictures of {_size(lens.image_size)}, but "
                f"camera {name!r} has {_size(observations.image_size[name])}: another camera, or a "
                "scaled or cropped picture; intrinsics are not scaled here"
            )
    if problems:
        raise DataError(*problems)


def _stated(options: CalibrationOptions, prefix: str) -> set[str]:
    """Intrinsics of a camera that the options hold already."""
    names = {name for name in INTRINSIC_NAMES if {name, prefix + name} & options.known.keys()}
    pair = {"principal_point", prefix + "principal_point"} & options.known.keys()
    return names | {"u0", "v0"} if pair else names


def _prefix(observations: Observations, camera: str) -> str:
    return f"{camera}." if len(observations.cameras) > 1 else ""


def _size(size: tuple[int, int] | None) -> str:
    return "unknown size" if size is None else f"{size[0]} x {size[1]} px"
