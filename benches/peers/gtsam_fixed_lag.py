"""Our estimator beside GTSAM's IncrementalFixedLagSmoother: the same log, factors and lag, in one run.

Called by run.sh; README.md says what is alike and what is not. Tables go to stdout, numbers to results.json.
"""

import argparse
import ctypes
import importlib.metadata
import json
import multiprocessing
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from readings import FIX_PERIOD_S, Imu, Machine, first_estimate, measurements, normal_gravity, read_tum

MACHINE_ID = "walker-1"
GOOD_STRETCH_S = (12.0, 105.0)
MEMORY_EVERY_S = 300.0
HOUR_S = 3600.0

# Constants of src/estimator/{updater,initialization}.rs, src/smoother/mod.rs and src/factors/imu.rs.
HUBER_THRESHOLD = 5.0
LIDAR_GAP_MAX_S = 1.1
NODE_SPACING_S = 1.0e-3
NODE_EVERY_S = 0.5
START_VELOCITY_SIGMA = 0.02
UNSEEN_POSITION_SIGMA_M = 1.0e-6
RELINEARIZE = {"rotation": 1.0e-3, "position": 0.1, "velocity": 0.1, "gyro_bias": 1.0e-3, "accel_bias": 0.02}

# --- GTSAM ------------------------------------------------------------------------------------------------


