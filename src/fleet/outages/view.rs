//! What the API says of outages: units in the names, times as RFC 3339.

use serde::Serialize;

use super::{Budget, Ending, FixState, Outage};
use crate::fleet::view::UtcTime;
use crate::frames::geodesy::SiteFrame;
use crate::lie::Vec3;
use crate::state::Mode;
use crate::time::Stamp;

/// A machine's fixes, now.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct GnssView {
    /// State of the fixes.
    pub state: FixState,
    /// Since when.
    #[cfg_attr(feature = "shells", schema(value_type = String, format = DateTime))]
    pub since: UtcTime,
    /// What the estimate rests on, as the machine last said; `null` before it said so.
    pub mode: Option<Mode>,
    /// The outage that goes on; `null` if none does.
    pub outage: Option<CurrentOutage>,
}

/// The outage that goes on, with what is left.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct CurrentOutage {
    /// As in `/api/v1/outages/{id}`.
    pub id: String,
    /// What was wrong when it began.
    pub cause: FixState,
    /// Since when.
    #[cfg_attr(feature = "shells", schema(value_type = String, format = DateTime))]
    pub start: UtcTime,
    /// Since its start, s.
    pub duration_s: f64,
    /// Way since its start, m; `null` if the link is lost.
    pub travelled_m: Option<f64>,
    /// One sigma of the position along its worst horizontal direction, m.
    pub position_sigma_m: Option<f64>,
    /// What is left until the sigma passes the site's tolerance; `null` as long as it is too early to tell.
    pub budget: Option<Budget>,
}

/// Sigma of an outage along the worst horizontal direction.
#[derive(Clone, Copy, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct SigmaSummary {
    /// When it began, m.
    pub start_m: Option<f64>,
    /// Newest, m.
    pub last_m: Option<f64>,
    /// Largest, m.
    pub max_m: Option<f64>,
}

/// A place on the site.
#[derive(Clone, Copy, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct PlaceView {
    /// In the site frame: east, north, up, m.
    pub position_m: [f64; 3],
    /// Degrees, north positive.
    pub latitude_deg: f64,
    /// Degrees, east positive.
    pub longitude_deg: f64,
    /// Above the ellipsoid, m.
    pub altitude_m: f64,
}

/// An outage.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct OutageView {
    /// Unique on the site.
    pub id: String,
    /// The machine's id.
    pub machine: String,
    /// What was wrong when it began.
    pub cause: FixState,
    /// When it began, by the site's clock.
    #[cfg_attr(feature = "shells", schema(value_type = String, format = DateTime))]
    pub start: UtcTime,
    /// When it ended; `null` while it goes on.
    #[cfg_attr(feature = "shells", schema(value_type = Option<String>, format = DateTime))]
    pub end: Option<UtcTime>,
    /// How it ended; `null` while it goes on.
    pub ended_by: Option<Ending>,
    /// So far, s.
    pub duration_s: f64,
    /// Way since its start, m; `null` if nobody knows.
    pub travelled_m: Option<f64>,
    /// By how much `world_from_odom` moved the machine when it ended, m; `null` if it did not, or did not say.
    pub jump_m: Option<f64>,
    /// One sigma of the position.
    pub position_sigma: SigmaSummary,
    /// Where it began; `null` if nobody knows.
    pub place: Option<PlaceView>,
}

/// Sigma at a time of an outage.
#[derive(Clone, Copy, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct SigmaView {
    /// Since the outage began, s.
    pub time_s: f64,
    /// Way since the outage began, m.
    pub travelled_m: f64,
    /// One sigma along the worst horizontal direction, m.
    pub position_sigma_m: f64,
}

/// Where the machine was at a time of an outage.
#[derive(Clone, Copy, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct TrackView {
    /// Since the outage began, s.
    pub time_s: f64,
    /// Where.
    #[serde(flatten)]
    pub place: PlaceView,
}

/// An outage with all that is known of it.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct OutageDetail {
    /// What the list says of it.
    #[serde(flatten)]
    pub outage: OutageView,
    /// Sigma over time, a few hundred samples at most, however long it lasted.
    pub sigma: Vec<SigmaView>,
    /// Where the machine was, a few hundred points at most.
    pub track: Vec<TrackView>,
}

impl PlaceView {
    pub(super) fn of(position_m: [f64; 3], frame: &SiteFrame) -> Self {
        let geodetic = frame.to_geodetic(&Vec3::from(position_m));
        Self {
            position_m,
            latitude_deg: geodetic.latitude_deg,
            longitude_deg: geodetic.longitude_deg,
            altitude_m: geodetic.altitude_m,
        }
    }
}

impl OutageView {
    /// As it stands at `now`.
    pub fn of(outage: &Outage, frame: &SiteFrame, now: Stamp) -> Self {
        Self {
            id: outage.id.clone(),
            machine: outage.machine.clone(),
            cause: outage.cause,
            start: UtcTime(outage.start),
            end: outage.end.map(UtcTime),
            ended_by: outage.ended_by,
            duration_s: outage.duration_s(now),
            travelled_m: outage.travelled_m,
            jump_m: outage.jump_m,
            position_sigma: SigmaSummary {
                start_m: outage.sigma_start_m,
                last_m: outage.sigma_m,
                max_m: outage.sigma_max_m,
            },
            place: outage.place_m.map(|position_m| PlaceView::of(position_m, frame)),
        }
    }
}

impl OutageDetail {
    /// As it stands at `now`.
    pub fn of(outage: &Outage, frame: &SiteFrame, now: Stamp) -> Self {
        let sigma = outage.sigma.samples().iter().map(|sample| SigmaView {
            time_s: sample.time_s,
            travelled_m: sample.travelled_m,
            position_sigma_m: sample.sigma_m,
        });
        let track = outage
            .track
            .samples()
            .iter()
            .map(|point| TrackView { time_s: point.time_s, place: PlaceView::of(point.position_m, frame) });
        Self { outage: OutageView::of(outage, frame, now), sigma: sigma.collect(), track: track.collect() }
    }
}
