//! The files of a smoothed session.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use serde::Serialize;

use super::{Gain, Smoothed, SolvedChain};
use crate::batch::SmoothedNode;
use crate::export::write_tum_line;
use crate::lie::{Se3, Vec3};

const NODES_HEADER: &str =
    "t,x,y,z,qx,qy,qz,qw,vx,vy,vz,bgx,bgy,bgz,bax,bay,baz,sd_x,sd_y,sd_z,sd_roll,sd_pitch,sd_yaw,part";
/// Rows and columns of a covariance: rotation, then position.
const AXES: [&str; 6] = ["rx", "ry", "rz", "x", "y", "z"];

/// A part of a session that has no solution.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Unsolved {
    /// Stamp of its first node, s.
    pub start_s: f64,
    /// Stamp of its last node, s.
    pub end_s: f64,
    /// How many it has.
    pub nodes: usize,
    /// In words.
    pub why: String,
}

/// The contents of `smooth.json`.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Whose session.
    pub machine: String,
    /// Solved, in their order: the estimate began anew between them.
    pub parts: Vec<PartSummary>,
    /// Not solved.
    pub unsolved: Vec<Unsolved>,
    /// Live against smoothed.
    pub gain: Gain,
    /// Of the estimator's run, s.
    pub forward_s: f64,
    /// Of the batches, s.
    pub batch_s: f64,
}

/// One solved part.
#[derive(Clone, Debug, Serialize)]
pub struct PartSummary {
    /// Stamp of its first node, s.
    pub start_s: f64,
    /// Stamp of its last node, s.
    pub end_s: f64,
    /// States that were solved for.
    pub nodes: usize,
    /// Steps of the solve.
    pub iterations: usize,
    /// Whether the last step was within the tolerance.
    pub converged: bool,
    /// Half the sum of squares, before and after.
    pub cost: [f64; 2],
    /// IMU motions between neighbours.
    pub imu: usize,
    /// Antenna positions.
    pub positions: usize,
    /// Of these, so odd that they count less.
    pub positions_weighted_down: usize,
    /// Poses in the world.
    pub poses: usize,
    /// Relative poses, of lidar and of a chassis that stands.
    pub between: usize,
    /// Turns of the chassis.
    pub turns: usize,
}

impl PartSummary {
    /// Of a chain.
    pub fn of(chain: &SolvedChain) -> Self {
        let seconds = |node: Option<&SmoothedNode>| node.map_or(0.0, |node| node.stamp.as_seconds());
        let factors = &chain.factors;
        Self {
            start_s: seconds(chain.nodes.first()),
            end_s: seconds(chain.nodes.last()),
            nodes: chain.nodes.len(),
            iterations: chain.iterations,
            converged: chain.converged,
            cost: chain.cost,
            imu: factors.imu,
            positions: factors.positions,
            positions_weighted_down: factors.weighted_down,
            poses: factors.poses,
            between: factors.between,
            turns: factors.turns,
        }
    }
}

/// Where the files go.
pub struct Outputs<'a> {
    directory: &'a Path,
}

impl<'a> Outputs<'a> {
    /// Makes the folder.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn create(directory: &'a Path) -> io::Result<Self> {
        fs::create_dir_all(directory)?;
        Ok(Self { directory })
    }

    /// Writes `smoothed.tum`, `nodes.csv` and `covariance.csv`; files of an earlier run are overwritten.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn write(&self, smoothed: &Smoothed) -> io::Result<()> {
        let create = |name: &str| File::create(self.directory.join(name)).map(BufWriter::new);
        let mut poses = create("smoothed.tum")?;
        let mut written = Ok(());
        smoothed.at_samples(|stamp, state, _| {
            if written.is_ok() {
                written = write_tum_line(&mut poses, stamp, &Se3::new(state.rotation, state.position));
            }
        });
        written?;
        poses.flush()?;
        let mut nodes = create("nodes.csv")?;
        writeln!(nodes, "{NODES_HEADER}")?;
        let mut covariances = create("covariance.csv")?;
        write!(covariances, "t")?;
        for (row, column) in upper_half() {
            write!(covariances, ",{}_{}", AXES[row], AXES[column])?;
        }
        writeln!(covariances)?;
        for (part, chain) in smoothed.chains.iter().enumerate() {
            for node in chain.nodes.iter().filter(|node| chain.until.is_none_or(|until| node.stamp < until)) {
                write_node(&mut nodes, node, part)?;
                write!(covariances, "{}", node.stamp)?;
                for place in upper_half() {
                    write!(covariances, ",{}", node.covariance[place])?;
                }
                writeln!(covariances)?;
            }
        }
        nodes.flush()?;
        covariances.flush()
    }

    /// Writes `smooth.json`.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn finish(self, summary: &Summary) -> io::Result<()> {
        let mut file = BufWriter::new(File::create(self.directory.join("smooth.json"))?);
        serde_json::to_writer_pretty(&mut file, summary)?;
        writeln!(file)?;
        file.flush()
    }
}

fn upper_half() -> impl Iterator<Item = (usize, usize)> {
    (0..AXES.len()).flat_map(|row| (row..AXES.len()).map(move |column| (row, column)))
}

fn write_node(writer: &mut impl Write, node: &SmoothedNode, part: usize) -> io::Result<()> {
    let state = &node.state;
    let turned = state.rotation.matrix();
    let rotation = turned * node.covariance.fixed_view::<3, 3>(0, 0) * turned.transpose();
    let position = Vec3::from_fn(|axis, _| node.covariance[(3 + axis, 3 + axis)]);
    let sigmas = position.iter().copied().chain((0..3).map(|axis| rotation[(axis, axis)]));
    let vectors = [state.velocity, state.gyro_bias, state.accel_bias];
    write!(writer, "{}", node.stamp)?;
    let values = state.position.iter().copied().chain(state.rotation.to_xyzw());
    let values = values.chain(vectors.iter().flat_map(|vector| vector.iter().copied()));
    for value in values.chain(sigmas.map(|variance| variance.max(0.0).sqrt())) {
        write!(writer, ",{value}")?;
    }
    writeln!(writer, ",{part}")
}
