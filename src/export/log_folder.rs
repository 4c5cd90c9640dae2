//! Log folders: one CSV file a sensor, as the reader of the room `import` takes them.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use super::{Target, about};
use crate::lie::Vec3;
use crate::sensors::{Arrival, GnssFix, ImuSample, Reading, Sensor};

/// Columns of an IMU's file.
const IMU_HEADER: &str = "t_arrival,t,gx,gy,gz,ax,ay,az";
/// Columns of an antenna's file.
const GNSS_HEADER: &str = "t_arrival,t,lat,lon,alt,sd_e,sd_n,sd_u";
/// Columns of the lidar odometry's file.
const LIDAR_HEADER: &str = "t_arrival,t,x,y,z,qx,qy,qz,qw";
/// Columns of the encoder's file.
const CABIN_TURN_HEADER: &str = "t_arrival,t,angle";

/// Writes readings into a log folder; what is there is overwritten by [`LogFolderWriter::finish`], and not before.
#[derive(Debug)]
pub struct LogFolderWriter {
    directory: PathBuf,
    files: [Option<(Target, BufWriter<File>)>; Sensor::ALL.len()],
}

impl LogFolderWriter {
    /// Makes the folder if it is not there.
    ///
    /// # Errors
    /// The folder cannot be made.
    pub fn create(directory: &Path) -> io::Result<Self> {
        fs::create_dir_all(directory).map_err(|error| about(directory, error))?;
        Ok(Self { directory: directory.to_owned(), files: Default::default() })
    }

    /// Appends one reading to the file of its sensor.
    ///
    /// # Errors
    /// The file cannot be made or written.
    pub fn write(&mut self, arrival: &Arrival) -> io::Result<()> {
        let sensor = arrival.reading.sensor();
        let path = || log_file(&self.directory, sensor);
        let slot = &mut self.files[sensor as usize];
        let file = match slot {
            Some((_, file)) => file,
            None => {
                let target = Target::of(&path())?;
                let mut file = BufWriter::new(target.open()?);
                writeln!(file, "{}", header(sensor)).map_err(|error| about(&path(), error))?;
                &mut slot.insert((target, file)).1
            }
        };
        write_row(file, arrival).map_err(|error| about(&path(), error))
    }

    /// Puts all files in their places, and removes those that an earlier log has left beside them.
    ///
    /// # Errors
    /// A file cannot be written, or an old one cannot be removed.
    pub fn finish(mut self) -> io::Result<()> {
        for (file, sensor) in self.files.iter_mut().zip(Sensor::ALL) {
            if let Some((_, file)) = file {
                file.flush().map_err(|error| about(&log_file(&self.directory, sensor), error))?;
            }
        }
        for (file, sensor) in self.files.into_iter().zip(Sensor::ALL) {
            let path = log_file(&self.directory, sensor);
            match file {
                Some((target, _)) => target.keep()?,
                None => match fs::remove_file(&path) {
                    Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(about(&path, error)),
                    _ => {}
                },
            }
        }
        Ok(())
    }
}

/// The header line of a sensor's file in a log folder.
pub const fn header(sensor: Sensor) -> &'static str {
    match sensor {
        Sensor::Imu | Sensor::BaseImu => IMU_HEADER,
        Sensor::GnssLeft | Sensor::GnssRight => GNSS_HEADER,
        Sensor::LidarOdometry => LIDAR_HEADER,
        Sensor::CabinTurn => CABIN_TURN_HEADER,
    }
}

/// Where a log folder keeps a sensor's readings.
pub fn log_file(directory: &Path, sensor: Sensor) -> PathBuf {
    directory.join(format!("{}.csv", sensor.name()))
}

/// One line of a log file.
///
/// # Errors
/// What the writer says.
pub fn write_row(writer: &mut impl Write, arrival: &Arrival) -> io::Result<()> {
    write!(writer, "{},{}", arrival.arrival, arrival.reading.stamp())?;
    match &arrival.reading {
        Reading::Imu(sample) | Reading::BaseImu(sample) => {
            let ImuSample { angular_rate, specific_force, .. } = sample;
            write_vector(writer, angular_rate)?;
            write_vector(writer, specific_force)?;
        }
        Reading::GnssLeft(fix) | Reading::GnssRight(fix) => {
            let GnssFix { position, sigma_enu_m, .. } = fix;
            write!(writer, ",{},{},{}", position.latitude_deg, position.longitude_deg, position.altitude_m)?;
            write_vector(writer, sigma_enu_m)?;
        }
        Reading::LidarOdometry(pose) => {
            write_vector(writer, &pose.lidarmap_from_lidar.translation())?;
            let [x, y, z, w] = pose.lidarmap_from_lidar.rotation().to_xyzw();
            write!(writer, ",{x},{y},{z},{w}")?;
        }
        Reading::CabinTurn(turn) => write!(writer, ",{}", turn.angle_rad)?,
    }
    writeln!(writer)
}

fn write_vector(writer: &mut impl Write, vector: &Vec3) -> io::Result<()> {
    write!(writer, ",{},{},{}", vector.x, vector.y, vector.z)
}
