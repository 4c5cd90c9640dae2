//! The methods that ours is compared with, behind the same interface: readings in, estimates out.
//!
//! Each is written here from its publication; `README.md` beside this file has equations, tuning and sources. All
//! start where our own estimator starts ([`crate::estimator::Starter`]) and have the noise figures of the same
//! machine file. They publish one pose, without a second one that never steps: `odom_from_imu` is that pose in the
//! world, with its steps, and `world_from_odom` is the identity. Not in here: how errors are measured.

mod dead_reckoning;
mod filter;
mod fix_gate;
mod lidar_alone;
mod lidar_pace;
mod msf;
mod transition;
mod tsif;

#[cfg(test)]
mod tests;

pub use dead_reckoning::DeadReckoning;
pub use filter::{Core, Filter, Took};
pub use lidar_alone::LidarAlone;
pub use msf::Msf;
pub use tsif::Tsif;

use crate::estimator::{Estimator, Method, Options};

/// The methods that can be run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Ours: two graphs over a fixed-lag window.
    Dual,
    /// Two-state implicit filter, IMU and GNSS (Bloesch et al. 2017).
    Tsif,
    /// Error-state Kalman filter with a state buffer: IMU, GNSS and lidar (Lynen et al. 2013).
    Msf,
    /// Lidar odometry alone, aligned at the start.
    Lidar,
    /// The IMU alone.
    DeadReckoning,
}

impl Kind {
    /// All, ours first.
    pub const ALL: [Kind; 5] = [Kind::Dual, Kind::Tsif, Kind::Msf, Kind::Lidar, Kind::DeadReckoning];

    /// The name in files and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Kind::Dual => "dual",
            Kind::Tsif => "tsif",
            Kind::Msf => "msf",
            Kind::Lidar => "lidar",
            Kind::DeadReckoning => "dead-reckoning",
        }
    }

    /// The name in tables and plots.
    pub const fn title(self) -> &'static str {
        match self {
            Kind::Dual => "holdfast",
            Kind::Tsif => "TSIF",
            Kind::Msf => "MSF",
            Kind::Lidar => "lidar odometry",
            Kind::DeadReckoning => "dead reckoning",
        }
    }

    /// An estimator of this kind that has seen nothing yet.
    pub fn estimator(self, options: Options) -> Box<dyn Method> {
        match self {
            Kind::Dual => Box::new(Estimator::new(options)),
            Kind::Tsif => Box::new(Filter::<Tsif>::new(options)),
            Kind::Msf => Box::new(Filter::<Msf>::new(options)),
            Kind::Lidar => Box::new(LidarAlone::new(options)),
            Kind::DeadReckoning => Box::new(Filter::<DeadReckoning>::new(options)),
        }
    }
}
