"""The spots of one camera and one laser in the form which all closed-form stages share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.closed_form.linear import transformed
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Observations

Index = npt.NDArray[np.int64]

IMAGE_DIAGONAL = 2.0 * np.sqrt(2.0)
"""Of every picture after `pixel_scaling`."""


@dataclass(frozen=True, eq=False)
class Spots:
    """N spots of one (camera, laser) pair.

    Attributes
    ----------
    rows : (N,) indices of the spots in the observations
    xy : (N, 2) pixels after `pixel_scaling` (image centre 0, half diagonal sqrt(2))
    R, t : (N, 3, 3), (N, 3); hand poses ``p_base = R p_hand + t``, metres
    plane : (N,) index into ``plane_names``
    plane_names : names of the planes these spots lie on
    scaling : (3, 3); the map from pixels to ``xy``
    image_size : (width, height), pixels
    """

    rows: Index
    xy: Array
    R: Array
    t: Array
    plane: Index
    plane_names: tuple[str, ...]
    scaling: Array
    image_size: tuple[int, int]

    @classmethod
    def of_pair(cls, observations: Observations, camera: str, laser: str) -> Spots:
        """Pick the spots which ``laser`` lit and ``camera`` saw."""
        chosen = np.flatnonzero((observations.camera == camera) & (observations.laser == laser))
        index = observations.plane_index[chosen]
        used, plane = np.unique(index, return_inverse=True)
        size = observations.image_size[camera]
        scaling = pixel_scaling(size)
        poses = observations.T_base_hand[chosen]
        return cls(
            rows=chosen,
            xy=transformed(scaling, observations.uv[chosen]),
            R=poses[:, :3, :3],
            t=poses[:, :3, 3],
            plane=plane.astype(np.int64),
            plane_names=tuple(observations.planes[i] for i in used),
            scaling=scaling,
            image_size=size,
        )

    def __len__(self) -> int:
        return len(self.xy)

    def subset(self, rows: Index) -> Spots:
        """Select spots by index; the planes stay numbered as they are."""
        return replace(
            self,
            rows=self.rows[rows],
            xy=self.xy[rows],
            R=self.R[rows],
            t=self.t[rows],
            plane=self.plane[rows],
        )

    @property
    def plane_count(self) -> int:
        """Number of planes."""
        return len(self.plane_names)

    def on_plane(self, p: int) -> Index:
        """Indices of the spots on plane ``p``."""
        return np.flatnonzero(self.plane == p)


def pairs_of(observations: Observations) -> list[tuple[str, str]]:
    """The (camera, laser) pairs that have spots, in order of their names."""
    count = len(observations.lasers)
    codes = np.unique(observations.camera_index * count + observations.laser_index)
    return [(observations.cameras[i // count], observations.lasers[i % count]) for i in codes]


def image_centre(image_size: tuple[int, int]) -> tuple[float, float]:
    """Centre of the picture in pixels; (0, 0) is the centre of the top-left pixel."""
    return (image_size[0] - 1) / 2, (image_size[1] - 1) / 2


def pixel_scaling(image_size: tuple[int, int]) -> Array:
    """``T_n`` (3, 3): the image centre goes to 0, the diagonal to `IMAGE_DIAGONAL`."""
    scale = IMAGE_DIAGONAL / np.hypot(*image_size)
    u0, v0 = image_centre(image_size)
    return np.array([[scale, 0.0, -scale * u0], [0.0, scale, -scale * v0], [0.0, 0.0, 1.0]])
