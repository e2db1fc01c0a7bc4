//! The symbolic factorisation: an order, the elimination tree, and dense fronts over it.
//!
//! Everything happens on the graph of blocks, which is smaller than that of scalars by the square of
//! the block size. Columns with (nearly) the same pattern form one front; the fronts form a tree in
//! which a front adds its update to its parent's. The tree is cut into subtrees of bounded work that
//! can be factorised at the same time, and what is left above them.

use super::{BlockMatrix, order};
use std::ops::Range;

/// Above the root.
pub(super) const NO_PARENT: usize = usize::MAX;

/// A block of the matrix and where in its front it goes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Entry {
    pub(super) slot: usize,
    /// Scalar row and column in the front.
    pub(super) row: usize,
    pub(super) column: usize,
    /// The stored block is the transpose of what belongs here.
    pub(super) turned: bool,
}

/// A dense block column: `order` rows, of which the first `width` are its own columns.
#[derive(Debug)]
pub(super) struct Front {
    pub(super) width: usize,
    pub(super) order: usize,
    /// Scalars of the matrix behind the rows, in the matrix' own numbering.
    pub(super) scalars: Vec<u32>,
    pub(super) entries: Vec<Entry>,
    pub(super) parent: usize,
    pub(super) children: Vec<usize>,
    /// Runs of the update's rows in the parent's: `(own first row, parent's first row, length)`.
    pub(super) runs: Vec<(u32, u32, u32)>,
    /// Where its columns begin in the factor of its task.
    pub(super) factor_at: usize,
    /// Where its update begins on the stack of its task.
    pub(super) update_at: usize,
}

impl Front {
    /// Rows of its update.
    pub(super) fn rest(&self) -> usize {
        self.order - self.width
    }

    pub(super) fn work(&self) -> f64 {
        // Multiply-adds of a partial factorisation.
        let (n, m) = (self.order as f64, self.rest() as f64);
        (n * n * n - m * m * m) / 6.0
    }
}

/// Fronts that are factorised one after the other, and the memory they need.
#[derive(Debug)]
pub(super) struct Task {
    pub(super) fronts: Vec<usize>,
    pub(super) factor_len: usize,
    pub(super) stack_len: usize,
    /// The largest update, squared.
    pub(super) update_len: usize,
}

/// The symbolic factorisation.
#[derive(Debug)]
pub(super) struct Tree {
    pub(super) fronts: Vec<Front>,
    /// Subtrees, then the fronts above them.
    pub(super) tasks: Vec<Task>,
    /// The task of each front.
    pub(super) task_of: Vec<usize>,
}

/// How much of a front may be zeros when two are merged: by the merged width, up to which share.
const RELAXED: [(usize, f64); 3] = [(40, 0.6), (100, 0.25), (usize::MAX, 0.06)];
/// Subtrees have at most this share of the whole work, unless they are a single front.
const SUBTREE_SHARE: f64 = 0.1;

impl Tree {
    /// One front: the matrix is taken for full.
    pub(super) fn dense(matrix: &BlockMatrix) -> Tree {
        let blocks = matrix.block_count();
        let identity: Vec<usize> = (0..blocks).collect();
        let node = Node { columns: 0..blocks, rows: Vec::new(), parent: NO_PARENT };
        Tree::build(matrix, &identity, &[node])
    }

    /// Fronts along a fill-reducing order; `None` if there is no such order.
    pub(super) fn sparse(matrix: &BlockMatrix) -> Option<Tree> {
        let minimum_degree = order(matrix)?;
        let (forward, columns) = structure(matrix, &minimum_degree);
        let dims: Vec<usize> = forward.iter().map(|&old| matrix.dim(old)).collect();
        Some(Tree::build(matrix, &forward, &merge(columns, &dims)))
    }

    /// Numbers in the factor.
    pub(super) fn factor_len(&self) -> usize {
        self.tasks.iter().map(|task| task.factor_len).sum()
    }

