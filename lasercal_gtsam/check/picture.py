"""Where the spots of a capture lie in the picture, and on the planes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.closed_form.requirements import planes_seen_flat
from lasercal_gtsam.closed_form.spots import Spots, pairs_of
from lasercal_gtsam.observations import Observations

FIELDS = (4, 3)
"""The picture is divided into so many fields, across and down."""
NARROW = 0.1
"""Spots of a plane that spread less across a line than this share of its length are nearly one."""


@dataclass(frozen=True)
class Coverage:
    """Where the spots of one camera lie.

    Attributes
    ----------
    camera : its name
    spots : their number
    span : share of the picture's width and height between the outermost spots
    fields : how many of the 12 fields (4 across, 3 down) have a spot
    reach : distance of the farthest spot from the middle, as a share of that of a corner
    """

    camera: str
    spots: int
    span: tuple[float, float]
    fields: int
    reach: float


def coverage(observations: Observations) -> tuple[Coverage, ...]:
    """Coverage of each camera's picture."""
    found = []
    for camera in observations.cameras:
        uv = observations.uv[observations.camera == camera]
        size = np.array(observations.image_size[camera], dtype=np.float64)
        span = np.ptp(uv, axis=0) / size
        field = np.clip((uv + 0.5) / size * FIELDS, 0, np.array(FIELDS) - 1).astype(int)
        reach = np.linalg.norm(uv - 0.5 * (size - 1), axis=1).max() / np.linalg.norm(0.5 * size)
        found.append(
            Coverage(
                camera,
                len(uv),
                (float(span[0]), float(span[1])),
                len(np.unique(field, axis=0)),
                float(reach),
            )
        )
    return tuple(found)


def lines_of_spots(observations: Observations) -> list[str]:
    """Planes whose spots lie on a line in the picture, or nearly: one sentence each."""
    found = []
    for camera, laser in pairs_of(observations):
        spots = Spots.of_pair(observations, camera, laser)
        flat = planes_seen_flat(spots)
        who = f" of camera {camera!r}" if len(observations.cameras) > 1 else ""
        for p, name in enumerate(spots.plane_names):
            xy = spots.xy[spots.on_plane(p)]
            s = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
            if p in flat:
                found.append(
                    f"the {len(xy)} spots{who} on plane {name!r} lie on one line in the picture "
                    "and say nothing of its tilt: move the spots across it in two directions"
                )
            elif s[1] < NARROW * s[0]:
                found.append(
                    f"the {len(xy)} spots{who} on plane {name!r} lie nearly on one line (spread "
                    f"{100 * s[1] / s[0]:.0f} % across it): move them in two directions"
                )
    return found
