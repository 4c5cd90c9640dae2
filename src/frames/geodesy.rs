//! WGS84 positions, the site's east-north-up frame and local gravity.
//!
//! Constants and formulas: NIMA TR8350.2 (WGS84, third edition); geodetic from geocentric coordinates by
//! Bowring's method, iterated to convergence. Angles at this border are degrees, as receivers give them.

use crate::lie::{Mat3, Vec3};

/// Semi-major axis, m.
const SEMI_MAJOR_AXIS_M: f64 = 6_378_137.0;
/// Flattening.
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// First eccentricity squared.
const ECCENTRICITY_SQUARED: f64 = FLATTENING * (2.0 - FLATTENING);

/// A WGS84 position: degrees, and metres above the ellipsoid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Geodetic {
    /// North positive, [-90, 90].
    pub latitude_deg: f64,
    /// East positive, [-180, 180].
    pub longitude_deg: f64,
    /// Above the ellipsoid, m.
    pub altitude_m: f64,
}

impl Geodetic {
    /// Earth-centred, earth-fixed coordinates, m.
    pub fn to_ecef(self) -> Vec3 {
        let (sin_lat, cos_lat) = libm::sincos(self.latitude_deg.to_radians());
        let (sin_lon, cos_lon) = libm::sincos(self.longitude_deg.to_radians());
        let normal = SEMI_MAJOR_AXIS_M / (1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat).sqrt();
        let horizontal = (normal + self.altitude_m) * cos_lat;
        Vec3::new(
            horizontal * cos_lon,
            horizontal * sin_lon,
            (normal * (1.0 - ECCENTRICITY_SQUARED) + self.altitude_m) * sin_lat,
        )
    }

    /// From earth-centred, earth-fixed coordinates (m), good to 1e-9 m near the surface.
    pub fn from_ecef(ecef: &Vec3) -> Self {
        let horizontal = libm::hypot(ecef.x, ecef.y);
        let semi_minor = SEMI_MAJOR_AXIS_M * (1.0 - FLATTENING);
        let second_eccentricity_squared = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED);
        let mut reduced_tan = ecef.z / horizontal * (SEMI_MAJOR_AXIS_M / semi_minor);
        let mut latitude = 0.0;
        for _ in 0..4 {
            let (sin, cos) = libm::sincos(libm::atan(reduced_tan));
            latitude = libm::atan2(
                ecef.z + second_eccentricity_squared * semi_minor * sin.powi(3),
                horizontal - ECCENTRICITY_SQUARED * SEMI_MAJOR_AXIS_M * cos.powi(3),
            );
            reduced_tan = (1.0 - FLATTENING) * libm::tan(latitude);
        }
        let (sin_lat, cos_lat) = libm::sincos(latitude);
        let normal = SEMI_MAJOR_AXIS_M / (1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat).sqrt();
        // Projected on the ellipsoid's normal, which is well conditioned at every latitude.
        let altitude_m = horizontal * cos_lat + ecef.z * sin_lat
            - normal * (1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat);
        Self {
            latitude_deg: latitude.to_degrees(),
            longitude_deg: libm::atan2(ecef.y, ecef.x).to_degrees(),
            altitude_m,
        }
    }
}

/// The site's east-north-up frame at a fixed origin.
#[derive(Clone, Copy, Debug)]
pub struct SiteFrame {
    origin: Geodetic,
    origin_ecef: Vec3,
    enu_from_ecef: Mat3,
}

impl SiteFrame {
    /// The frame tangent to the ellipsoid's normal at `origin`.
    pub fn new(origin: Geodetic) -> Self {
        let (sin_lat, cos_lat) = libm::sincos(origin.latitude_deg.to_radians());
        let (sin_lon, cos_lon) = libm::sincos(origin.longitude_deg.to_radians());
        let enu_from_ecef = Mat3::new(
            -sin_lon,
            cos_lon,
            0.0,
            -sin_lat * cos_lon,
            -sin_lat * sin_lon,
            cos_lat,
            cos_lat * cos_lon,
            cos_lat * sin_lon,
            sin_lat,
        );
        Self { origin, origin_ecef: origin.to_ecef(), enu_from_ecef }
    }

