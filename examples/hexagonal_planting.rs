//! A prior of your own for the locator: hexagonal planting, where neighbouring rows are shifted by half a spacing.
//!
//! ```sh
//! cargo run --example hexagonal_planting
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram::{
    descent::{CoordinateDescentOptions, run},
    engine::SolveError,
    problems::plants::{Model, PlantPrior, Plants, Quadratic, index::PixelIndex},
};

/// Distances between the plants of a row and between rows, pixels.
#[derive(Clone, Debug)]
struct Hexagonal([f64; 2]);
/// Where the lattice begins, the variance of the plants about it, and where each plant is expected.
type Lattice = ([f64; 2], f64, Vec<[f64; 2]>);

fn square(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)
}

impl PlantPrior for Hexagonal {
    type Latent = Lattice;
    fn is_sound(&self, x: &Lattice, plants: usize) -> bool {
        x.1 > 0.0 && x.2.len() == plants
    }
    fn add_to(&self, x: &Lattice, plant: usize, at: [f64; 2], prior: &mut Quadratic) {
        prior.add([1.0, 0.0], x.2[plant][0] - at[0], x.1);
        prior.add([0.0, 1.0], x.2[plant][1] - at[1], x.1);
    }
    fn add_cost(&self, x: &Lattice, positions: &[[f64; 2]], cost: &mut f64) {
        let of = |(&at, &node)| square(at, node) / (2.0 * x.1) + x.1.ln();
        *cost += positions.iter().zip(&x.2).map(of).sum::<f64>();
    }
    fn refit(&self, (origin, variance, expected): &mut Lattice, positions: &[[f64; 2]]) {
        let ([along, across], n) = (self.0, positions.len() as f64);
        let node = |at: &[f64; 2], next: f64| {
            let row = ((at[1] - origin[1]) / across).floor() + next;
            let shift = origin[0] + 0.5 * along * row.rem_euclid(2.0);
            [((at[0] - shift) / along).round() * along + shift, origin[1] + row * across]
        };
        let nearer = |at, a, b| if square(at, b) < square(at, a) { b } else { a };
        let nearest = |at: &[f64; 2]| nearer(*at, node(at, 0.0), node(at, 1.0));
        *expected = positions.iter().map(nearest).collect();
        for k in 0..2 {
            let off = positions.iter().zip(&*expected).map(|(at, node)| at[k] - node[k]);
            let shift = off.sum::<f64>() / n;
            expected.iter_mut().for_each(|node| node[k] += shift);
            origin[k] += shift;
        }
        let squares = positions.iter().zip(expected).map(|(&at, node)| square(at, *node));
        *variance = (squares.sum::<f64>() / (2.0 * n)).max(0.25);
    }
}

pub(crate) fn main() -> Result<(), SolveError> {
    // Five rows of eight plants; of every third plant only the leaves on one side are seen.
    let node = |p: usize| [33 + 24 * (p % 8) + 12 * (p / 8 % 2), 27 + 20 * (p / 8)];
    let leaf = |k: usize| (k / 225, [k % 15, k / 15 % 15]);
    let seen = (0..9000).map(leaf).filter(|(p, d)| p % 3 > 0 || d[0] > 7);
    let seen = seen.map(|(p, d)| [0, 1].map(|k| (node(p)[k] + d[k] - 7) as u32));
    let index = PixelIndex::new(&seen.collect::<Vec<_>>());
    let start: Vec<_> = (0..40).map(|p| node(p).map(|v| v as f64 + 3.0)).collect();
    let model = Model { tempering: Some(6.0), ..Model::default() };
    let problem = Plants::with_prior(index, 40, model, Hexagonal([24.0, 20.0]))?;
    let mut lattice = ([30.0, 30.0], 9.0, Vec::new());
    problem.prior().refit(&mut lattice, &start);
    let mut x = problem.field_with(start, lattice)?;
    let end = run(&problem, &mut x, CoordinateDescentOptions::default(), 200, |_, _| ())?;
    let away = |(p, &at)| square(at, node(p).map(|v| v as f64)).sqrt();
    let worst = x.positions_px.iter().enumerate().map(away).fold(0.0, f64::max);
    println!("{} sweeps, the worst plant is {worst:.1} px away", end.iterations);
    // Their pixels alone would put a third of the plants 4 px away.
    assert!(worst < 3.0 && end.stop.converged(), "{worst}");
    Ok(())
}
