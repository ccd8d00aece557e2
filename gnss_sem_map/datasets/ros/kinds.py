"""Types of messages: which sensor each tells of, those of drivers that ROS itself lacks, and those that are not read.

Types are written as ROS 2 writes them, also those of ROS 1. Messages are decoded by `rosbags`, those of a driver by the
definition here, never by that of the bag.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from gnss_sem_map.datasets.ros.bag import Bag, Messages
from gnss_sem_map.errors import one_line
from gnss_sem_map.files.untrusted import refused

IMU, VECTOR = "sensor_msgs/msg/Imu", "geometry_msgs/msg/Vector3Stamped"
FIX, GPS_FIXES = "sensor_msgs/msg/NavSatFix", ("gps_msgs/msg/GPSFix", "gps_common/msg/GPSFix")
SENTENCE, STRING = "nmea_msgs/msg/Sentence", "std_msgs/msg/String"
CLOUD = "sensor_msgs/msg/PointCloud2"
LIVOX = tuple(
    f"{name}/msg/CustomMsg" for name in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
)
IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
TWISTS = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TwistWithCovarianceStamped")
QUATERNION, FLOATS = "geometry_msgs/msg/QuaternionStamped", ("std_msgs/msg/Float64", "std_msgs/msg/Float32")
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_REPORTS = tuple(
    f"{package}/msg/VelocityReport" for package in ("autoware_vehicle_msgs", "autoware_auto_vehicle_msgs")
)

KINDS = {
    "IMU": (IMU,),
    "gyroscope": (),
    "accelerometer": (),
    "receiver": (FIX, *GPS_FIXES, SENTENCE),
    "LiDAR": (CLOUD, *LIVOX),
    "camera": (IMAGE, COMPRESSED_IMAGE),
    "velocity": TWISTS,
    "heading": (QUATERNION, FLOATS[0]),
    "wheels": ("nav_msgs/msg/Odometry", *_REPORTS),
}
"""Parts of an IMU are of the type of the whole. Velocities, headings and wheels, which may also be a command or an
angle of anything, are never taken unasked. Of receivers, the first type that is there: others say the same again."""
NAMED = {
    "IMU": (VECTOR,),
    "receiver": (STRING,),
    "heading": (IMU,),
    "wheels": (*TWISTS, "geometry_msgs/msg/Twist", *FLOATS),
}
"""More types, which are of that sensor where rig.yaml names the topic."""
HEADLESS = (*FLOATS, STRING, "geometry_msgs/msg/Twist")
"""Without a header: their arrival counts."""
TAKEN_FOR = {kind: sensor for sensor, kinds in KINDS.items() for kind in kinds}
TAKEN_FOR |= {INFO: "calibration"} | dict.fromkeys(TRANSFORMS, "transforms")

_PACKETS = {
    "velodyne_pointcloud": ("velodyne_msgs",),
    "ouster_ros": ("ouster_ros", "ouster_msgs", "ouster_sensor_msgs"),
    "rslidar_sdk": ("rslidar_msg", "rslidar_msgs"),
    "hesai_ros_driver or nebula": ("hesai_ros_driver", "hesai_lidar", "pandar_msgs", "nebula_msgs"),
    "lslidar_driver": ("lslidar_msgs",),
    "the driver of Seyond": ("seyond", "innovusion_msgs"),
}
"""Packages whose messages are packets of a LiDAR, by the driver that makes clouds of them."""
_OTHERS = {
    "reports of a vehicle's bus: write its speed as std_msgs/Float64 (of CAN frames by your DBC file)": (
        "can_msgs", "dbw_mkz_msgs", "dbw_fca_msgs", "dbw_ford_msgs", "raptor_dbw_msgs", "pacmod_msgs", "pacmod3_msgs",
    ),
    "a receiver's own messages: record the NavSatFix of its driver": (
        "ublox_msgs", "novatel_gps_msgs", "novatel_oem7_msgs", "septentrio_gnss_driver",
    ),
    "a video: republish it as compressed images": ("ffmpeg_image_transport_msgs", "theora_image_transport"),
    "a LiDAR of one plane, which makes no map": ("sensor_msgs/msg/LaserScan",),
    "the old cloud without times of points: record PointCloud2": ("sensor_msgs/msg/PointCloud",),
}  # fmt: skip
_NOTES = {
    package: f"packets of a LiDAR: play the bag, run {driver}, and record its sensor_msgs/PointCloud2"
    for driver, packages in _PACKETS.items()
    for package in packages
} | {name: note for note, names in _OTHERS.items() for name in names}

_HEADER = "std_msgs/Header header;"
_GPS_STATUS = (
    "uint16 satellites_used;int32[] satellite_used_prn;uint16 satellites_visible;int32[] satellite_visible_prn;"
    "int32[] satellite_visible_z;int32[] satellite_visible_azimuth;int32[] satellite_visible_snr;int16 status;"
    "uint16 motion_source;uint16 orientation_source;uint16 position_source"
)
_GPS_NUMBERS = (
    "latitude longitude altitude track speed climb pitch roll dip time gdop pdop hdop vdop tdop err err_horz err_vert"
    " err_track err_speed err_climb err_time err_pitch err_roll err_dip"
)
_GPS_FIX = f"GPSStatus status;{''.join(f'float64 {name};' for name in _GPS_NUMBERS.split())}"
_LIVOX_POINT = "uint32 offset_time;float32 x;float32 y;float32 z;uint8 reflectivity;uint8 tag;uint8 line"
_LIVOX = "uint64 timebase;uint32 point_num;uint8 lidar_id;uint8[3] rsvd;CustomPoint[] points"
DEFINITIONS = {
    **dict.fromkeys(TRANSFORMS, "geometry_msgs/TransformStamped[] transforms"),
    **{kind.replace("Fix", "Status"): _HEADER + _GPS_STATUS for kind in GPS_FIXES},
    **dict.fromkeys(
        GPS_FIXES, f"{_HEADER}{_GPS_FIX}float64[9] position_covariance;uint8 position_covariance_type"
    ),
    SENTENCE: f"{_HEADER}string sentence",
    **{kind.replace("Msg", "Point"): _LIVOX_POINT for kind in LIVOX},
    **dict.fromkeys(LIVOX, _HEADER + _LIVOX),
    **dict.fromkeys(
        _REPORTS, f"{_HEADER}float32 longitudinal_velocity;float32 lateral_velocity;float32 heading_rate"
    ),
}
"""Of the types that ROS itself lacks: their fields, between semicolons."""


def unread(kind: str) -> str:
    """What a type is that is not read, and the way out; empty where there is nothing to say of it."""
    return _NOTES.get(kind) or _NOTES.get(kind.partition("/")[0], "")


@cache
def typestore(is_ros1: bool) -> Any:
    """The message types of ROS; those that we read are the same in every release of it."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text.replace(";", "\n"), name))
    return store


def decode(bag: Bag, messages: Messages, k: int) -> Any:
    """A message, as an object with the fields of its type; raises DataError for one that is damaged."""
    data, store = memoryview(bag.read(messages, k)), typestore(messages.is_ros1)  # whose parts are no copies
    try:
        if messages.is_ros1:
            return store.deserialize_ros1(data, messages.kind)
        return store.deserialize_cdr(data, messages.kind)
    except Exception as error:
        # generated code reads bytes that may be anything: it fails in as many ways as there are bytes
        if isinstance(error, MemoryError):
            raise
        raise refused(messages.topic, f"message {k} is no {messages.kind} ({one_line(error, 80)})") from None
