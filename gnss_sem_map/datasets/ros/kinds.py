"""Types of messages: which sensor each tells of, those of drivers that ROS itself lacks, and those that are not read.

Types are written as ROS 2 writes them, also those of ROS 1. A type of a driver is decoded by the definition here, never
by that of the bag.
"""

from __future__ import annotations

IMU, VECTOR = "sensor_msgs/msg/Imu", "geometry_msgs/msg/Vector3Stamped"
FIX, GPS_FIXES = "sensor_msgs/msg/NavSatFix", ("gps_msgs/msg/GPSFix", "gps_common/msg/GPSFix")
SENTENCE, STRING = "nmea_msgs/msg/Sentence", "std_msgs/msg/String"
CLOUD = "sensor_msgs/msg/PointCloud2"
LIVOX = tuple(
    f"{package}/msg/CustomMsg"
    for package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces", "livox_ros2_driver")
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
    "receiver": (FIX, *GPS_FIXES, SENTENCE),
    "LiDAR": (CLOUD, *LIVOX),
    "camera": (IMAGE, COMPRESSED_IMAGE),
    "velocity": TWISTS,
    "heading": (QUATERNION, FLOATS[0]),
    "wheels": ("nav_msgs/msg/Odometry", *_REPORTS),
}
"""Those of velocities, headings and wheels, which may also be a command or an angle of anything, are never taken
unasked. Of receivers, the first type that is there: others most often say the same once more."""
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

_DRIVERS = {
    "velodyne_msgs": "velodyne_pointcloud",
    "ouster_ros": "ouster_ros", "ouster_msgs": "ouster_ros", "ouster_sensor_msgs": "ouster_ros",
    "rslidar_msg": "rslidar_sdk", "rslidar_msgs": "rslidar_sdk",
    "hesai_ros_driver": "hesai_ros_driver", "hesai_lidar": "hesai_lidar", "pandar_msgs": "hesai_ros_driver or nebula",
    "nebula_msgs": "nebula", "lslidar_msgs": "lslidar_driver", "seyond": "seyond", "innovusion_msgs": "seyond",
}  # fmt: skip
"""What makes clouds of the packets of a LiDAR, by the package of their type."""
_OTHERS = {
    "can_msgs/msg/Frame": "raw CAN frames: write the speed of its wheels as std_msgs/Float64 (by your DBC file)",
    "sensor_msgs/msg/LaserScan": "a LiDAR of one plane, which makes no map",
    "sensor_msgs/msg/PointCloud": "the old cloud without times of points: record PointCloud2",
}

_GPS_STATUS = """std_msgs/Header header
uint16 satellites_used
int32[] satellite_used_prn
uint16 satellites_visible
int32[] satellite_visible_prn
int32[] satellite_visible_z
int32[] satellite_visible_azimuth
int32[] satellite_visible_snr
int16 status
uint16 motion_source
uint16 orientation_source
uint16 position_source
"""
_GPS_NUMBERS = (
    "latitude longitude altitude track speed climb pitch roll dip time gdop pdop hdop vdop tdop err err_horz err_vert"
    " err_track err_speed err_climb err_time err_pitch err_roll err_dip"
)
_GPS_FIX = (
    "std_msgs/Header header\nGPSStatus status\n"
    + "".join(f"float64 {name}\n" for name in _GPS_NUMBERS.split())
    + "float64[9] position_covariance\nuint8 position_covariance_type\n"
)
_LIVOX_POINT = (
    "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
)
_LIVOX = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "CustomPoint[] points\n"
)
_REPORT = (
    "std_msgs/Header header\nfloat32 longitudinal_velocity\nfloat32 lateral_velocity\nfloat32 heading_rate\n"
)
DEFINITIONS = {
    **dict.fromkeys(TRANSFORMS, "geometry_msgs/TransformStamped[] transforms\n"),
    **dict.fromkeys((kind.replace("Fix", "Status") for kind in GPS_FIXES), _GPS_STATUS),
    **dict.fromkeys(GPS_FIXES, _GPS_FIX),
    SENTENCE: "std_msgs/Header header\nstring sentence\n",
    **dict.fromkeys((kind.replace("Msg", "Point") for kind in LIVOX), _LIVOX_POINT),
    **dict.fromkeys(LIVOX, _LIVOX),
    **dict.fromkeys(_REPORTS, _REPORT),
}
"""Of the types that ROS itself lacks."""


def unread(kind: str) -> str:
    """What a type is that is not read, and the way out; empty where there is nothing to say of it."""
    driver = _DRIVERS.get(kind.partition("/")[0])
    if driver is not None:
        return f"packets of a LiDAR: play the bag, run {driver}, and record its sensor_msgs/PointCloud2"
    return _OTHERS.get(kind, "")
