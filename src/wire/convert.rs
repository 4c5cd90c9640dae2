//! Readings and estimates as ROS 2 messages, and readings back from them.
//!
//! A fit reading comes back to the bit: sigmas travel as squares, and the root of a square is exact in binary
//! floating point.

use nalgebra::SMatrix;

use super::WireError;
use super::messages::{Header, Imu, JointState, NavSatFix, NavSatStatus, Odometry, RosMessage};
use crate::frames::geodesy::Geodetic;
use crate::frames::{self, Frame, Pose};
use crate::lie::{Mat3, Se3, So3, Vec3, hat};
use crate::sensors::{CabinTurn, GnssFix, ImuSample, LidarPose, Reading, Sensor};
use crate::state::{Estimate, STATE_DIM, row};

/// First element of a covariance whose value is not given at all (`sensor_msgs/Imu`).
const NOT_GIVEN: f64 = -1.0;
/// `NavSatStatus.STATUS_NO_FIX`.
const STATUS_NO_FIX: i8 = -1;
/// `NavSatStatus.SERVICE_GPS`.
const SERVICE_GPS: u16 = 1;
/// `NavSatFix.COVARIANCE_TYPE_UNKNOWN`.
const COVARIANCE_UNKNOWN: u8 = 0;
/// `NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN`.
const COVARIANCE_DIAGONAL: u8 = 2;
/// Rows and columns of a pose's or a twist's covariance.
const ROS_DIM: usize = 6;

type RosMatrix = SMatrix<f64, ROS_DIM, ROS_DIM>;
type RosFromState = SMatrix<f64, ROS_DIM, STATE_DIM>;

/// The ROS 2 message of a reading, as CDR.
pub fn encode_reading(reading: &Reading) -> Vec<u8> {
    match reading {
        Reading::Imu(sample) => imu_message(sample, frames::Imu::NAME).encode(),
        Reading::BaseImu(sample) => imu_message(sample, frames::BaseImu::NAME).encode(),
        Reading::GnssLeft(fix) | Reading::GnssRight(fix) => {
            fix_message(fix, reading.sensor().name()).encode()
        }
        Reading::LidarOdometry(pose) => lidar_message(pose).encode(),
        Reading::CabinTurn(turn) => JointState {
            header: Header::new(turn.stamp, frames::Base::NAME),
            name: vec![Sensor::CabinTurn.name().to_owned()],
            position: vec![turn.angle_rad],
            velocity: vec![],
            effort: vec![],
        }
        .encode(),
    }
}

/// The reading of a sensor from its ROS 2 message. Whether its numbers can be a measurement is asked by
/// [`Reading::check`], not here.
///
/// # Errors
/// [`WireError`] if the bytes are not that message, or the message says that it holds no measurement.
pub fn decode_reading(sensor: Sensor, bytes: &[u8]) -> Result<Reading, WireError> {
    Ok(match sensor {
        Sensor::Imu => Reading::Imu(imu_sample(&Imu::decode(bytes)?)?),
        Sensor::BaseImu => Reading::BaseImu(imu_sample(&Imu::decode(bytes)?)?),
        Sensor::GnssLeft => Reading::GnssLeft(gnss_fix(&NavSatFix::decode(bytes)?)?),
        Sensor::GnssRight => Reading::GnssRight(gnss_fix(&NavSatFix::decode(bytes)?)?),
        Sensor::LidarOdometry => Reading::LidarOdometry(lidar_pose(&Odometry::decode(bytes)?)?),
        Sensor::CabinTurn => Reading::CabinTurn(cabin_turn(&JointState::decode(bytes)?)?),
    })
}

