//! A run with a limit, a trace and checkpoints, that is broken off and goes on where it was: the same bytes as one that
//! was not.
//!
//! ```sh
//! cargo run -p rowgram-optim --example drive_with_checkpoint
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram_optim::{
    drive::{Drive, DriveError, Fingerprint, Limits},
    nlls::{
        Euclidean, Infeasible, LeastSquares, Loss, Options, Problem, Residual, Residuals, Scalar,
        Vector,
    },
};

/// A point `(t, y)` of a curve `a exp(-b t) + c`.
struct Sample {
    t: f64,
    y: f64,
}

impl Residual<1> for Sample {
    type Blocks = (Vector<3>,);
    fn evaluate<T: Scalar>(&self, ([a, b, c],): ([T; 3],)) -> Result<[T; 1], Infeasible> {
        Ok([a * (b * -self.t).exp() + c - self.y])
    }
}

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut problem = Problem::new();
    let curve = problem.block("curve", Euclidean(3), &[1.0, 0.01, 0.0])?;
    let samples = (0..60).map(|k| {
        let t = 0.2 * f64::from(k);
        ([curve], Sample { t, y: 8.0 * (-0.7 * t).exp() + 2.0 + 0.02 * (9.0 * t).sin() })
    });
    problem.add("samples", Loss::Trivial, Residuals::new(samples))?;
    let folder = std::env::temp_dir().join(format!("rowgram-drive-{}", std::process::id()));
    std::fs::create_dir_all(&folder)?;
    let (checkpoint, trace) = (folder.join("run.checkpoint"), folder.join("trace.csv"));
    let options = Options::default();
    // What decides the run: a checkpoint is not resumed on another problem.
    let mark = Fingerprint::new().numbers(&problem.start()).text(&format!("{options:?}")).finish();
    let new = || Drive::new(&problem, LeastSquares::new(options.clone()), problem.start());
    let whole = new().run()?.checked()?;

    let broken_off =
        new().fingerprint(mark).checkpoint(&checkpoint, 2).limits(Limits::iterations(3)).run()?;
    println!("broken off: {}", broken_off.brief());
    let resumed = new()
        .fingerprint(mark)
        .resume_from(&checkpoint)
        .checkpoint(&checkpoint, 2)
        .trace(&trace)
        .on_step(|event| println!("iteration {}: cost {:.6e}", event.iteration, event.cost))
        .run()?
        .checked()?;
    println!("resumed: {}", resumed.brief());
    assert_eq!(resumed.iterations, whole.iterations);
    assert_eq!(resumed.x, whole.x);
    let rows = std::fs::read_to_string(&trace)?.lines().count();
    println!("{rows} lines in {}", trace.display());
    let refused = new().fingerprint(mark + 1).resume_from(&checkpoint).run();
    assert!(matches!(refused, Err(DriveError::File(_))));
    std::fs::remove_dir_all(&folder)?;
    Ok(())
}
