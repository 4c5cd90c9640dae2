//! What the estimates rested on, kept for a solution of the whole afterwards.

use super::{Phase, Updater};
use crate::estimator::Past;
use crate::sensors::ImuSample;

/// What the estimates rested on.
#[derive(Default)]
pub(super) struct History {
    /// Of those that were given up.
    closed: Vec<Past>,
    /// Their nodes, and those of the longest chain among them.
    closed_nodes: [usize; 2],
    /// Since then.
    pub(super) samples: Vec<ImuSample>,
}

impl Updater {
    /// Keeps from now on every node of the graph that answers, with its factors, and the samples of the IMU: to be
    /// called before the first reading. Memory then grows by some 3 kB a node and 60 bytes a sample.
    pub fn keep_history(&mut self) {
        self.history.get_or_insert_default();
    }

    /// Nodes that are kept so far, and those of the longest chain among them.
    pub fn history_nodes(&self) -> [usize; 2] {
        let Some(history) = &self.history else { return [0; 2] };
        let [nodes, longest] = match &self.phase {
            Phase::Running(running) => running.graphs.active().history_nodes(),
            Phase::Waiting(_) => [0; 2],
        };
        [history.closed_nodes[0] + nodes, history.closed_nodes[1].max(longest)]
    }

    /// Gives up what was kept, and its memory; nothing is kept from then on, and estimates stay as they are.
    pub fn forget_history(&mut self) {
        self.history = None;
        if let Phase::Running(running) = &mut self.phase {
            running.graphs.forget_history();
        }
    }

    /// All that was kept, oldest first; nothing is kept from then on.
    pub fn take_history(&mut self) -> Vec<Past> {
        self.close_history();
        self.history.take().map_or_else(Vec::new, |history| history.closed)
    }

    /// The estimate is given up: what it rested on is one past.
    pub(super) fn close_history(&mut self) {
        let closed_nodes = self.history_nodes();
        let Some(history) = &mut self.history else { return };
        history.closed_nodes = closed_nodes;
        let samples = std::mem::take(&mut history.samples);
        if let Phase::Running(running) = &mut self.phase {
            let nodes = running.graphs.active_mut().take_history();
            history.closed.push(Past { nodes, samples });
        }
    }
}
