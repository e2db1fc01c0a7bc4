//! What targets look like: how much of a place is white and how much black, seen through a Gaussian blur.
//!
//! In the frame of the target (`x` to the right, `y` down when it is read, its size 1) a target is a grid of white and black
//! cells, whose blurred share is a product of two differences of the normal distribution `Phi`, or a disc:
//!
//! ```text
//! white(x, y) = sum_ij c_ij (Phi((x - x_i)/s) - Phi((x - x_{i+1})/s)) (Phi((y - y_j)/s) - Phi((y - y_{j+1})/s))
//! disc(x, y)  = Phi((1/2 - sqrt(x^2 + y^2))/s)
//! ```

use super::{
    TargetKind,
    codes::{APRILTAG, ARUCO, Family},
};
use statrs::function::erf::erf;
use std::{f64::consts::FRAC_1_SQRT_2, sync::LazyLock};

/// Width of the arms of a cross over their length: that of two boards of 10 cm by 50 cm.
const ARM_WIDTH: f64 = 0.2;
/// What is seen of the ground around a target, in its size.
const MARGIN: f64 = 0.15;

/// A grid of cells, or a disc.
#[derive(Debug, Clone, PartialEq)]
enum Form {
    Grid { lines: Vec<f64>, white: Vec<bool> },
    Disc,
}

/// What a kind of target looks like.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Shape {
    form: Form,
    /// How far from its middle it is compared with a photo, along `x` or `y`.
    pub(super) reach: f64,
    /// Where the comparison begins; 0 but for codes that are not yet known.
    hole: f64,
    /// Turn after which it looks the same, or with white and black exchanged, radians; `None` where it always does.
    pub(super) period_rad: Option<f64>,
    /// Whether white and black make up a plate that alone is not enough.
    pub(super) has_plate: bool,
}

impl Shape {
    /// A kind, of coded targets the border only.
    pub(super) fn of(kind: TargetKind) -> Shape {
        let quarter = std::f64::consts::FRAC_PI_2;
        match kind {
            TargetKind::Chequered => Shape {
                form: Form::Grid {
                    lines: vec![-0.5, 0.0, 0.5],
                    white: vec![true, false, false, true],
                },
                reach: 0.5 + MARGIN,
                hole: 0.0,
                period_rad: Some(quarter),
                has_plate: true,
            },
            TargetKind::Cross => {
                let half = 0.5 * ARM_WIDTH;
                let white = (0..9).map(|k| k % 2 == 1 || k == 4).collect();
                Shape {
                    form: Form::Grid { lines: vec![-0.5, -half, half, 0.5], white },
                    reach: 0.5 + MARGIN,
                    hole: 0.0,
                    period_rad: Some(quarter),
                    has_plate: true,
                }
            }
            TargetKind::Disc => Shape {
                form: Form::Disc,
                reach: 0.5 + MARGIN,
                hole: 0.0,
                period_rad: None,
                has_plate: false,
            },
            TargetKind::Apriltag => Shape::coded(&APRILTAG, None),
            TargetKind::Aruco => Shape::coded(&ARUCO, None),
        }
    }

    /// A coded target: white margin of one cell, black border of one cell, and the cells of the code. The size is that of the black
    /// square.
    pub(super) fn coded(family: &Family, code: Option<usize>) -> Shape {
        let side = family.cells + 4;
        let cell = 1.0 / (family.cells + 2) as f64;
        let lines = (0..=side).map(|k| (k as f64 - 0.5 * side as f64) * cell).collect();
        let inner = code.map(|code| family.white(code));
        let white = (0..side * side).map(|k| {
            let (row, column) = (k / side, k % side);
            let ring = row.min(column).min(side - 1 - row).min(side - 1 - column);
            match (ring, &inner) {
                (0, _) => true,
                (1, _) | (_, None) => false,
                (_, Some(inner)) => inner[(row - 2) * family.cells + column - 2],
            }
        });
        Shape {
            form: Form::Grid { lines, white: white.collect() },
            reach: 0.5 + 0.8 * cell,
            hole: if code.is_some() { 0.0 } else { 0.5 - 0.7 * cell },
            period_rad: Some(std::f64::consts::FRAC_PI_2),
            has_plate: true,
        }
    }

    /// Whether a place is compared with a photo.
    pub(super) fn covers(&self, [x, y]: [f64; 2]) -> bool {
        let far = match self.form {
            Form::Disc => x.hypot(y),
            Form::Grid { .. } => x.abs().max(y.abs()),
        };
        (self.hole..=self.reach).contains(&far)
    }

    /// Area that is compared with a photo, in squares of the size.
    pub(super) fn area(&self) -> f64 {
        let square = 4.0 * (self.reach * self.reach - self.hole * self.hole);
        match self.form {
            Form::Disc => square * std::f64::consts::FRAC_PI_4,
            Form::Grid { .. } => square,
        }
    }

    /// White and black shares of a place, through a blur of standard deviation `sigma`.
    pub(super) fn shares(&self, [x, y]: [f64; 2], sigma: f64) -> [f64; 2] {
        match &self.form {
            Form::Disc => [below((0.5 - x.hypot(y)) / sigma), 0.0],
            Form::Grid { lines, white } => {
                let cells = lines.len() - 1;
                let mut columns = [0.0; MAX_CELLS];
                let mut before = below((x - lines[0]) / sigma);
                for (column, line) in columns.iter_mut().zip(&lines[1..]) {
                    let after = below((x - line) / sigma);
                    *column = before - after;
                    before = after;
                }
                let across: f64 = columns[..cells].iter().sum();
                let (mut bright, mut all) = (0.0, 0.0);
                let mut before = below((y - lines[0]) / sigma);
                for (row, line) in lines[1..].iter().enumerate() {
                    let after = below((y - line) / sigma);
                    let share = before - after;
                    before = after;
                    all += share * across;
                    if share < 1e-6 {
                        continue;
                    }
                    let cells = columns.iter().zip(&white[row * cells..(row + 1) * cells]);
                    bright += share * cells.map(|(c, &w)| if w { *c } else { 0.0 }).sum::<f64>();
                }
                [bright, all - bright]
            }
        }
    }
}