class Peer:
    """Nodes at the exact stamps of the measurements, one update of the smoother for each of them."""

    def __init__(self, machine, imu, first):
        self.machine, self.imu = machine, imu
        self.parameters = imu_parameters(machine)
        self.update_ns = self.covariance_ns = 0
        smoother = gtsam.ISAM2Params()
        smoother.relinearizeSkip = 1
        smoother.findUnusedFactorSlots = True
        # GTSAM's default, Cholesky, gives up on these factors ("indeterminate linear system") once the window slides.
        smoother.setFactorization("QR")
        smoother.setRelinearizeThreshold(relinearize_thresholds())
        self.smoother = gtsam.IncrementalFixedLagSmoother(machine.lag_s, smoother)
        lidar_sigma = np.repeat(
            [np.radians(machine.lidar["increment_sigma_deg"]), machine.lidar["increment_sigma_m"]], 3
        )
        # Sigmas hold in the lidar's frame; the between factor lives in the IMU's.
        adjoint = machine.imu_from_lidar.AdjointMap()
        self.lidar_noise = gtsam.noiseModel.Gaussian.Covariance(adjoint @ np.diag(lidar_sigma**2) @ adjoint.T)
        walks = [machine.imu[f"{sensor}_random_walk"] for sensor in ("accelerometer", "gyroscope")]
        self.bias_walk = np.repeat(walks, 3)
        self.last_lidar = None
        self.start(first)

    def start(self, first):
        """From our own first estimate (a row of estimate.csv), with its sigmas."""
        rotation = gtsam.Rot3.Quaternion(first["qw"], first["qx"], first["qy"], first["qz"])
        pose = gtsam.Pose3(rotation, np.array([first[axis] for axis in "xyz"]))
        self.node, self.stamp = 0, first["t"]
        self.state = gtsam.NavState(pose, np.array([first["vx"], first["vy"], first["vz"]]))
        self.bias = gtsam.imuBias.ConstantBias(
            np.array([first["bax"], first["bay"], first["baz"]]),
            np.array([first["bgx"], first["bgy"], first["bgz"]]),
        )
        to_body = np.zeros((6, 6))
        to_body[:3, :3] = to_body[3:, 3:] = rotation.matrix().T
        names = ("sd_roll", "sd_pitch", "sd_yaw", "sd_x", "sd_y", "sd_z")
        pose_covariance = to_body @ np.diag([first[name] ** 2 for name in names]) @ to_body.T
        initialization, noise = self.machine.initialization, self.machine.imu
        gyro_bias_sigma = 1.0e-4 + 2.0 * noise["gyroscope_noise_density"] / np.sqrt(
            initialization["static_window_s"]
        )
        bias_sigma = np.repeat([initialization["accel_bias_sigma"], gyro_bias_sigma], 3)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        gaussian, diagonal = gtsam.noiseModel.Gaussian.Covariance, gtsam.noiseModel.Diagonal.Sigmas
        graph.add(gtsam.PriorFactorPose3(X(0), pose, gaussian(pose_covariance)))
        graph.add(
            gtsam.PriorFactorVector(V(0), self.state.velocity(), diagonal(np.full(3, START_VELOCITY_SIGMA)))
        )
        graph.add(gtsam.PriorFactorConstantBias(B(0), self.bias, diagonal(bias_sigma)))
        values.insert(X(0), pose)
        values.insert(V(0), self.state.velocity())
        values.insert(B(0), self.bias)
        self.update(graph, values, {key(0): self.stamp for key in (X, V, B)})

    def take(self, stamp, kind, value):
        """One measurement, one update; the time of the update alone is in `update_ns`. False if it was none."""
        while stamp - self.stamp > 2.0 * NODE_EVERY_S:
            self.update(*self.new_node(self.stamp + NODE_EVERY_S))
        last = self.last_lidar
        if last is not None and stamp - last[0] > LIDAR_GAP_MAX_S:
            last = None
        if stamp - self.stamp > NODE_SPACING_S:
            graph, values, stamps = self.new_node(stamp)
        else:
            graph, values, stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
        # Within a millisecond of the newest node: the measurement is carried to the node.
        node_pose = self.predicted.pose() if stamps else self.state.pose()
        at_stamp = node_pose if stamps else self.predict(stamp).pose()
        node = self.node + 1 if stamps else self.node
        if kind == "lidar":
            offset = node_pose.inverse().compose(at_stamp)
            if last is not None:
                _, last_node, last_offset, last_pose = last
                seen = last_pose.inverse().compose(value)
                extrinsic = self.machine.imu_from_lidar
                of_imu = extrinsic.compose(seen).compose(extrinsic.inverse())
                of_nodes = last_offset.compose(of_imu).compose(offset.inverse())
                if last_node != node:
                    graph.add(gtsam.BetweenFactorPose3(X(last_node), X(node), of_nodes, self.lidar_noise))
            self.last_lidar = (stamp, node, offset, value)
        else:
            lever_arm = self.machine.antennas[kind]
            position, sigma = value
            position = position + node_pose.transformFrom(lever_arm) - at_stamp.transformFrom(lever_arm)
            huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER_THRESHOLD)
            noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Diagonal.Sigmas(sigma))
            graph.add(gtsam.GPSFactorArm(X(node), position, lever_arm, noise))
        if graph.size() == 0:
            return False
        self.update(graph, values, stamps)
        return True

    def new_node(self, stamp):
        """Factors and first values of a node at `stamp`, ahead of the newest."""
        motion = self.preintegrate(self.stamp, stamp, self.bias)
        self.predicted = motion.predict(self.state, self.bias)
        node = self.node + 1
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(gtsam.ImuFactor(X(node - 1), V(node - 1), X(node), V(node), B(node - 1), motion))
        walk = self.bias_walk * np.sqrt(motion.deltaTij())
        unchanged = gtsam.imuBias.ConstantBias()
        noise = gtsam.noiseModel.Diagonal.Sigmas(walk)
        graph.add(gtsam.BetweenFactorConstantBias(B(node - 1), B(node), unchanged, noise))
        values.insert(X(node), self.predicted.pose())
        values.insert(V(node), self.predicted.velocity())
        values.insert(B(node), self.bias)
        return graph, values, {key(node): stamp for key in (X, V, B)}

    def update(self, graph, values, stamps):
        """Only the call of the smoother is timed. `stamps` holds the keys of a new node, or nothing."""
        if stamps:
            self.stamp = max(stamps.values())
            self.node = gtsam.Symbol(next(iter(stamps))).index()
        before = time.perf_counter_ns()
        self.smoother.update(graph, values, stamps)
        self.update_ns = time.perf_counter_ns() - before
        before = time.perf_counter_ns()
        for variable in (X, V, B):
            self.smoother.marginalCovariance(variable(self.node))
        self.covariance_ns = time.perf_counter_ns() - before
        pose = self.smoother.calculateEstimatePose3(X(self.node))
        velocity = self.smoother.calculateEstimateVector(V(self.node))
        self.state = gtsam.NavState(pose, velocity)
        self.bias = self.smoother.calculateEstimateConstantBias(B(self.node))

    def predict(self, stamp):
        if stamp <= self.stamp:
            return self.state
        return self.preintegrate(self.stamp, stamp, self.bias).predict(self.state, self.bias)

    def preintegrate(self, start, end, bias):
        motion = gtsam.PreintegratedImuMeasurements(self.parameters, bias)
        spans, readings = self.imu.steps(start, end)
        for span, reading in zip(spans, readings):
            if span > 0.0:
                motion.integrateMeasurement(reading[3:], reading[:3], span)
        return motion


