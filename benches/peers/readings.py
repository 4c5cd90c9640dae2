"""Machine file, log and results as both estimators get them; numbers as in src/config and src/frames."""

import tomllib
from pathlib import Path

import gtsam
import numpy as np

# What the estimator takes where a machine file is silent (src/config/machine.rs).
DEFAULTS = {
    "imu": {
        "accelerometer_noise_density": 1.1e-3,
        "accelerometer_random_walk": 6.0e-5,
        "gyroscope_noise_density": 1.6e-4,
        "gyroscope_random_walk": 8.0e-6,
    },
    "lidar_odometry": {"increment_sigma_m": 0.006, "increment_sigma_deg": 0.05},
    "gnss": {"sigma_floor_m": 0.005, "sigma_max_m": 0.2},
    "smoother": {"lag_s": 3.0},
    "initialization": {"static_window_s": 2.0, "accel_bias_sigma": 0.1},
}
# Constants of src/estimator/gate.rs.
WHITE_SIGMA_M = 0.02
CORRELATION_S = 3.0
FIX_PERIOD_S = 0.05

SEMI_MAJOR_AXIS_M = 6_378_137.0
FLATTENING = 1.0 / 298.257_223_563
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)


# --- Machine file -----------------------------------------------------------------------------------------


def transform(table):
    """`parent_from_child` of a frame's table: translation, and intrinsic Z-Y-X angles in degrees."""
    yaw, pitch, roll = np.radians(table.get("yaw_pitch_roll_deg", [0.0, 0.0, 0.0]))
    translation = np.array(table.get("translation_m", [0.0, 0.0, 0.0]))
    return gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, roll), translation)


class Machine:
    """What both estimators must know of the machine."""

    def __init__(self, path):
        table = tomllib.loads(Path(path).read_text())
        settings = {name: {**default, **table.get(name, {})} for name, default in DEFAULTS.items()}
        self.imu, self.lidar, self.gnss = (settings[name] for name in ("imu", "lidar_odometry", "gnss"))
        self.lag_s = settings["smoother"]["lag_s"]
        self.initialization = settings["initialization"]
        self.world = table["world"]
        frames = table["frames"]
        imu_from_cabin = transform(frames["cabin_from_imu"]).inverse()
        self.imu_from_lidar = imu_from_cabin.compose(transform(frames["cabin_from_lidar"]))
        self.antennas = {
            side: imu_from_cabin.transformFrom(transform(frames[f"cabin_from_gnss_{side}"]).translation())
            for side in ("left", "right")
        }


def normal_gravity(latitude_deg, altitude_m):
    """WGS84 normal gravity, m/s² (as src/frames/geodesy.rs)."""
    sin_squared = np.sin(np.radians(latitude_deg)) ** 2
    surface = 9.780_325_335_9 * (1.0 + 0.001_931_852_652_41 * sin_squared)
    surface /= np.sqrt(1.0 - ECCENTRICITY_SQUARED * sin_squared)
    ratio = altitude_m / SEMI_MAJOR_AXIS_M
    first_order = 2.0 * (1.0 + FLATTENING + 0.003_449_786_506_84 - 2.0 * FLATTENING * sin_squared)
    return surface * (1.0 - first_order * ratio + 3.0 * ratio * ratio)


def to_ecef(latitude_deg, longitude_deg, altitude_m):
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    normal = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    horizontal = (normal + altitude_m) * np.cos(latitude)
    up = (normal * (1.0 - ECCENTRICITY_SQUARED) + altitude_m) * np.sin(latitude)
    return np.stack([horizontal * np.cos(longitude), horizontal * np.sin(longitude), up], axis=-1)


def to_enu(world, latitude_deg, longitude_deg, altitude_m):
    """Positions in the site frame, m."""
    origin = (world["latitude_deg"], world["longitude_deg"], world["altitude_m"])
    latitude, longitude = np.radians(origin[:2])
    (sin_lat, cos_lat), (sin_lon, cos_lon) = [(np.sin(a), np.cos(a)) for a in (latitude, longitude)]
    enu_from_ecef = np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
    return (to_ecef(latitude_deg, longitude_deg, altitude_m) - to_ecef(*origin)) @ enu_from_ecef.T


# --- Log --------------------------------------------------------------------------------------------------


def table(path):
    return np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)


class Imu:
    """Samples in order; what lies between two of them is interpolated linearly."""

    def __init__(self, path):
        rows = table(path)
        self.arrival, self.stamp = rows[:, 0].copy(), rows[:, 1].copy()
        self.readings = rows[:, 2:8].copy()

    def steps(self, start, end):
        """Steps from `start` to `end`: lengths, and the mean reading of each (trapezoid rule)."""
        first = np.searchsorted(self.stamp, start, side="right")
        last = np.searchsorted(self.stamp, end, side="left")
        stamps = np.concatenate([[start], self.stamp[first:last], [end]])
        readings = np.vstack([self.at(start), self.readings[first:last], self.at(end)])
        return np.diff(stamps), 0.5 * (readings[1:] + readings[:-1])

    def at(self, stamp):
        after = min(max(int(np.searchsorted(self.stamp, stamp, side="left")), 1), len(self.stamp) - 1)
        before = after - 1
        share = (stamp - self.stamp[before]) / (self.stamp[after] - self.stamp[before])
        return self.readings[before] * (1.0 - share) + self.readings[after] * share


def measurements(log, machine, start):
    """Believed fixes and lidar poses after `start`, in order of stamp: (stamp, arrival, kind, values)."""
    unreliable = [
        tuple(map(float, line.split(",")[:2]))
        for line in (log / "gnss_truth.csv").read_text().splitlines()[1:]
        if not line.endswith(",good")
    ]
    found = []
    for order, side in enumerate(("left", "right")):
        rows = table(log / f"gnss_{side}.csv")
        positions = to_enu(machine.world, rows[:, 2], rows[:, 3], rows[:, 4])
        for row, position in zip(rows, positions):
            worst = max(row[5], row[6], 0.5 * row[7])
            excluded = any(begin <= row[1] <= end + 0.5 for begin, end in unreliable)
            if row[1] > start and worst <= machine.gnss["sigma_max_m"] and not excluded:
                found.append((row[1], order, row[0], side, (position, usable_sigma(machine, row[5:8]))))
    for row in table(log / "lidar_odometry.csv"):
        if row[1] > start:
            pose = gtsam.Pose3(gtsam.Rot3.Quaternion(row[8], row[5], row[6], row[7]), row[2:5])
            found.append((row[1], 2, row[0], "lidar", pose))
    found.sort(key=lambda entry: entry[:2])
    return found


def usable_sigma(machine, reported):
    """As the estimator's gate: what goes beyond white noise changes slowly and so counts less."""
    alike = 1.0 + 2.0 * CORRELATION_S / FIX_PERIOD_S
    sigma = np.maximum(reported, machine.gnss["sigma_floor_m"])
    white = np.minimum(sigma, WHITE_SIGMA_M)
    return np.sqrt(white**2 + (sigma**2 - white**2) * alike)


# --- Results ----------------------------------------------------------------------------------------------


def first_estimate(ours):
    with open(ours / "estimate.csv") as file:
        names, values = (file.readline().strip().split(",") for _ in range(2))
    return {name: float(value) for name, value in zip(names, values) if name != "mode"}


def read_tum(path):
    rows = np.loadtxt(path)
    rotations = np.array([gtsam.Rot3.Quaternion(q[3], q[0], q[1], q[2]).matrix() for q in rows[:, 4:8]])
    return rows[:, 0], rows[:, 1:4], rotations
