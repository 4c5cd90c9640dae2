#!/usr/bin/env python3
"""Holds what the site says in other people's formats against what its API says, with other people's readers.

    python tests/feeds/check.py aemp http://127.0.0.1:8080 MACHINES
    python tests/feeds/check.py metrics http://127.0.0.1:8080 compose/

Exit code 0 if all is as it should be, 1 with a message for what is not.
"""

import json
import re
import sys
import xml.etree.ElementTree as ElementTree
from datetime import datetime
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import yaml
from prometheus_client.openmetrics.parser import text_string_to_metric_families

ISO = "{http://standards.iso.org/iso/15143/-3}"
OURS = "{urn:holdfast:pose-quality:1}"
PAGE = 100


def expect(condition, *what):
    if not condition:
        sys.exit(" ".join(str(one)[:2000] for one in what))


def get(url, accept="*/*"):
    try:
        with urlopen(Request(url, headers={"Accept": accept})) as answer:
            return answer.status, answer.headers, answer.read()
    except HTTPError as error:
        return error.code, error.headers, error.read()


def time(text):
    expect(re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", text), "not a time to the second:", text)
    return datetime.fromisoformat(text)


def near(left, right, by):
    return abs(float(left) - float(right)) <= by


def aemp(site, machines):
    fleet = json.loads(get(f"{site}/api/v1/fleet")[2])["machines"]
    expect(len(fleet) == machines, "machines:", len(fleet))
    last = max(1, -(-machines // PAGE))
    found = []
    page = "/aemp/2.0/Fleet/1"
    number = 0
    while page:
        number += 1
        status, headers, body = get(site + page, "application/xml")
        expect(status == 200 and headers["Content-Type"] == "application/xml; charset=utf-8", status, headers)
        expect("Accept" in headers.get_all("Vary", []), headers)
        root = ElementTree.fromstring(body)
        expect(root.tag == f"{ISO}Fleet" and root.get("version") == "1", root.tag, root.attrib)
        time(root.get("snapshotTime"))
        links = {link.findtext(f"{ISO}rel"): link.findtext(f"{ISO}href") for link in root.findall(f"{ISO}Links")}
        expect(links["self"] == page and links["first"].endswith("/1"), links)
        expect(links["last"].endswith(f"/{last}"), links)
        expect(("prev" in links) == (number > 1) and ("next" in links) == (number < last), number, links)
        order = [child.tag for child in root]
        expect(order == sorted(order, key=[f"{ISO}Links", f"{ISO}Equipment"].index), order)
        found += root.findall(f"{ISO}Equipment")
        as_json(site + page, root)
        page = links.get("next")
    expect(number == last, "pages:", number, last)
    ids = [one.findtext(f"{ISO}EquipmentHeader/{ISO}EquipmentID") for one in found]
    expect(ids == [machine["id"] for machine in fleet], ids)
    located = 0
    for one, machine in zip(found, fleet):
        quality = one.find(f"{OURS}PoseQuality")
        expect(quality.findtext(f"{OURS}Name") == machine["name"], machine["name"])
        location = one.find(f"{ISO}Location")
        pose = machine["pose"]
        expect((location is None) == (pose is None), machine["id"])
        if pose is None:
            expect(quality.find(f"{OURS}Pose") is None, machine["id"])
            continue
        located += 1
        expect(quality.findtext(f"{OURS}Presence") == machine["presence"], machine)
        expect(quality.findtext(f"{OURS}Severity") == machine["severity"], machine)
        expect(abs((time(location.get("datetime")) - datetime.fromisoformat(pose["stamp"])).total_seconds()) < 60)
        # 1e-7 degrees are a centimetre; the machine moves between two questions.
        expect(near(location.findtext(f"{ISO}Latitude"), pose["latitude_deg"], 5e-5), pose)
        expect(near(location.findtext(f"{ISO}Longitude"), pose["longitude_deg"], 5e-5), pose)
        expect(near(location.findtext(f"{ISO}Altitude"), pose["altitude_m"], 1.0), pose)
        expect(location.findtext(f"{ISO}AltitudeUnits") == "metre")
        inner = quality.find(f"{OURS}Pose")
        sigmas = [inner.findtext(f"{OURS}PositionSigma{axis}Metres") for axis in ("East", "North", "Up")]
        expect(all(near(a, b, 0.02) for a, b in zip(sigmas, pose["position_sigma_m"])), sigmas, pose)
    expect(located, "nobody is anywhere")
    for accept, kind in [
        ("application/json", "application/json"),
        ("text/xml", "text/xml; charset=utf-8"),
        ("text/html, */*;q=0.1", "application/xml; charset=utf-8"),
    ]:
        status, headers, _ = get(f"{site}/aemp/2.0/Fleet/1", accept)
        expect(status == 200 and headers["Content-Type"] == kind, accept, status, headers["Content-Type"])
    for path, accept, wanted in [
        (f"/aemp/2.0/Fleet/{last + 1}", "*/*", 404),
        ("/aemp/2.0/Fleet/0", "*/*", 404),
        ("/aemp/2.0/Fleet/x", "*/*", 400),
        ("/aemp/2.0/Fleet/-1", "*/*", 400),
        ("/aemp/2.0/Fleet/1", "image/png", 406),
    ]:
        status, headers, body = get(site + path, accept)
        expect(status == wanted and headers["Content-Type"] == "application/problem+json", path, status, body)
    print(f"{len(found)} machines on {last} pages, {located} with a location")


def as_json(url, root):
    """The same page as JSON: the same names, and what does not change from one second to the next."""
    _, headers, body = get(url, "application/json")
    page = json.loads(body)
    expect(set(page) == {"version", "snapshotTime", "Links", "Equipment"}, list(page))
    time(page["snapshotTime"])
    names = lambda element: [child.tag.split("}")[1] for child in element]
    for one, element in zip(page["Equipment"], root.findall(f"{ISO}Equipment"), strict=True):
        expect([name.removeprefix("hf:") for name in one] == names(element), list(one), names(element))
        expect(one["EquipmentHeader"] == {"EquipmentID": element.findtext(f".//{ISO}EquipmentID")}, one)
        if "Location" in one:
            location = element.find(f"{ISO}Location")
            expect(list(one["Location"]) == ["datetime", *names(location)], one["Location"])
        quality = element.find(f"{OURS}PoseQuality")
        expect(list(one["hf:PoseQuality"]) == names(quality), one["hf:PoseQuality"], names(quality))


def names_in(expression):
    """The metrics that an expression or a query of a dashboard names."""
    return set(re.findall(r"\bholdfast_[a-z0-9_]+", expression))


def metrics(site, compose):
    status, headers, body = get(f"{site}/metrics")
    expect(status == 200, status)
    expect(headers["Content-Type"].startswith("application/openmetrics-text; version=1.0.0"), headers)
    samples = {}
    for family in text_string_to_metric_families(body.decode()):
        expect(family.name.startswith("holdfast_"), family.name)
        expect(family.documentation, "no help:", family.name)
        base_units = {"seconds", "bytes", "meters", "hertz"}
        ends = family.name.rsplit("_", 1)[1]
        expect(family.unit == (ends if ends in base_units else ""), family.name, family.unit)
        expect(not re.search(r"_(ms|us|millis|minutes|hours|kb|mb|percent|deg)$", family.name), family.name)
        expect(family.type in ("gauge", "counter", "info"), family.name, family.type)
        # The name is there also without a machine, and with none of its samples.
        samples[family.name + {"counter": "_total", "info": "_info"}.get(family.type, "")] = family
        for sample in family.samples:
            expect(set(sample.labels) <= {"machine", "axis", "type", "state", "version"}, sample)
    named = set()
    rules = yaml.safe_load((compose / "prometheus/alerts.yml").read_text())
    alerts = [rule for group in rules["groups"] for rule in group["rules"]]
    expect(len({rule["alert"] for rule in alerts}) == len(alerts) > 5, "alerts:", len(alerts))
    for rule in alerts:
        expect(set(rule) <= {"alert", "expr", "for", "labels", "annotations"}, rule)
        expect(rule["labels"]["severity"] in ("info", "warning", "critical") and rule["annotations"]["summary"], rule)
        expect(names_in(rule["expr"]) or "up{job=" in rule["expr"], rule)
        named |= names_in(rule["expr"])
    dashboard = json.loads((compose / "grafana/dashboards/holdfast.json").read_text())
    expect(len({panel["id"] for panel in dashboard["panels"]}) == len(dashboard["panels"]) > 5)
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            expect(names_in(target["expr"]), panel["title"])
            named |= names_in(target["expr"])
    for variable in dashboard["templating"]["list"]:
        named |= names_in(variable["definition"])
    expect(named <= set(samples), "named in compose/, but not said:", sorted(named - set(samples)))
    labels = {"gnss_fix": "type", "position_sigma_meters": "axis", "recording_gaps": "state"}
    for name, label in labels.items():
        values = {sample.labels[label] for sample in samples[f"holdfast_{name}"].samples}
        text = " ".join(path.read_text() for path in (compose / "prometheus/alerts.yml", compose / "grafana/dashboards/holdfast.json"))
        used = re.findall(rf'holdfast_{name}\{{[^}}]*{label}=~?\\?"([a-z_|]+)', text)
        expect(used, "not used:", name)
        wanted = {value for one in used for value in one.split("|")}
        expect(wanted <= values, name, wanted, values)
    services = yaml.safe_load((compose / "compose.yaml").read_text())["services"]
    for name, service in services.items():
        expect("build" in service or re.search(r":v?\d+\.\d+\.\d+$", service["image"]), name, "is not pinned")
        expect(service["network_mode"] == "host" and "ports" not in service, name, "is not on loopback")
    scrape = yaml.safe_load((compose / "prometheus/prometheus.yml").read_text())["scrape_configs"][0]
    expect(scrape["metrics_path"] == "/metrics" and "credentials_file" in scrape["authorization"], scrape)
    print(f"{len(samples)} metrics, of which compose/ names {len(named)}")


if sys.argv[1] == "aemp":
    aemp(sys.argv[2], int(sys.argv[3]))
else:
    metrics(sys.argv[2], Path(sys.argv[3]))
