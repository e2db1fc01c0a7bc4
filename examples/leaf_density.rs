//! A leaf density of your own for the locator: tails so heavy that weeds between the rows hardly pull.
//!
//! ```sh
//! cargo run --example leaf_density
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram::{
    descent::{CoordinateDescentOptions, run},
    engine::SolveError,
    problems::plants::{
        LeafDensity, Model, Plants, Prior, SigmaRule, index::PixelIndex, lines::Axes,
    },
};

/// Student's t in the plane with so many degrees of freedom.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Student(pub(crate) f64);

impl LeafDensity for Student {
    fn cost(&self, ratio2: f64) -> f64 {
        0.5 * (self.0 + 2.0) * (ratio2 / self.0).ln_1p()
    }
    fn slope(&self, ratio2: f64) -> f64 {
        0.5 * (self.0 + 2.0) / (self.0 + ratio2)
    }
}

pub(crate) fn main() -> Result<(), SolveError> {
    // Three rows of ten plants with discs of leaf, and a weed beside every third plant.
    let truth: Vec<[f64; 2]> = (0..30)
        .map(|p| [40.0 + 30.0 * f64::from(p % 10), 40.0 + 60.0 * f64::from(p / 10)])
        .collect();
    let disc = |at: [f64; 2], radius: i32| {
        let square = (-radius..=radius).flat_map(move |v| (-radius..=radius).map(move |u| [u, v]));
        let inside = square.filter(move |[u, v]| u * u + v * v <= radius * radius);
        inside.map(move |d| [0, 1].map(|k| (at[k] + f64::from(d[k])) as u32))
    };
    let plants = truth.iter().flat_map(|&at| disc(at, 6));
    let weeds = truth.iter().step_by(3).flat_map(|&[u, v]| disc([u + 3.0, v + 20.0], 5));
    let index = PixelIndex::new(&plants.chain(weeds).collect::<Vec<_>>());
    let start: Vec<[f64; 2]> = truth.iter().map(|[u, v]| [u + 4.0, v + 2.0]).collect();
    let model = Model { prior: Prior::None, sigma: SigmaRule::Planar, ..Model::default() };
    let axes = Axes { origin_px: [0.0; 2], heading_rad: 0.0 };
    let farthest = |positions: &[[f64; 2]]| {
        let away = positions.iter().zip(&truth).map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1]));
        away.fold(0.0, f64::max)
    };
    let exponential = Plants::new(index, 30, model, axes)?;
    let student = exponential.clone().with_density(Student(1.0));
    let options = CoordinateDescentOptions::default();
    let mut x = exponential.field(start.clone(), &[], &[])?;
    run(&exponential, &mut x, options, 200, |_, _| ())?;
    let before = farthest(&x.positions_px);
    let mut x = student.field_with(start, x.latent)?;
    let end = run(&student, &mut x, options, 200, |_, _| ())?;
    let after = farthest(&x.positions_px);
    println!(
        "the farthest plant: {before:.1} px away as the paper has it, {after:.1} px with heavy tails"
    );
    assert!(after < 0.5 * before && end.stop.converged(), "{before} {after}");
    Ok(())
}
