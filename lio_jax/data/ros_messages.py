"""Serialise sensor messages for ROS 1 and ROS 2 exactly as drivers publish them."""

import struct
from collections import Counter
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.data import navigation_messages, pointcloud2, static_transforms

POSE_TYPE = "geometry_msgs/msg/PoseStamped"

_LIVOX_POINT = """uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
_LIVOX_MESSAGE = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
"""
_FIELD_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
_LIVOX_STRIDE = 20
"""Bytes from one point to the next in CDR, which aligns uint32; the point itself has 19."""


class Message(NamedTuple):
    """A serialised message with its topic and type, as a bag stores it."""

    topic: str
    type: str
    received_ns: int
    """When the recorder received it, ns."""
    raw: bytes


class RosMessages:
    """Build the messages of one bag; ROS 1 headers are numbered per topic."""

    def __init__(self, ros2: bool) -> None:
        """Choose the serialisation: ROS 1, or CDR of ROS 2."""
        self._ros2 = ros2
        self._sequence: Counter[str] = Counter()

    @cached_property
    def typestore(self) -> Any:
        """Message definitions, including those of tf2 and of the Livox driver."""
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store = get_typestore(Stores.ROS2_HUMBLE if self._ros2 else Stores.ROS1_NOETIC)
        static_transforms.register_type(store)
        package = self.livox_type.removesuffix("CustomMsg")
        store.register(get_types_from_msg(_LIVOX_POINT, f"{package}CustomPoint"))
        store.register(get_types_from_msg(_LIVOX_MESSAGE, f"{package}CustomMsg"))
        return store

    @property
    def livox_type(self) -> str:
        """Name of the CustomMsg that systems of this ROS version subscribe to."""
        return f"livox_ros_driver{'2' if self._ros2 else ''}/msg/CustomMsg"

    def cloud(self, topic: str, frame: str, stamp_ns: int, points: NDArray[Any], received_ns: int) -> Message:
        """Return a PointCloud2 of a structured array, not organised, without invalid points."""
        layout = points.dtype
        fields = [
            self._make("sensor_msgs/msg/PointField", name, offset, _FIELD_TYPES[dtype.str[1:]], 1)
            for name, (dtype, offset, *_) in (layout.fields or {}).items()
        ]
        data = points.view(np.uint8) if len(points) else np.empty(0, np.uint8)
        header = self._header(topic, frame, stamp_ns)
        step, width = layout.itemsize, len(points)
        body = (1, width, fields, False, step, width * step, data, True)
        return self._message(topic, received_ns, pointcloud2.TYPE, header, *body)

    def custom_cloud(
        self, topic: str, frame: str, stamp_ns: int, points: NDArray[Any], received_ns: int
    ) -> Message:
        """Return a Livox CustomMsg; points are copied as bytes: rosbags would make an object of each one."""
        rsvd = np.zeros(3, np.uint8)
        header = self._header(topic, frame, stamp_ns)
        empty = self._message(topic, received_ns, self.livox_type, header, stamp_ns, 0, 0, rsvd, [])
        count, size = len(points), points.dtype.itemsize
        rows = np.zeros((count, _LIVOX_STRIDE if self._ros2 else size), np.uint8)
        rows[:, :size] = points.view(np.uint8).reshape(count, size)
        behind_last = rows.shape[1] - size if count else 0
        # an empty message ends with uint32 point_num, four bytes of lidar_id and rsvd, and uint32 length
        number = struct.pack("<I", count)
        raw = empty.raw[:-12] + number + empty.raw[-8:-4] + number + rows.tobytes()
        return empty._replace(raw=raw[: len(raw) - behind_last])

    def imu(
        self,
        topic: str,
        frame: str,
        stamp_ns: int,
        gyro: NDArray[np.float64],
        accel: NDArray[np.float64],
        orientation: NDArray[np.float64] | None,
    ) -> Message:
        """Return an Imu; without an orientation its covariance begins with -1, as the definition demands."""
        unknown, stated = np.zeros(9), np.zeros(9)
        if orientation is None:
            stated[0] = -1.0
        return self._message(
            topic,
            stamp_ns,
            navigation_messages.TYPE,
            self._header(topic, frame, stamp_ns),
            self._quaternion((0.0, 0.0, 0.0, 1.0) if orientation is None else orientation),
            stated,
            self._vector(gyro),
            unknown,
            self._vector(accel),
            unknown,
        )

    def fix(
        self, topic: str, stamp_ns: int, geodetic: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> Message:
        """Return a NavSatFix of latitude deg, longitude deg, height m with its ENU covariance in m^2."""
        status = self._make("sensor_msgs/msg/NavSatStatus", 0, 1)
        header = self._header(topic, "gps", stamp_ns)
        known = 3
        return self._message(
            topic,
            stamp_ns,
            navigation_messages.FIX_TYPE,
            header,
            status,
            *geodetic.tolist(),
            np.ascontiguousarray(covariance).ravel(),
            known,
        )

    def pose(self, topic: str, frame: str, stamp_ns: int, pose: NDArray[np.float64]) -> Message:
        """Return a PoseStamped of a (4, 4) pose."""
        body = self._make("geometry_msgs/msg/Pose", *self._parts("Point", pose))
        return self._message(topic, stamp_ns, POSE_TYPE, self._header(topic, frame, stamp_ns), body)

    def static_transform(
        self, parent: str, child: str, stamp_ns: int, T_parent_child: NDArray[np.float64]
    ) -> Message:
        """Return the /tf_static message of a (4, 4) transform."""
        topic = static_transforms.TOPIC
        body = self._make("geometry_msgs/msg/Transform", *self._parts("Vector3", T_parent_child))
        header = self._header(topic, parent, stamp_ns)
        stamped = self._make("geometry_msgs/msg/TransformStamped", header, child, body)
        return self._message(topic, stamp_ns, static_transforms.TYPE, [stamped])

    def _message(self, topic: str, received_ns: int, kind: str, *body: Any) -> Message:
        message = self._make(kind, *body)
        store = self.typestore
        raw = store.serialize_cdr(message, kind) if self._ros2 else store.serialize_ros1(message, kind)
        return Message(topic, kind, received_ns, bytes(raw))

    def _make(self, kind: str, *values: Any) -> Any:
        return self.typestore.types[kind](*values)

    def _header(self, topic: str, frame: str, stamp_ns: int) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", *divmod(int(stamp_ns), 1_000_000_000))
        if self._ros2:
            return self._make("std_msgs/msg/Header", stamp, frame)
        number = self._sequence[topic]
        self._sequence[topic] += 1
        return self._make("std_msgs/msg/Header", number, stamp, frame)

    def _parts(self, position_type: str, pose: NDArray[np.float64]) -> tuple[Any, Any]:
        position = self._make(f"geometry_msgs/msg/{position_type}", *pose[:3, 3].tolist())
        return position, self._quaternion(Rotation.from_matrix(pose[:3, :3]).as_quat())

    def _vector(self, values: Any) -> Any:
        return self._make("geometry_msgs/msg/Vector3", *(float(value) for value in values))

    def _quaternion(self, values: Any) -> Any:
        return self._make("geometry_msgs/msg/Quaternion", *(float(value) for value in values))
