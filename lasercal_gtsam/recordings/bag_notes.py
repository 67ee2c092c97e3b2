"""What is odd in a bag but no error, in sentences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from lasercal_gtsam.recordings.messages import CameraInfo
from lasercal_gtsam.recordings.stamps import NS_PER_S, duration_text


def picture_notes(
    topic: str,
    formats: Iterable[str],
    sizes: Iterable[tuple[int, int]],
    repeated: int,
    info: CameraInfo | None,
) -> tuple[str, ...]:
    """Say what is odd in an image topic.

    Parameters
    ----------
    topic : its name
    formats : as compressed pictures state them, lower case
    sizes : (width, height) of raw pictures
    repeated : how many pictures have the stamp of another one
    info : what the ``camera_info`` beside it says
    """
    notes = []
    if any("jpeg" in form or "jpg" in form for form in formats):
        notes.append(
            f"{topic} was compressed as JPEG, which moves spots by some tenths of a pixel; "
            "record the raw topic if you can"
        )
    if repeated:
        notes.append(
            f"{topic}: {repeated} pictures have the stamp of another one; the first of each was "
            "taken"
        )
    found = sorted(sizes)
    if info is not None and found and (info.width, info.height) not in found:
        notes.append(
            f"{info.topic} speaks of {info.width} x {info.height} pixels, the pictures of {topic} "
            f"have {found[0][0]} x {found[0][1]}: are they binned or cut?"
        )
    return tuple(notes)


def clock_notes(lags: Mapping[str, float], images: Sequence[str]) -> list[str]:
    """Say where pictures and poses reach the recorder with very different delays.

    Parameters
    ----------
    lags : as `Bag.lags`
    images : the image topics among them
    """
    others = {
        topic: lag for topic, lag in lags.items() if topic not in images and "static" not in topic
    }
    return [
        f"{image} is received {duration_text(lags[image])} after its stamps, {topic} "
        f"{duration_text(lag)}: their clocks may differ by that much (--image-offset, or --stamps "
        "received)"
        for image in images
        for topic, lag in others.items()
        if image in lags and abs(lags[image] - lag) > NS_PER_S // 2
    ]
