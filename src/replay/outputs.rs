//! The files of a run: poses, estimates, events.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use crate::export::write_tum_line;
use crate::state::{Estimate, Event};

use super::Summary;

const HEADER: &str =
    "t,x,y,z,qx,qy,qz,qw,vx,vy,vz,bgx,bgy,bgz,bax,bay,baz,sd_x,sd_y,sd_z,sd_roll,sd_pitch,sd_yaw,mode";

/// Writers of `world.tum`, `odom.tum`, `base_odom.tum`, `estimate.csv`, `events.jsonl` in one folder.
pub struct Outputs {
    world: BufWriter<File>,
    odom: BufWriter<File>,
    base_odom: BufWriter<File>,
    estimates: BufWriter<File>,
    events: BufWriter<File>,
    summary: std::path::PathBuf,
}

impl Outputs {
    /// Makes the folder and its files; files of an earlier run are overwritten.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn create(directory: &Path) -> io::Result<Self> {
        fs::create_dir_all(directory)?;
        let create = |name: &str| File::create(directory.join(name)).map(BufWriter::new);
        let mut estimates = create("estimate.csv")?;
        writeln!(estimates, "{HEADER}")?;
        Ok(Self {
            world: create("world.tum")?,
            odom: create("odom.tum")?,
            base_odom: create("base_odom.tum")?,
            estimates,
            events: create("events.jsonl")?,
            summary: directory.join("summary.json"),
        })
    }

    /// One line in each pose file (the chassis' only where it is known) and in `estimate.csv`.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn write_estimate(&mut self, estimate: &Estimate) -> io::Result<()> {
        let stamp = estimate.stamp;
        write_tum_line(&mut self.world, stamp, estimate.world_from_imu().motion())?;
        write_tum_line(&mut self.odom, stamp, estimate.odom_from_imu.motion())?;
        if let Some(base) = &estimate.base {
            write_tum_line(&mut self.base_odom, stamp, base.odom_from_base.motion())?;
        }
        let state = &estimate.state;
        write!(self.estimates, "{stamp}")?;
        let rotation = state.rotation.to_xyzw();
        let vectors = [state.velocity, state.gyro_bias, state.accel_bias];
        let values = state
            .position
            .iter()
            .chain(rotation.iter())
            .chain(vectors.iter().flat_map(|vector| vector.iter()))
            .copied()
            .chain(estimate.position_sigma_m())
            .chain(estimate.rotation_sigma());
        for value in values {
            write!(self.estimates, ",{value}")?;
        }
        writeln!(self.estimates, ",{}", estimate.mode)
    }

    /// One JSON object a line.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn write_event(&mut self, event: &Event) -> io::Result<()> {
        serde_json::to_writer(&mut self.events, event)?;
        writeln!(self.events)
    }

    /// Writes `summary.json` and flushes all files.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn finish(mut self, summary: &Summary) -> io::Result<()> {
        for writer in
            [&mut self.world, &mut self.odom, &mut self.base_odom, &mut self.estimates, &mut self.events]
        {
            writer.flush()?;
        }
        let mut file = File::create(&self.summary)?;
        serde_json::to_writer_pretty(&mut file, summary)?;
        writeln!(file)
    }
}
