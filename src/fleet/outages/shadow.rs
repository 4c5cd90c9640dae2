//! Where on the site machines lack good GNSS: time in the cells of a grid.

use std::collections::BTreeMap;

use serde::Serialize;

use super::FixState;
use crate::frames::geodesy::SiteFrame;
use crate::lie::Vec3;
use crate::time::{Span, Stamp};

/// Edge of the cells in which time is counted, m; a map's cells are whole multiples of it.
pub const CELL_M: f64 = 1.0;
/// Time is counted by quarters of an hour: days begin with one in every time zone.
pub const QUARTER: Span = Span::from_millis(900_000);
/// Two poses further apart in time than this say nothing of the time between.
const GAP_MAX: Span = Span::from_millis(1_000);
/// Positions further from the site's origin are not counted, m.
const REACH_MAX_M: f64 = 100_000.0;

/// A cell in a quarter of an hour.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct CellKey {
    /// Quarters of an hour since the epoch.
    pub quarter: i64,
    /// Cells east of the origin; the cell reaches from here to one more.
    pub east: i64,
    /// Cells north of the origin.
    pub north: i64,
}

/// Time spent in a cell, ns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CellTime {
    /// All of it.
    pub observed_ns: i64,
    /// With fixes that are usable, but not to the centimetre.
    pub float_ns: i64,
    /// Without good fixes.
    pub without_ns: i64,
}

impl CellTime {
    /// Adds another time to this.
    pub fn add(&mut self, other: &CellTime) {
        self.observed_ns += other.observed_ns;
        self.float_ns += other.float_ns;
        self.without_ns += other.without_ns;
    }
}

/// Counts the time of one machine.
#[derive(Debug, Default)]
pub(super) struct Shadow {
    last: Option<Stamp>,
    cells: BTreeMap<CellKey, CellTime>,
}

impl Shadow {
    /// The machine is there, with such fixes, since its pose before.
    pub fn count(&mut self, position: &Vec3, state: FixState, now: Stamp) {
        let Some(last) = self.last.replace(now) else { return };
        let passed = now - last;
        let near = position.x.abs() <= REACH_MAX_M && position.y.abs() <= REACH_MAX_M;
        if passed <= Span::default() || passed > GAP_MAX || !near {
            return;
        }
        let key = CellKey {
            quarter: now.as_nanos().div_euclid(QUARTER.as_nanos()),
            east: (position.x / CELL_M).floor() as i64,
            north: (position.y / CELL_M).floor() as i64,
        };
        let nanos = passed.as_nanos();
        self.cells.entry(key).or_default().add(&CellTime {
            observed_ns: nanos,
            float_ns: if state == FixState::Float { nanos } else { 0 },
            without_ns: if state.is_good() { 0 } else { nanos },
        });
    }

    /// What was counted since the last call.
    pub fn take(&mut self) -> BTreeMap<CellKey, CellTime> {
        std::mem::take(&mut self.cells)
    }
}

/// The cells as GeoJSON (RFC 7946).
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct ShadowMap {
    /// `FeatureCollection`.
    #[serde(rename = "type")]
    pub kind: &'static str,
    /// A polygon for each cell in which a machine was.
    pub features: Vec<ShadowFeature>,
}

/// One cell of the shadow map.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct ShadowFeature {
    /// `Feature`.
    #[serde(rename = "type")]
    pub kind: &'static str,
    /// The cell's outline.
    pub geometry: ShadowPolygon,
    /// What was counted in it.
    pub properties: ShadowProperties,
}

/// A cell's outline.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct ShadowPolygon {
    /// `Polygon`.
    #[serde(rename = "type")]
    pub kind: &'static str,
    /// One ring of longitude and latitude, counterclockwise, closed.
    pub coordinates: [[[f64; 2]; 5]; 1],
}

/// What was counted in a cell.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct ShadowProperties {
    /// The cell's western edge in the site frame, m.
    pub east_m: f64,
    /// The cell's southern edge in the site frame, m.
    pub north_m: f64,
    /// Length of its edges, m.
    pub cell_m: f64,
    /// Time that machines spent in it, s.
    pub observed_s: f64,
    /// Of that, with fixes that are usable, but not to the centimetre, s.
    pub float_s: f64,
    /// Of that, without good GNSS, s.
    pub without_gnss_s: f64,
    /// Share of the time without good GNSS, 0 to 1.
    pub share_without_gnss: f64,
}

