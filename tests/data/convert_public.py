#!/usr/bin/env python3
"""Converts two public recordings into log folders.

    convert_public.py drive CHECKOUT OUT      rtklibexplorer/GNSS_IMU, commit 8235ee6c5f34 (BSD-3-Clause)
    convert_public.py handheld CHECKOUT OUT   koide3/gtsam_points, commit 85d0f4c43098 (MIT)

CHECKOUT is a local clone of the repository at that commit. Nothing but Python 3 is needed.

drive: a car with an RTK receiver (4 Hz) and a MEMS IMU (100 Hz), from data/drive_0708/.
  gnss_1934_sf.pos   RTKLIB solution, GPS time, degrees, m; sigmas north, east, up. Times are counted from
                     2025-07-08 19:34:18.
  imu_1934.csv       ax,ay,az (g), gx,gy,gz (degrees/s), ms since power-up.
  imu_1934.csv.tag   RTKLIB time tags: when logging started (GPS time) and, with each block, ms since then.
  The IMU's ms are stretched to the span of the tags, as the repository's own converter does (but nothing
  is filtered), then the IMU's constant lateness against the fixes, 0.270 s, is taken off. If the tags are
  missing or do not end within 50 ms of what is known, the known start and rate are used instead, and that
  is said: the layout of the tag file is taken from the repository's converter.
  Not converted: truth. The reference that our table quotes is a batch smoother over all fixes.
  World origin: the first fix, 40.0966268 deg, -105.1474483 deg, 1601.474 m.

handheld: a lidar with its IMU carried through a building, from data/continuous/.
  imu.txt            t ax ay az gx gy gz, SI units.
  traj.txt           t x y z qx qy qz qw: the IMU body by lidar odometry.
  Times are counted from 1647090000 s. There is no GNSS in it: gnss_left.csv is emulated at 5 Hz from the
  odometry with 12/12/25 mm of white noise, lever arm (0.05, 0.0, 0.12) m, origin 47 deg, 8 deg, 400 m. The
  noise is drawn from a fixed seed, but not the one that our table was made with: errors differ by noise.
"""

import bisect
import csv
import datetime
import math
import pathlib
import random
import struct
import sys

GRAVITY = 9.80665
DRIVE_EPOCH = datetime.datetime(2025, 7, 8, 19, 34, 18, tzinfo=datetime.timezone.utc)
DRIVE_IMU_LATE_S = 0.270
# First stamp after the lateness is taken off, and seconds by the tags for each second of the IMU.
DRIVE_KNOWN_START_S = 3.714839
DRIVE_KNOWN_RATE = 1.0000131792
HANDHELD_EPOCH_S = 1647090000
HANDHELD_ORIGIN = (47.0, 8.0, 400.0)
HANDHELD_ARM = (0.05, 0.0, 0.12)
HANDHELD_SIGMA = (0.012, 0.012, 0.025)

IMU_HEADER = ["t", "gx", "gy", "gz", "ax", "ay", "az"]
GNSS_HEADER = ["t", "lat", "lon", "alt", "sd_e", "sd_n", "sd_u"]
LIDAR_HEADER = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]


