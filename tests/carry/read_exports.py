#!/usr/bin/env python3
"""Reads exports of holdfast with the tools that other people use, and compares them with each other.

    read_exports.py FOLDER EXPECTED.json

FOLDER holds one.tum (for evo), all.csv, all.geojson (for geojson, shapely and GDAL), all.gpx (for gpxpy and GDAL),
all.kml (for fastkml and GDAL). EXPECTED.json: {"machines": {ID: POSES}, "one": ID, "origin": [LAT, LON, ALT],
"outages": {ID: COUNT}, "published": PATH of a TUM file of what the machine in one.tum published}. GDAL is what QGIS reads with. Exit code 0 if all is well, 1 with a message
for each thing that is not.
"""

import copy
import csv
import datetime
import json
import math
import sys
import warnings
from pathlib import Path

import geojson
import gpxpy
import numpy as np
import pyogrio
import shapely
from evo.core import metrics, sync
from evo.tools import file_interface

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from fastkml import kml

A, E2 = 6378137.0, (2 - 1 / 298.257223563) / 298.257223563


def ecef(latitude, longitude, altitude):
    """WGS84, vectorised; written anew here, so that the product's own formula is checked by another."""
    latitude, longitude = np.radians(latitude), np.radians(longitude)
    normal = A / np.sqrt(1 - E2 * np.sin(latitude) ** 2)
    flat = (normal + altitude) * np.cos(latitude)
    return np.stack([flat * np.cos(longitude), flat * np.sin(longitude), (normal * (1 - E2) + altitude) * np.sin(latitude)], -1)


def enu(places, origin):
    """Rows of latitude, longitude, altitude in the frame at origin."""
    latitude, longitude = math.radians(origin[0]), math.radians(origin[1])
    sa, ca, so, co = math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude)
    turn = np.array([[-so, co, 0], [-sa * co, -sa * so, ca], [ca * co, ca * so, sa]])
    places = np.asarray(places, float)
    return (ecef(places[:, 0], places[:, 1], places[:, 2]) - ecef(*origin)) @ turn.T


def seconds(time):
    return time.replace(tzinfo=time.tzinfo or datetime.timezone.utc).timestamp()