def imu_parameters(machine):
    world, noise, identity = machine.world, machine.imu, np.eye(3)
    gravity = normal_gravity(world["latitude_deg"], world["altitude_m"])
    parameters = gtsam.PreintegrationParams.MakeSharedU(gravity)
    parameters.setAccelerometerCovariance(identity * noise["accelerometer_noise_density"] ** 2)
    parameters.setGyroscopeCovariance(identity * noise["gyroscope_noise_density"] ** 2)
    # Ours has the floor once in each link, GTSAM as a density: the same over one interval between fixes.
    parameters.setIntegrationCovariance(identity * UNSEEN_POSITION_SIGMA_M**2 / FIX_PERIOD_S)
    return parameters


def relinearize_thresholds():
    limits = RELINEARIZE
    thresholds = gtsam.ISAM2ThresholdMap()
    thresholds.insert(("x", np.repeat([limits["rotation"], limits["position"]], 3)))
    thresholds.insert(("v", np.full(3, limits["velocity"])))
    thresholds.insert(("b", np.repeat([limits["accel_bias"], limits["gyro_bias"]], 3)))
    return thresholds


def run_gtsam(machine_path, log, ours, wall_limit_s, keep):
    """GTSAM over a log, in a process of its own: update times, memory curve and, if kept, its solutions."""
    log, machine = Path(log), Machine(machine_path)
    imu = Imu(log / "imu.csv")
    first = first_estimate(Path(ours))
    todo = measurements(log, machine, first["t"])
    # Filled at once, so that the memory curve is that of the smoother.
    update_ns = np.full(len(todo), -1, dtype=np.int64)
    covariance_ns = np.full(len(todo), -1, dtype=np.int64)
    stamps = np.full(len(todo), -1.0)
    solutions = []
    memory = []
    peer = Peer(machine, imu, first)
    # What reading the log has left behind goes back, so that growth cannot hide in it.
    ctypes.CDLL(None).malloc_trim(0)
    begun = time.monotonic()
    next_memory = MEMORY_EVERY_S
    count = 0
    reached = first["t"]
    for stamp, _, arrival, kind, value in todo:
        if stamp >= imu.stamp[-1] or time.monotonic() - begun > wall_limit_s:
            break
        if stamp >= next_memory:
            memory.append((next_memory, resident_bytes(os.getpid())))
            next_memory += MEMORY_EVERY_S
        if not peer.take(stamp, kind, value):
            continue
        update_ns[count], covariance_ns[count], stamps[count] = peer.update_ns, peer.covariance_ns, stamp
        count += 1
        reached = stamp
        if keep:
            solutions.append((peer.stamp, arrival, peer.state, peer.bias))
    memory.append((reached, resident_bytes(os.getpid())))
    result = {
        "update_us": statistics(update_ns[:count] / 1e3),
        "update_and_covariance_us": statistics((update_ns[:count] + covariance_ns[:count]) / 1e3),
        "update_us_by_five_minutes": [
            float(np.mean(update_ns[:count][chosen]) / 1e3)
            for begin in np.arange(0.0, reached, MEMORY_EVERY_S)
            if (chosen := (stamps[:count] >= begin) & (stamps[:count] < begin + MEMORY_EVERY_S)).any()
        ],
        "updates": count,
        "data_s": float(reached),
        "wall_s": time.monotonic() - begun,
        "memory": memory,
        "factor_slots": peer.smoother.getFactors().size(),
    }
    if keep:
        result["accuracy"] = accuracy(log, *published(peer, imu, solutions))
    return result


def published(peer, imu, solutions):
    """Poses at the IMU's samples as they would go out live: the newest solution that has arrived, predicted."""
    order = sorted(range(len(solutions)), key=lambda index: solutions[index][1])
    stamps, poses = [], []
    upcoming, best, motion, reached = 0, None, None, 0.0
    for sample in range(1, len(imu.stamp)):
        while upcoming < len(order) and solutions[order[upcoming]][1] <= imu.arrival[sample]:
            candidate = solutions[order[upcoming]]
            upcoming += 1
            if candidate[0] <= imu.stamp[sample] and (best is None or candidate[0] >= best[0]):
                best, motion = candidate, None
        if best is None:
            continue
        if motion is None:
            motion, reached = gtsam.PreintegratedImuMeasurements(peer.parameters, best[3]), best[0]
        spans, readings = imu.steps(reached, imu.stamp[sample])
        for span, reading in zip(spans, readings):
            if span > 0.0:
                motion.integrateMeasurement(reading[3:], reading[:3], span)
        reached = imu.stamp[sample]
        stamps.append(reached)
        poses.append(motion.predict(best[2], best[3]).pose())
    rotations = np.array([pose.rotation().matrix() for pose in poses])
    return np.array(stamps), np.array([pose.translation() for pose in poses]), rotations


# --- Numbers ----------------------------------------------------------------------------------------------


