"""ROS 1 and ROS 2 bags (.bag, sqlite3, mcap) through `rosbags`; the only module that knows it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.pictures import Picture
from lasercal_gtsam.io.wording import did_you_mean, some
from lasercal_gtsam.recordings.bag_notes import picture_notes
from lasercal_gtsam.recordings.messages import (
    CameraInfo,
    camera_info_of,
    picture_of,
    pose_numbers,
)
from lasercal_gtsam.recordings.motion import Motion, chain, pose_series
from lasercal_gtsam.recordings.stamps import (
    NS_PER_S,
    Stamps,
    as_stamps,
    seconds_text,
)
from lasercal_gtsam.recordings.tree import TransformTree

Clock = Literal["header", "received"]

TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
CAMERA_INFO_TYPE = "sensor_msgs/msg/CameraInfo"
_SUFFIXES = (".bag", ".mcap", ".db3")
_MENDING = {
    ".bag": "'rosbag reindex'",
    ".mcap": "'mcap recover cut.mcap -o mended.mcap'",
    ".db3": "'sqlite3 cut.db3 .recover | sqlite3 mended.db3', then 'ros2 bag reindex'",
}


@dataclass(frozen=True)
class Topic:
    """A topic of a bag; ``kind`` is the message type as in ROS 2 (``sensor_msgs/msg/Image``)."""

    name: str
    kind: str
    count: int


def bag_files(path: Path) -> list[Path] | None:
    """Paths to hand to the reader for a bag, or None where ``path`` is no bag.

    A bag is a ``.bag``, ``.mcap`` or ``.db3`` file, or a folder with such files, with or without
    its ``metadata.yaml``.
    """
    if path.is_file():
        if path.name.endswith(".bag.active"):
            raise DataError(f"{path}: this recording was never closed; {_mend('.bag')}")
        return [path] if path.suffix in _SUFFIXES else None
    if (path / "metadata.yaml").is_file() and path.suffix != ".bag":
        return [path]
    files = sorted(p for suffix in _SUFFIXES for p in path.glob(f"*{suffix}"))
    return files or None


@contextmanager
def open_bag(*paths: str | Path, clock: Clock = "header") -> Iterator[Bag]:
    """Open a bag, or the parts of one that was split.

    Parameters
    ----------
    paths : files or folders of ROS 1 or of ROS 2, not both
    clock : take the time of a message from its header, or from when it was received

    Raises
    ------
    DataError
        `rosbags` is not installed, or the bag is missing, damaged or of an unknown kind.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise DataError(
            "reading bags needs rosbags, which is not installed: pip install 'lasercal-gtsam[ros]'"
        ) from None
    files: list[Path] = []
    for path in map(Path, paths):
        if not path.exists():
            raise DataError(f"{path}: there is no such file or folder")
        found = bag_files(path)
        if found is None:
            raise DataError(
                f"{path}: this is no bag; expected a {', '.join(_SUFFIXES)} file or the folder of "
                "a ROS 2 bag"
            )
        files += found
    if len({file.suffix == ".bag" for file in files}) > 1:
        raise DataError("the bags are of ROS 1 and of ROS 2; give those of one recording")
    name = some([str(path) for path in paths])
    with ExitStack() as stack:
        try:
            store = get_typestore(Stores.ROS2_HUMBLE)
            reader = stack.enter_context(AnyReader(files, default_typestore=store))
        except Exception as error:  # whatever a damaged file makes the reader stumble over
            raise _damaged(name, files, error) from None
        yield Bag(name, files, reader, clock)


