//! A k-d tree of points in the plane, from which points can be withdrawn for a while.
//!
//! Every box knows the tight bounds of its points and how many of them are there at the moment, so
//! that a search passes over what is used up.

/// Points in one leaf.
const LEAF: usize = 8;

/// One box: the points `order[start..end]`.
struct Node {
    lower: [f64; 2],
    upper: [f64; 2],
    start: usize,
    end: usize,
    parent: usize,
    halves: Option<[usize; 2]>,
    alive: usize,
}

/// The tree; points and boxes go by their indices.
pub(super) struct Tree {
    nodes: Vec<Node>,
    order: Vec<usize>,
    leaf_of: Vec<usize>,
    alive: Vec<bool>,
}

impl Tree {
    /// The box of all points.
    pub(super) const ROOT: usize = 0;

    pub(super) fn new(points: &[[f64; 2]]) -> Tree {
        let mut tree = Tree {
            nodes: Vec::with_capacity(4 * points.len() / LEAF + 1),
            order: (0..points.len()).collect(),
            leaf_of: vec![0; points.len()],
            alive: vec![true; points.len()],
        };
        tree.nodes.push(Node::over(points, &tree.order, 0, Tree::ROOT));
        let mut next = 0;
        while next < tree.nodes.len() {
            tree.split(points, next);
            next += 1;
        }
        tree
    }

    /// Cuts a box at the median of its longer side, unless it is small enough for a leaf.
    fn split(&mut self, points: &[[f64; 2]], index: usize) {
        let Node { lower, upper, start, end, .. } = self.nodes[index];
        if end - start <= LEAF {
            for &point in &self.order[start..end] {
                self.leaf_of[point] = index;
            }
            return;
        }
        let axis = usize::from(upper[1] - lower[1] > upper[0] - lower[0]);
        let half = (end - start) / 2;
        self.order[start..end].select_nth_unstable_by(half, |&a, &b| {
            points[a][axis].total_cmp(&points[b][axis]).then(a.cmp(&b))
        });
        let middle = start + half;
        self.nodes[index].halves = Some([self.nodes.len(), self.nodes.len() + 1]);
        for (start, end) in [(start, middle), (middle, end)] {
            self.nodes.push(Node::over(points, &self.order[start..end], start, index));
        }
    }

    /// Distance from a position to a box, no larger than that to any of its points; `None` where
    /// no point is left in it.
    pub(super) fn distance(&self, index: usize, [u, v]: [f64; 2]) -> Option<f64> {
        let Node { lower, upper, alive, .. } = self.nodes[index];
        let beyond = |x: f64, axis: usize| (lower[axis] - x).max(x - upper[axis]).max(0.0);
        let (du, dv) = (beyond(u, 0), beyond(v, 1));
        (alive > 0).then(|| (du * du + dv * dv).sqrt())
    }

    /// The two halves of a box, `None` for a leaf.
    pub(super) fn halves(&self, index: usize) -> Option<[usize; 2]> {
        self.nodes[index].halves
    }

    /// The points of a box, withdrawn or not.
    pub(super) fn points(&self, index: usize) -> &[usize] {
        &self.order[self.nodes[index].start..self.nodes[index].end]
    }

    pub(super) fn is_alive(&self, point: usize) -> bool {
        self.alive[point]
    }

    /// Withdraws a point that is there.
    pub(super) fn kill(&mut self, point: usize) {
        debug_assert!(self.alive[point], "a point is withdrawn once");
        self.alive[point] = false;
        self.count(point, |alive| *alive -= 1);
    }

    /// Brings a withdrawn point back.
    pub(super) fn revive(&mut self, point: usize) {
        debug_assert!(!self.alive[point], "only a withdrawn point comes back");
        self.alive[point] = true;
        self.count(point, |alive| *alive += 1);
    }

    fn count(&mut self, point: usize, change: impl Fn(&mut usize)) {
        let mut index = self.leaf_of[point];
        change(&mut self.nodes[index].alive);
        while index != Tree::ROOT {
            index = self.nodes[index].parent;
            change(&mut self.nodes[index].alive);
        }
    }
}

impl Node {
    fn over(points: &[[f64; 2]], of: &[usize], start: usize, parent: usize) -> Node {
        let (mut lower, mut upper) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for axis in 0..2 {
            for &point in of {
                lower[axis] = lower[axis].min(points[point][axis]);
                upper[axis] = upper[axis].max(points[point][axis]);
            }
        }
        Node { lower, upper, start, end: start + of.len(), parent, halves: None, alive: of.len() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_bound_their_points_and_count_them() {
        let points: Vec<[f64; 2]> =
            (0..100).map(|i| [f64::from(i * 37 % 101), f64::from(i * 53 % 97)]).collect();
        let mut tree = Tree::new(&points);
        let (mut leaves, here) = (0, [20.5, -3.0]);
        for index in 0..tree.nodes.len() {
            let least = tree.distance(index, here).unwrap();
            for &point in tree.points(index) {
                assert!((points[point][0] - here[0]).hypot(points[point][1] - here[1]) >= least);
            }
            leaves += if tree.halves(index).is_none() { tree.points(index).len() } else { 0 };
        }
        assert_eq!(leaves, points.len());
        (0..100).for_each(|point| tree.kill(point));
        assert_eq!(tree.distance(Tree::ROOT, here), None);
        tree.revive(7);
        assert!(tree.distance(Tree::ROOT, points[7]).is_some() && tree.is_alive(7));
        assert_eq!(Tree::new(&[]).distance(Tree::ROOT, here), None);
    }
}
