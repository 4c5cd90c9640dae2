#!/usr/bin/env python3
"""What evo says of two trajectories.

    compare_with_evo.py TRUTH.tum ESTIMATE.tum CASES.json

CASES.json is a list of objects with the keys align, align_first, delta, delta_unit, all_pairs, pairs_from_truth.
Prints a list of objects {"pairs", "ape": {relation: {statistic: value}}, "rpe": {...}}, in the same order.
"""

import contextlib
import copy
import json
import sys

from evo.core import metrics, sync
from evo.core.units import Unit
from evo.tools import file_interface

UNITS = {"frames": Unit.frames, "meters": Unit.meters, "degrees": Unit.degrees, "radians": Unit.radians}
APE = ["translation_part", "rotation_part", "full_transformation", "rotation_angle_deg", "rotation_angle_rad", "point_distance"]
RPE = APE + ["point_distance_error_ratio"]


def align(estimate, truth, case):
    how = case["align"]
    first = -1 if case["align_first"] is None else case["align_first"]
    if how in ("se3", "sim3", "scale"):
        estimate.align(truth, correct_scale=how == "sim3", correct_only_scale=how == "scale", n=first)
    elif how == "origin":
        estimate.align_origin(truth)


def figures(metric, pair):
    metric.process_data(pair)
    return {name: float(value) for name, value in metric.get_all_statistics().items()}


def main():
    truth_path, estimate_path, cases_path = sys.argv[1:]
    truth = file_interface.read_tum_trajectory_file(truth_path)
    estimate = file_interface.read_tum_trajectory_file(estimate_path)
    truth, estimate = sync.associate_trajectories(truth, estimate)
    # evo prints its progress.
    with contextlib.redirect_stdout(sys.stderr):
        results = [judge(truth, estimate, case) for case in json.load(open(cases_path))]
    print(json.dumps(results))


def judge(truth, estimate, case):
    aligned = copy.deepcopy(estimate)
    align(aligned, truth, case)
    pair = (truth, aligned)
    ape = {name: figures(metrics.APE(metrics.PoseRelation[name]), pair) for name in APE}
    step = dict(
        delta=case["delta"],
        delta_unit=UNITS[case["delta_unit"]],
        all_pairs=case["all_pairs"],
        pairs_from_reference=case["pairs_from_truth"],
    )
    rpe = {name: figures(metrics.RPE(metrics.PoseRelation[name], **step), pair) for name in RPE}
    return {"pairs": truth.num_poses, "ape": ape, "rpe": rpe}


if __name__ == "__main__":
    main()
