//! Configuration files: TOML in, checked and typed values out.
//!
//! Unknown keys are refused, and every error names file, line and column. What a value means to the
//! estimator is said by the estimator's own options; this room fills them in.

mod alerts;
mod endpoint;
mod machine;
mod map;
mod site;
mod tls;
mod topics;

use std::fmt;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

pub use alerts::{
    Alerts, ClockOff, DiskLow, EstimatorLate, IdConflict, MachineLost, Mail, MailTls, OutageLonger,
    RecordingPaused, SensorSilent, SigmaOverTolerance, Webhook,
};
pub use endpoint::endpoint;
pub use machine::{
    BaseImu, Frames, Gate, Gnss, Imu, Initialization, LidarInOutage, LidarOdometry, Link, Machine, OnBoard,
    Publish, Smoother, Transform, World,
};
pub use map::Map;
pub use site::{Equipment, Http, Record, Rotate, Site, Tolerance, Zenoh};
pub use tls::{Admitted, Tls};
pub use topics::Topics;

/// Why a configuration file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}", path.display())]
    Unreadable {
        /// Which file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The text is not what it should be.
    #[error("{}:{line}:{column}: {message}", path.display())]
    Invalid {
        /// Which file.
        path: PathBuf,
        /// From 1.
        line: usize,
        /// From 1.
        column: usize,
        /// What is wrong, and what would be right.
        message: String,
    },
}

/// A value that is out of its range: the dotted key, and what is wrong.
#[derive(Clone, Debug, PartialEq)]
pub struct Violation {
    /// For example `gnss.sigma_floor_m`.
    pub key: String,
    /// For example `is -1, must be above 0`.
    pub message: String,
}

impl fmt::Display for Violation {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} {}", self.key, self.message)
    }
}

impl std::error::Error for Violation {}

/// A configuration that can check its values beyond their types.
pub trait Checked: DeserializeOwned {
    /// The first value out of its range.
    ///
    /// # Errors
    /// The [`Violation`], if there is one.
    fn check(&self) -> Result<(), Violation>;
}

/// Reads and checks a configuration file.
///
/// # Errors
/// [`ConfigError`] with file, line and column.
pub fn load<T: Checked>(path: &Path) -> Result<T, ConfigError> {
    let text = std::fs::read_to_string(path)
        .map_err(|source| ConfigError::Unreadable { path: path.to_owned(), source })?;
    parse(&text, path)
}

/// Checks configuration text; `path` is what errors name.
///
/// # Errors
/// [`ConfigError::Invalid`] with line and column.
pub fn parse<T: Checked>(text: &str, path: &Path) -> Result<T, ConfigError> {
    let invalid = |offset: usize, message: String| {
        let (line, column) = position(text, offset);
        ConfigError::Invalid { path: path.to_owned(), line, column, message }
    };
    let value: T = toml::from_str(text).map_err(|error| {
        let offset = error.span().map_or(0, |span| span.start);
        invalid(offset, error.message().trim_end().replace('\n', ", "))
    })?;
    value.check().map_err(|violation| invalid(offset_of_key(text, &violation.key), violation.to_string()))?;
    Ok(value)
}

fn position(text: &str, offset: usize) -> (usize, usize) {
    let before = &text[..offset.min(text.len())];
    let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
    (before.matches('\n').count() + 1, before[line_start..].chars().count() + 1)
}

/// Where the dotted `key` stands in `text`; the start of its table or of the text if it is a default.
fn offset_of_key(text: &str, key: &str) -> usize {
    let (table, name) = key.rsplit_once('.').unwrap_or(("", key));
    let mut current = String::new();
    let mut table_offset = 0;
    let mut offset = 0;
    for line in text.split_inclusive('\n') {
        let trimmed = line.trim_start();
        let indent = line.len() - trimmed.len();
        if let Some(header) = trimmed.strip_prefix('[') {
            current = header.trim_start_matches('[').split(']').next().unwrap_or("").trim().to_owned();
            if current == table {
                table_offset = offset + indent;
            }
        } else if current == table {
            let found = trimmed.split(['=', '#']).next().unwrap_or("").trim();
            if found == name {
                return offset + indent;
            }
        }
        offset += line.len();
    }
    table_offset
}

/// `Err` unless `value` is finite and above zero.
pub(crate) fn positive(key: &str, value: f64) -> Result<(), Violation> {
    if value.is_finite() && value > 0.0 {
        Ok(())
    } else {
        violation(key, format!("is {value}, must be above 0"))
    }
}

