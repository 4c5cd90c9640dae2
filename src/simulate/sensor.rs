//! Sensors on the machine but for GNSS: what they read of the true motion.

use super::dice::Dice;
use super::motion::Bodies;
use super::specification::{CabinTurn, Imu, LidarOdometry};
use crate::frames::Pose;
use crate::lie::{Se3, So3, Vec3};
use crate::sensors::{self, ImuSample, LidarPose, Reading};
use crate::time::Stamp;

/// Something that measures.
pub(super) trait Source: Send {
    /// What it reads at `stamp`; nothing if it misses the moment.
    fn read(&mut self, stamp: Stamp, bodies: &Bodies) -> Option<Reading>;

    /// Gyro and accelerometer bias at the newest reading, of the IMU on that body.
    fn imu_bias(&self, _carrier: Carrier) -> Option<[Vec3; 2]> {
        None
    }
}

/// On which body an IMU sits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Carrier {
    Cabin,
    Base,
}

/// An IMU: the motion at its stamp, bias, white noise and the engine.
pub(super) struct ImuSource {
    carrier: Carrier,
    body_from_imu: Se3,
    gravity: Vec3,
    specification: Imu,
    engine: Engine,
    gyro_bias: Vec3,
    accel_bias: Vec3,
    last_stamp: Option<Stamp>,
    dice: Dice,
}

impl ImuSource {
    pub(super) fn new(
        carrier: Carrier,
        body_from_imu: Se3,
        gravity: Vec3,
        specification: Imu,
        mut dice: Dice,
    ) -> Self {
        let engine = Engine::new(&specification, &mut dice);
        let gyro_bias = dice.offsets(specification.gyroscope_bias);
        let accel_bias = dice.offsets(specification.accelerometer_bias);
        let last_stamp = None;
        Self {
            carrier,
            body_from_imu,
            gravity,
            specification,
            engine,
            gyro_bias,
            accel_bias,
            last_stamp,
            dice,
        }
    }
}

impl Source for ImuSource {
    fn read(&mut self, stamp: Stamp, bodies: &Bodies) -> Option<Reading> {
        let body = match self.carrier {
            Carrier::Cabin => &bodies.cabin,
            Carrier::Base => &bodies.base,
        };
        let motion = body.mounted(&self.body_from_imu);
        let specification = &self.specification;
        // The walk and the white noise draw the same numbers whatever their size.
        let walks = [self.dice.normals(), self.dice.normals()];
        let whites = [self.dice.normals(), self.dice.normals()];
        if let Some(last_stamp) = self.last_stamp {
            let root_s = stamp.seconds_since(last_stamp).sqrt();
            self.gyro_bias += walks[0] * (specification.gyroscope_random_walk * root_s);
            self.accel_bias += walks[1] * (specification.accelerometer_random_walk * root_s);
        }
        self.last_stamp = Some(stamp);
        let root_rate = specification.rate_hz.sqrt();
        let [shake_rate, shake] = self.engine.at(stamp);
        let angular_rate = motion.angular_rate
            + self.gyro_bias
            + whites[0] * (specification.gyroscope_noise_density * root_rate)
            + shake_rate;
        let specific_force = motion.specific_force(&self.gravity)
            + self.accel_bias
            + whites[1] * (specification.accelerometer_noise_density * root_rate)
            + shake;
        let sample = ImuSample { stamp, angular_rate, specific_force };
        Some(match self.carrier {
            Carrier::Cabin => Reading::Imu(sample),
            Carrier::Base => Reading::BaseImu(sample),
        })
    }

    fn imu_bias(&self, carrier: Carrier) -> Option<[Vec3; 2]> {
        (self.carrier == carrier).then_some([self.gyro_bias, self.accel_bias])
    }
}

/// Vibration of the engine. The IMU does shake by it, but by some micrometres: the truth leaves it out.
struct Engine {
    /// Middle and half range.
    frequency_hz: [f64; 2],
    /// Middle and half range.
    amplitude: [f64; 2],
    amplitude_radps: f64,
    direction: Vec3,
    direction_of_rate: Vec3,
    /// Phase of each axis, and of the slow changes of frequency and amplitude.
    phases: Vec3,
    slow_phases: [f64; 2],
}

impl Engine {
    /// Periods in which speed and load of the engine change, s.
    const SPEED_PERIOD_S: f64 = 23.0;
    const LOAD_PERIOD_S: f64 = 7.0;

