//! Excavators that are not there: smooth exact truth from a scenario file, and what the sensors make of it.
//!
//! [`Simulation`] yields one machine's readings in the order of their arrival, lazily and for ever if the
//! scenario repeats. Same scenario, same bits: every purpose has a generator of its own, derived from the
//! scenario's seed, the machine's id and the purpose's name, so that a change of one sensor leaves the
//! others as they were. Time starts at 0. Pace and clocks are the caller's.

mod clock;
mod dice;
mod glide;
mod gnss;
mod jet;
mod motion;
mod path;
mod recording;
mod rigid;
mod scenario;
mod sensor;
mod specification;
mod write;

#[cfg(test)]
mod tests;

pub use recording::write_recording;
pub use rigid::RigidMotion;
pub use scenario::{Action, GnssCondition, GnssConditionKind, Machine, Scenario, ScenarioFile};
pub use specification::{CabinTurn, Gnss, Imu, LidarOdometry, Sensors};
pub use write::{Progress, write};

use crate::config;
use crate::frames::{Base, Pose, World};
use crate::sensors::{Arrival, Reading};
use crate::state::NavState;
use crate::time::{Span, Stamp};

use clock::{Clock, Tick};
use dice::Dice;
use gnss::{AntennaSource, Interval, Receiver, Side, Sky};
use motion::Motion;
use sensor::{Carrier, EncoderSource, ImuSource, LidarSource, Source, at_point};

/// What is true at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Truth {
    /// When.
    pub stamp: Stamp,
    /// The cabin IMU. Its biases are those of the newest reading that the simulation has drawn, at
    /// whatever stamp.
    pub state: NavState,
    /// The cabin IMU's motion with its second derivatives.
    pub imu: RigidMotion,
    /// The chassis.
    pub world_from_base: Pose<World, Base>,
    /// The chassis' motion with its second derivatives.
    pub base: RigidMotion,
    /// Cabin against chassis, rad, not wrapped.
    pub cabin_turn_rad: f64,
    /// rad/s.
    pub cabin_turn_rate: f64,
}

/// One machine of a scenario: an iterator over its readings in the order of their arrival.
pub struct Simulation {
    machine: config::Machine,
    motion: Motion,
    sky: Sky,
    sensors: Vec<SimulatedSensor>,
    /// Readings after it are not taken; `None` never ends.
    end: Option<Stamp>,
}

/// A sensor and its next reading.
struct SimulatedSensor {
    clock: Clock,
    source: Box<dyn Source>,
    tick: Tick,
    reading: Option<Reading>,
}

impl Simulation {
    /// The machine at `index` of the scenario's machines.
    ///
    /// # Panics
    /// If there is no machine at that index.
    pub fn new(scenario: &Scenario, index: usize) -> Self {
        let machine = scenario.machines[index].clone();
        let (seed, id) = (scenario.file.seed, machine.id.as_str());
        let acting = &scenario.file.machine[index];
        let repeat = scenario.file.repeat;
        let frames = &machine.frames;
        let base_from_cabin = *frames.base_from_cabin.pose::<(), ()>().motion();
        let motion = Motion::new(acting, base_from_cabin, repeat, seed, id);
        let sky = sky(scenario, id, repeat.then(|| Span::from_seconds(motion.period_s())));

        let site = machine.world.site_frame();
        let dice = |purpose: &str| Dice::new(seed, id, purpose);
        let mut sensors = acting.sensors.unwrap_or(scenario.file.sensors);
        sensors.imu.rate_hz = machine.imu.update_rate;
        let imu = |carrier, transform: &config::Transform, specification, name: &str| {
            let body_from_imu = *transform.pose::<(), ()>().motion();
            let noise = dice(&format!("{name}/noise"));
            ImuSource::new(carrier, body_from_imu, site.gravity(), specification, noise)
        };
        let antenna = |side, transform: &config::Transform, name: &str| {
            let receiver = Receiver::new(sky.clone(), dice("gnss/receiver"));
            let offsets = dice(&format!("{name}/multipath"));
            let noise = [dice(&format!("{name}/noise")), dice(&format!("{name}/slow noise"))];
            let at = at_point(transform.translation_m);
            AntennaSource::new(side, at, site, sensors.gnss, receiver, offsets, noise)
        };
        let cabin_from_lidar = *frames.cabin_from_lidar.pose::<(), ()>().motion();
        let lidar = LidarSource::new(cabin_from_lidar, sensors.lidar_odometry, dice("lidar_odometry/noise"));
        // In the order of `Sensor`, which settles ties.
        let mut sources: Vec<(specification::Timing, &str, Box<dyn Source>)> = Vec::new();
        let cabin_imu = imu(Carrier::Cabin, &frames.cabin_from_imu, sensors.imu, "imu");
        sources.push((sensors.imu.timing(), "imu/clock", Box::new(cabin_imu)));
        let base_imu = imu(Carrier::Base, &frames.base_from_base_imu, sensors.base_imu, "base_imu");
        sources.push((sensors.base_imu.timing(), "base_imu/clock", Box::new(base_imu)));
        // One receiver: both antennas measure and arrive together.
        let left = antenna(Side::Left, &frames.cabin_from_gnss_left, "gnss_left");
        sources.push((sensors.gnss.timing(), "gnss/clock", Box::new(left)));
        if let Some(transform) = &frames.cabin_from_gnss_right {
            let right = antenna(Side::Right, transform, "gnss_right");
            sources.push((sensors.gnss.timing(), "gnss/clock", Box::new(right)));
        }
        sources.push((sensors.lidar_odometry.timing(), "lidar_odometry/clock", Box::new(lidar)));
        let encoder = EncoderSource::new(sensors.cabin_turn);
        sources.push((sensors.cabin_turn.timing(), "cabin_turn/clock", Box::new(encoder)));

        let sensors = sources
            .into_iter()
            .map(|(timing, purpose, mut source)| {
                let mut clock = Clock::new(timing, dice(purpose));
                let tick = clock.tick();
                let reading = source.read(tick.stamp, &motion.at(tick.stamp));
                SimulatedSensor { clock, source, tick, reading }
            })
            .collect();
        let end = (!repeat).then(|| Stamp::from_seconds(scenario.file.duration_s));
        Self { machine, motion, sky, sensors, end }
    }

