"""Bags as a robot cell records them, written with `rosbags` from a simulated capture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from lasercal_gtsam.cell import Camera, Cell, Intrinsics
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.capture import Capture, load_capture
from lasercal_gtsam.io.pictures import read_picture
from lasercal_gtsam.simulate import simulate_cell, write_simulation
from lasercal_gtsam.simulate.cells import paper_cell
from lasercal_gtsam.simulate.pictures import PictureOptions
from lasercal_gtsam.simulate.render import RenderOptions

STORAGES = ("ros1", "sqlite3", "mcap")
IMAGES = "/camera/image_raw"
START = 1_700_000_000_123_456_789  # ns
MS = 1_000_000
SIZE = (160, 120)
QUIET = RenderOptions(highlights=1, ghost_probability=0.0)

Event = tuple[int, str, str, Any]  # received, topic, type, content


def small_cell() -> Cell:
    """The paper's cell seen by a camera of a quarter of the resolution."""
    cell = paper_cell(2)
    camera = cell.cameras["camera"]
    small = Camera(
        Intrinsics(fu=137.5, fv=137.5, u0=79.5, v0=59.5), camera.T_base_camera, image_size=SIZE
    )
    return replace(cell, cameras={"camera": small})


def small_capture(folder: Path, groups: int = 2, shots: int = 2, **render: Any) -> Capture:
    """A simulated capture with small pictures, on disk."""
    simulation = simulate_cell(small_cell(), groups=groups, shots=shots, seed=3)
    pictures = PictureOptions(replace(QUIET, **render), beam_radius_m=0.004)
    return load_capture(write_simulation(folder, simulation, spots=False, pictures=pictures))


@cache
def picture(path: Path | None, size: tuple[int, int] = SIZE) -> np.ndarray:
    assert path is not None
    return read_picture(path, size, "test")


# --- a session: stops, moves between them, a laser that is switched -----------------------------