def accuracy(log, stamps, positions, rotations):
    """RMSE of position (three axes together) and of heading, in the stretch with good GNSS."""
    true_stamps, true_positions, true_rotations = read_tum(log / "truth_imu.tum")
    _, mine, theirs = np.intersect1d(np.round(stamps, 9), np.round(true_stamps, 9), return_indices=True)
    inside = (stamps[mine] >= GOOD_STRETCH_S[0]) & (stamps[mine] <= GOOD_STRETCH_S[1])
    mine, theirs = mine[inside], theirs[inside]
    position = np.linalg.norm(positions[mine] - true_positions[theirs], axis=1)
    errors = np.einsum("nij,nkj->nik", rotations[mine], true_rotations[theirs])
    # The errors are small: half the skew part is the rotation vector, its z the heading.
    heading = 0.5 * (errors[:, 1, 0] - errors[:, 0, 1])
    return {
        "samples": int(inside.sum()),
        "position_rmse_cm": float(100.0 * np.sqrt(np.mean(position**2))),
        "position_max_cm": float(100.0 * position.max()),
        "heading_rmse_deg": float(np.degrees(np.sqrt(np.mean(heading**2)))),
    }


def statistics(values):
    p50, p99 = np.percentile(values, [50, 99])
    return {
        "mean": float(np.mean(values)),
        "p50": float(p50),
        "p99": float(p99),
        "max": float(np.max(values)),
    }


def resident_bytes(pid):
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def run_ours(holdfast, machine_path, log, out):
    """`holdfast estimate`; how far it is in the data is seen from what it has written."""
    out.mkdir(parents=True, exist_ok=True)
    written = out / "world.tum"
    written.unlink(missing_ok=True)
    command = [holdfast, "estimate", "--machine", machine_path, "--out", out, log]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    seen = []
    while process.poll() is None:
        try:
            seen.append((last_stamp(written), resident_bytes(process.pid)))
        except (OSError, IndexError, ValueError):
            pass
        time.sleep(0.005)
    if process.returncode not in (0, 3):
        sys.exit(f"holdfast estimate failed with exit code {process.returncode}")
    summary = json.loads((out / "summary.json").read_text())
    end = summary["data_s"]
    # The last second is left out: the process gives its memory back.
    marks = [*np.arange(MEMORY_EVERY_S, end - 2.0, MEMORY_EVERY_S), end - 1.0]
    memory = []
    for mark in marks:
        known = [resident for stamp, resident in seen if stamp is not None and stamp <= mark]
        if known:
            memory.append((float(mark), known[-1]))
    return {
        "update_us": summary["update_us"],
        "consistency_cm": summary["consistency_cm"],
        "updates": summary["updates"],
        "data_s": end,
        "wall_s": summary["wall_s"],
        "memory": memory,
    }


