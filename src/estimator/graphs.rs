//! The two graphs, and who answers.
//!
//! ```text
//!             fixes are lost: fallback becomes a copy of main
//!    main ─────────────────────────────────────────────▶ fallback ◀─────────────────┐
//!     ▲                                                     │ good fixes            │ a bad fix, or silence:
//!     │                                                     ▼                       │ main becomes a copy
//!     ├──────────────────────────────────────────── fallback, main on trial ────────┘ of fallback
//!     │  enough good fixes: main answers, fallback ends
//!     └─── from either: fixes contradict for so long that they are right; main is seated on them
//! ```
//!
//! Main holds IMU, fixes and lidar; fallback is fed by all but fixes. Through an outage both live side by side and
//! fallback answers. Fixes that come back go into main alone, so that it has settled on them when it takes over:
//! nothing is optimized anew at that moment. Should they turn out bad, what they said is forgotten with the copy.
//! With fixes trusted both graphs would hold the same, so only main is kept (Nubert et al. 2022, section IV,
//! whose main graph holds whatever came through its gate).

use crate::factors::{BetweenFactor, PositionFactor};
use crate::sensors::ImuSample;
use crate::smoother::{Smoother, SmootherError};
use crate::state::Graph;
use crate::time::Stamp;

/// See the file's first lines.
pub(super) struct Graphs {
    main: Smoother,
    /// While fixes are lost.
    fallback: Option<Box<Smoother>>,
    /// Main holds fixes that fallback does not.
    on_trial: bool,
}

impl Graphs {
    /// Main alone.
    pub fn new(main: Smoother) -> Self {
        Self { main, fallback: None, on_trial: false }
    }

    /// Who answers.
    pub fn state(&self) -> Graph {
        match (&self.fallback, self.on_trial) {
            (None, _) => Graph::Main,
            (Some(_), false) => Graph::Fallback,
            (Some(_), true) => Graph::Trial,
        }
    }

    /// The graph that answers.
    pub fn active(&self) -> &Smoother {
        self.fallback.as_deref().unwrap_or(&self.main)
    }

    /// The graph that answers.
    pub fn active_mut(&mut self) -> &mut Smoother {
        self.fallback.as_deref_mut().unwrap_or(&mut self.main)
    }

    /// Main, while fallback answers.
    pub fn passive_mut(&mut self) -> Option<&mut Smoother> {
        self.fallback.is_some().then_some(&mut self.main)
    }

    /// Appends an IMU sample, newer than all before.
    pub fn push_sample(&mut self, sample: ImuSample) {
        self.main.push_sample(sample);
        if let Some(fallback) = &mut self.fallback {
            fallback.push_sample(sample);
        }
    }

    /// Fixes are lost: fallback takes over from a copy of main.
    pub fn lose(&mut self) {
        if self.fallback.is_none() {
            self.fallback = Some(Box::new(self.main.clone()));
        }
    }

    /// A fix that may be the first of those that end the outage, at main's node for it.
    ///
    /// # Errors
    /// The window cannot take it.
    pub fn try_position(&mut self, node: Stamp, factor: PositionFactor) -> Result<(), SmootherError> {
        debug_assert!(self.fallback.is_some(), "fixes are tried while they are lost");
        self.main.add_position(node, factor)?;
        self.on_trial = true;
        self.main.update().map(|_| ())
    }

    /// The fixes on trial were bad: main becomes a copy of fallback.
    pub fn end_trial(&mut self) {
        if let (true, Some(fallback)) = (self.on_trial, &self.fallback) {
            self.main.clone_from(fallback);
        }
        self.on_trial = false;
    }

    /// Enough good fixes have come: main takes over with those it holds.
    pub fn recover(&mut self) {
        self.main.hold(None);
        self.fallback = None;
        self.on_trial = false;
    }

    /// Neither window keeps what leaves it from now on, nor what has left it.
    pub fn forget_history(&mut self) {
        self.main.forget_history();
        if let Some(fallback) = &mut self.fallback {
            fallback.forget_history();
        }
    }

    /// Both windows reach back to this stamp, as long as fixes are lost. See [`Smoother::hold`].
    pub fn hold(&mut self, from: Stamp) {
        if let Some(fallback) = &mut self.fallback {
            fallback.hold(Some(from));
            self.main.hold(Some(from));
        }
    }

    /// No window reaches back further than its lag.
    pub fn release(&mut self) {
        self.main.hold(None);
        if let Some(fallback) = &mut self.fallback {
            fallback.hold(None);
        }
    }