class Bag:
    """An open bag; made by `open_bag`.

    Attributes
    ----------
    name : for messages
    topics : name to `Topic`, sorted
    start, end : when the first and the last message were received, nanoseconds
    lags : topic to the median time (ns) from a message's stamp until it was received, for the
        topics read so far
    """

    def __init__(self, name: str, files: Sequence[Path], reader: Any, clock: Clock) -> None:
        self.name = name
        self._files = tuple(files)
        self._reader = reader
        self._clock = clock
        self._transforms: TransformTree | None = None
        self.lags: dict[str, float] = {}
        counts: dict[str, Topic] = {}
        for link in reader.connections:
            before = counts[link.topic].count if link.topic in counts else 0
            counts[link.topic] = Topic(link.topic, link.msgtype, before + link.msgcount)
        self.topics: Mapping[str, Topic] = dict(sorted(counts.items()))
        if not any(topic.count for topic in counts.values()):
            raise DataError(f"{name}: the bag holds no messages")
        self.start, self.end = int(reader.start_time), int(reader.end_time)

    def of_types(self, kinds: Sequence[str]) -> tuple[str, ...]:
        """Names of the topics with messages of some types."""
        return tuple(t.name for t in self.topics.values() if t.kind in kinds and t.count)

    def check_topic(self, name: str, kinds: Sequence[str], option: str) -> None:
        """Raise `DataError` where a topic is missing or of another type; lists what would do."""
        fitting = self.of_types(kinds)
        would_do = f"topics that would do: {some(fitting, 20)}" if fitting else "none would do"
        if name not in self.topics:
            raise DataError(
                f"{option}: {self.name} has no topic {name!r}{did_you_mean(name, self.topics)}; "
                f"{would_do}. All topics: {some(list(self.topics), 40)}"
            )
        if name not in fitting:
            topic = self.topics[name]
            raise DataError(
                f"{option}: {name} holds {topic.count} messages of type {topic.kind}; expected "
                f"{' or '.join(kinds)}; {would_do}"
            )

    def transforms(self) -> TransformTree:
        """All transforms of the bag; read once.

        Topics whose name ends in ``tf_static`` are static, all others of that type move.
        """
        if self._transforms is None:
            tree = TransformTree()
            for topic in self.of_types(TRANSFORM_TYPES):
                static = topic.rstrip("/").endswith("tf_static")
                lags = []
                for received, message in self._messages([topic]):
                    for item in message.transforms:
                        stamp = received if static else self._stamp(item.header, received)
                        lags.append(received - stamp)
                        v, q = item.transform.translation, item.transform.rotation
                        tree.add(
                            item.header.frame_id,
                            item.child_frame_id,
                            stamp,
                            (v.x, v.y, v.z),
                            (q.x, q.y, q.z, q.w),
                            static=static,
                        )
                self._note_lag(topic, lags)
            self._transforms = tree
        return self._transforms

    def hand_motion(self, base: str, hand: str) -> Motion:
        """The motion of frame ``hand`` in frame ``base`` out of the transforms; see `Motion`."""
        return self.transforms().motion(base, hand)

    def pose_motion(self, topic: str, base: str | None = None, hand: str | None = None) -> Motion:
        """The motion that a topic of stamped poses, transforms or odometry gives.

        The message's own frames are taken as base and hand. Where they are given here they must be
        the same; a PoseStamped does not name its hand.

        Raises
        ------
        DataError
            Missing topic, another type, other or changing frames.
        """
        self.check_topic(topic, POSE_TYPES, "pose topic")
        stamps, numbers, lags = [], [], []
        frames: set[tuple[str, str]] = set()
        for received, message in self._messages([topic]):
            stamps.append(self._stamp(message.header, received))
            lags.append(received - stamps[-1])
            child = getattr(message, "child_frame_id", "").lstrip("/")
            frames.add((message.header.frame_id.lstrip("/"), child))
            numbers.append(pose_numbers(message))
        self._note_lag(topic, lags)
        wanted = (base or "").lstrip("/"), (hand or "").lstrip("/")
        problems = [
            f"{topic}: its {role} is {found!r}, not {want!r}"
            for pair in sorted(frames)
            for role, found, want in zip(("base", "hand"), pair, wanted, strict=True)
            if want and found and found != want
        ]
        if len(frames) > 1:
            problems.append(
                f"{topic}: the frames change in the recording: "
                f"{some([f'{a!r} <- {b!r}' for a, b in sorted(frames)])}"
            )
        if problems:
            raise DataError(*problems)
        parent, child = next(iter(frames))
        values = np.array(numbers)
        series = pose_series(
            topic, np.array(stamps, dtype=np.int64), values[:, :3], values[:, 3:], "quat_xyzw"
        )
        return chain(parent or wanted[0] or "base", child or wanted[1] or "hand", [(series, False)])

    def pictures(self, topic: str, camera: str = "camera", offset: int = 0) -> BagPictures:
        """Pictures of an image topic; only their stamps are taken now.

        Parameters
        ----------
        topic : ``sensor_msgs/Image`` or ``CompressedImage``
        camera : its name in the capture
        offset : added to the stamps, nanoseconds
        """
        self.check_topic(topic, IMAGE_TYPES, "image topic")
        pairs, formats, sizes = [], set(), set()
        for received, message in self._messages([topic]):
            pairs.append((self._stamp(message.header, received), received))
            if hasattr(message, "format"):
                formats.add(str(message.format).lower())
            else:
                sizes.add((int(message.width), int(message.height)))
        if self._clock == "header" and any(stamp == 0 for stamp, _ in pairs):
            raise DataError(
                f"{topic}: its messages have no stamp; use the time when they were received "
                "(--stamps received)"
            )
        self._note_lag(topic, [received - stamp for stamp, received in pairs])
        first: dict[int, int] = {}
        for stamp, received in pairs:
            first.setdefault(stamp, received)
        notes = picture_notes(
            topic, formats, sizes, len(pairs) - len(first), self.camera_info(topic)
        )
        return BagPictures(self, topic, camera, sorted(first.items()), offset, notes)

    def latched(self, topic: str, kind: str) -> tuple[Stamps, list[Any]]:
        """Values of a ``std_msgs`` topic and when they were received, in that order."""
        self.check_topic(topic, (f"std_msgs/msg/{kind}",), f"{kind} topic")
        read = [(received, message.data) for received, message in self._messages([topic])]
        return as_stamps([received for received, _ in read]), [value for _, value in read]

    def camera_info(self, image_topic: str) -> CameraInfo | None:
        """The ``camera_info`` beside an image topic, or None."""
        parts = image_topic.split("/")
        for k in range(len(parts) - 1, 0, -1):
            topic = "/".join([*parts[:k], "camera_info"])
            if topic in self.of_types([CAMERA_INFO_TYPE]):
                _, message = next(self._messages([topic]))
                return camera_info_of(topic, message)
        return None

    def camera_infos(self) -> dict[str, CameraInfo]:
        """What is said of the cameras, by image topic."""
        topics = self.of_types(IMAGE_TYPES)
        return {topic: info for topic in topics if (info := self.camera_info(topic))}

    def read_pictures(
        self, topic: str, wanted: Mapping[tuple[int, int], int]
    ) -> Iterator[tuple[int, Picture]]:
        """Pictures by (stamp, received); the mapping's values are handed out with them."""
        left = dict(wanted)
        times = [received for _, received in wanted]
        for received, message in self._messages([topic], min(times), max(times) + 1):
            stamp = self._stamp(message.header, received)
            which = left.pop((stamp, received), None)
            if which is None:
                continue
            try:
                yield which, picture_of(message)
            except DataError as error:
                at = f"{topic}, stamp {seconds_text(stamp)}"
                raise DataError(*(f"{at}: {text}" for text in error.problems)) from None
        if left:
            raise DataError(f"{self.name}: {len(left)} pictures of {topic} were there and are gone")

    def _messages(
        self, topics: Sequence[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Messages of some topics as (received, message), in the order received."""
        links = [link for link in self._reader.connections if link.topic in topics]
        raw = self._reader.messages(connections=links, start=start, stop=stop)
        while True:
            try:
                link, received, content = next(raw)
                message = self._reader.deserialize(content, link.msgtype)
            except StopIteration:
                return
            except Exception as error:  # whatever a damaged file makes the reader stumble over
                raise _damaged(self.name, self._files, error) from None
            yield int(received), message

    def _stamp(self, header: Any, received: int) -> int:
        if self._clock == "received":
            return received
        return int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec)

    def _note_lag(self, topic: str, lags: Sequence[int]) -> None:
        if lags:
            self.lags[topic] = float(np.median(np.asarray(lags, dtype=np.int64)))


class BagPictures:
    """Pictures of an image topic as a `PictureSource`; made by `Bag.pictures`.

    ``notes`` say what was found odd in the topic.
    """

    def __init__(
        self,
        bag: Bag,
        topic: str,
        camera: str,
        times: Sequence[tuple[int, int]],
        offset: int,
        notes: tuple[str, ...],
    ) -> None:
        self.camera = camera
        self.name = topic
        self.notes = notes
        self._bag = bag
        self._times = list(times)
        self.stamps = as_stamps([stamp + offset for stamp, _ in times])

    def read(self, which: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """Read some pictures; see `PictureSource`."""
        yield from self._bag.read_pictures(self.name, {self._times[k]: k for k in which})


def _damaged(name: str, files: Sequence[Path], error: Exception) -> DataError:
    what = " ".join(str(error).split()) or type(error).__name__
    inside = [p for file in files for p in (file.iterdir() if file.is_dir() else [file])]
    kinds = [kind for kind in _MENDING if any(path.suffix == kind for path in inside)]
    return DataError(f"{name}: the bag cannot be read ({what}); {_mend(*kinds)}")


def _mend(*kinds: str) -> str:
    ways = " or ".join(_MENDING[kind] for kind in kinds)
    return f"if the recording was cut off (a crash, a full disk), mend it first: {ways}"