impl ShadowMap {
    /// Of cells `multiple` times [`CELL_M`] wide, by their column and row.
    pub fn of(cells: impl Iterator<Item = (i64, i64, CellTime)>, multiple: i64, frame: &SiteFrame) -> Self {
        let cell_m = CELL_M * multiple as f64;
        let feature = |(column, row, time): (i64, i64, CellTime)| {
            let corner = |east: i64, north: i64| {
                let enu = Vec3::new((column + east) as f64 * cell_m, (row + north) as f64 * cell_m, 0.0);
                let geodetic = frame.to_geodetic(&enu);
                [geodetic.longitude_deg, geodetic.latitude_deg]
            };
            let seconds = |nanos: i64| Span::from_nanos(nanos).as_seconds();
            ShadowFeature {
                kind: "Feature",
                geometry: ShadowPolygon {
                    kind: "Polygon",
                    coordinates: [[corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1), corner(0, 0)]],
                },
                properties: ShadowProperties {
                    east_m: column as f64 * cell_m,
                    north_m: row as f64 * cell_m,
                    cell_m,
                    observed_s: seconds(time.observed_ns),
                    float_s: seconds(time.float_ns),
                    without_gnss_s: seconds(time.without_ns),
                    share_without_gnss: time.without_ns as f64 / time.observed_ns.max(1) as f64,
                },
            }
        };
        Self { kind: "FeatureCollection", features: cells.map(feature).collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::geodesy::Geodetic;

    fn at(seconds: f64) -> Stamp {
        Stamp::from_seconds(1_795_410_000.0 + seconds)
    }

    #[test]
    fn time_goes_to_the_cell_and_the_state_it_was_spent_in_and_gaps_to_none() {
        let mut shadow = Shadow::default();
        for tenth in 0..=100 {
            let seconds = f64::from(tenth) * 0.1;
            let east = if seconds <= 4.0 { -0.5 } else { 2.5 };
            let state = if seconds <= 6.0 { FixState::Fixed } else { FixState::Silent };
            shadow.count(&Vec3::new(east, 0.1, 3.0), state, at(seconds));
        }
        shadow.count(&Vec3::new(2.5, 0.1, 3.0), FixState::Silent, at(60.0));
        shadow.count(&Vec3::new(1e7, 0.1, 3.0), FixState::Silent, at(60.1));
        let cells = shadow.take();
        let seconds = |east: i64| {
            let (_, time) = cells.iter().find(|(key, _)| key.east == east && key.north == 0).expect("a cell");
            [time.observed_ns, time.without_ns].map(|nanos| (nanos as f64 / 1e8).round() / 10.0)
        };
        assert_eq!((seconds(-1), seconds(2)), ([4.0, 0.0], [6.0, 4.0]));
        assert_eq!((cells.len(), shadow.take().len()), (2, 0));
    }

    #[test]
    fn map_is_geojson_with_closed_rings_where_the_cells_are() {
        let frame = SiteFrame::new(Geodetic { latitude_deg: 47.0, longitude_deg: 8.0, altitude_m: 400.0 });
        let time = CellTime { observed_ns: 10_000_000_000, float_ns: 0, without_ns: 2_500_000_000 };
        let map = ShadowMap::of([(-1, 2, time)].into_iter(), 5, &frame);
        let feature = &map.features[0];
        let [ring] = feature.geometry.coordinates;
        assert_eq!(ring[0], ring[4]);
        let south_west = Geodetic { latitude_deg: ring[0][1], longitude_deg: ring[0][0], altitude_m: 400.0 };
        let enu = frame.to_enu(south_west);
        assert!((enu.x + 5.0).abs() < 1e-3 && (enu.y - 10.0).abs() < 1e-3, "{enu}");
        let area: f64 = ring.windows(2).map(|pair| pair[0][0] * pair[1][1] - pair[1][0] * pair[0][1]).sum();
        assert!(area > 0.0, "counterclockwise");
        let properties = &feature.properties;
        assert_eq!((properties.east_m, properties.north_m, properties.cell_m), (-5.0, 10.0, 5.0));
        assert_eq!((properties.observed_s, properties.share_without_gnss), (10.0, 0.25));
    }
}
