#!/usr/bin/env python3
"""Writes a ROS 2 bag in MCAP with rosbags, from a holdfast log folder.

    write_bag.py LOG_FOLDER BAG [--compress zstd|none] [--lidar pose|covariance] [--spoil KIND]

Topics are /cabin/imu, /chassis/imu, /gnss/left, /gnss/right, /lidar (Odometry; PoseStamped with --lidar pose,
PoseWithCovarianceStamped with --lidar covariance) and /joint_states, whose joints are boom, swing (the cabin turn) and stick. Beside them /chatter of another type.
Each message is recorded at its t_arrival. --spoil makes the bag bad in one way:
    nan         the 11th IMU sample has a NaN
    backward    the stamp of the 21st IMU sample is that of the 11th
    no-fix      fixes 5 to 9 of the left antenna say that there is none
    no-sigma    fix 5 of the left antenna does not know its covariance
    joint       joint states 3 and 4 have no joint swing
    late        the 100th IMU sample is written last
    short       the 7th IMU message ends early
"""

import argparse
import csv
import sys
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types


LIDAR_TYPES = {
    "odometry": "nav_msgs/msg/Odometry",
    "pose": "geometry_msgs/msg/PoseStamped",
    "covariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
}


def nanos(text):
    """Decimal seconds with up to nine decimals, exactly."""
    sign = -1 if text.startswith("-") else 1
    whole, _, fraction = text.lstrip("-").partition(".")
    return sign * (int(whole) * 10**9 + int(fraction.ljust(9, "0")[:9] or "0"))


def make(name, *values):
    return TYPES[name](*values)


def header(stamp, frame):
    time = make("builtin_interfaces/msg/Time", stamp // 10**9, stamp % 10**9)
    return make("std_msgs/msg/Header", time, frame)


def vector(row, *keys):
    return make("geometry_msgs/msg/Vector3", *(float(row[key]) for key in keys))


def quaternion(x, y, z, w):
    return make("geometry_msgs/msg/Quaternion", float(x), float(y), float(z), float(w))


def imu(row, stamp, frame, number, spoil):
    rate = vector(row, "gx", "gy", "gz")
    if spoil == "nan" and number == 11:
        rate.y = float("nan")
    unknown = np.zeros(9)
    orientation = np.array([-1.0] + [0.0] * 8)
    force = vector(row, "ax", "ay", "az")
    return make("sensor_msgs/msg/Imu", header(stamp, frame), quaternion(0, 0, 0, 1), orientation, rate, unknown, force, unknown)


def fix(row, stamp, number, spoil):
    status = -1 if spoil == "no-fix" and 5 <= number <= 9 else 2
    kind = 0 if spoil == "no-sigma" and number == 5 else 2
    covariance = np.zeros(9)
    covariance[[0, 4, 8]] = [float(row[key]) ** 2 for key in ("sd_e", "sd_n", "sd_u")]
    return make(
        "sensor_msgs/msg/NavSatFix", header(stamp, "gnss"), make("sensor_msgs/msg/NavSatStatus", status, 1),
        float(row["lat"]), float(row["lon"]), float(row["alt"]), covariance, kind,
    )


def pose(row):
    point = make("geometry_msgs/msg/Point", *(float(row[key]) for key in "xyz"))
    return make("geometry_msgs/msg/Pose", point, quaternion(row["qx"], row["qy"], row["qz"], row["qw"]))


def lidar_odometry(row, stamp):
    covariance = np.zeros(36)
    zero = make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    twist = make("geometry_msgs/msg/TwistWithCovariance", make("geometry_msgs/msg/Twist", zero, zero), covariance)
    with_covariance = make("geometry_msgs/msg/PoseWithCovariance", pose(row), covariance)
    return make("nav_msgs/msg/Odometry", header(stamp, "lidar_map"), "lidar", with_covariance, twist)


def joints(row, stamp, number, spoil):
    names = ["boom", "swing", "stick"]
    if spoil == "joint" and number in (3, 4):
        names[1] = "slew"
    positions = np.array([0.5, float(row["angle"]), -1.25])
    return make("sensor_msgs/msg/JointState", header(stamp, "base"), names, positions, np.array([]), np.array([]))


def messages(folder, lidar, spoil):
    """(time, topic, type, CDR) of everything in the folder, in the order of the files."""
    plan = {
        "imu.csv": ("/cabin/imu", "sensor_msgs/msg/Imu"),
        "base_imu.csv": ("/chassis/imu", "sensor_msgs/msg/Imu"),
        "gnss_left.csv": ("/gnss/left", "sensor_msgs/msg/NavSatFix"),
        "gnss_right.csv": ("/gnss/right", "sensor_msgs/msg/NavSatFix"),
        "lidar_odometry.csv": ("/lidar", LIDAR_TYPES[lidar]),
        "cabin_turn.csv": ("/joint_states", "sensor_msgs/msg/JointState"),
    }
    for file, (topic, kind) in plan.items():
        earlier = None
        with open(folder / file, newline="") as stream:
            for number, row in enumerate(csv.DictReader(stream), start=1):
                stamp = nanos(row["t"])
                cabin = topic == "/cabin/imu"
                if cabin and number == 11:
                    earlier = stamp
                if spoil == "backward" and cabin and number == 21:
                    stamp = earlier
                if kind.endswith("Imu"):
                    message = imu(row, stamp, topic.split("/")[1], number, spoil if cabin else None)
                elif kind.endswith("NavSatFix"):
                    message = fix(row, stamp, number, spoil if topic.endswith("left") else None)
                elif kind.endswith("Odometry"):
                    message = lidar_odometry(row, stamp)
                elif kind.endswith("PoseStamped"):
                    message = make(kind, header(stamp, "lidar_map"), pose(row))
                elif kind.endswith("PoseWithCovarianceStamped"):
                    covariance = np.arange(36, dtype=float)
                    with_covariance = make("geometry_msgs/msg/PoseWithCovariance", pose(row), covariance)
                    message = make(kind, header(stamp, "lidar_map"), with_covariance)
                else:
                    message = joints(row, stamp, number, spoil)
                data = bytes(STORE.serialize_cdr(message, kind))
                if spoil == "short" and cabin and number == 7:
                    data = data[:60]
                last = spoil == "late" and cabin and number == 100
                yield (2**62 if last else nanos(row["t_arrival"])), nanos(row["t_arrival"]), topic, kind, data


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--compress", default="none")
    parser.add_argument("--lidar", choices=LIDAR_TYPES, default="odometry")
    parser.add_argument("--spoil")
    arguments = parser.parse_args()
    writer = Writer(arguments.bag, version=9, storage_plugin=StoragePlugin.MCAP)
    if arguments.compress == "zstd":
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    elif arguments.compress == "message":
        writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        chatter = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=STORE)
        text = STORE.serialize_cdr(make("std_msgs/msg/String", "not ours"), "std_msgs/msg/String")
        everything = sorted(messages(arguments.folder, arguments.lidar, arguments.spoil), key=lambda item: item[0])
        for index, (_, time, topic, kind, data) in enumerate(everything):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], time, data)
            if index % 100 == 0:
                writer.write(chatter, time, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
