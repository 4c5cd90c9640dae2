//! The numbers of site and machines in the OpenMetrics text format.
//!
//! Everything is read off the newest frame and the counters when it is asked for; nothing is kept up to date
//! for nobody. Names are by Prometheus' conventions: base units at the end, and `_total` behind it for what only grows.
//! Labels are the machine and the kind of a thing: at most some twenty series a machine, and there are
//! [`MACHINES_MAX`](crate::fleet::MACHINES_MAX) machines at most.

use std::sync::atomic::{AtomicI64, AtomicU64};

use axum::extract::State;
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::{ConstGauge, Gauge};
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Metric, Registry, Unit};

use super::Shared;
use super::problem::Problem;
use crate::fleet::MachineView;
use crate::site::counters::get;
use crate::site::sessions::{RecordingState, disk_free_bytes};
use crate::state::GnssState;

type Labels = Vec<(&'static str, String)>;
type Floats = Family<Labels, Gauge<f64, AtomicU64>>;
type Integers = Family<Labels, Gauge<i64, AtomicI64>>;

const FIX_STATES: [GnssState; 6] = [
    GnssState::Fixed,
    GnssState::Degraded,
    GnssState::Frozen,
    GnssState::Jumping,
    GnssState::Silent,
    GnssState::Recovering,
];

/// Numbers of site and machines for Prometheus.
#[utoipa::path(get, path = "/metrics", tag = "operation",
    responses((status = OK, content_type = "application/openmetrics-text", body = String)))]
pub(super) async fn metrics(State(shared): State<Shared>) -> Result<Response, Problem> {
    let mut registry = Registry::with_prefix("holdfast");
    machines(&mut registry, &shared.frame().view.machines);
    site(&mut registry, &shared);
    let mut text = String::new();
    encode(&mut text, &registry).map_err(|_| {
        Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "the metrics cannot be written as text")
    })?;
    let kind = "application/openmetrics-text; version=1.0.0; charset=utf-8";
    Ok(([(CONTENT_TYPE, kind)], text).into_response())
}

fn machines(registry: &mut Registry, machines: &[MachineView]) {
    let up = Integers::default();
    let pose_age = Floats::default();
    let sigma = Floats::default();
    let fix = Integers::default();
    let dead_reckoning = Floats::default();
    let clock_offset = Floats::default();
    let pose_rate = Floats::default();
    let received = Family::<Labels, prometheus_client::metrics::counter::Counter>::default();
    let missed = Family::<Labels, prometheus_client::metrics::counter::Counter>::default();
    let gaps = Integers::default();
    for machine in machines {
        let labels = || vec![("machine", machine.id.clone())];
        let and =
            |key: &'static str, value: &str| vec![("machine", machine.id.clone()), (key, value.to_owned())];
        up.get_or_create(&labels()).set(i64::from(machine.presence.is_heard()));
        pose_rate.get_or_create(&labels()).set(machine.link.pose_rate_hz);
        received.get_or_create(&labels()).inc_by(machine.link.received);
        missed.get_or_create(&labels()).inc_by(machine.link.missed);
        let link = &machine.link;
        for (state, count) in
            [("open", link.gaps_open), ("filled", link.gaps_filled), ("lost", link.gaps_lost)]
        {
            gaps.get_or_create(&and("state", state)).set(integer(count));
        }
        if let Some(offset_s) = machine.link.clock_offset_s {
            clock_offset.get_or_create(&labels()).set(offset_s);
        }
        if let Some(pose) = &machine.pose {
            pose_age.get_or_create(&labels()).set(pose.age_s);
            let one_sigma = |axis_95_m: f64| axis_95_m / crate::fleet::SIGMAS_95;
            let axes = [
                ("semi_major", one_sigma(pose.ellipse95.semi_major_m)),
                ("semi_minor", one_sigma(pose.ellipse95.semi_minor_m)),
                ("up", pose.position_sigma_m[2]),
            ];
            for (axis, sigma_m) in axes {
                sigma.get_or_create(&and("axis", axis)).set(sigma_m);
            }
        }
        if let Some(health) = &machine.health {
            for state in FIX_STATES {
                let is = i64::from(health.report.gnss == state);
                fix.get_or_create(&and("type", state.name())).set(is);
            }
            let outage = health.report.outage.as_ref().filter(|outage| outage.end_stamp_ns.is_none());
            dead_reckoning.get_or_create(&labels()).set(outage.map_or(0.0, |outage| outage.travelled_m));
        }
    }
    register(
        registry,
        "machine_up",
        "1 if the machine is connected and its data are young, or it was just started anew",
        up,
    );
    register(registry, "pose_age_seconds", "Since the newest pose arrived", pose_age);
    register(registry, "position_sigma_meters", "One sigma of the position along an axis", sigma);
    register(registry, "gnss_fix", "1 for the state that the machine's fixes are in", fix);
    register(registry, "dead_reckoning_meters", "Way since the last good fix, in an outage", dead_reckoning);
    register(registry, "clock_offset_seconds", "Site's clock less the machine's, plus transit", clock_offset);
    register(registry, "pose_rate_hertz", "Poses in the last second", pose_rate);
    register(registry, "samples_received", "Messages that arrived", received);
    register(registry, "samples_missed", "Messages that were sent but did not arrive", missed);
    register(
        registry,
        "recording_gaps",
        "Messages that the recording lacks, lacked, or will always lack",
        gaps,
    );
}