    /// The machine's file.
    pub fn machine(&self) -> &config::Machine {
        &self.machine
    }

    /// Ends the readings at `end`, also where the scenario repeats.
    pub fn ending_at(mut self, end: Stamp) -> Self {
        self.end = Some(end);
        self
    }

    /// What GNSS is like from 0 to `end`: consecutive intervals, each `good` or with the scenario's word.
    pub fn gnss_conditions(&self, end: Stamp) -> Vec<(Stamp, Stamp, &'static str)> {
        self.sky.conditions(end)
    }

    /// What is true at `stamp`.
    pub fn truth(&self, stamp: Stamp) -> Truth {
        let bodies = self.motion.at(stamp);
        let imu = bodies.cabin.mounted(self.machine.frames.cabin_from_imu.pose::<(), ()>().motion());
        let [gyro_bias, accel_bias] =
            self.sensors.iter().find_map(|sensor| sensor.source.imu_bias(Carrier::Cabin)).unwrap_or_default();
        let [base_gyro_bias, _] =
            self.sensors.iter().find_map(|sensor| sensor.source.imu_bias(Carrier::Base)).unwrap_or_default();
        let base_gyro_bias =
            (self.machine.frames.base_from_base_imu.pose::<(), ()>().rotation() * base_gyro_bias).z;
        Truth {
            stamp,
            state: NavState {
                rotation: imu.pose.rotation,
                position: imu.pose.translation,
                velocity: imu.velocity,
                gyro_bias,
                accel_bias,
                base_gyro_bias,
            },
            imu,
            world_from_base: Pose::assume(bodies.base.pose),
            base: bodies.base,
            cabin_turn_rad: bodies.cabin_turn.value,
            cabin_turn_rate: bodies.cabin_turn.rate,
        }
    }
}

/// Yields readings in the order of their arrival; equal times in the order of `Sensor`.
impl Iterator for Simulation {
    type Item = Arrival;

    fn next(&mut self) -> Option<Arrival> {
        loop {
            let ended = |tick: &Tick| self.end.is_some_and(|end| tick.stamp > end);
            let sensor = self
                .sensors
                .iter_mut()
                .filter(|sensor| !ended(&sensor.tick))
                .min_by_key(|sensor| sensor.tick.arrival)?;
            let arrival = sensor.tick.arrival;
            let reading = sensor.reading.take();
            sensor.tick = sensor.clock.tick();
            let bodies = self.motion.at(sensor.tick.stamp);
            sensor.reading = sensor.source.read(sensor.tick.stamp, &bodies);
            if let Some(reading) = reading {
                return Some(Arrival { arrival, reading });
            }
        }
    }
}

fn sky(scenario: &Scenario, id: &str, period: Option<Span>) -> Sky {
    let intervals = scenario
        .file
        .gnss_condition
        .iter()
        .filter(|condition| condition.machines.is_empty() || condition.machines.iter().any(|name| name == id))
        .map(|condition| Interval {
            start: Stamp::from_seconds(condition.start_s),
            end: Stamp::from_seconds(condition.end_s),
            kind: condition.kind,
            offset_m: condition.offset_m,
        })
        .collect();
    Sky { intervals, period }
}