class Check:
    def __init__(self, expected):
        self.expected = expected
        self.errors = []
        self.truth = {}

    def same(self, what, found, wanted):
        if found != wanted:
            self.errors.append(f"{what}: {found!r}, must be {wanted!r}")

    def track(self, what, machine, times, places):
        """Times and places of a track are those of the CSV: within a millisecond and a millimetre."""
        rows = self.truth[machine]
        self.same(f"{what}: poses of {machine}", len(times), len(rows))
        if len(times) != len(rows):
            return
        late = np.abs(np.asarray(times) - rows[:, 0]).max()
        off = np.abs(enu(places, self.expected["origin"]) - rows[:, 1:4]).max()
        if not late < 1e-3:
            self.errors.append(f"{what}: times of {machine} are off by {late} s")
        if not off < 1e-3:
            self.errors.append(f"{what}: places of {machine} are off by {off} m")

    def csv(self, path):
        with open(path, newline="") as stream:
            for row in csv.DictReader(stream):
                values = [float(row[key]) for key in ("t", "x", "y", "z", "latitude_deg", "longitude_deg", "altitude_m")]
                self.truth.setdefault(row["machine"], []).append(values)
        self.truth = {machine: np.array(rows) for machine, rows in self.truth.items()}
        self.same("csv: poses", {machine: len(rows) for machine, rows in self.truth.items()}, self.expected["machines"])
        for machine, rows in self.truth.items():
            self.track("csv", machine, rows[:, 0], rows[:, 4:7])

    def tum(self, path):
        trajectory = file_interface.read_tum_trajectory_file(str(path))
        valid, details = trajectory.check()
        self.same(f"tum: evo says {details}", valid, True)
        rows = self.truth[self.expected["one"]]
        self.same("tum: poses", trajectory.num_poses, len(rows))
        self.same("tum: positions", bool(np.array_equal(trajectory.positions_xyz, rows[:, 1:4])), True)
        # What the machine published, written by another hand; moved by 5 m and a quarter turn, evo must say so.
        reference = file_interface.read_tum_trajectory_file(self.expected["published"])
        moved = copy.deepcopy(reference)
        moved.transform(np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]), right_mul=True)
        moved.transform(np.array([[1, 0, 0, 3], [0, 1, 0, 4], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
        self.errors_to("published", trajectory, reference, 0.0, 0.0)
        self.errors_to("moved", trajectory, moved, 5.0, 90.0)

    def errors_to(self, name, trajectory, reference, metres, degrees):
        """evo pairs the poses by their stamps, and finds each as far from the reference as it must be."""
        reference, found = sync.associate_trajectories(reference, trajectory, max_diff=1e-4)
        self.same(f"tum: poses that pair with those {name}", found.num_poses, trajectory.num_poses)
        relations = {metrics.PoseRelation.translation_part: metres, metrics.PoseRelation.rotation_angle_deg: degrees}
        for relation, wanted in relations.items():
            error = metrics.APE(relation)
            error.process_data((reference, found))
            for statistic in (metrics.StatisticsType.min, metrics.StatisticsType.max):
                value = error.get_statistic(statistic)
                # Of an angle of nothing, evo's arc cosine leaves a few parts in a million of a degree.
                if not abs(value - wanted) < 1e-5:
                    self.errors.append(f"tum: {relation.name} to those {name}: {statistic.name} {value}, must be {wanted}")

    def geojson(self, path):
        # The package rounds to six decimals, some 6 cm, if it is not told.
        geojson.geometry.DEFAULT_PRECISION = 9
        collection = geojson.loads(path.read_text())
        self.same("geojson: valid", (collection.is_valid, collection.errors()), (True, []))
        outages, tracks, last = {}, {}, {}
        for feature in collection["features"]:
            machine = feature["properties"]["machine"]
            times = [datetime.datetime.fromisoformat(time[:26].rstrip("Z") + "+00:00") for time in feature["properties"]["coordTimes"]]
            shape = shapely.geometry.shape(feature["geometry"])
            coordinates = list(shape.coords)
            self.same("geojson: times of a line", len(times), len(coordinates))
            self.same("geojson: length of a place", {len(place) for place in coordinates}, {3})
            if feature["properties"]["gnss"] == "outage":
                outages[machine] = outages.get(machine, 0) + 1
            items = list(zip(map(seconds, times), ((y, x, z) for x, y, z in coordinates)))
            # A line begins where the one before ended, if there is no gap between.
            if machine in last and items[0] == last[machine]:
                items = items[1:]
            last[machine] = items[-1] if items else last[machine]
            tracks.setdefault(machine, []).extend(items)
        for machine in self.expected["machines"]:
            times, places = zip(*tracks[machine])
            self.track("geojson", machine, times, places)
        self.same("geojson: outages", outages, self.expected["outages"])
        self.gdal(path, "geojson", None)

    def gpx(self, path):
        gpx = gpxpy.parse(path.read_text())
        self.same("gpx: version", gpx.version, "1.1")
        self.same("gpx: tracks", [track.name for track in gpx.tracks], sorted(self.expected["machines"]))
        for track in gpx.tracks:
            points = [point for segment in track.segments for point in segment.points]
            self.track("gpx", track.name, [seconds(point.time) for point in points],
                       [(point.latitude, point.longitude, point.elevation) for point in points])
        self.gdal(path, "gpx", "tracks")

    def kml(self, path):
        document = next(iter(kml.KML.from_string(path.read_bytes()).features))
        names = [folder.name for folder in document.features]
        self.same("kml: folders", names, sorted(self.expected["machines"]))
        for folder in document.features:
            items, last = [], None
            outages = 0
            for placemark in folder.features:
                track = placemark.kml_geometry
                outages += placemark.style_url.url == "#outage"
                these = [(seconds(item.when.dt), (item.coord.y, item.coord.x, item.coord.z)) for item in track.track_items]
                items.extend(these[1:] if these[0] == last else these)
                last = these[-1]
            times, places = zip(*items)
            self.track("kml", folder.name, times, places)
            self.same(f"kml: outages of {folder.name}", outages, self.expected["outages"].get(folder.name, 0))
        for machine in self.expected["machines"]:
            self.gdal(path, "kml", machine)

    def gdal(self, path, what, layer):
        """GDAL opens it as QGIS does: lines with heights in WGS84, on the site."""
        meta, _, shapes, _ = pyogrio.raw.read(path, layer=layer)
        self.same(f"{what}: reference system is WGS84", meta["crs"] in ("EPSG:4326", "EPSG:4979"), True)
        shapes = shapely.from_wkb(shapes)
        kinds = {shape.geom_type for shape in shapes}
        if not shapes.size or not kinds <= {"LineString", "MultiLineString", "Point"}:
            self.errors.append(f"{what}: GDAL reads {shapes.size} shapes of kinds {kinds}")
            return
        origin = shapely.Point(self.expected["origin"][1], self.expected["origin"][0])
        far = max(shape.distance(origin) for shape in shapes)
        if not far < 0.02:
            self.errors.append(f"{what}: GDAL reads shapes {far} degrees from the site")
        # Of GPX, GDAL gives heights only if it is told to.
        if what != "gpx" and not all(shape.has_z for shape in shapes):
            self.errors.append(f"{what}: GDAL reads no heights")


def main():
    folder = Path(sys.argv[1])
    check = Check(json.loads(Path(sys.argv[2]).read_text()))
    check.csv(folder / "all.csv")
    check.tum(folder / "one.tum")
    check.geojson(folder / "all.geojson")
    check.gpx(folder / "all.gpx")
    check.kml(folder / "all.kml")
    for error in check.errors[:50]:
        print(f"error: {error}", file=sys.stderr)
    return 1 if check.errors else 0


if __name__ == "__main__":
    sys.exit(main())
