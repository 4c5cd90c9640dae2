//! TUM trajectories: lines of `t x y z qx qy qz qw`, comments after `#`.

use std::path::Path;

use super::ImportError;
use super::table::{Row, Separator, Text};
use crate::lie::{Se3, So3, Vec3};
use crate::time::Stamp;

/// A pose and its time. Which frames it is between is the file's promise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StampedPose {
    /// When.
    pub stamp: Stamp,
    /// Where.
    pub pose: Se3,
}

/// Reads a TUM trajectory. Its stamps must increase.
///
/// # Errors
/// [`ImportError`] with file, line and column.
pub fn read_tum(path: &Path) -> Result<Vec<StampedPose>, ImportError> {
    let text = Text::read(path)?;
    let mut poses: Vec<StampedPose> = Vec::new();
    for row in text.rows(Separator::Space).filter(|row| !row.is_comment()) {
        row.expect_fields(8)?;
        let pose = StampedPose { stamp: row.stamp(0)?, pose: pose(&row, 1)? };
        if let Some(last) = poses.last()
            && pose.stamp <= last.stamp
        {
            return Err(row.error(0, format!("time {} does not come after {}", pose.stamp, last.stamp)));
        }
        poses.push(pose);
    }
    Ok(poses)
}

fn pose(row: &Row<'_>, first: usize) -> Result<Se3, ImportError> {
    let mut values = [0.0; 7];
    for (index, value) in values.iter_mut().enumerate() {
        *value = row.number(first + index)?;
        if !value.is_finite() {
            return Err(row.error(first + index, format!("{value} cannot be part of a trajectory")));
        }
    }
    let [x, y, z, qx, qy, qz, qw] = values;
    let rotation = So3::from_xyzw(qx, qy, qz, qw)
        .ok_or_else(|| row.error(first + 3, "the quaternion has no length".to_owned()))?;
    Ok(Se3::new(rotation, Vec3::new(x, y, z)))
}
