"""Flat places: drawing axes on a plane, hulls of spots, the part of a plane that a camera sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from lasercal_gtsam.cell import Camera, Cell, Plane
from lasercal_gtsam.frozen import Array, FrozenData, set_array
from lasercal_gtsam.projection import ray_in_base
from lasercal_gtsam.units import MM_PER_M

Mask = npt.NDArray[np.bool_]

_EDGE_STEPS = 24
# a ray nearly along the plane meets it anywhere: views are cut off at this many camera heights
_FARTHEST_HEIGHTS = 8.0
_AXES = "xyz"


@dataclass(frozen=True, eq=False)
class PlaneAxes(FrozenData):
    """Drawing axes on a plane, right-handed as seen from the camera's side.

    The origin is the foot of the perpendicular from the base's origin; x runs along the base axis
    that lies least across the plane, as far as the plane allows. On a horizontal table the
    coordinates are therefore the base's own x and y.

    Attributes
    ----------
    origin_base, x_base, y_base : (3,), metres and unit vectors in base
    words : the above, for a human
    """

    origin_base: Array
    x_base: Array
    y_base: Array
    words: str

    def __post_init__(self) -> None:
        for name in ("origin_base", "x_base", "y_base"):
            set_array(self, name, getattr(self, name), (3,))

    @classmethod
    def of(cls, plane: Plane, camera: Camera) -> PlaneAxes:
        """Axes of a plane that is seen by a camera."""
        n, centre = plane.normal_base, camera.T_base_camera[:3, 3]
        towards = n if n @ centre >= plane.distance else -n
        i = int(np.argmin(np.abs(n).round(9)))
        x = np.eye(3)[i] - n[i] * n
        x /= np.linalg.norm(x)
        words = (
            f"millimetres from the point of the plane nearest to the base's origin; x along the "
            f"base's {_AXES[i]} axis as far as the plane allows, y to its left as the camera sees "
            "the plane"
        )
        return cls(plane.vector, x, np.cross(towards, x), words)

    @property
    def basis(self) -> Array:
        """(3, 2) the two axes as columns."""
        return np.column_stack([self.x_base, self.y_base])

    def to_plane_mm(self, points_base: Array) -> Array:
        """(N, 2) coordinates, mm, of base points (N, 3), metres."""
        return np.asarray(MM_PER_M * (points_base - self.origin_base) @ self.basis)

    def to_base(self, xy_mm: Array) -> Array:
        """(N, 3) base points, metres, of coordinates (N, 2), mm."""
        return np.asarray(self.origin_base + (np.asarray(xy_mm) / MM_PER_M) @ self.basis.T)


def axes_of(cell: Cell, plane: str, cameras: tuple[str, ...] = ()) -> PlaneAxes:
    """Axes of a plane by name, as seen by the first of these cameras (or of the cell's)."""
    first = (*cameras, *cell.cameras)[0]
    return PlaneAxes.of(cell.planes[plane], cell.cameras[first])


def hull(points: Array) -> Array:
    """Corners (K, 2) of the convex hull of flat points (N, 2), counter-clockwise; (0, 2) if flat.

    Points on one line, or fewer than three, have none.
    """
    if len(points) < 3:
        return np.zeros((0, 2))
    try:
        return np.asarray(points[ConvexHull(points).vertices], dtype=np.float64)
    except QhullError:
        return np.zeros((0, 2))


def area(polygon: Array) -> float:
    """Area of a polygon (K, 2) without crossings, by the trapezoid rule; 0 for none."""
    if len(polygon) < 3:
        return 0.0
    x, y = (polygon - polygon[0]).T
    return float(0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def inside(points: Array, convex: Array) -> Mask:
    """(N,) which flat points (N, 2) lie in a convex polygon (K, 2), its border included."""
    if len(convex) < 3:
        return np.zeros(len(points), dtype=np.bool_)
    edges = np.roll(convex, -1, axis=0) - convex
    offset = points[:, None] - convex
    side = edges[:, 0] * offset[..., 1] - edges[:, 1] * offset[..., 0]
    scale = 1e-9 * np.abs(side).max(initial=0.0)
    return np.asarray((side >= -scale).all(axis=1) | (side <= scale).all(axis=1))


def clipped(polygon: Array, convex: Array) -> Array:
    """The part (K, 2) of a polygon inside a convex one, edge by edge (Sutherland and Hodgman)."""
    x, y = convex.T
    if x @ np.roll(y, -1) < y @ np.roll(x, -1):
        convex = convex[::-1]
    out = np.asarray(polygon, dtype=np.float64)
    for a, b in zip(convex, np.roll(convex, -1, axis=0), strict=True):
        if not len(out):
            break
        side = (b[0] - a[0]) * (out[:, 1] - a[1]) - (b[1] - a[1]) * (out[:, 0] - a[0])
        kept: list[Array] = []
        for k, p in enumerate(out):
            before, s, s_before = out[k - 1], side[k], side[k - 1]
            if (s >= 0) != (s_before >= 0):
                kept.append(before + (p - before) * (s_before / (s_before - s)))
            if s >= 0:
                kept.append(p)
        out = np.array(kept).reshape(-1, 2)
    return out


def picture_border(size: tuple[int, int], steps: int = _EDGE_STEPS) -> Array:
    """Pixels (4 steps, 2) along the outermost edge of a picture, clockwise as it is looked at."""
    w, h = size[0] - 0.5, size[1] - 0.5
    corners = np.array([[-0.5, -0.5], [w, -0.5], [w, h], [-0.5, h]])
    s = np.arange(steps)[:, None] / steps
    edges = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    return np.concatenate([a + s * (b - a) for a, b in edges])


def view_outline(cell: Cell, plane: str, camera: str, axes: PlaneAxes) -> Array:
    """Closed outline (K, 2), mm, of the part of a plane that a camera sees.

    Where the picture's edge shows the horizon, or the plane very far away, the outline is cut off
    at eight times the camera's height over the plane, measured along the ray. (0, 2) where the
    camera does not see the plane. Pixels of the edge that the distortion cannot show are left out.
    """
    part, seen = cell.planes[plane], cell.cameras[camera]
    rays = ray_in_base(picture_border(seen.image_size), seen)
    rays = rays[np.isfinite(rays).all(axis=1)]
    centre = seen.T_base_camera[:3, 3]
    height = part.distance - float(part.normal_base @ centre)
    lengths = np.linalg.norm(rays, axis=1)
    slope = rays @ part.normal_base / lengths * np.sign(height)
    limit = _FARTHEST_HEIGHTS * abs(height)
    met = slope > 0
    if len(rays) < 3 or height == 0.0 or not met.any():
        return np.zeros((0, 2))
    with np.errstate(divide="ignore"):
        far = np.where(met, np.minimum(abs(height) / np.where(met, slope, 1.0), limit), limit)
    points = centre + (far / lengths)[:, None] * rays
    # a ray that was cut off ends above the plane: its foot is where the outline passes
    points -= np.outer(points @ part.normal_base - part.distance, part.normal_base)
    return axes.to_plane_mm(points)