    fn new(specification: &Imu, dice: &mut Dice) -> Self {
        let middle = |[low, high]: [f64; 2]| [0.5 * (low + high), 0.5 * (high - low)];
        let turn = std::f64::consts::TAU;
        Self {
            frequency_hz: middle(specification.vibration_hz),
            amplitude: middle(specification.vibration_mps2),
            amplitude_radps: specification.vibration_radps,
            direction: dice.offsets(1.0).normalize(),
            direction_of_rate: dice.offsets(1.0).normalize(),
            phases: Vec3::new(dice.uniform(0.0, turn), dice.uniform(0.0, turn), dice.uniform(0.0, turn)),
            slow_phases: [dice.uniform(0.0, turn), dice.uniform(0.0, turn)],
        }
    }

    /// Disturbance of the angular rate (rad/s) and of the specific force (m/s²).
    fn at(&self, stamp: Stamp) -> [Vec3; 2] {
        let time_s = stamp.as_seconds();
        let slow = std::f64::consts::TAU / Self::SPEED_PERIOD_S;
        // The phase is the integral of the frequency, middle + half range * sin.
        let [middle_hz, half_range_hz] = self.frequency_hz;
        let turns =
            middle_hz * time_s - half_range_hz / slow * libm::cos(slow * time_s + self.slow_phases[0]);
        let phase = std::f64::consts::TAU * turns.fract();
        let load = libm::sin(std::f64::consts::TAU / Self::LOAD_PERIOD_S * time_s + self.slow_phases[1]);
        let amplitude = self.amplitude[0] + self.amplitude[1] * load;
        let wave = self.phases.map(|axis| libm::sin(phase + axis));
        [
            self.direction_of_rate.component_mul(&wave) * self.amplitude_radps,
            self.direction.component_mul(&wave) * amplitude,
        ]
    }
}

/// Lidar odometry: true increments, each a little off, chained.
pub(super) struct LidarSource {
    cabin_from_lidar: Se3,
    specification: LidarOdometry,
    last: Option<Se3>,
    lidarmap_from_lidar: Se3,
    dice: Dice,
}

impl LidarSource {
    pub(super) fn new(cabin_from_lidar: Se3, specification: LidarOdometry, dice: Dice) -> Self {
        Self { cabin_from_lidar, specification, last: None, lidarmap_from_lidar: Se3::identity(), dice }
    }
}

impl Source for LidarSource {
    fn read(&mut self, stamp: Stamp, bodies: &Bodies) -> Option<Reading> {
        let world_from_lidar = bodies.cabin.pose * self.cabin_from_lidar;
        let turn = self.dice.normals() * self.specification.increment_sigma_deg.to_radians();
        let shift = self.dice.normals() * self.specification.increment_sigma_m;
        let scale = 1.0 + self.dice.normal() * self.specification.increment_sigma_scale;
        if let Some(last) = self.last {
            let increment = last.inverse() * world_from_lidar;
            let seen = Se3::new(increment.rotation.plus(&turn), increment.translation * scale + shift);
            let next = self.lidarmap_from_lidar * seen;
            self.lidarmap_from_lidar = Se3::new(next.rotation.renormalized(), next.translation);
        }
        self.last = Some(world_from_lidar);
        let lidarmap_from_lidar = Pose::assume(self.lidarmap_from_lidar);
        Some(Reading::LidarOdometry(LidarPose { stamp, lidarmap_from_lidar }))
    }
}

/// The cabin-turn encoder.
pub(super) struct EncoderSource {
    specification: CabinTurn,
}

impl EncoderSource {
    pub(super) fn new(specification: CabinTurn) -> Self {
        Self { specification }
    }
}

impl Source for EncoderSource {
    fn read(&mut self, stamp: Stamp, bodies: &Bodies) -> Option<Reading> {
        let angle = bodies.cabin_turn.value;
        let angle_rad = match self.specification.steps {
            0 => angle,
            steps => {
                let step = std::f64::consts::TAU / f64::from(steps);
                (angle / step).round() * step
            }
        };
        Some(Reading::CabinTurn(sensors::CabinTurn { stamp, angle_rad }))
    }
}

/// Antenna positions need no rotation.
pub(super) fn at_point(translation_m: [f64; 3]) -> Se3 {
    Se3::new(So3::identity(), Vec3::from_row_slice(&translation_m))
}
