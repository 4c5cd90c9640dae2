//! The IMU alone: what the start and the integration of every sample since are worth.

use super::filter::{Core, Took};
use crate::estimator::{Options, Start};
use crate::preintegration::{Preintegration, SampleBuffer};
use crate::sensors::Reading;
use crate::smoother::predict_covariance;
use crate::state::{Mode, NavState, StateMatrix};
use crate::time::{Span, Stamp};

/// The covariance's linearization is moved along so often.
const NODE_EVERY: Span = Span::from_millis(1_000);

/// State and covariance, brought forward once a second.
pub struct DeadReckoning {
    stamp: Stamp,
    state: NavState,
    covariance: StateMatrix,
}

impl Core for DeadReckoning {
    fn begin(_: &Options, start: &Start) -> Self {
        let covariance = start.information.try_inverse().unwrap_or_else(StateMatrix::identity);
        Self { stamp: start.stamp, state: start.state, covariance }
    }

    fn take(&mut self, options: &Options, reading: &Reading, samples: &SampleBuffer) -> Took {
        let Reading::Imu(sample) = reading else { return Took::Nothing };
        if sample.stamp - self.stamp < NODE_EVERY {
            return Took::Nothing;
        }
        let Some(steps) = samples.steps(self.stamp, sample.stamp) else { return Took::Nothing };
        let (noise, gravity) = (&options.smoother.noise, &options.smoother.gravity);
        let mut motion = Preintegration::new(self.state.gyro_bias, self.state.accel_bias);
        let mut state = self.state;
        for step in steps {
            motion.add(&step, noise);
            state = crate::preintegration::propagate(&state, &step, gravity);
        }
        self.covariance = predict_covariance(&motion, &self.state, &self.covariance, noise);
        self.state = state;
        self.stamp = sample.stamp;
        Took::Moved
    }

    fn newest(&self) -> (Stamp, NavState, StateMatrix) {
        (self.stamp, self.state, self.covariance)
    }

    fn needs_since(&self) -> Stamp {
        self.stamp
    }

    fn mode(&self, _: Stamp) -> Mode {
        Mode::ImuOnly
    }
}
