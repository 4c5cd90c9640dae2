//! What a client can subscribe to.

use std::sync::Arc;

use serde_json::{Value, json};

use crate::sensors::Sensor;
use crate::wire::{Schema, Topic, schema_of};

/// Of messages in JSON, which describe themselves: any object.
const ANY_OBJECT: &str = "{\"type\":\"object\",\"properties\":{}}";
/// Ids of a machine's channels begin at a multiple of it.
const IDS_OF_A_MACHINE: u32 = 16;

/// What a channel says of its machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// A topic, as the machine sent it.
    Sent(Topic),
    /// Places of its frames.
    Transforms,
    /// Where it is on the earth.
    Location,
    /// Its events, in words.
    Log,
}

impl Kind {
    /// All there are; ids count along it, so only the end may grow.
    const ALL: [Kind; 13] = [
        Kind::Sent(Topic::Pose),
        Kind::Sent(Topic::Odom),
        Kind::Sent(Topic::Health),
        Kind::Sent(Topic::Event),
        Kind::Sent(Topic::Sensor(Sensor::Imu)),
        Kind::Sent(Topic::Sensor(Sensor::BaseImu)),
        Kind::Sent(Topic::Sensor(Sensor::GnssLeft)),
        Kind::Sent(Topic::Sensor(Sensor::GnssRight)),
        Kind::Sent(Topic::Sensor(Sensor::LidarOdometry)),
        Kind::Sent(Topic::Sensor(Sensor::CabinTurn)),
        Kind::Transforms,
        Kind::Location,
        Kind::Log,
    ];

    /// What comes of the messages of a topic.
    pub fn of(topic: Topic) -> &'static [Kind] {
        match topic {
            Topic::Pose => &[Kind::Sent(Topic::Pose), Kind::Transforms, Kind::Location],
            Topic::Odom => &[Kind::Sent(Topic::Odom), Kind::Transforms],
            Topic::Health => &[Kind::Sent(Topic::Health), Kind::Transforms],
            Topic::Event => &[Kind::Sent(Topic::Event), Kind::Log],
            // For replay, and for nobody to look at.
            Topic::Journal => &[],
            Topic::Sensor(Sensor::Imu) => &[Kind::Sent(Topic::Sensor(Sensor::Imu))],
            Topic::Sensor(Sensor::BaseImu) => &[Kind::Sent(Topic::Sensor(Sensor::BaseImu))],
            Topic::Sensor(Sensor::GnssLeft) => &[Kind::Sent(Topic::Sensor(Sensor::GnssLeft))],
            Topic::Sensor(Sensor::GnssRight) => &[Kind::Sent(Topic::Sensor(Sensor::GnssRight))],
            Topic::Sensor(Sensor::LidarOdometry) => &[Kind::Sent(Topic::Sensor(Sensor::LidarOdometry))],
            Topic::Sensor(Sensor::CabinTurn) => &[Kind::Sent(Topic::Sensor(Sensor::CabinTurn))],
        }
    }

    /// Where the kind stands among all.
    pub fn index(self) -> u32 {
        Self::ALL.iter().position(|kind| *kind == self).map_or(Self::ALL.len() as u32, |index| index as u32)
    }

    /// Number of the channel, for the machine of that number.
    pub fn channel(self, machine: u32) -> u32 {
        machine * IDS_OF_A_MACHINE + self.index()
    }

    fn name(self) -> &'static str {
        match self {
            Kind::Sent(topic) => topic.name(),
            Kind::Transforms => "tf",
            Kind::Location => "location",
            Kind::Log => "log",
        }
    }

    fn schema(self) -> Option<Schema> {
        match self {
            Kind::Sent(topic) => schema_of(topic),
            Kind::Transforms => Some(Schema::TRANSFORMS),
            Kind::Location => Some(Schema::LOCATION),
            Kind::Log => Some(Schema::LOG),
        }
    }
}

/// A channel of a machine.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Channel {
    pub id: u32,
    pub machine: Arc<str>,
    pub kind: Kind,
}

impl Channel {
    pub fn new(number: u32, machine: &Arc<str>, kind: Kind) -> Self {
        Self { id: kind.channel(number), machine: Arc::clone(machine), kind }
    }

    /// As it is advertised.
    pub fn advertisement(&self) -> Value {
        let topic = format!("/{}/{}", self.machine, self.kind.name());
        let (encoding, name, schema, schema_encoding) = match self.kind.schema() {
            Some(Schema { name, definition }) => ("cdr", name, definition, "ros2msg"),
            None if self.kind == Kind::Sent(Topic::Health) => {
                ("json", "holdfast.Health", ANY_OBJECT, "jsonschema")
            }
            None => ("json", "holdfast.Event", ANY_OBJECT, "jsonschema"),
        };
        json!({"id": self.id, "topic": topic, "encoding": encoding, "schemaName": name, "schema": schema,
            "schemaEncoding": schema_encoding})
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_every_topic_has_a_number_of_its_own() {
        let mut ids: Vec<u32> = Kind::ALL.iter().map(|kind| kind.channel(7)).collect();
        assert!(ids.iter().all(|id| (112..128).contains(id)), "{ids:?}");
        ids.dedup();
        assert_eq!(ids.len(), Kind::ALL.len());
        for topic in Topic::ALL {
            assert!(Kind::of(topic).iter().all(|kind| Kind::ALL.contains(kind)), "{topic}");
            assert_eq!(Kind::of(topic).contains(&Kind::Sent(topic)), topic != Topic::Journal, "{topic}");
        }
    }

    #[test]
    fn channels_are_named_and_described_as_in_a_recording() {
        let machine: Arc<str> = "yard-1".into();
        let of = |kind| Channel::new(0, &machine, kind).advertisement();
        let pose = of(Kind::Sent(Topic::Pose));
        assert_eq!((&pose["topic"], &pose["encoding"]), (&"/yard-1/pose".into(), &"cdr".into()));
        assert_eq!(pose["schemaName"], "nav_msgs/msg/Odometry");
        assert_eq!(pose["schemaEncoding"], "ros2msg");
        assert_eq!(of(Kind::Sent(Topic::Health))["encoding"], "json");
        assert_eq!(of(Kind::Location)["schemaName"], "sensor_msgs/msg/NavSatFix");
    }
}