def write(path, header, rows):
    with open(path, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
    print(path, file=sys.stderr)


def drive(source, out):
    fixes = []
    for line in (source / "gnss_1934_sf.pos").read_text().splitlines():
        if line.startswith("%") or not line.strip():
            continue
        date, time, lat, lon, alt, _quality, _satellites, sd_n, sd_e, sd_u = line.split()[:10]
        moment = datetime.datetime.strptime(f"{date} {time} +0000", "%Y/%m/%d %H:%M:%S.%f %z")
        fixes.append([f"{(moment - DRIVE_EPOCH).total_seconds():.6f}", lat, lon, alt, sd_e, sd_n, sd_u])

    samples = []
    with open(source / "imu_1934.csv", newline="") as file:
        for row in csv.reader(file):
            if len(row) == 7:  # The last line may be cut.
                samples.append([float(value) for value in row])
    first_ms, last_ms = samples[0][6], samples[-1][6]
    start_s, rate = drive_clock(source / "imu_1934.csv.tag", (last_ms - first_ms) / 1000)
    rows = []
    for ax, ay, az, gx, gy, gz, ms in samples:
        stamp = start_s + rate * (ms - first_ms) / 1000
        gyro = [f"{math.radians(value):.8g}" for value in (gx, gy, gz)]
        rows.append([f"{stamp:.6f}", *gyro, *(f"{value * GRAVITY:.8g}" for value in (ax, ay, az))])
    write(out / "gnss_left.csv", GNSS_HEADER, fixes)
    write(out / "imu.csv", IMU_HEADER, rows)


def drive_clock(tag_path, span_s):
    """Stamp of the first sample, and seconds for each second of the IMU's clock."""
    known = (DRIVE_KNOWN_START_S, DRIVE_KNOWN_RATE)
    try:
        tags = tag_path.read_bytes()
        seconds, fraction = struct.unpack_from("<Id", tags, 64)
        last_tick_ms, _position = struct.unpack_from("<II", tags, 76 + (len(tags) - 76) // 8 * 8 - 8)
    except (OSError, struct.error) as error:
        print(f"{tag_path}: {error}; using the known start and rate", file=sys.stderr)
        return known
    start_s = seconds + fraction - DRIVE_EPOCH.timestamp() - DRIVE_IMU_LATE_S
    rate = last_tick_ms / 1000 / span_s
    off_s = max(abs(start_s - known[0]), abs(start_s - known[0] + (rate - known[1]) * span_s))
    if off_s > 0.05:
        print(f"{tag_path}: {off_s:.3f} s from the known start or end, which are used", file=sys.stderr)
        return known
    return start_s, rate


def handheld(source, out):
    samples = [line.split() for line in (source / "imu.txt").read_text().splitlines() if line.strip()]
    poses = [line.split() for line in (source / "traj.txt").read_text().splitlines() if line.strip()]
    shifted = lambda text: f"{int(text.split('.')[0]) - HANDHELD_EPOCH_S}.{text.split('.')[1]}"
    write(
        out / "imu.csv",
        IMU_HEADER,
        [[shifted(t), gx, gy, gz, ax, ay, az] for t, ax, ay, az, gx, gy, gz in samples],
    )
    write(out / "lidar_odometry.csv", LIDAR_HEADER, [[shifted(t), *rest] for t, *rest in poses])

    times = [float(shifted(t)) for t, *_ in poses]
    dice = random.Random(1)
    fixes = []
    step = math.ceil(max(times[0], float(shifted(samples[0][0]))) * 5)
    while step / 5 <= min(times[-1], float(shifted(samples[-1][0]))):
        stamp = step / 5
        after = min(max(bisect.bisect_right(times, stamp), 1), len(times) - 1)
        part = (stamp - times[after - 1]) / (times[after] - times[after - 1])
        antenna = [
            low + part * (high - low)
            for low, high in zip(antenna_of(poses[after - 1]), antenna_of(poses[after]))
        ]
        enu = [value + dice.gauss(0.0, sigma) for value, sigma in zip(antenna, HANDHELD_SIGMA)]
        lat, lon, alt = geodetic(enu, HANDHELD_ORIGIN)
        sigmas = [f"{sigma:.4f}" for sigma in HANDHELD_SIGMA]
        fixes.append([f"{stamp:.6f}", f"{lat:.11f}", f"{lon:.11f}", f"{alt:.4f}", *sigmas])
        step += 1
    write(out / "gnss_left.csv", GNSS_HEADER, fixes)


def antenna_of(pose):
    """The antenna's position: p + R arm."""
    x, y, z, qx, qy, qz, qw = (float(value) for value in pose[1:])
    vector = (qx, qy, qz)
    cross = lambda a, b: (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    once = [2 * value for value in cross(vector, HANDHELD_ARM)]
    twice = cross(vector, once)
    return [p + a + qw * o + t for p, a, o, t in zip((x, y, z), HANDHELD_ARM, once, twice)]


def geodetic(enu, origin):
    """WGS84 from metres east, north, up of the origin; iterated on the latitude."""
    axis, flattening = 6378137.0, 1 / 298.257223563
    squared = flattening * (2 - flattening)
    lat, lon = math.radians(origin[0]), math.radians(origin[1])
    normal = axis / math.sqrt(1 - squared * math.sin(lat) ** 2)
    across = -math.sin(lat) * enu[1] + math.cos(lat) * enu[2] + (normal + origin[2]) * math.cos(lat)
    x = -math.sin(lon) * enu[0] + math.cos(lon) * across
    y = math.cos(lon) * enu[0] + math.sin(lon) * across
    z = math.cos(lat) * enu[1] + math.sin(lat) * enu[2]
    z += (normal * (1 - squared) + origin[2]) * math.sin(lat)
    horizontal = math.hypot(x, y)
    lat = math.atan2(z, horizontal * (1 - squared))
    for _ in range(6):
        normal = axis / math.sqrt(1 - squared * math.sin(lat) ** 2)
        lat = math.atan2(z + squared * normal * math.sin(lat), horizontal)
    up = horizontal * math.cos(lat) + z * math.sin(lat) - normal * (1 - squared * math.sin(lat) ** 2)
    return math.degrees(lat), math.degrees(math.atan2(y, x)), up


def main():
    kinds = {"drive": (drive, "data/drive_0708"), "handheld": (handheld, "data/continuous")}
    if len(sys.argv) != 4 or sys.argv[1] not in kinds:
        sys.exit(__doc__)
    convert, folder = kinds[sys.argv[1]]
    source, out = pathlib.Path(sys.argv[2]) / folder, pathlib.Path(sys.argv[3])
    if not source.is_dir():
        sys.exit(f"{source}: no such folder")
    out.mkdir(parents=True, exist_ok=True)
    convert(source, out)


if __name__ == "__main__":
    main()
