#!/usr/bin/env python3
"""Reads a holdfast recording with the public tools: mcap, mcap-ros2-support and rosbags.

    python3 -m venv venv && venv/bin/pip install mcap mcap-ros2-support rosbags
    venv/bin/python tests/record/read_with_public_tools.py SESSION.mcap [EXPECTED.json]

Every ROS 2 message is decoded by both libraries from the schemas in the file, and their values must agree.
EXPECTED.json, if given, holds what must be in the file:
    {"topics": {"/a/pose": COUNT or [AT_LEAST, AT_MOST], ...},
     "first":  {"/a/sensor/imu": {"angular_velocity.x": VALUE, "header.frame_id": "imu", ...}, ...}}
Exit code 0 if all is well, 1 with a message for each thing that is not.
"""

import json
import math
import sys
from collections import Counter
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

SCHEMAS = {
    "pose": "nav_msgs/msg/Odometry",
    "odom": "nav_msgs/msg/Odometry",
    "sensor/imu": "sensor_msgs/msg/Imu",
    "sensor/base_imu": "sensor_msgs/msg/Imu",
    "sensor/gnss_left": "sensor_msgs/msg/NavSatFix",
    "sensor/gnss_right": "sensor_msgs/msg/NavSatFix",
    "sensor/lidar_odometry": "nav_msgs/msg/Odometry",
    "sensor/cabin_turn": "sensor_msgs/msg/JointState",
    "health": None,
    "event": None,
}

# One field of each type, to be compared between the libraries.
FIELDS = {
    "nav_msgs/msg/Odometry": [
        "header.stamp.sec", "header.stamp.nanosec", "header.frame_id", "child_frame_id",
        "pose.pose.position.x", "pose.pose.orientation.w", "pose.covariance.35",
        "twist.twist.linear.x", "twist.twist.angular.z", "twist.covariance.35",
    ],
    "sensor_msgs/msg/Imu": [
        "header.stamp.sec", "header.stamp.nanosec", "header.frame_id", "angular_velocity.x",
        "linear_acceleration.z", "orientation_covariance.0", "linear_acceleration_covariance.8",
    ],
    "sensor_msgs/msg/NavSatFix": [
        "header.stamp.sec", "header.stamp.nanosec", "header.frame_id", "status.status", "latitude",
        "longitude", "altitude", "position_covariance.8", "position_covariance_type",
    ],
    "sensor_msgs/msg/JointState": [
        "header.stamp.sec", "header.stamp.nanosec", "name.0", "position.0",
    ],
}


def field(message, path):
    """The value at a dotted path; numbers index sequences."""
    for part in path.split("."):
        message = message[int(part)] if part.isdigit() else getattr(message, part)
    return message


def same(left, right):
    if isinstance(left, str) or isinstance(right, str):
        return str(left) == str(right)
    left, right = float(left), float(right)
    return left == right or (math.isnan(left) and math.isnan(right))


def check(path, expected):
    errors = []
    counts = Counter()
    by_mcap = {}
    first = {}
    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        header = reader.get_header()
        if header.profile != "ros2":
            errors.append(f"profile is {header.profile!r}, must be 'ros2'")
        if not header.library.startswith("holdfast "):
            errors.append(f"library is {header.library!r}, must begin with 'holdfast '")
        statistics = reader.get_summary().statistics
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            counts[channel.topic] += 1
            name = channel.topic.split("/", 2)[2]
            if name not in SCHEMAS:
                errors.append(f"{channel.topic}: unknown topic")
                continue
            wanted = SCHEMAS[name]
            if wanted is None:
                if channel.message_encoding != "json":
                    errors.append(f"{channel.topic}: encoding is {channel.message_encoding}, must be json")
                value = json.loads(message.data)
                if not isinstance(value, dict):
                    errors.append(f"{channel.topic}: not a JSON object: {message.data[:80]!r}")
            elif schema is None or schema.name != wanted or schema.encoding != "ros2msg":
                errors.append(f"{channel.topic}: schema is {schema}, must be {wanted} in ros2msg")
        if statistics.message_count != sum(counts.values()):
            errors.append(f"the index counts {statistics.message_count} messages, the file has {sum(counts.values())}")
        for item in reader.iter_decoded_messages(
            topics=[topic for topic in counts if SCHEMAS.get(topic.split("/", 2)[2])], log_time_order=False
        ):
            key = (item.channel.topic, item.message.log_time, item.message.sequence)
            by_mcap[key] = [field(item.decoded_message, name) for name in FIELDS[item.schema.name]]
            first.setdefault(item.channel.topic, item.decoded_message)

    ros_counts = Counter()
    unmatched = Counter((topic, log_time) for topic, log_time, _ in by_mcap)
    values_at = {}
    for (topic, log_time, _), values in by_mcap.items():
        values_at.setdefault((topic, log_time), []).append(values)
    with AnyReader([Path(path)]) as reader:
        listed = {connection.topic for connection in reader.connections}
        if listed != set(counts):
            errors.append(f"rosbags lists {sorted(listed)}, mcap {sorted(counts)}")
        ros = [connection for connection in reader.connections if connection.msgtype in FIELDS]
        for connection, timestamp, raw in reader.messages(connections=ros):
            ros_counts[connection.topic] += 1
            message = reader.deserialize(raw, connection.msgtype)
            values = [field(message, name) for name in FIELDS[connection.msgtype]]
            candidates = values_at.get((connection.topic, timestamp), [])
            if not any(all(map(same, values, candidate)) for candidate in candidates):
                errors.append(f"{connection.topic} at {timestamp}: rosbags reads {values}, mcap {candidates}")
            unmatched[(connection.topic, timestamp)] -= 1
    missing = sum(count for count in unmatched.values() if count > 0)
    if missing:
        errors.append(f"rosbags misses {missing} messages that mcap reads")

    for topic, wanted in expected.get("topics", {}).items():
        low, high = wanted if isinstance(wanted, list) else (wanted, wanted)
        if not low <= counts[topic] <= high:
            errors.append(f"{topic}: {counts[topic]} messages, must be {low} to {high}")
    for topic, fields in expected.get("first", {}).items():
        for name, wanted in fields.items():
            found = field(first[topic], name) if topic in first else None
            if found is None or not same(found, wanted):
                errors.append(f"{topic}: first message has {name} = {found!r}, must be {wanted!r}")
    return counts, ros_counts, errors


def main():
    if len(sys.argv) not in (2, 3):
        print(__doc__, file=sys.stderr)
        return 2
    expected = json.loads(Path(sys.argv[2]).read_text()) if len(sys.argv) == 3 else {}
    counts, ros_counts, errors = check(sys.argv[1], expected)
    for topic in sorted(counts):
        print(f"{topic}: {counts[topic]} messages, {ros_counts[topic]} of them decoded by rosbags")
    if not counts:
        errors.append("the file holds no messages")
    for error in errors[:50]:
        print(f"error: {error}", file=sys.stderr)
    return 1 if errors else 0


if __name__ == "__main__":
    sys.exit(main())