    /// Where the frame is tied to the earth.
    pub fn origin(&self) -> Geodetic {
        self.origin
    }

    /// East, north, up in the site frame, m.
    pub fn to_enu(&self, position: Geodetic) -> Vec3 {
        self.enu_from_ecef * (position.to_ecef() - self.origin_ecef)
    }

    /// WGS84 position of a point of the site frame (m).
    pub fn to_geodetic(&self, enu: &Vec3) -> Geodetic {
        Geodetic::from_ecef(&(self.origin_ecef + self.enu_from_ecef.transpose() * enu))
    }

    /// Gravity at the origin, written in the site frame, m/s²: [`normal_gravity`] straight down.
    pub fn gravity(&self) -> Vec3 {
        Vec3::new(0.0, 0.0, -normal_gravity(self.origin.latitude_deg, self.origin.altitude_m))
    }
}

/// WGS84 normal gravity, m/s²: Somigliana's closed form on the ellipsoid (TR8350.2 eq. 4-1) with its
/// second-order continuation to `altitude_m` above it (eq. 4-3).
pub fn normal_gravity(latitude_deg: f64, altitude_m: f64) -> f64 {
    const EQUATOR: f64 = 9.780_325_335_9;
    const SOMIGLIANA: f64 = 0.001_931_852_652_41;
    const CENTRIFUGAL_RATIO: f64 = 0.003_449_786_506_84;
    let sin_squared = libm::sin(latitude_deg.to_radians()).powi(2);
    let surface =
        EQUATOR * (1.0 + SOMIGLIANA * sin_squared) / (1.0 - ECCENTRICITY_SQUARED * sin_squared).sqrt();
    let ratio = altitude_m / SEMI_MAJOR_AXIS_M;
    let first_order = 2.0 * (1.0 + FLATTENING + CENTRIFUGAL_RATIO - 2.0 * FLATTENING * sin_squared);
    surface * (1.0 - first_order * ratio + 3.0 * ratio * ratio)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_points_map_to_their_geocentric_coordinates() {
        let equator = Geodetic { latitude_deg: 0.0, longitude_deg: 0.0, altitude_m: 0.0 };
        assert!((equator.to_ecef() - Vec3::new(6_378_137.0, 0.0, 0.0)).norm() < 1e-9);
        let pole = Geodetic { latitude_deg: 90.0, longitude_deg: 0.0, altitude_m: 10.0 };
        assert!((pole.to_ecef() - Vec3::new(0.0, 0.0, 6_356_752.314_245_18 + 10.0)).norm() < 1e-8);
        // Meridian radius of curvature over one arc second of latitude at 45°: 30.870 m.
        let origin = Geodetic { latitude_deg: 45.0, longitude_deg: 7.0, altitude_m: 0.0 };
        let north = Geodetic { latitude_deg: 45.0 + 1.0 / 3600.0, ..origin };
        assert!((SiteFrame::new(origin).to_enu(north).y - 30.870).abs() < 1e-3);
    }

    #[test]
    fn geodetic_and_site_coordinates_come_back() {
        for latitude_deg in [-89.0, -33.0, 0.0, 47.480_140_2, 80.0] {
            for altitude_m in [-400.0, 0.0, 474.9, 8000.0] {
                let origin = Geodetic { latitude_deg, longitude_deg: 8.499_753_25, altitude_m };
                let site = SiteFrame::new(origin);
                let point = Vec3::new(812.5, -1310.25, 17.125);
                let back = site.to_enu(site.to_geodetic(&point));
                assert!((back - point).norm() < 1e-7, "{latitude_deg} {altitude_m}: {back}");
            }
        }
    }

    #[test]
    fn gravity_meets_published_values() {
        assert!((normal_gravity(0.0, 0.0) - 9.780_325).abs() < 1e-6);
        assert!((normal_gravity(90.0, 0.0) - 9.832_185).abs() < 1e-6);
        assert!((normal_gravity(45.0, 0.0) - 9.806_198).abs() < 1e-5);
        // Free air: about -3.086e-6 m/s² a metre.
        let slope = (normal_gravity(45.0, 100.0) - normal_gravity(45.0, 0.0)) / 100.0;
        assert!((slope + 3.086e-6).abs() < 2e-9, "{slope}");
    }
}
