//! A pose graph: a round of relative measurements that drifts, closed by a loop.
//!
//! ```sh
//! cargo run -p rowgram-optim --example pose_graph
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram_optim::{
    engine::SolveError,
    geometry::rotation,
    nlls::{
        Infeasible, Loss, Options, Problem, Residual, Residuals, Scalar, manifold,
        residual::{PoseBlock, RigidTransform},
        solve,
    },
};

/// The step from one pose to the next, both `world_from_body`: the second's origin seen from the
/// first (metres), and its heading (radians).
struct Step {
    step_m: [f64; 3],
    heading_rad: f64,
}

impl Residual<6> for Step {
    type Blocks = (PoseBlock, PoseBlock);
    fn evaluate<T: Scalar>(
        &self,
        (a, b): (RigidTransform<T>, RigidTransform<T>),
    ) -> Result<[T; 6], Infeasible> {
        let seen = a.transform_back(b.translation);
        let r = a.rotation.between(&b.rotation).0;
        let heading = r[1][0].atan2(r[0][0]) - self.heading_rad;
        let step: [T; 3] = std::array::from_fn(|k| (seen[k] - self.step_m[k]) / 0.05);
        Ok([step[0], step[1], step[2], heading / 0.01, r[2][0] / 0.01, r[2][1] / 0.01])
    }
}

pub(crate) fn main() -> Result<(), SolveError> {
    const COUNT: usize = 12;
    let turn_rad = 2.0 * std::f64::consts::PI / COUNT as f64;
    let mut problem = Problem::new();
    let mut poses = Vec::new();
    let (mut heading, mut at) = (0.0f64, [0.0; 2]);
    for _ in 0..COUNT {
        let q = rotation::exp([0.0, 0.0, heading]);
        let values = [q[0], q[1], q[2], q[3], at[0], at[1], 0.0];
        poses.push(problem.block("pose", manifold::Pose, &values)?);
        // The start drifts: 3 % too far, 2 % too little of a turn.
        at = [at[0] + 1.03 * heading.cos(), at[1] + 1.03 * heading.sin()];
        heading += 0.98 * turn_rad;
    }
    problem.fix(poses[0]);
    let steps = (0..COUNT).map(|k| {
        let blocks = [poses[k], poses[(k + 1) % COUNT]];
        (blocks, Step { step_m: [1.0, 0.0, 0.0], heading_rad: turn_rad })
    });
    problem.add("steps", Loss::Trivial, Residuals::new(steps))?;
    let mut x = problem.start();
    println!("{}", solve(&problem, &mut x, &Options::default(), 50)?);
    let last = problem.values(&x, poses[COUNT - 1]);
    assert!((last[4].hypot(last[5]) - 1.0).abs() < 1e-3, "{last:?}");
    Ok(())
}