@dataclass
class Session:
    """How a capture is recorded.

    Every stop lasts a second: five frames with the laser on, the last of them half lit, then five
    with it off (the other way round at every second stop). The capture's own pictures are those in
    the middle of each half; the others have other noise, and those taken while the hand moves are
    smeared.
    """

    stop_ns: int = 1000 * MS
    move_ns: int = 400 * MS
    pose_every_ns: int = 40 * MS
    picture_every_ns: int = 100 * MS
    picture_delay_ns: int = 7 * MS  # never at the stamp of a pose
    encoding: str = "mono8"
    padding: int = 0
    big_endian: bool = False
    jitter_m: float = 0.0
    off: bool = True
    always_on_at: tuple[int, ...] = ()
    always_off_at: tuple[int, ...] = ()
    image_shift_ns: int = 0
    poses_as: str = "tf"
    compressed: str | None = None
    truth: dict[int, str] = field(default_factory=dict)

    def events(self, capture: Capture, seed: int = 0) -> Iterator[Event]:
        rng = np.random.default_rng(seed)
        period = self.stop_ns + self.move_ns
        T = capture.T_base_hand
        end = START + len(T) * period - self.move_ns
        yield from static_events(START)
        for stamp in range(START, end + 300 * MS, self.pose_every_ns):
            progress = (stamp - START) // period + self.moving_share(stamp)
            yield from self.pose_events(stamp, self.hand(T, stamp, rng), progress)
        for stamp in range(START + self.picture_delay_ns, end, self.picture_every_ns):
            k, within = divmod(stamp - START, period)
            yield self.image_event(stamp + self.image_shift_ns, self.frame(capture, k, within, rng))
            if within < self.picture_every_ns:
                yield stamp, "/plane", "std_msgs/msg/String", str(capture.planes[k])
        for k in range(len(T)):
            for begin, lit in self.switching(k):
                yield START + k * period + begin, "/laser", "std_msgs/msg/Bool", lit

    def switching(self, k: int) -> list[tuple[int, bool]]:
        first = k % 2 == 0
        return [(0, first), (int(0.45 * self.stop_ns), not first), (self.stop_ns, False)]

    def hand(self, T: Array, stamp: int, rng: np.random.Generator) -> Array:
        k = min((stamp - START) // (self.stop_ns + self.move_ns), len(T) - 1)
        share = self.moving_share(stamp)
        pose = T[k].copy()
        if share > 0:
            then = T[min(k + 1, len(T) - 1)]
            turn = Rotation.from_matrix(T[k, :3, :3].T @ then[:3, :3]).as_rotvec()
            pose[:3, :3] = T[k, :3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
            pose[:3, 3] += share * (then[:3, 3] - T[k, :3, 3])
            pose[2, 3] += 0.05 * np.sin(np.pi * share)  # also between equal poses
        pose[:3, 3] += self.jitter_m * rng.uniform(-1, 1, 3)
        return pose

    def frame(self, capture: Capture, k: int, within: int, rng: np.random.Generator) -> np.ndarray:
        on = picture(capture.images_on[k]).astype(float)
        off = picture(capture.images_off[k]).astype(float)
        full = 255.0 if picture(capture.images_on[k]).dtype == np.uint8 else 65535.0
        number = within // self.picture_every_ns
        if within >= self.stop_ns:
            smeared = np.mean([np.roll(on, shift, axis=1) for shift in range(8)], axis=0)
            return as_depth(smeared, full)
        lit = (number < 5) == (k % 2 == 0)
        if k in self.always_on_at or not self.off:
            lit = True
        if k in self.always_off_at:
            lit = False
        own = number in (3, 7)
        light = on if lit else off
        if number == 5 and self.off and k not in (*self.always_on_at, *self.always_off_at):
            light, own = 0.5 * (on + off), False
        if not own:
            light = light + 0.004 * full * rng.standard_normal(light.shape)
        return as_depth(light, full)

    def moving_share(self, stamp: int) -> float:
        within = (stamp - START) % (self.stop_ns + self.move_ns)
        return max(0.0, (within - self.stop_ns) / self.move_ns)

    def pose_events(self, stamp: int, T: Array, progress: float) -> Iterator[Event]:
        if self.poses_as == "tf":
            # two joints that both move between stops, such that the tool is where it must be
            A = rigid(Rotation.from_rotvec([0.1, 0.2, 0.9 * np.sin(progress)]), [0, 0, 0.3])
            B = np.linalg.inv(A) @ T @ np.linalg.inv(TOOL)
            yield stamp + 2 * MS, "/tf", "tf", [("base_link", "arm", stamp, A)]
            yield stamp + 2 * MS, "/tf", "tf", [("arm", "flange", stamp, B)]
        else:
            yield stamp + 2 * MS, "/hand_pose", self.poses_as, (stamp, T)

    def image_event(self, stamp: int, array: np.ndarray) -> Event:
        received = stamp - self.image_shift_ns + 30 * MS
        if self.compressed:
            return received, IMAGES, "sensor_msgs/msg/CompressedImage", (stamp, array, self)
        return received, IMAGES, "sensor_msgs/msg/Image", (stamp, array, self)


TOOL = np.eye(4)
TOOL[:3, 3] = 0.0, 0.0, 0.11
TOOL[:3, :3] = Rotation.from_euler("ZYX", [0.3, -0.2, 2.0]).as_matrix()


def rigid(R: Rotation, t: Sequence[float]) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.as_matrix(), t
    return T


def as_depth(light: Array, full: float) -> np.ndarray:
    kind = np.uint8 if full == 255.0 else np.uint16
    return np.clip(np.rint(light), 0, full).astype(kind)


def static_events(stamp: int) -> Iterator[Event]:
    world = rigid(Rotation.from_rotvec([0, 0, 1.0]), [1.0, 2.0, 3.0])
    yield stamp, "/tf_static", "tf", [("world", "base_link", stamp, world)]
    yield stamp, "/tf_static", "tf", [("flange", "tool0", stamp, TOOL)]
    yield stamp, "/camera/camera_info", "sensor_msgs/msg/CameraInfo", stamp


# --- as messages --------------------------------------------------------------------------------


class Messages:
    """Builds and serialises messages for one version of ROS."""

    def __init__(self, ros1: bool) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:
            self.store.register(
                get_types_from_msg(
                    "geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"
                )
            )

    def type_name(self, kind: str) -> str:
        return "tf2_msgs/msg/TFMessage" if kind == "tf" else kind

    def serialized(self, kind: str, content: Any) -> bytes:
        message = self.build(kind, content)
        name = self.type_name(kind)
        if self.ros1:
            return bytes(self.store.serialize_ros1(message, name))
        return bytes(self.store.serialize_cdr(message, name))

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, stamp: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        fields = {"stamp": time, "frame_id": frame}
        return self.make("std_msgs/msg/Header", **({"seq": 0} if self.ros1 else {}), **fields)

    def transform(self, parent: str, child: str, stamp: int, T: Array) -> Any:
        slash = "/" if self.ros1 else ""  # as old ROS 1 nodes write it
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp, slash + parent),
            child_frame_id=slash + child,
            transform=self.make(
                "geometry_msgs/msg/Transform",
                translation=self.make("geometry_msgs/msg/Vector3", **xyz(T)),
                rotation=self.quaternion(T),
            ),
        )

    def quaternion(self, T: Array) -> Any:
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def build(self, kind: str, content: Any) -> Any:
        if kind == "tf":
            return self.make(
                "tf2_msgs/msg/TFMessage", transforms=[self.transform(*item) for item in content]
            )
        if kind == "geometry_msgs/msg/PoseStamped":
            stamp, T = content
            point = self.make("geometry_msgs/msg/Point", **xyz(T))
            pose = self.make(
                "geometry_msgs/msg/Pose", position=point, orientation=self.quaternion(T)
            )
            return self.make(kind, header=self.header(stamp, "base_link"), pose=pose)
        if kind == "geometry_msgs/msg/TransformStamped":
            stamp, T = content
            return self.transform("base_link", "tool0", stamp, T)
        if kind == "sensor_msgs/msg/Image":
            return self.image(*content)
        if kind == "sensor_msgs/msg/CompressedImage":
            return self.compressed(*content)
        if kind == "sensor_msgs/msg/CameraInfo":
            return self.camera_info(content)
        return self.make(kind, data=content)

    def image(self, stamp: int, array: np.ndarray, session: Session) -> Any:
        rows = array.astype(array.dtype.newbyteorder(">" if session.big_endian else "<"))
        rows = np.ascontiguousarray(rows).view(np.uint8).reshape(len(array), -1)
        rows = np.pad(rows, ((0, 0), (0, session.padding)), constant_values=123)
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(stamp, "camera"),
            height=array.shape[0],
            width=array.shape[1],
            encoding=session.encoding,
            is_bigendian=int(session.big_endian),
            step=rows.shape[1],
            data=rows.ravel(),
        )

    def compressed(self, stamp: int, array: np.ndarray, session: Session) -> Any:
        import cv2

        done, content = cv2.imencode(f".{session.compressed}", array)
        assert done
        return self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(stamp, "camera"),
            format=f"mono8; {session.compressed} compressed mono8",
            data=content.ravel(),
        )

    def camera_info(self, stamp: int) -> Any:
        K = np.array([137.5, 0, 79.5, 0, 137.5, 59.5, 0, 0, 1.0])
        names = ("D", "K", "R", "P") if self.ros1 else ("d", "k", "r", "p")
        values = (np.zeros(5), K, np.eye(3).ravel(), np.zeros(12))
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(stamp, "camera"),
            height=SIZE[1],
            width=SIZE[0],
            distortion_model="plumb_bob",
            **dict(zip(names, values, strict=True)),
            binning_x=0,
            binning_y=0,
            roi=self.make(
                "sensor_msgs/msg/RegionOfInterest",
                x_offset=0,
                y_offset=0,
                height=0,
                width=0,
                do_rectify=False,
            ),
        )


def xyz(T: Array) -> dict[str, float]:
    return dict(zip("xyz", map(float, T[:3, 3]), strict=True))


def write_bag(path: Path, storage: str, events: Sequence[Event]) -> Path:
    """Write events as a bag: a ``.bag`` file, or a folder with metadata and a storage file."""
    messages = Messages(ros1=storage == "ros1")
    if storage == "ros1":
        path = path.with_suffix(".bag")
        writer: Any = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    links: dict[tuple[str, str], Any] = {}
    with writer:
        for received, topic, kind, content in sorted(events, key=lambda event: event[0]):
            name = messages.type_name(kind)
            if (topic, name) not in links:
                links[topic, name] = writer.add_connection(topic, name, typestore=messages.store)
            writer.write(links[topic, name], received, messages.serialized(kind, content))
    return path
