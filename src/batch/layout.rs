//! Where each block of the normal equations lies in the sparse matrix.

use std::ops::Range;

use super::BatchError;
use super::factorization::Factorization;
use crate::lie::Mat6;
use crate::state::{STATE_DIM, StateMatrix, StateVector};

/// Rows of a node that an edge from an older node touches.
const POSE_DIM: usize = 6;

/// The upper half of H, column by column. The columns of a node hold, in the order of rows: each older node that an
/// edge to it comes from (columns of the pose only), the node before, the node itself.
pub(super) struct Layout {
    nodes: usize,
    /// Older nodes, not neighbours, of each node's edges: those of node k are `sources[first_source[k]..]`.
    sources: Vec<usize>,
    first_source: Vec<usize>,
    /// First entry of each node.
    first: Vec<usize>,
    pub column_starts: Vec<u32>,
    pub rows: Vec<u32>,
}

/// H, its upper half, and g.
pub(super) struct Equations {
    pub entries: Vec<f64>,
    /// The diagonal without damping.
    diagonal: Vec<f64>,
    pub right: Vec<StateVector>,
}

impl Layout {
    /// Of a chain of `nodes` nodes with edges from an older to a later one.
    pub fn new(nodes: usize, mut edges: Vec<[usize; 2]>) -> Result<Self, BatchError> {
        edges.retain(|[from, to]| from + 1 < *to);
        edges.sort_unstable_by_key(|[from, to]| (*to, *from));
        edges.dedup();
        let mut first_source = vec![0; nodes + 1];
        edges.iter().for_each(|[_, to]| first_source[to + 1] += 1);
        (0..nodes).for_each(|node| first_source[node + 1] += first_source[node]);
        let mut layout = Self {
            nodes,
            sources: edges.into_iter().map(|[from, _]| from).collect(),
            first_source,
            first: Vec::with_capacity(nodes + 1),
            column_starts: Vec::with_capacity(nodes * STATE_DIM + 1),
            rows: Vec::new(),
        };
        let entries: usize = (0..nodes).map(|node| layout.entries_of(node)).sum();
        if u32::try_from(entries).is_err() || u32::try_from(nodes * STATE_DIM).is_err() {
            return Err(BatchError::TooLarge);
        }
        layout.rows.reserve_exact(entries);
        for node in 0..nodes {
            layout.first.push(layout.rows.len());
            for column in 0..STATE_DIM {
                layout.column_starts.push(layout.rows.len() as u32);
                if column < POSE_DIM {
                    for source in layout.first_source[node]..layout.first_source[node + 1] {
                        let from = layout.sources[source] * STATE_DIM;
                        layout.rows.extend((from..from + STATE_DIM).map(|row| row as u32));
                    }
                }
                let own = node * STATE_DIM;
                let from = own.saturating_sub(STATE_DIM);
                layout.rows.extend((from..=own + column).map(|row| row as u32));
            }
        }
        layout.column_starts.push(layout.rows.len() as u32);
        Ok(layout)
    }

    /// Of one column of a node: entries of edges, and of the node before.
    fn above(&self, node: usize, column: usize) -> [usize; 2] {
        let sources = self.first_source[node + 1] - self.first_source[node];
        let by_edges = if column < POSE_DIM { sources * STATE_DIM } else { 0 };
        [by_edges, if node > 0 { STATE_DIM } else { 0 }]
    }

    fn entries_of(&self, node: usize) -> usize {
        (0..STATE_DIM).map(|column| self.above(node, column).iter().sum::<usize>() + column + 1).sum()
    }

    /// The column's entry of the node's first row of its own.
    fn own(&self, node: usize, column: usize) -> usize {
        let first = self.column_starts[node * STATE_DIM + column] as usize;
        first + self.above(node, column).iter().sum::<usize>()
    }

    /// The node of a column of H.
    pub fn node_of(&self, column: usize) -> usize {
        (column / STATE_DIM).min(self.nodes - 1)
    }

    /// Room for the equations.
    pub fn equations(&self) -> Equations {
        Equations {
            entries: vec![0.0; self.rows.len()],
            diagonal: vec![0.0; self.nodes * STATE_DIM],
            right: vec![StateVector::zeros(); self.nodes],
        }
    }

    /// How H is factorized.
    pub fn analyze(&self) -> Result<Factorization, BatchError> {
        Factorization::new(self)
    }
}

impl Equations {
    /// H = 0, g = 0.
    pub fn clear(&mut self) {
        self.entries.fill(0.0);
        self.right.fill(StateVector::zeros());
    }

    /// Adds to a node's own block, of which rows and columns of one range are not zero; only the upper half is read.
    pub fn add_own(
        &mut self,
        layout: &Layout,
        node: usize,
        range: Range<usize>,
        at: impl Fn(usize, usize) -> f64,
    ) {
        for column in range.clone() {
            let own = layout.own(node, column);
            for row in range.start..=column {
                self.entries[own + row] += at(row - range.start, column - range.start);
            }
        }
    }

    /// Adds the whole of a node's own block.
    pub fn add_whole(&mut self, layout: &Layout, node: usize, block: &StateMatrix) {
        self.add_own(layout, node, 0..STATE_DIM, |row, column| block[(row, column)]);
    }

    /// Adds to the pose of a node.
    pub fn add_pose(&mut self, layout: &Layout, node: usize, block: &Mat6) {
        self.add_own(layout, node, 0..POSE_DIM, |row, column| block[(row, column)]);
    }

    /// Adds the block of a node and the one before, whose rows it has.
    pub fn add_neighbours(&mut self, layout: &Layout, node: usize, block: &StateMatrix) {
        for column in 0..STATE_DIM {
            let before = layout.own(node, column) - STATE_DIM;
            for row in 0..STATE_DIM {
                self.entries[before + row] += block[(row, column)];
            }
        }
    }

    /// Adds one entry of the block between an older node (row) and a later node's pose (column).
    pub fn add_edge(
        &mut self,
        layout: &Layout,
        [from, to]: [usize; 2],
        row: usize,
        column: usize,
        value: f64,
    ) {
        let [by_edges, _] = layout.above(to, column);
        let first = layout.column_starts[to * STATE_DIM + column] as usize;
        let sources = &layout.sources[layout.first_source[to]..layout.first_source[to + 1]];
        let place = match sources.binary_search(&from) {
            Ok(place) => place * STATE_DIM,
            Err(_) => by_edges,
        };
        self.entries[first + place + row] += value;
    }

    /// All is added: H + damping · diag(H).
    pub fn damp(&mut self, layout: &Layout, damping: f64) {
        for (column, diagonal) in self.diagonal.iter().enumerate() {
            let place = layout.column_starts[column + 1] as usize - 1;
            self.entries[place] = diagonal * (1.0 + damping);
        }
    }

    /// All is added: keeps the diagonal for [`Equations::damp`].
    pub fn finish(&mut self, layout: &Layout) {
        for (column, diagonal) in self.diagonal.iter_mut().enumerate() {
            *diagonal = self.entries[layout.column_starts[column + 1] as usize - 1];
        }
    }
}
