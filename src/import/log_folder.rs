//! Log folders: one CSV file a sensor, merged into one stream in the order of arrival.

use std::path::Path;

use super::table::{Row, Separator, Text};
use super::{ImportError, StampedPose, read_tum};
use crate::export::{header, log_file};
use crate::frames::Pose;
use crate::frames::geodesy::Geodetic;
use crate::lie::{Se3, So3, Vec3};
use crate::sensors::{Arrival, CabinTurn, GnssFix, ImuSample, LidarPose, Reading, Sensor};
use crate::time::Stamp;

/// Rows between two calls of `progress`.
const PROGRESS_EVERY: usize = 4_096;

/// What is in a log folder.
#[derive(Clone, Debug)]
pub struct LogFolder {
    /// All readings in the order in which they arrived; the cabin IMU first among equals, then the
    /// other sensors in the order of [`Sensor`].
    pub arrivals: Vec<Arrival>,
    /// `truth_imu.tum`, where there is one: the cabin IMU in the site frame.
    pub truth: Option<Vec<StampedPose>>,
}

/// Reads a log folder. All files but `imu.csv` are optional; a row with no `t_arrival` arrived at its
/// stamp. A row cannot arrive before the row above it: an earlier time of arrival is raised to that.
///
/// # Errors
/// [`ImportError`] with file, line and column.
pub fn read_log_folder(directory: &Path) -> Result<LogFolder, ImportError> {
    read_log_folder_showing(directory, |_| ())
}

/// The length of its files, as far as they can be looked at.
pub fn log_folder_bytes(directory: &Path) -> u64 {
    let length = |sensor| std::fs::metadata(log_file(directory, sensor)).map_or(0, |file| file.len());
    Sensor::ALL.into_iter().map(length).sum()
}

/// [`read_log_folder`] that tells how many bytes of [`log_folder_bytes`] are behind.
///
/// # Errors
/// [`ImportError`] with file, line and column.
pub fn read_log_folder_showing(
    directory: &Path,
    mut progress: impl FnMut(u64),
) -> Result<LogFolder, ImportError> {
    let mut arrivals = Vec::new();
    let mut bytes = 0;
    for sensor in Sensor::ALL {
        let path = log_file(directory, sensor);
        if sensor == Sensor::Imu || path.exists() {
            bytes += read_sensor(&path, sensor, &mut arrivals, |part| progress(bytes + part))?;
        }
    }
    // Stable, and the files were read in the order of the sensors, so ties are already as they should be.
    arrivals.sort_by_key(|arrival: &Arrival| arrival.arrival);
    let truth_path = directory.join("truth_imu.tum");
    let truth = if truth_path.exists() { Some(read_tum(&truth_path)?) } else { None };
    Ok(LogFolder { arrivals, truth })
}

/// Reads a file; gives back its length.
fn read_sensor(
    path: &Path,
    sensor: Sensor,
    arrivals: &mut Vec<Arrival>,
    mut progress: impl FnMut(u64),
) -> Result<u64, ImportError> {
    let text = Text::read(path)?;
    let mut rows = text.rows(Separator::Comma);
    let Some(head) = rows.next() else {
        return Err(text.error(1, format!("no header line, expected {}", header(sensor))));
    };
    let columns = Columns::find(&head, sensor)?;
    let mut latest = Stamp::from_nanos(i64::MIN);
    for (index, row) in rows.enumerate() {
        if index.is_multiple_of(PROGRESS_EVERY) {
            progress(text.offset(&row));
        }
        row.expect_fields(head.fields().len())?;
        let stamp = row.stamp(columns.stamp)?;
        let arrival = columns.arrival.map_or(Ok(stamp), |field| row.stamp(field))?;
        latest = latest.max(arrival);
        let reading = columns.reading(&row, sensor, stamp)?;
        arrivals.push(Arrival { arrival: latest, reading });
    }
    Ok(text.bytes())
}

/// In which field of a row each column stands.
struct Columns {
    arrival: Option<usize>,
    stamp: usize,
    /// After the two times, in the order of the contract.
    values: Vec<usize>,
}

impl Columns {
    fn find(head: &Row<'_>, sensor: Sensor) -> Result<Self, ImportError> {
        let expected: Vec<&str> = header(sensor).split(',').collect();
        for (field, name) in head.fields().iter().enumerate() {
            let message = if !expected.contains(name) {
                "is unknown"
            } else if head.fields()[..field].contains(name) {
                "comes twice"
            } else {
                continue;
            };
            return Err(
                head.error(field, format!("column \"{name}\" {message}, expected {}", header(sensor)))
            );
        }
        let position = |name: &str| head.fields().iter().position(|field| *field == name);
        let required = |name: &str| {
            position(name).ok_or_else(|| {
                let end = head.fields().len();
                head.error(end, format!("column \"{name}\" is missing, expected {}", header(sensor)))
            })
        };
        Ok(Self {
            arrival: position(expected[0]),
            stamp: required(expected[1])?,
            values: expected[2..].iter().map(|name| required(name)).collect::<Result<_, _>>()?,
        })
    }

    fn reading(&self, row: &Row<'_>, sensor: Sensor, stamp: Stamp) -> Result<Reading, ImportError> {
        let number = |index: usize| row.number(self.values[index]);
        let vector = |first: usize| -> Result<Vec3, ImportError> {
            Ok(Vec3::new(number(first)?, number(first + 1)?, number(first + 2)?))
        };
        let imu = || -> Result<ImuSample, ImportError> {
            Ok(ImuSample { stamp, angular_rate: vector(0)?, specific_force: vector(3)? })
        };
        let fix = || -> Result<GnssFix, ImportError> {
            let position =
                Geodetic { latitude_deg: number(0)?, longitude_deg: number(1)?, altitude_m: number(2)? };
            Ok(GnssFix { stamp, position, sigma_enu_m: vector(3)? })
        };
        Ok(match sensor {
            Sensor::Imu => Reading::Imu(imu()?),
            Sensor::BaseImu => Reading::BaseImu(imu()?),
            Sensor::GnssLeft => Reading::GnssLeft(fix()?),
            Sensor::GnssRight => Reading::GnssRight(fix()?),
            Sensor::LidarOdometry => {
                // What is no rotation stays NaN, for the estimator to refuse.
                let rotation = So3::from_xyzw(number(3)?, number(4)?, number(5)?, number(6)?)
                    .unwrap_or_else(|| So3::exp(&Vec3::repeat(f64::NAN)));
                let lidarmap_from_lidar = Pose::assume(Se3::new(rotation, vector(0)?));
                Reading::LidarOdometry(LidarPose { stamp, lidarmap_from_lidar })
            }
            Sensor::CabinTurn => Reading::CabinTurn(CabinTurn { stamp, angle_rad: number(0)? }),
        })
    }
}
