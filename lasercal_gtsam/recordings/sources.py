"""Where pictures come from: a topic of a bag, or a folder of files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

from lasercal_gtsam.io.pictures import Picture
from lasercal_gtsam.recordings.stamps import Stamps


class PictureSource(Protocol):
    """Pictures of one camera by stamp; they are read when asked for, a few at a time.

    Attributes
    ----------
    camera : the camera's name in the capture
    name : topic or folder, for messages
    stamps : (N,) nanoseconds, strictly increasing
    """

    @property
    def camera(self) -> str:
        """The camera's name."""

    @property
    def name(self) -> str:
        """Topic or folder."""

    @property
    def stamps(self) -> Stamps:
        """Stamps of the pictures."""

    def read(self, which: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """Read some pictures (indices into ``stamps``), in any order; as (index, picture).

        Raises `DataError` where one cannot be read.
        """