fn site(registry: &mut Registry, shared: &Shared) {
    let counters = &shared.counters;
    register(
        registry,
        "build",
        "Version of the server",
        Info::new(vec![("version", env!("CARGO_PKG_VERSION"))]),
    );
    for (name, help, value) in [
        ("ws_dropped", "Deltas that slow live clients did not get", &counters.ws_dropped),
        ("foxglove_dropped", "Messages that slow Foxglove clients did not get", &counters.foxglove_dropped),
        ("aggregator_dropped", "Messages dropped before the fleet saw them", &counters.aggregator_dropped),
        ("recorder_dropped", "Messages dropped before they were recorded", &counters.recorder_dropped),
        ("tokens_dropped", "Liveliness tokens dropped", &counters.tokens_dropped),
        ("foreign_messages", "Publications under keys that are none of ours", &counters.foreign),
    ] {
        register(registry, name, help, ConstCounter::new(get(value)));
    }
    for (name, help, value) in [
        ("ws_clients", "Live clients", &counters.ws_clients),
        ("foxglove_clients", "Clients of the Foxglove protocol", &counters.foxglove_clients),
    ] {
        register(registry, name, help, ConstGauge::new(integer(get(value))));
    }
    if let Some(progress) = shared.progress() {
        let unsynced_s = progress.unsynced_since.map_or(0.0, |since| shared.clock.now().seconds_since(since));
        register(
            registry,
            "recording_bytes",
            "Recorded since the start",
            ConstCounter::new(progress.total_bytes),
        );
        let paused = i64::from(progress.state == RecordingState::Paused);
        register(
            registry,
            "recording_paused",
            "1 if what arrives should be recorded, but cannot",
            ConstGauge::new(paused),
        );
        register(
            registry,
            "recording_missed",
            "Messages that came while the recording was paused",
            ConstCounter::new(progress.missed),
        );
        register(
            registry,
            "recording_unsynced_seconds",
            "Age of the oldest message that may not be on the disk",
            ConstGauge::new(unsynced_s),
        );
    }
    if let Some(free) = shared.record_directory.as_deref().and_then(disk_free_bytes) {
        register(registry, "disk_free_bytes", "Left where recordings go", ConstGauge::new(integer(free)));
    }
}

/// A name that ends with a unit says so to those who read the metadata, too.
fn register(registry: &mut Registry, name: &str, help: &str, metric: impl Metric) {
    let units = [
        ("_seconds", Unit::Seconds),
        ("_bytes", Unit::Bytes),
        ("_meters", Unit::Meters),
        ("_hertz", Unit::Other("hertz".to_owned())),
    ];
    match units.into_iter().find_map(|(end, unit)| Some((name.strip_suffix(end)?, unit))) {
        Some((stem, unit)) => registry.register_with_unit(stem, help, unit, metric),
        None => registry.register(name, help, metric),
    }
}

fn integer(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}