/// Topic `pose`: the IMU in the site frame, with covariances in ROS order.
///
/// The pose's covariance is that of (position, rotation about the world's axes), `[p; R θ]` of the state's
/// tangent; the twist's is that of the velocity in the IMU frame, `Rᵀ v`, and of the angular rate, whose
/// error is the gyro bias.
pub fn pose_message(estimate: &Estimate) -> Odometry {
    let rotation = estimate.state.rotation.matrix();
    let velocity_in_imu = estimate.state.rotation.inverse() * estimate.state.velocity;
    let mut pose_from_state = RosFromState::zeros();
    set(&mut pose_from_state, 0, row::POSITION, &Mat3::identity());
    set(&mut pose_from_state, 3, row::ROTATION, &rotation);
    let pose_covariance = propagated(&pose_from_state, estimate);
    odometry(
        estimate,
        [frames::World::NAME, frames::Imu::NAME],
        estimate.world_from_imu().motion(),
        [velocity_in_imu, estimate.angular_rate_in_imu],
        [pose_covariance, imu_twist_covariance(estimate)],
    )
}

/// Topic `odom`: the chassis in the odom frame, or the IMU if the chassis is not known. The covariance of the
/// pose in a frame that drifts is not estimated: zeros, which say so in ROS.
pub fn odom_message(estimate: &Estimate) -> Odometry {
    let unknown = [0.0; ROS_DIM * ROS_DIM];
    match &estimate.base {
        Some(base) => odometry(
            estimate,
            [frames::Odom::NAME, frames::Base::NAME],
            base.odom_from_base.motion(),
            [base.velocity_in_base, base.angular_rate_in_base],
            [unknown, unknown],
        ),
        None => odometry(
            estimate,
            [frames::Odom::NAME, frames::Imu::NAME],
            estimate.odom_from_imu.motion(),
            [estimate.state.rotation.inverse() * estimate.state.velocity, estimate.angular_rate_in_imu],
            [unknown, imu_twist_covariance(estimate)],
        ),
    }
}

fn odometry(
    estimate: &Estimate,
    [frame, child]: [&str; 2],
    motion: &Se3,
    [linear, angular]: [Vec3; 2],
    [pose_covariance, twist_covariance]: [[f64; ROS_DIM * ROS_DIM]; 2],
) -> Odometry {
    Odometry {
        header: Header::new(estimate.stamp, frame),
        child_frame_id: child.to_owned(),
        position: motion.translation.into(),
        orientation: motion.rotation.to_xyzw(),
        pose_covariance,
        linear: linear.into(),
        angular: angular.into(),
        twist_covariance,
    }
}

/// With `R exp(θ)` for the rotation, the velocity in the IMU frame moves by `Rᵀ δv + [Rᵀ v]× θ`, and the
/// angular rate by the negative gyro bias.
fn imu_twist_covariance(estimate: &Estimate) -> [f64; ROS_DIM * ROS_DIM] {
    let imu_from_world = estimate.state.rotation.matrix().transpose();
    let velocity_in_imu = imu_from_world * estimate.state.velocity;
    let mut twist_from_state = RosFromState::zeros();
    set(&mut twist_from_state, 0, row::VELOCITY, &imu_from_world);
    set(&mut twist_from_state, 0, row::ROTATION, &hat(&velocity_in_imu));
    set(&mut twist_from_state, 3, row::GYRO_BIAS, &-Mat3::identity());
    propagated(&twist_from_state, estimate)
}

fn set(matrix: &mut RosFromState, first_row: usize, first_column: usize, block: &Mat3) {
    matrix.fixed_view_mut::<3, 3>(first_row, first_column).copy_from(block);
}

fn propagated(jacobian: &RosFromState, estimate: &Estimate) -> [f64; ROS_DIM * ROS_DIM] {
    let covariance: RosMatrix = jacobian * estimate.covariance * jacobian.transpose();
    // Symmetric to the bit, so that row-major or column-major does not matter.
    std::array::from_fn(|index| {
        let (line, column) = (index / ROS_DIM, index % ROS_DIM);
        0.5 * (covariance[(line, column)] + covariance[(column, line)])
    })
}

fn imu_message(sample: &ImuSample, frame: &str) -> Imu {
    let mut no_orientation = [0.0; 9];
    no_orientation[0] = NOT_GIVEN;
    Imu {
        header: Header::new(sample.stamp, frame),
        orientation: [0.0, 0.0, 0.0, 1.0],
        orientation_covariance: no_orientation,
        angular_velocity: sample.angular_rate.into(),
        angular_velocity_covariance: [0.0; 9],
        linear_acceleration: sample.specific_force.into(),
        linear_acceleration_covariance: [0.0; 9],
    }
}

