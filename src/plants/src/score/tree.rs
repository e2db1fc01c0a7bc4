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
pub(crate) struct Tree {
    nodes: Vec<Node>,
    order: Vec<usize>,
    leaf_of: Vec<usize>,
    alive: Vec<bool>,
}

impl Tree {
    /// The box of all points.
    pub(crate) const ROOT: usize = 0;

    pub(crate) fn new(points: &[[f64; 2]]) -> Tree {
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
    pub(crate) fn distance(&self, index: usize, [u, v]: [f64; 2]) -> Option<f64> {
        let Node { lower, upper, alive, .. } = self.nodes[index];
        let beyond = |x: f64, axis: usize| (lower[axis] - x).max(x - upper[axis]).max(0.0);
        let (du, dv) = (beyond(u, 0), beyond(v, 1));
        (alive > 0).then(|| (du * du + dv * dv).sqrt())
    }

    /// The two halves of a box, `None` for a leaf.
    pub(crate) fn halves(&self, index: usize) -> Option<[usize; 2]> {
        self.nodes[index].halves
    }

    /// The points of a box, withdrawn or not.
    pub(crate) fn points(&self, index: usize) -> &[usize] {
        &self.order[self.nodes[index].start..self.nodes[index].end]
    }

    /// The point nearest to a position, of equals the first, and its distance; `but` is passed over.
    pub(crate) fn nearest(
        &self,
        points: &[[f64; 2]],
        at: [f64; 2],
        but: Option<usize>,
    ) -> Option<(usize, f64)> {
        let mut best: Option<(f64, usize)> = None;
        let mut open = vec![Tree::ROOT];
        while let Some(index) = open.pop() {
            let least = self.distance(index, at);
            if least.is_none_or(|least| best.is_some_and(|(distance, _)| least > distance)) {
                continue;
            }
            if let Some([a, b]) = self.halves(index) {
                // The nearer one is looked at first.
                let is_a = self.distance(a, at) < self.distance(b, at);
                open.extend(if is_a { [b, a] } else { [a, b] });
                continue;
            }
            for &point in self.points(index).iter().filter(|point| self.alive[**point]) {
                let [du, dv] = [0, 1].map(|k| points[point][k] - at[k]);
                let found = ((du * du + dv * dv).sqrt(), point);
                if Some(point) != but && best.is_none_or(|best| found < best) {
                    best = Some(found);
                }
            }
        }
        best.map(|(distance, point)| (point, distance))
    }

    pub(crate) fn is_alive(&self, point: usize) -> bool {
        self.alive[point]
    }

    /// Withdraws a point that is there.
    pub(crate) fn kill(&mut self, point: usize) {
        debug_assert!(self.alive[point], "a point is withdrawn once");
        self.alive[point] = false;
        self.count(point, |alive| *alive -= 1);
    }

    /// Brings a withdrawn point back.
    pub(crate) fn revive(&mut self, point: usize) {
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

    #[test]
    fn the_nearest_point_is_that_of_a_look_at_all() {
        let points: Vec<[f64; 2]> =
            (0..100).map(|i| [f64::from(i * 37 % 11), f64::from(i * 53 % 13)]).collect();
        let mut tree = Tree::new(&points);
        tree.kill(3);
        for k in 0..200 {
            let at = [f64::from(k % 17) - 2.5, f64::from(k % 19) - 3.0];
            let (at, but) = if k < 100 {
                (at, None)
            } else {
                (points[k as usize - 100], Some(k as usize - 100))
            };
            let distance = |p: usize| {
                let [du, dv] = [points[p][0] - at[0], points[p][1] - at[1]];
                (du * du + dv * dv).sqrt()
            };
            let expected = (0..100)
                .filter(|p| *p != 3 && Some(*p) != but)
                .min_by(|&a, &b| distance(a).total_cmp(&distance(b)));
            let expected = expected.map(|p| (p, distance(p)));
            assert_eq!(tree.nearest(&points, at, but), expected);
        }
        assert_eq!(Tree::new(&[]).nearest(&[], [0.0; 2], None), None);
    }
}