    /// Ties two nodes of each graph, which has them or makes them.
    ///
    /// # Errors
    /// The answering graph cannot take it.
    pub fn add_between(
        &mut self,
        earlier: Stamp,
        later: Stamp,
        factor: BetweenFactor,
    ) -> Result<(), SmootherError> {
        self.in_passive(earlier, later, |main| main.add_between(earlier, later, factor));
        self.active_mut().add_between(earlier, later, factor)
    }

    /// Adds to main, while fallback answers, what ties two nodes of fallback. Main goes without where its nodes lie
    /// elsewhere: it is made anew from fallback or from fixes.
    pub fn in_passive(
        &mut self,
        earlier: Stamp,
        later: Stamp,
        add: impl FnOnce(&mut Smoother) -> Result<(), SmootherError>,
    ) {
        let Some(main) = self.passive_mut() else { return };
        if main.node_at(earlier) == Ok(earlier) && main.node_at(later) == Ok(later) {
            // Both nodes were just found, and an edge asks for nothing else.
            let _ = add(main);
        }
    }

    /// Brings both graphs up to date.
    ///
    /// # Errors
    /// [`SmootherError::NotDetermined`] if the answering graph must be started anew.
    pub fn update(&mut self) -> Result<(), SmootherError> {
        if let Some(fallback) = &mut self.fallback {
            fallback.update()?;
            if self.main.update().is_err() {
                self.main.clone_from(fallback);
                self.on_trial = false;
            }
            return Ok(());
        }
        self.main.update().map(|_| ())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lie::Vec3;
    use crate::preintegration::ImuNoise;
    use crate::smoother::Options;
    use crate::state::{NavState, StateMatrix};
    use crate::time::Span;

    const NOISE: ImuNoise = ImuNoise::OF_TESTS;

    fn at(millis: i64) -> Stamp {
        Stamp::from_nanos(millis * 1_000_000)
    }

    /// At rest for a second, with the IMU known for another.
    fn graphs() -> Graphs {
        let gravity = Vec3::new(0.0, 0.0, -9.81);
        let mut smoother = Smoother::new(Options::new(Span::from_seconds(3.0), gravity, NOISE));
        (0..=200).for_each(|index| {
            smoother.push_sample(ImuSample {
                stamp: at(10 * index),
                angular_rate: Vec3::zeros(),
                specific_force: -gravity,
            });
        });
        smoother.start(at(0), NavState::identity(), &(StateMatrix::identity() * 1e4)).expect("covered");
        smoother.node_at(at(1_000)).expect("covered");
        smoother.update().expect("determined");
        Graphs::new(smoother)
    }

    fn tried(graphs: &mut Graphs, millis: i64) {
        let factor = PositionFactor {
            measured: Vec3::x(),
            lever_arm: Vec3::zeros(),
            sigma: Vec3::repeat(0.01),
            huber_threshold: f64::INFINITY,
        };
        let node = graphs.passive_mut().expect("lost").node_at(at(millis)).expect("covered");
        graphs.try_position(node, factor).expect("determined");
    }

    #[test]
    fn what_a_failed_trial_said_is_forgotten_to_the_bit() {
        let mut graphs = graphs();
        let before = graphs.active().newest();
        graphs.lose();
        tried(&mut graphs, 1_200);
        assert_eq!(graphs.state(), Graph::Trial);
        assert_eq!(graphs.active().newest(), before, "fallback does not know of the trial");
        graphs.end_trial();
        assert_eq!(graphs.state(), Graph::Fallback);
        graphs.recover();
        assert_eq!((graphs.state(), graphs.active().newest()), (Graph::Main, before));
    }

    #[test]
    fn main_takes_over_with_the_fixes_it_holds() {
        let mut graphs = graphs();
        graphs.lose();
        tried(&mut graphs, 1_200);
        graphs.recover();
        let (stamp, state) = graphs.active().newest().expect("started");
        assert_eq!(stamp, at(1_200));
        assert!(state.position.x > 0.2, "the fix counts: {}", state.position.x);
        assert_eq!(graphs.state(), Graph::Main);
    }

    #[test]
    fn both_graphs_get_what_is_no_fix() {
        let mut graphs = graphs();
        graphs.lose();
        let factor = BetweenFactor {
            measured: crate::lie::Se3::identity(),
            imu_from_sensor: crate::lie::Se3::identity(),
            sigma: [1e-4, 1e-3],
        };
        let (earlier, later) = (at(1_000), at(1_500));
        graphs.active_mut().node_at(later).expect("covered");
        graphs.add_between(earlier, later, factor).expect("nodes exist");
        graphs.update().expect("determined");
        let fallback = graphs.active().newest();
        graphs.recover();
        assert_eq!(graphs.active().newest(), fallback);
    }
}