fn imu_sample(message: &Imu) -> Result<ImuSample, WireError> {
    for (covariance, what) in [
        (&message.angular_velocity_covariance, "no angular velocity"),
        (&message.linear_acceleration_covariance, "no linear acceleration"),
    ] {
        if covariance[0] == NOT_GIVEN {
            return Err(unusable::<Imu>(format!("says that it holds {what}")));
        }
    }
    Ok(ImuSample {
        stamp: message.header.stamp,
        angular_rate: message.angular_velocity.into(),
        specific_force: message.linear_acceleration.into(),
    })
}

fn fix_message(fix: &GnssFix, frame: &str) -> NavSatFix {
    let mut covariance = [0.0; 9];
    for (axis, sigma) in fix.sigma_enu_m.iter().enumerate() {
        // A negative sigma is no measurement; its square would look like one.
        covariance[4 * axis] = if *sigma < 0.0 { f64::NAN } else { sigma * sigma };
    }
    NavSatFix {
        header: Header::new(fix.stamp, frame),
        status: NavSatStatus { status: 0, service: SERVICE_GPS },
        latitude: fix.position.latitude_deg,
        longitude: fix.position.longitude_deg,
        altitude: fix.position.altitude_m,
        position_covariance: covariance,
        position_covariance_type: COVARIANCE_DIAGONAL,
    }
}

fn gnss_fix(message: &NavSatFix) -> Result<GnssFix, WireError> {
    if message.status.status <= STATUS_NO_FIX {
        return Err(unusable::<NavSatFix>(format!("status {}: no fix", message.status.status)));
    }
    if message.position_covariance_type == COVARIANCE_UNKNOWN {
        return Err(unusable::<NavSatFix>("the covariance is not known".to_owned()));
    }
    let covariance = &message.position_covariance;
    Ok(GnssFix {
        stamp: message.header.stamp,
        position: Geodetic {
            latitude_deg: message.latitude,
            longitude_deg: message.longitude,
            altitude_m: message.altitude,
        },
        sigma_enu_m: Vec3::new(covariance[0].sqrt(), covariance[4].sqrt(), covariance[8].sqrt()),
    })
}

fn lidar_message(pose: &LidarPose) -> Odometry {
    let motion = pose.lidarmap_from_lidar.motion();
    Odometry {
        header: Header::new(pose.stamp, frames::LidarMap::NAME),
        child_frame_id: frames::Lidar::NAME.to_owned(),
        position: motion.translation.into(),
        orientation: motion.rotation.to_xyzw(),
        pose_covariance: [0.0; ROS_DIM * ROS_DIM],
        linear: [0.0; 3],
        angular: [0.0; 3],
        twist_covariance: [0.0; ROS_DIM * ROS_DIM],
    }
}

fn lidar_pose(message: &Odometry) -> Result<LidarPose, WireError> {
    let [x, y, z, w] = message.orientation;
    let rotation = So3::from_xyzw(x, y, z, w)
        .ok_or_else(|| unusable::<Odometry>(format!("the orientation {x} {y} {z} {w} is no rotation")))?;
    Ok(LidarPose {
        stamp: message.header.stamp,
        lidarmap_from_lidar: Pose::assume(Se3::new(rotation, message.position.into())),
    })
}

fn cabin_turn(message: &JointState) -> Result<CabinTurn, WireError> {
    let joint = Sensor::CabinTurn.name();
    let index = message.name.iter().position(|name| name == joint);
    let angle = index.and_then(|index| message.position.get(index));
    match angle {
        Some(angle) => Ok(CabinTurn { stamp: message.header.stamp, angle_rad: *angle }),
        None => Err(unusable::<JointState>(format!("holds no position of the joint {joint}"))),
    }
}