def last_stamp(path):
    """Stamp of the last whole line of a trajectory that is still being written; None before the first."""
    with open(path, "rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - 600))
        lines = file.read().split(b"\n")
    return float(lines[-2].split()[0]) if len(lines) > 2 else None


def without_chassis(log):
    """The log without the chassis' sensors, so that ours has no factor that GTSAM has not."""
    bare = log.parent / f"{log.name}-cabin"
    bare.mkdir(exist_ok=True)
    for path in log.iterdir():
        link = bare / path.name
        if path.stem not in ("base_imu", "cabin_turn") and not link.exists():
            link.symlink_to(path.resolve())
    return bare


# --- The run ----------------------------------------------------------------------------------------------


def simulate(holdfast, scenario, out):
    subprocess.run(
        [holdfast, "simulate", "--scenario", scenario, "--out", out], check=True, stdout=subprocess.DEVNULL
    )
    return out / MACHINE_ID


def hour_scenario(repository, out):
    """The demonstration's scenario, an hour long."""
    source = repository / "config" / "scenarios" / "demo.toml"
    text = re.sub(r"(?m)^duration_s = .*$", f"duration_s = {HOUR_S}", source.read_text())
    text = re.sub(
        r'(?m)^file = "(.*)"$', lambda found: f'file = "{(source.parent / found[1]).resolve()}"', text
    )
    path = out / "hour.toml"
    path.write_text(text)
    return path


def apart(function, *arguments):
    """In a process of its own, so that memory is that of this run."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context) as pool:
        return pool.submit(function, *arguments).result()


def show(results):
    construction = results["construction"]
    ours, peer, whole = construction["holdfast"], construction["gtsam"], construction["holdfast_with_chassis"]
    print(f"GTSAM {results['gtsam_version']}, lag {results['lag_s']} s, log construction/{MACHINE_ID}\n")
    print(f"{'':38}{'holdfast':>12}{'GTSAM':>12}{'ratio':>10}{'holdfast':>14}")
    print(f"{'':38}{'same factors':>12}{'':>22}{'with chassis':>14}")

    def line(name, left, right, digits, more=None):
        extra = "" if more is None else f"{more:14.{digits}f}"
        print(f"{name:38}{left:12.{digits}f}{right:12.{digits}f}{right / left:10.1f}{extra}")

    stretch = f"{GOOD_STRETCH_S[0]:.0f} to {GOOD_STRETCH_S[1]:.0f} s"
    runs = (ours, peer, whole)
    for name, key, digits in (
        (f"position RMSE, cm, {stretch}", "position_rmse_cm", 3),
        (f"heading RMSE, deg, {stretch}", "heading_rmse_deg", 4),
    ):
        left, right, more = (run["accuracy"][key] for run in runs)
        line(name, left, right, digits, more)
    show_times(line, *runs)
    print(f"{'updates':38}{ours['updates']:12}{peer['updates']:12}{whole['updates']:24}")
    if "hour" not in results:
        return
    ours, peer = results["hour"]["holdfast"], results["hour"]["gtsam"]
    print(
        f"\nAn hour of data, same factors: holdfast {ours['data_s']:.0f} s, GTSAM {peer['data_s']:.0f} s",
        end="",
    )
    print("" if peer["data_s"] > HOUR_S - 5.0 else f" (stopped after {peer['wall_s'] / 60.0:.1f} minutes)")
    print(f"{'':38}{'holdfast':>12}{'GTSAM':>12}{'ratio':>10}")
    show_times(line, ours, peer)
    print(f"\n{'data, min':>10}{'holdfast RSS, MB':>20}{'GTSAM RSS, MB':>18}{'GTSAM update, us':>20}")
    for index, (stamp, resident) in enumerate(ours["memory"]):
        cells = f"{stamp / 60.0:10.0f}{resident / 1e6:20.1f}"
        known = [there for there in peer["memory"] if abs(there[0] - stamp) < 60.0]
        if known:
            cells += f"{known[0][1] / 1e6:18.1f}{peer['update_us_by_five_minutes'][index]:20.0f}"
        print(cells)


def show_times(line, ours, peer, whole=None):
    for name in ("mean", "p50", "p99"):
        more = whole and whole["update_us"][name]
        line(f"time per update, us, {name}", ours["update_us"][name], peer["update_us"][name], 0, more)
    with_covariance = peer["update_and_covariance_us"]["mean"]
    line("  GTSAM with covariances, us, mean", ours["update_us"]["mean"], with_covariance, 0)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--holdfast", required=True, help="our binary")
    parser.add_argument("--out", type=Path, required=True, help="folder for logs and results")
    parser.add_argument(
        "--minutes",
        type=float,
        default=12.0,
        help="wall clock for GTSAM's hour of data; 0 leaves the hour out",
    )
    arguments = parser.parse_args()
    repository = Path(__file__).resolve().parents[2]
    machine_path = repository / "config" / "machines" / "simulated-roof.toml"
    out = arguments.out
    out.mkdir(parents=True, exist_ok=True)

    results = {
        "gtsam_version": importlib.metadata.version("gtsam"),
        "lag_s": Machine(machine_path).lag_s,
        "hour_wall_limit_minutes": arguments.minutes,
    }
    runs = [("construction", repository / "config" / "scenarios" / "construction.toml", 600.0)]
    if arguments.minutes > 0.0:
        runs.append(("hour", hour_scenario(repository, out), 60.0 * arguments.minutes))
    for name, scenario, wall_limit_s in runs:
        log = simulate(arguments.holdfast, scenario, out / f"{name}-log")
        ours = out / f"{name}-holdfast"
        keep = name == "construction"
        entry = {"holdfast": run_ours(arguments.holdfast, machine_path, without_chassis(log), ours)}
        if keep:
            entry["holdfast"]["accuracy"] = accuracy(log, *read_tum(ours / "world.tum"))
            whole = out / f"{name}-holdfast-with-chassis"
            entry["holdfast_with_chassis"] = run_ours(arguments.holdfast, machine_path, log, whole)
            entry["holdfast_with_chassis"]["accuracy"] = accuracy(log, *read_tum(whole / "world.tum"))
        entry["gtsam"] = apart(run_gtsam, machine_path, log, ours, wall_limit_s, keep)
        results[name] = entry
        (out / "results.json").write_text(json.dumps(results, indent=2) + "\n")
    show(results)


if __name__ == "__main__":
    main()