    fn build(matrix: &BlockMatrix, forward: &[usize], nodes: &[Node]) -> Tree {
        let mut inverse = vec![0; forward.len()];
        for (new, &old) in forward.iter().enumerate() {
            inverse[old] = new;
        }
        let mut owner = vec![0; forward.len()];
        for (k, node) in nodes.iter().enumerate() {
            owner[node.columns.clone()].fill(k);
        }
        let mut fronts: Vec<Front> = Vec::with_capacity(nodes.len());
        let mut starts: Vec<Vec<usize>> = Vec::with_capacity(nodes.len());
        for node in nodes {
            let (mut start, mut scalars) = (vec![0], Vec::new());
            for block in node.blocks() {
                let old = forward[block];
                scalars.extend(matrix.starts[old] as u32..matrix.starts[old + 1] as u32);
                start.push(scalars.len());
            }
            fronts.push(Front {
                width: start[node.columns.len()],
                order: scalars.len(),
                scalars,
                entries: Vec::new(),
                parent: node.parent,
                children: Vec::new(),
                runs: Vec::new(),
                factor_at: 0,
                update_at: 0,
            });
            starts.push(start);
        }
        for (k, node) in nodes.iter().enumerate() {
            if node.parent == NO_PARENT {
                continue;
            }
            fronts[node.parent].children.push(k);
            let width = fronts[k].width;
            let own = &starts[k][node.columns.len()..];
            for (position, &row) in node.rows.iter().enumerate() {
                let to = starts[node.parent][nodes[node.parent].position(row as usize)] as u32;
                let from = (own[position] - width) as u32;
                let length = (own[position + 1] - own[position]) as u32;
                match fronts[k].runs.last_mut() {
                    Some(run) if run.0 + run.2 == from && run.1 + run.2 == to => run.2 += length,
                    _ => fronts[k].runs.push((from, to, length)),
                }
            }
        }
        for column in 0..matrix.block_count() {
            for slot in matrix.column_ptr[column]..matrix.column_ptr[column + 1] {
                let (row, own) = (inverse[matrix.rows[slot] as usize], inverse[column]);
                let (high, low) = (row.max(own), row.min(own));
                let (node, start) = (&nodes[owner[low]], &starts[owner[low]]);
                fronts[owner[low]].entries.push(Entry {
                    slot,
                    row: start[node.position(high)],
                    column: start[node.position(low)],
                    turned: row < own,
                });
            }
        }
        let mut tree = Tree { task_of: vec![0; fronts.len()], fronts, tasks: Vec::new() };
        tree.cut();
        tree
    }

    /// Cuts the tree into tasks and lays out their memory.
    fn cut(&mut self) {
        let count = self.fronts.len();
        let mut work: Vec<f64> = self.fronts.iter().map(Front::work).collect();
        let mut first: Vec<usize> = (0..count).collect();
        for k in 0..count {
            let parent = self.fronts[k].parent;
            if parent != NO_PARENT {
                work[parent] += work[k];
                first[parent] = first[parent].min(first[k]);
            }
        }
        let roots: Vec<usize> =
            (0..count).filter(|&k| self.fronts[k].parent == NO_PARENT).collect();
        let limit = SUBTREE_SHARE * roots.iter().map(|&k| work[k]).sum::<f64>();
        let (mut open, mut subtrees, mut above) = (roots, Vec::new(), Vec::new());
        while let Some(k) = open.pop() {
            if work[k] > limit {
                above.push(k);
                open.extend(&self.fronts[k].children);
            } else {
                subtrees.push(k);
            }
        }
        subtrees.sort_unstable();
        above.sort_unstable();
        let mut lists: Vec<Vec<usize>> =
            subtrees.into_iter().map(|root| (first[root]..=root).collect()).collect();
        lists.push(above);
        for (k, list) in lists.iter().enumerate() {
            for &front in list {
                self.task_of[front] = k;
            }
        }
        for (k, fronts) in lists.into_iter().enumerate() {
            let mut task = Task { fronts: Vec::new(), factor_len: 0, stack_len: 0, update_len: 0 };
            let mut top = 0;
            for &f in &fronts {
                // Children of other tasks are on other stacks.
                let own = self.fronts[f].children.iter().filter(|&&c| self.task_of[c] == k);
                top = own.map(|&c| self.fronts[c].update_at).min().unwrap_or(top);
                let front = &mut self.fronts[f];
                let rest = front.rest();
                front.factor_at = task.factor_len;
                front.update_at = top;
                task.factor_len += front.order * front.width;
                task.update_len = task.update_len.max(rest * rest);
                top += rest * (rest + 1) / 2;
                task.stack_len = task.stack_len.max(top);
            }
            task.fronts = fronts;
            self.tasks.push(task);
        }
    }
}

/// A run of block columns with one pattern below them.
#[derive(Debug, Clone)]
struct Node {
    columns: Range<usize>,
    /// Block rows below the columns, ascending.
    rows: Vec<u32>,
    /// A column until [`merge`] has numbered the nodes, then a node.
    parent: usize,
}

impl Node {
    fn blocks(&self) -> impl Iterator<Item = usize> + '_ {
        self.columns.clone().chain(self.rows.iter().map(|&row| row as usize))
    }

    /// The place of a block among [`Node::blocks`].
    fn position(&self, block: usize) -> usize {
        if block < self.columns.end {
            return block - self.columns.start;
        }
        self.columns.len() + self.rows.partition_point(|&row| (row as usize) < block)
    }
}