fn unusable<M: RosMessage>(reason: String) -> WireError {
    WireError::Unusable { message: M::TYPE, reason }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::state::{BaseState, Mode, NavState, StateMatrix, StateVector};
    use crate::time::Stamp;

    fn awkward(index: usize) -> f64 {
        // Every bit of the mantissa in use.
        ((index as f64 + 1.0) * 0.123_456_789_012_345_67).sin()
    }

    fn readings(index: usize) -> Vec<Reading> {
        let stamp = Stamp::from_nanos(1_790_000_000_123_456_789 + index as i64);
        let vector = |first: usize| Vec3::from_fn(|axis, _| awkward(3 * index + first + axis));
        let sample = ImuSample { stamp, angular_rate: vector(0), specific_force: vector(5) * 9.81 };
        let fix = GnssFix {
            stamp,
            position: Geodetic {
                latitude_deg: 47.0 + awkward(index),
                longitude_deg: 8.0 + awkward(index + 1),
                altitude_m: 474.0 + awkward(index + 2),
            },
            sigma_enu_m: vector(9).abs() * 0.02,
        };
        let rotation = So3::exp(&(vector(2) * 2.0)).renormalized();
        let lidarmap_from_lidar = Pose::assume(Se3::new(rotation, vector(7) * 100.0));
        vec![
            Reading::Imu(sample),
            Reading::BaseImu(sample),
            Reading::GnssLeft(fix),
            Reading::GnssRight(fix),
            Reading::LidarOdometry(LidarPose { stamp, lidarmap_from_lidar }),
            Reading::CabinTurn(CabinTurn { stamp, angle_rad: 5.0 * awkward(index) }),
        ]
    }

    #[test]
    fn readings_come_back_to_the_bit() {
        for index in 0..500 {
            for reading in readings(index) {
                let bytes = encode_reading(&reading);
                let back = decode_reading(reading.sensor(), &bytes).expect("own bytes");
                assert_eq!(back, reading, "{index}");
                assert_eq!(encode_reading(&back), bytes, "{index}");
            }
        }
    }

    #[test]
    fn messages_without_a_measurement_are_refused_with_the_reason() {
        let stamp = Stamp::from_nanos(1);
        let fix = GnssFix {
            stamp,
            position: Geodetic { latitude_deg: 1.0, longitude_deg: 2.0, altitude_m: 3.0 },
            sigma_enu_m: Vec3::repeat(0.01),
        };
        let reason =
            |sensor, bytes: Vec<u8>| decode_reading(sensor, &bytes).expect_err("refused").to_string();
        let mut message = fix_message(&fix, "gnss_left");
        message.status.status = STATUS_NO_FIX;
        assert!(reason(Sensor::GnssLeft, message.encode()).contains("no fix"));
        message.status.status = 0;
        message.position_covariance_type = COVARIANCE_UNKNOWN;
        assert!(reason(Sensor::GnssLeft, message.encode()).contains("covariance is not known"));
        let sample = ImuSample { stamp, angular_rate: Vec3::zeros(), specific_force: Vec3::zeros() };
        let mut message = imu_message(&sample, "imu");
        message.linear_acceleration_covariance[0] = NOT_GIVEN;
        assert!(reason(Sensor::Imu, message.encode()).contains("no linear acceleration"));
        let lidar = LidarPose { stamp, lidarmap_from_lidar: Pose::identity() };
        let mut message = lidar_message(&lidar);
        message.orientation = [0.0; 4];
        assert!(reason(Sensor::LidarOdometry, message.encode()).contains("is no rotation"));
        let negative = GnssFix { sigma_enu_m: Vec3::new(0.1, -0.1, 0.1), ..fix };
        let bytes = encode_reading(&Reading::GnssLeft(negative));
        let back = decode_reading(Sensor::GnssLeft, &bytes).expect("well formed");
        assert!(back.check().is_err());
    }

    fn estimate() -> Estimate {
        let state = NavState {
            rotation: So3::from_yaw_pitch_roll(2.0, 0.4, -0.9),
            position: Vec3::new(3.0, 4.0, 5.0),
            velocity: Vec3::new(1.0, -2.0, 0.5),
            gyro_bias: Vec3::new(0.01, 0.02, 0.03),
            ..NavState::identity()
        };
        let root = StateMatrix::from_fn(|line, column| 0.01 * awkward(line * 15 + column));
        Estimate {
            stamp: Stamp::from_nanos(1_790_000_000_000_000_001),
            state,
            angular_rate_in_imu: Vec3::new(0.1, 0.2, 0.3),
            odom_from_imu: Pose::identity(),
            world_from_odom: Pose::assume(*state.world_from_imu().motion()),
            base: None,
            covariance: root * root.transpose(),
            mode: Mode::Main,
        }
    }

    /// What the message says of a state, as numbers, against the reference state.
    fn observed(state: &NavState, reference: &NavState, gyro: &Vec3) -> [SMatrix<f64, 6, 1>; 2] {
        let mut pose = SMatrix::<f64, 6, 1>::zeros();
        pose.fixed_rows_mut::<3>(0).copy_from(&state.position);
        let fixed_axes = (state.rotation * reference.rotation.inverse()).log();
        pose.fixed_rows_mut::<3>(3).copy_from(&fixed_axes);
        let mut twist = SMatrix::<f64, 6, 1>::zeros();
        twist.fixed_rows_mut::<3>(0).copy_from(&(state.rotation.inverse() * state.velocity));
        twist.fixed_rows_mut::<3>(3).copy_from(&(gyro - state.gyro_bias));
        [pose, twist]
    }

    #[test]
    fn covariances_agree_with_differences() {
        let estimate = estimate();
        let gyro = Vec3::new(0.3, 0.1, -0.2);
        let mut jacobians = [RosFromState::zeros(), RosFromState::zeros()];
        let step = 1e-6;
        for column in 0..STATE_DIM {
            let mut tangent = StateVector::zeros();
            tangent[column] = step;
            let ahead = observed(&estimate.state.plus(&tangent), &estimate.state, &gyro);
            let behind = observed(&estimate.state.plus(&-tangent), &estimate.state, &gyro);
            for part in 0..2 {
                jacobians[part].set_column(column, &((ahead[part] - behind[part]) / (2.0 * step)));
            }
        }
        let message = pose_message(&estimate);
        for (jacobian, covariance) in
            jacobians.iter().zip([message.pose_covariance, message.twist_covariance])
        {
            let expected = jacobian * estimate.covariance * jacobian.transpose();
            let told = RosMatrix::from_row_slice(&covariance);
            assert!((told - expected).norm() < 1e-8 * expected.norm(), "{told} {expected}");
        }
        assert_eq!((message.header.frame_id.as_str(), message.child_frame_id.as_str()), ("world", "imu"));
        assert_eq!(message.position, [3.0, 4.0, 5.0]);
        assert_eq!(message.header.stamp, estimate.stamp);
        let sigma = estimate.rotation_sigma();
        assert!((message.pose_covariance[21].sqrt() - sigma[0]).abs() < 1e-12);
        assert!((message.pose_covariance[35].sqrt() - sigma[2]).abs() < 1e-12);
    }

    #[test]
    fn odom_is_the_chassis_where_it_is_known() {
        let mut estimate = estimate();
        assert_eq!(odom_message(&estimate).child_frame_id, "imu");
        estimate.base = Some(BaseState {
            odom_from_base: Pose::assume(Se3::new(So3::identity(), Vec3::new(7.0, 8.0, 9.0))),
            velocity_in_base: Vec3::new(0.5, 0.0, 0.0),
            angular_rate_in_base: Vec3::zeros(),
        });
        let message = odom_message(&estimate);
        assert_eq!((message.header.frame_id.as_str(), message.child_frame_id.as_str()), ("odom", "base"));
        assert_eq!((message.position, message.linear), ([7.0, 8.0, 9.0], [0.5, 0.0, 0.0]));
        assert_eq!(Odometry::decode(&message.encode()).expect("own bytes"), message);
    }
}