/// `Err` unless `value` is within `low..=high`.
pub(crate) fn within(key: &str, value: f64, low: f64, high: f64) -> Result<(), Violation> {
    if value >= low && value <= high {
        Ok(())
    } else {
        violation(key, format!("is {value}, must be from {low} to {high}"))
    }
}

/// `Err` unless `id` is one to 64 letters, digits and '-'.
pub(crate) fn identifier(key: &str, id: &str) -> Result<(), Violation> {
    let plain = id.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-');
    if plain && (1..=64).contains(&id.len()) {
        Ok(())
    } else {
        violation(key, format!("is \"{id}\", must be 1 to 64 letters, digits and '-'"))
    }
}

pub(crate) fn violation<T>(key: &str, message: String) -> Result<T, Violation> {
    Err(Violation { key: key.to_owned(), message })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensors::Sensor;

    const MINIMAL: &str = "id = \"a\"\n[world]\nlatitude_deg = 47.0\nlongitude_deg = 8.0\naltitude_m = 400.0\n\
                           [frames]\nbase_from_cabin = {}\ncabin_from_imu = {}\n";

    fn error(text: &str) -> String {
        parse::<Machine>(text, Path::new("m.toml")).expect_err("must be refused").to_string()
    }

    #[test]
    fn defaults_fill_what_is_not_said() {
        let machine: Machine = parse(MINIMAL, Path::new("m.toml")).expect("valid");
        assert_eq!(machine.smoother.lag_s, 3.0);
        assert_eq!(machine.imu.update_rate, 100.0);
        assert!(machine.frames.cabin_from_gnss_right.is_none());
    }

    #[test]
    fn unknown_key_is_refused_with_its_line() {
        let message = error(&format!("{MINIMAL}[gnss]\nsigma_flor_m = 0.1\n"));
        assert!(message.starts_with("m.toml:10:1: unknown field `sigma_flor_m`"), "{message}");
    }

    #[test]
    fn value_out_of_range_is_refused_with_its_line() {
        let message = error(&format!("{MINIMAL}[gnss]\n# a comment\n  sigma_floor_m = -0.1\n"));
        assert_eq!(message, "m.toml:11:3: gnss.sigma_floor_m is -0.1, must be above 0");
        let message = error(&MINIMAL.replace("47.0", "147.0"));
        assert!(message.starts_with("m.toml:3:1: world.latitude_deg is 147"), "{message}");
        let message = error(&MINIMAL.replace("\"a\"", "\"a/b\""));
        assert!(message.starts_with("m.toml:1:1: id is \"a/b\""), "{message}");
    }

    #[test]
    fn topics_are_topics_and_of_one_sensor_each() {
        let topics = "[topics]\nimu = \"/cabin/imu\"\ncabin_turn = \"/joints\"\n";
        let machine: Machine = parse(&format!("{MINIMAL}{topics}"), Path::new("m.toml")).expect("valid");
        assert_eq!(machine.topics.of(Sensor::Imu), Some("/cabin/imu"));
        assert_eq!(machine.topics.of(Sensor::BaseImu), None);
        assert_eq!(machine.topics.cabin_turn_joint, "cabin_turn");
        let message = error(&format!("{MINIMAL}{}", topics.replace("/joints", "joints")));
        assert!(
            message.starts_with("m.toml:11:1: topics.cabin_turn is \"joints\", must be a topic"),
            "{message}"
        );
        let message = error(&format!("{MINIMAL}{}", topics.replace("/joints", "/cabin/imu")));
        assert_eq!(message, "m.toml:11:1: topics.cabin_turn is \"/cabin/imu\", which is imu already");
        assert!(error(&format!("{MINIMAL}[topics]\nlidar = \"/l\"\n")).contains("unknown field `lidar`"));
    }

    #[test]
    fn wrong_type_and_missing_table_are_refused() {
        assert!(error(&MINIMAL.replace("47.0", "\"north\"")).starts_with("m.toml:3:16: invalid type"));
        assert!(error("id = \"a\"\n").contains("missing field `world`"));
        assert!(error("id = \n").starts_with("m.toml:1:"));
    }

    #[test]
    fn missing_file_is_named() {
        let message = load::<Machine>(Path::new("/nowhere/m.toml")).expect_err("missing").to_string();
        assert!(message.starts_with("/nowhere/m.toml: cannot be read"), "{message}");
    }
}