/// The tree's postorder of `order` (new to old) and the pattern of each column of the factor.
fn structure(matrix: &BlockMatrix, order: &[usize]) -> (Vec<usize>, Vec<Node>) {
    let below = permuted(matrix, order);
    let parent = elimination_tree(&below);
    let postorder = postorder(&parent);
    let forward: Vec<usize> = postorder.iter().map(|&k| order[k]).collect();
    let below = permuted(matrix, &forward);
    let parent = elimination_tree(&below);
    let count = forward.len();
    let (mut nodes, mut seen) = (Vec::<Node>::with_capacity(count), vec![usize::MAX; count]);
    let mut children: Vec<Vec<usize>> = vec![Vec::new(); count];
    for k in 0..count {
        seen[k] = k;
        let mut rows = Vec::new();
        let own = below[k].iter();
        let theirs = children[k].iter().flat_map(|&child: &usize| &nodes[child].rows);
        for &row in own.chain(theirs) {
            if seen[row as usize] != k {
                seen[row as usize] = k;
                rows.push(row);
            }
        }
        rows.sort_unstable();
        if parent[k] != NO_PARENT {
            children[parent[k]].push(k);
        }
        nodes.push(Node { columns: k..k + 1, rows, parent: parent[k] });
    }
    (forward, nodes)
}

/// For each column the block rows below its diagonal after renumbering by `order`.
fn permuted(matrix: &BlockMatrix, order: &[usize]) -> Vec<Vec<u32>> {
    let mut inverse = vec![0u32; order.len()];
    for (new, &old) in order.iter().enumerate() {
        inverse[old] = new as u32;
    }
    let mut below: Vec<Vec<u32>> = vec![Vec::new(); order.len()];
    for column in 0..order.len() {
        for slot in matrix.column_ptr[column] + 1..matrix.column_ptr[column + 1] {
            let (a, b) = (inverse[matrix.rows[slot] as usize], inverse[column]);
            below[a.min(b) as usize].push(a.max(b));
        }
    }
    below
}

/// The parent of each column (Liu's algorithm with path compression).
fn elimination_tree(below: &[Vec<u32>]) -> Vec<usize> {
    let count = below.len();
    let mut left: Vec<Vec<u32>> = vec![Vec::new(); count];
    for (column, rows) in below.iter().enumerate() {
        for &row in rows {
            left[row as usize].push(column as u32);
        }
    }
    let (mut parent, mut ancestor) = (vec![NO_PARENT; count], vec![NO_PARENT; count]);
    for row in 0..count {
        for &column in &left[row] {
            let mut at = column as usize;
            while ancestor[at] != NO_PARENT && ancestor[at] != row {
                at = std::mem::replace(&mut ancestor[at], row);
            }
            if ancestor[at] == NO_PARENT {
                ancestor[at] = row;
                parent[at] = row;
            }
        }
    }
    parent
}

/// Columns in an order in which subtrees are contiguous.
fn postorder(parent: &[usize]) -> Vec<usize> {
    let count = parent.len();
    let mut children: Vec<Vec<usize>> = vec![Vec::new(); count];
    let mut stack = Vec::new();
    for k in (0..count).rev() {
        match parent[k] {
            NO_PARENT => stack.push(k),
            p => children[p].push(k),
        }
    }
    let mut order = Vec::with_capacity(count);
    while let Some(&k) = stack.last() {
        match children[k].pop() {
            Some(child) => stack.push(child),
            None => {
                order.push(k);
                stack.pop();
            }
        }
    }
    order
}

/// Merges columns into fronts: where the patterns agree, and where they nearly do.
fn merge(columns: Vec<Node>, dims: &[usize]) -> Vec<Node> {
    let scalars = |blocks: &mut dyn Iterator<Item = usize>| blocks.map(|b| dims[b]).sum::<usize>();
    let mut merged: Vec<(Node, usize, usize, usize)> = Vec::new();
    for column in columns {
        let width = dims[column.columns.start];
        let rows = scalars(&mut column.rows.iter().map(|&row| row as usize));
        merged.push((column, width, rows, 0));
        while merged.len() >= 2 {
            let (child, parent) = (&merged[merged.len() - 2], &merged[merged.len() - 1]);
            if !parent.0.columns.contains(&child.0.parent) {
                break;
            }
            let added = child.1 * (parent.1 + parent.2 - child.2);
            let zeros = child.3 + parent.3 + added;
            let width = child.1 + parent.1;
            let size = width * (width + 1) / 2 + width * parent.2;
            let allowed = RELAXED.iter().find(|(limit, _)| width <= *limit);
            let share = zeros as f64 / size as f64;
            if added > 0 && allowed.is_none_or(|(_, allowed)| share > *allowed) {
                break;
            }
            let first = child.0.columns.start;
            let Some((mut node, _, rows, _)) = merged.pop() else { break };
            merged.pop();
            node.columns.start = first;
            merged.push((node, width, rows, zeros));
        }
    }
    let mut owner = vec![0; dims.len()];
    for (k, (node, ..)) in merged.iter().enumerate() {
        owner[node.columns.clone()].fill(k);
    }
    merged
        .into_iter()
        .map(|(mut node, ..)| {
            if node.parent != NO_PARENT {
                node.parent = owner[node.parent];
            }
            node
        })
        .collect()
}