/// A target as areas: left, top, width, height in its size, from its middle, `y` down.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Drawing {
    /// Side of the whole.
    pub(super) side: f64,
    pub(super) black: Vec<[f64; 4]>,
    /// On top of those.
    pub(super) white: Vec<[f64; 4]>,
    /// A white disc of the size on top of all.
    pub(super) has_disc: bool,
}

impl Shape {
    /// A kind as it is printed: a disc on a black square half as wide again, a coded target with its white margin.
    pub(super) fn drawing(kind: TargetKind, code: usize) -> Drawing {
        let shape = match kind {
            TargetKind::Apriltag => Shape::coded(&APRILTAG, Some(code)),
            TargetKind::Aruco => Shape::coded(&ARUCO, Some(code)),
            TargetKind::Chequered | TargetKind::Cross | TargetKind::Disc => Shape::of(kind),
        };
        let square = |side: f64| [-0.5 * side, -0.5 * side, side, side];
        match shape.form {
            Form::Disc => {
                Drawing { side: 1.5, black: vec![square(1.5)], white: Vec::new(), has_disc: true }
            }
            Form::Grid { lines, white } => {
                let cells = lines.len() - 1;
                let side = lines[cells] - lines[0];
                let areas = (0..cells * cells).filter(|&k| white[k]).map(|k| {
                    let (i, j) = (k % cells, k / cells);
                    [lines[i], lines[j], lines[i + 1] - lines[i], lines[j + 1] - lines[j]]
                });
                Drawing { side, black: vec![square(side)], white: areas.collect(), has_disc: false }
            }
        }
    }
}

/// Cells along a side of the largest grid, that of AprilTag 36h11 with its margins.
const MAX_CELLS: usize = 10;

/// Beyond this the normal distribution is 0 or 1: less than a hundredth of a grey value.
const TAIL: f64 = 4.0;
/// Nodes of its table for each unit.
const NODES: f64 = 32.0;
/// The normal distribution and its slope for one step of the table, from `-TAIL` on.
static NORMAL: LazyLock<Vec<[f64; 2]>> = LazyLock::new(|| {
    let node = |k: usize| {
        let z = k as f64 / NODES - TAIL;
        let slope = (-0.5 * z * z).exp() / (std::f64::consts::TAU.sqrt() * NODES);
        [0.5 + 0.5 * erf(z * FRAC_1_SQRT_2), slope]
    };
    (0..=(2.0 * TAIL * NODES) as usize + 1).map(node).collect()
});

/// The normal distribution, by cubics between the nodes of a table: within 4e-9.
fn below(z: f64) -> f64 {
    let at = (z + TAIL) * NODES;
    if at <= 0.0 {
        return 0.0;
    }
    if z >= TAIL {
        return 1.0;
    }
    let node = at as usize;
    let (t, table) = (at - node as f64, &*NORMAL);
    let [[from, leaves], [to, arrives]] = [table[node], table[node + 1]];
    let rise = to - from;
    from + t
        * (leaves
            + t * ((3.0 * rise - 2.0 * leaves - arrives) + t * (leaves + arrives - 2.0 * rise)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_the_normal_distribution() {
        for k in -3999..4000 {
            let z = f64::from(k) * 1e-3;
            let exact = 0.5 + 0.5 * erf(z * FRAC_1_SQRT_2);
            assert!((below(z) - exact).abs() < 4e-9, "{z}: {} {exact}", below(z));
        }
        assert_eq!([-9.0, -4.0, 4.0, 9.0].map(below), [0.0, 0.0, 1.0, 1.0]);
    }

    #[test]
    fn shares_are_those_of_the_pattern_where_it_is_sharp() {
        let chequered = Shape::of(TargetKind::Chequered);
        for (at, expected) in [
            ([-0.2, -0.2], [1.0, 0.0]),
            ([0.2, -0.2], [0.0, 1.0]),
            ([0.2, 0.2], [1.0, 0.0]),
            ([0.6, 0.2], [0.0, 0.0]),
        ] {
            let found = chequered.shares(at, 0.01);
            assert!((0..2).all(|k| (found[k] - expected[k]).abs() < 1e-9), "{at:?}: {found:?}");
        }
        let cross = Shape::of(TargetKind::Cross);
        assert!(cross.shares([0.3, 0.0], 0.01)[0] > 0.99);
        assert!(cross.shares([0.3, 0.3], 0.01)[1] > 0.99);
        // Half of it beside a straight edge, whatever the blur.
        let disc = Shape::of(TargetKind::Disc);
        assert!((disc.shares([0.5, 0.0], 0.1)[0] - 0.5).abs() < 1e-9);
        let coded = Shape::coded(&APRILTAG, Some(0));
        // Word 0 begins with 110101.
        let cell = 0.125;
        for (k, white) in [true, true, false, true, false, true].into_iter().enumerate() {
            let at = [-0.5 + cell * (k as f64 + 1.5), -0.5 + 1.5 * cell];
            assert_eq!(coded.shares(at, 0.01)[0] > 0.5, white, "{k}");
        }
    }
}
