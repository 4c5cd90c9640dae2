//! JSON on the wire: in which order the estimator took its readings, and where it took over solutions.

use serde::{Deserialize, Serialize};

use super::{BootId, WireError};
use crate::sensors::Sensor;

/// Readings of a page at most; a page ends earlier where a solution was taken over.
pub const PAGE_READINGS_MAX: usize = 256;

/// Topic `journal`: a page of what the predictor did since the boot.
///
/// The pages of a boot follow each other without a gap. With the readings of all sensors, whose messages are
/// numbered by topic, they say all that is needed to get the machine's estimates again to the bit: the order of
/// the readings does not rest on any clock.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JournalPage {
    /// The run of the process that took the readings.
    pub boot: BootId,
    /// On the first page of a boot: who takes the readings. `None` on all others, and from software that does not
    /// tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub head: Option<Box<JournalHead>>,
    /// Number of the page's first reading, counted over all sensors from 0.
    pub first: u64,
    /// So many solutions were taken over since the boot before this page.
    pub takeovers: u64,
    /// One letter for each reading, in order: `i` cabin IMU, `b` chassis IMU, `l` and `r` left and right antenna,
    /// `o` lidar odometry, `t` cabin turn.
    pub sensors: String,
    /// Numbers of those readings that the updater had no room for, so that only the predictor took them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unseen: Vec<u64>,
    /// After the page's last reading the predictor took over the solution to which the reading of this number
    /// led; `null` if the page was only full.
    pub taken_over: Option<u64>,
}

/// What one must know, beside readings and journal, to get the estimates of a boot again.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JournalHead {
    /// Version of the machine's software.
    pub software: String,
    /// The machine file, TOML, with all defaults.
    pub machine_file: String,
}

impl JournalPage {
    /// An empty page.
    pub fn new(boot: BootId, first: u64, takeovers: u64) -> Self {
        Self { boot, head: None, first, takeovers, sensors: String::new(), unseen: vec![], taken_over: None }
    }

    /// Number of the reading after the page's last.
    pub fn end(&self) -> u64 {
        self.first.saturating_add(self.sensors.len() as u64)
    }

    /// Whether nothing is on it.
    pub fn is_empty(&self) -> bool {
        self.sensors.is_empty() && self.taken_over.is_none()
    }

    /// The page after this one, empty.
    pub fn next(&self) -> Self {
        Self::new(self.boot, self.end(), self.takeovers + u64::from(self.taken_over.is_some()))
    }

    /// Adds the next reading.
    pub fn push(&mut self, sensor: Sensor, seen: bool) {
        if !seen {
            self.unseen.push(self.end());
        }
        self.sensors.push(letter(sensor));
    }

    /// The sensors of its readings, in order.
    ///
    /// # Errors
    /// [`WireError::Unusable`] names a letter that is none of ours.
    pub fn sensors(&self) -> Result<Vec<Sensor>, WireError> {
        let sensor = |found: char| Sensor::ALL.into_iter().find(|sensor| letter(*sensor) == found);
        let unknown = |found: char| WireError::Unusable {
            message: "journal page",
            reason: format!("'{}' stands for no sensor", found.escape_default()),
        };
        self.sensors.chars().map(|found| sensor(found).ok_or_else(|| unknown(found))).collect()
    }
}

const fn letter(sensor: Sensor) -> char {
    match sensor {
        Sensor::Imu => 'i',
        Sensor::BaseImu => 'b',
        Sensor::GnssLeft => 'l',
        Sensor::GnssRight => 'r',
        Sensor::LidarOdometry => 'o',
        Sensor::CabinTurn => 't',
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::{decode_journal_page, encode_json};

    #[test]
    fn page_is_as_documented_and_comes_back() {
        let mut page = JournalPage::new(BootId(0xab), 7, 3);
        Sensor::ALL.into_iter().for_each(|sensor| page.push(sensor, sensor != Sensor::GnssLeft));
        page.taken_over = Some(9);
        assert_eq!((page.end(), page.sensors.as_str()), (13, "iblrot"));
        let bytes = encode_json("journal page", &page).expect("JSON");
        let text = std::str::from_utf8(&bytes).expect("UTF-8");
        assert_eq!(
            text,
            r#"{"boot":"00000000000000ab","first":7,"takeovers":3,"sensors":"iblrot","unseen":[9],"taken_over":9}"#
        );
        let back = decode_journal_page(&bytes).expect("own bytes");
        assert_eq!(back, page);
        assert_eq!(back.sensors().expect("ours"), Sensor::ALL);
        let plain = JournalPage::new(BootId(1), 0, 0);
        assert!(plain.is_empty() && !page.is_empty());
        assert_eq!(page.next(), JournalPage::new(page.boot, 13, 4));
        let bytes = encode_json("journal page", &plain).expect("JSON");
        assert_eq!(decode_journal_page(&bytes).expect("own bytes"), plain);
        let head = JournalHead { software: "0.1.0".to_owned(), machine_file: "id = \"a\"\n".to_owned() };
        let first = JournalPage { head: Some(Box::new(head)), ..plain };
        let bytes = encode_json("journal page", &first).expect("JSON");
        assert_eq!(decode_journal_page(&bytes).expect("own bytes"), first);
        assert_eq!(first.next().head, None);
    }

    #[test]
    fn what_is_no_page_is_refused() {
        let mut page = JournalPage::new(BootId(1), u64::MAX, 0);
        page.sensors = "ix".to_owned();
        assert!(page.sensors().expect_err("x").to_string().contains("'x' stands for no sensor"));
        assert_eq!(page.end(), u64::MAX);
        assert!(decode_journal_page(b"{}").is_err());
    }
}
