//! Zenoh keys: `holdfast/{site}/{machine}/{topic}`, the queryables `…/record/{boot}` and `…/configuration/{boot}`,
//! and the liveliness token `…/alive/{boot}`.

use super::{BootId, Topic};

const ROOT: &str = "holdfast";

/// The key of a machine's topic.
pub fn topic_key(site: &str, machine: &str, topic: Topic) -> String {
    format!("{ROOT}/{site}/{machine}/{}", topic.name())
}

/// Where one run of a machine answers for the on-board record, that of earlier runs too. Of two machines with the
/// same id each answers for itself alone.
pub fn record_key(site: &str, machine: &str, boot: BootId) -> String {
    format!("{ROOT}/{site}/{machine}/record/{boot}")
}

/// Where one run of a machine answers with what it runs and how it is configured, [`super::JournalHead`] as JSON.
pub fn configuration_key(site: &str, machine: &str, boot: BootId) -> String {
    format!("{ROOT}/{site}/{machine}/configuration/{boot}")
}

/// The liveliness token of one run of a machine.
pub fn alive_key(site: &str, machine: &str, boot: BootId) -> String {
    format!("{ROOT}/{site}/{machine}/alive/{boot}")
}

/// One topic of every machine of a site.
pub fn topic_selector(site: &str, topic: Topic) -> String {
    topic_key(site, "*", topic)
}

/// The liveliness tokens of every machine of a site.
pub fn alive_selector(site: &str) -> String {
    format!("{ROOT}/{site}/*/alive/*")
}

/// A key, taken apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Key<'a> {
    /// A topic.
    Topic {
        /// The site's id.
        site: &'a str,
        /// The machine's id.
        machine: &'a str,
        /// What is published.
        topic: Topic,
    },
    /// A liveliness token.
    Alive {
        /// The site's id.
        site: &'a str,
        /// The machine's id.
        machine: &'a str,
        /// The run that is alive.
        boot: BootId,
    },
}

/// A key that is none of ours.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("key \"{key}\": {reason}")]
pub struct KeyError {
    key: String,
    reason: String,
}

impl<'a> Key<'a> {
    /// Takes a key apart.
    ///
    /// # Errors
    /// [`KeyError`] says which part is wrong.
    pub fn parse(key: &'a str) -> Result<Self, KeyError> {
        let error = |reason: String| KeyError { key: key.chars().take(200).collect(), reason };
        let mut parts = key.splitn(4, '/');
        let mut part = || parts.next().unwrap_or("");
        let (root, site, machine, rest) = (part(), part(), part(), part());
        if root != ROOT {
            return Err(error(format!("must begin with {ROOT}/")));
        }
        for (what, id) in [("site", site), ("machine", machine)] {
            let plain = id.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-');
            if !plain || !(1..=64).contains(&id.len()) {
                return Err(error(format!("the {what}'s id must be 1 to 64 letters, digits and '-'")));
            }
        }
        if let Some(boot) = rest.strip_prefix("alive/") {
            let boot = boot.parse().map_err(error)?;
            return Ok(Key::Alive { site, machine, boot });
        }
        let topic = Topic::from_name(rest).ok_or_else(|| error("unknown topic".to_owned()))?;
        Ok(Key::Topic { site, machine, topic })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensors::Sensor;

    #[test]
    fn keys_are_as_documented_and_come_back() {
        assert_eq!(topic_key("site", "a-1", Topic::Pose), "holdfast/site/a-1/pose");
        assert_eq!(topic_selector("site", Topic::Health), "holdfast/site/*/health");
        for topic in Topic::ALL {
            let key = topic_key("site", "a-1", topic);
            assert_eq!(Key::parse(&key), Ok(Key::Topic { site: "site", machine: "a-1", topic }));
        }
        let imu = topic_key("s", "m", Topic::Sensor(Sensor::Imu));
        assert_eq!(imu, "holdfast/s/m/sensor/imu");
        let boot = BootId(0xff);
        let alive = alive_key("s", "m", boot);
        assert_eq!(alive, "holdfast/s/m/alive/00000000000000ff");
        assert_eq!(Key::parse(&alive), Ok(Key::Alive { site: "s", machine: "m", boot }));
        assert_eq!(record_key("s", "m", boot), "holdfast/s/m/record/00000000000000ff");
        assert_eq!(configuration_key("s", "m", boot), "holdfast/s/m/configuration/00000000000000ff");
    }

    #[test]
    fn foreign_keys_are_refused_with_the_part_that_is_wrong() {
        for (key, reason) in [
            ("", "begin with"),
            ("fleet/s/m/pose", "begin with"),
            ("holdfast/s", "machine's id"),
            ("holdfast//m/pose", "site's id"),
            ("holdfast/s/m_1/pose", "machine's id"),
            ("holdfast/s/m", "unknown topic"),
            ("holdfast/s/m/pose/x", "unknown topic"),
            ("holdfast/s/m/alive/xyz", "hexadecimal"),
        ] {
            let message = Key::parse(key).expect_err(key).to_string();
            assert!(message.contains(reason), "{message}");
        }
        let long = format!("holdfast/{}/m/pose", "x".repeat(100_000));
        assert!(Key::parse(&long).expect_err("long").to_string().len() < 400);
    }
}
