//! The solution between its nodes, at the IMU's own rate.

use super::SmoothedNode;
use crate::lie::Vec3;
use crate::preintegration::{SampleBuffer, Step, propagate};
use crate::sensors::ImuSample;
use crate::state::NavState;
use crate::time::Stamp;

/// Gives `say` the state at every sample from the first node on, oldest first, with the node before it.
///
/// From node i the samples carry the state to node j; the little by which it misses x_j, d = x_j ⊟ x, is given back
/// along the way in proportion to the time, x(t) ⊞ d (t − t_i)/(t_j − t_i), so that nothing steps at a node. Behind
/// the last node the samples alone carry it. Samples are in the order of their stamps, those the window was given.
pub fn fill(
    nodes: &[SmoothedNode],
    samples: &[ImuSample],
    gravity: &Vec3,
    mut say: impl FnMut(Stamp, &NavState, &SmoothedNode),
) {
    let mut known = SampleBuffer::default();
    let mut next_sample = 0;
    let mut carried = Vec::new();
    for (index, node) in nodes.iter().enumerate() {
        let next = nodes.get(index + 1);
        while let Some(sample) = samples.get(next_sample)
            && next.is_none_or(|next| known.newest().is_none_or(|newest| newest.stamp < next.stamp))
        {
            known.push(*sample);
            next_sample += 1;
        }
        known.forget_before(node.stamp);
        let Some(mut previous) = known.at(node.stamp) else { continue };
        let mut state = node.state;
        carried.clear();
        for sample in known.iter().filter(|sample| sample.stamp >= node.stamp) {
            if next.is_some_and(|next| sample.stamp >= next.stamp) {
                break;
            }
            if sample.stamp > node.stamp {
                state = propagate(&state, &Step::between(&previous, sample), gravity);
                previous = *sample;
            }
            carried.push((sample.stamp, state));
        }
        let arrival = next.and_then(|next| Some((next, known.at(next.stamp)?)));
        let missed = arrival.map(|(next, sample)| {
            let arrived = propagate(&state, &Step::between(&previous, &sample), gravity);
            (next.state.minus(&arrived), next.stamp.seconds_since(node.stamp))
        });
        for (stamp, state) in &carried {
            let state = missed.map_or(*state, |(missed, span_s)| {
                state.plus(&(missed * (stamp.seconds_since(node.stamp) / span_s)))
            });
            say(*stamp, &state, node);
        }
    }
}
