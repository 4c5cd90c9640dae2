//! What a window was given, node by node, for those who solve it once more as a whole.
//!
//! A node that leaves the window takes all it was tied to along: nothing more can be said of it. So the nodes that
//! left, in their order, are the graph as the window had it, with what its caller believed and refused. Kept only
//! where it is asked for; a copy of a window has a copy of its history, of which the nodes are shared.

use std::collections::VecDeque;
use std::sync::Arc;

use super::Smoother;
use super::node::{Edge, Node};
use crate::factors::{BetweenFactor, ImuFactor, PoseFactor, PositionFactor};
use crate::state::{NavState, StateMatrix};
use crate::time::Stamp;

/// A node of which nothing more can be said, and all that ties it.
#[derive(Clone, Debug)]
pub struct PastNode {
    /// Of the node.
    pub stamp: Stamp,
    /// The state as far as it was known in the window.
    pub estimate: NavState,
    /// The window was started at this node: a chain of its own begins.
    pub start: Option<Box<WindowStart>>,
    /// Ties it to the next node; none at the end of a chain.
    pub link: Option<ImuFactor>,
    /// Antenna positions.
    pub positions: Vec<PositionFactor>,
    /// Poses in the world.
    pub poses: Vec<PoseFactor>,
    /// To later nodes of the chain, by their stamps.
    pub edges: Vec<(Stamp, Edge)>,
}

/// What a window began with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WindowStart {
    /// Where the information holds.
    pub state: NavState,
    /// Inverse covariance, 16×16, in the tangent of `state`.
    pub information: StateMatrix,
}

/// The nodes that left so far, and what the oldest one that did not began with.
#[derive(Clone, Debug, Default)]
pub(super) struct History {
    nodes: Vec<Arc<PastNode>>,
    /// Of the chain that grows, and of the longest.
    chain: [usize; 2],
    start: Option<Box<WindowStart>>,
    /// Of the chain that grows.
    ties: Vec<Tie>,
}

/// How two nodes of a chain lie to each other that a window did not hold at once.
#[derive(Clone, Copy, Debug)]
struct Tie {
    earlier: Stamp,
    later: Stamp,
    factor: BetweenFactor,
}

impl History {
    fn append(&mut self, node: &Node, last: bool) {
        let grown = if self.start.is_some() { 1 } else { self.chain[0] + 1 };
        self.chain = [grown, self.chain[1].max(grown)];
        self.nodes.push(Arc::new(PastNode {
            stamp: node.stamp,
            estimate: node.estimate(),
            start: self.start.take(),
            link: node.link.clone().filter(|_| !last),
            positions: node.positions.iter().map(|position| position.factor).collect(),
            poses: node.poses.iter().map(|pose| pose.factor).collect(),
            edges: node.edges.iter().map(|edge| (edge.later, edge.edge)).collect(),
        }));
    }

    /// The node leaves, others stay.
    pub fn note(&mut self, node: &Node) {
        self.append(node, false);
    }

    /// All nodes are given up.
    pub fn close(&mut self, nodes: &VecDeque<Box<Node>>) {
        let last = nodes.len().saturating_sub(1);
        nodes.iter().enumerate().for_each(|(index, node)| self.append(node, index == last));
        self.start = None;
        let ties = std::mem::take(&mut self.ties);
        if !nodes.is_empty() {
            let first = self.nodes.len() - self.chain[0];
            ties.iter().for_each(|tie| tie.put_into(&mut self.nodes[first..]));
        }
    }

    /// The window starts, after [`History::close`].
    pub fn begin(&mut self, state: NavState, information: &StateMatrix) {
        self.start = Some(Box::new(WindowStart { state, information: *information }));
    }
}

impl Tie {
    /// Gives the chain the relative pose. The pose factor by which the window took the same measurement goes.
    fn put_into(&self, chain: &mut [Arc<PastNode>]) {
        let place = |stamp: Stamp| chain.binary_search_by_key(&stamp, |node| node.stamp);
        let (Ok(earlier), Ok(later)) = (place(self.earlier), place(self.later)) else { return };
        Arc::make_mut(&mut chain[earlier]).edges.push((self.later, Edge::Between(self.factor)));
        Arc::make_mut(&mut chain[later]).poses.clear();
    }
}

impl Smoother {
    /// Tells those who solve the chain as a whole how a node lies to an older one, which may have left the window long
    /// ago: to the window this changes nothing. A pose factor of the later node stands for the same measurement, and is
    /// theirs no more.
    pub fn note_relative(&mut self, earlier: Stamp, later: Stamp, factor: BetweenFactor) {
        if let Some(history) = &mut self.history {
            history.ties.push(Tie { earlier, later, factor });
        }
    }

    /// Keeps from now on what leaves the window: some 3 kB a node. To be called before the window is started.
    pub fn keep_history(&mut self) {
        self.history.get_or_insert_default();
    }

    /// Nodes that [`Smoother::take_history`] would give, and those of the longest chain among them.
    pub fn history_nodes(&self) -> [usize; 2] {
        let Some(history) = &self.history else { return [0; 2] };
        let here = self.nodes.len();
        let grows = if history.start.is_some() { here } else { history.chain[0] + here };
        [history.nodes.len() + here, history.chain[1].max(grows)]
    }

    /// Gives up what was kept; nothing is kept from then on.
    pub fn forget_history(&mut self) {
        self.history = None;
    }

    /// All nodes that ever were in the window, oldest first, if they were kept; nothing is kept from then on. The
    /// window itself stays as it is.
    pub fn take_history(&mut self) -> Vec<Arc<PastNode>> {
        self.solve_back_to(0);
        let Some(mut history) = self.history.take() else { return Vec::new() };
        history.close(&self.nodes);
        history.nodes
    }
}
