//! The files of a run: poses, estimates, events.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::estimator::Correction;
use crate::export::write_tum_line;
use crate::state::{Estimate, Event, Takeover};
use crate::time::Stamp;

use super::Summary;

const HEADER: &str =
    "t,x,y,z,qx,qy,qz,qw,vx,vy,vz,bgx,bgy,bgz,bax,bay,baz,sd_x,sd_y,sd_z,sd_roll,sd_pitch,sd_yaw,mode";

const TAKEOVERS: &str = "takeovers.csv";

/// Writers of `world.tum`, `odom.tum`, `base_odom.tum`, `estimate.csv`, `corrections.csv`, `events.jsonl` in one folder.
pub struct Outputs {
    world: BufWriter<File>,
    odom: BufWriter<File>,
    base_odom: BufWriter<File>,
    estimates: BufWriter<File>,
    corrections: BufWriter<File>,
    events: BufWriter<File>,
    /// Only of a run on two threads.
    takeovers: Option<BufWriter<File>>,
    directory: PathBuf,
}

impl Outputs {
    /// The names of all files that a run may leave.
    pub const FILES: [&str; 8] = [
        "world.tum",
        "odom.tum",
        "base_odom.tum",
        "estimate.csv",
        "corrections.csv",
        "events.jsonl",
        TAKEOVERS,
        "summary.json",
    ];

    /// Makes the folder and its files; files of an earlier run are overwritten.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn create(directory: &Path) -> io::Result<Self> {
        fs::create_dir_all(directory)?;
        match fs::remove_file(directory.join(TAKEOVERS)) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            _ => {}
        }
        let create = |name: &str| File::create(directory.join(name)).map(BufWriter::new);
        let mut estimates = create("estimate.csv")?;
        writeln!(estimates, "{HEADER}")?;
        let mut corrections = create("corrections.csv")?;
        writeln!(corrections, "t,correction_m")?;
        Ok(Self {
            world: create("world.tum")?,
            odom: create("odom.tum")?,
            base_odom: create("base_odom.tum")?,
            estimates,
            corrections,
            events: create("events.jsonl")?,
            takeovers: None,
            directory: directory.to_owned(),
        })
    }

    /// Makes `takeovers.csv`, for [`Outputs::write_takeover`].
    ///
    /// # Errors
    /// Those of the file system.
    pub fn keep_takeovers(&mut self) -> io::Result<()> {
        let mut file = BufWriter::new(File::create(self.directory.join(TAKEOVERS))?);
        writeln!(file, "before,solution_of")?;
        self.takeovers = Some(file);
        Ok(())
    }

    /// One line in `takeovers.csv`, if it is kept.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn write_takeover(&mut self, takeover: &Takeover) -> io::Result<()> {
        match &mut self.takeovers {
            Some(file) => writeln!(file, "{},{}", takeover.before, takeover.solution_of),
            None => Ok(()),
        }
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

    /// One line in `corrections.csv`, if it moved anything: how far the solution that the reading which arrived at
    /// `now` led to moved the newest position.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn write_correction(&mut self, now: Stamp, correction: &Correction) -> io::Result<()> {
        match correction.correction_m {
            Some(correction_m) => writeln!(self.corrections, "{now},{correction_m}"),
            None => Ok(()),
        }
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
        let poses = [&mut self.world, &mut self.odom, &mut self.base_odom, &mut self.estimates];
        for writer in
            poses.into_iter().chain([&mut self.corrections, &mut self.events]).chain(&mut self.takeovers)
        {
            writer.flush()?;
        }
        let mut file = File::create(self.directory.join("summary.json"))?;
        serde_json::to_writer_pretty(&mut file, summary)?;
        writeln!(file)
    }
}
