//! A small bundle adjustment with a residual of your own, differentiated by dual numbers.
//!
//! ```sh
//! cargo run -p rowgram-optim --example small_bundle
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram_optim::{
    engine::SolveError,
    nlls::{
        Euclidean, Infeasible, Loss, Options, Problem, Residual, Residuals, Scalar, Vector,
        manifold,
        residual::{PoseBlock, RigidTransform},
        solve,
    },
};

/// A point measured in an image by a camera without distortion, looking along `-z`, pixels.
struct Reprojection([f64; 2]);

impl Residual<2> for Reprojection {
    type Blocks = (PoseBlock, Vector<3>);
    fn evaluate<T: Scalar>(
        &self,
        (camera, point): (RigidTransform<T>, [T; 3]),
    ) -> Result<[T; 2], Infeasible> {
        let p = camera.transform(point);
        if p[2].value() >= 0.0 {
            return Err(Infeasible); // behind the camera
        }
        Ok([-p[0] / p[2] * 900.0 - self.0[0], -p[1] / p[2] * 900.0 - self.0[1]])
    }
}

pub(crate) fn main() -> Result<(), SolveError> {
    let truth = |k: i32| [f64::from(k % 5) - 2.0, f64::from(k / 5) - 2.0, 0.2 * f64::from(k % 3)];
    let mut problem = Problem::new();
    let mut cameras = Vec::new();
    for k in 0..3 {
        let away = if k == 0 { 0.0 } else { 0.05 };
        let values = [1.0, 0.0, 0.0, 0.0, 0.5 - f64::from(k) + away, away, -8.0 - away];
        cameras.push(problem.block("camera", manifold::Pose, &values)?);
    }
    // The first camera and one coordinate of the second hold position, orientation and scale.
    problem.fix(cameras[0]);
    let away = problem.values(&problem.start(), cameras[1])[4] + 0.5;
    problem.fix_entries(cameras[1], &[3])?;
    let mut seen = Vec::new();
    for k in 0..25 {
        let [x, y, z] = truth(k);
        let point = problem.block("point", Euclidean(3), &[x + 0.1, y - 0.1, z + 0.1])?;
        problem.eliminate(point);
        for (c, &camera) in (0i32..).zip(&cameras) {
            let moved = if c == 1 { away } else { 0.0 };
            let p = [x + 0.5 - f64::from(c) + moved, y, z - 8.0];
            seen.push(([camera, point], Reprojection([0, 1].map(|i| -p[i] / p[2] * 900.0))));
        }
    }
    problem.add("tie points", Loss::Huber(1.0), Residuals::new(seen))?;
    let mut x = problem.start();
    let summary = solve(&problem, &mut x, &Options::default(), 50)?;
    println!("{summary}");
    assert!(summary.final_cost < 1e-12);
    Ok(())
}
