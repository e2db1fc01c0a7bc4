//! The examples run, all of them, and none is long.

#[path = "example_runner.rs"]
#[macro_use]
mod example_runner;

examples! {
    except []
    hello_world: "../examples/hello_world.rs",
    curve_fitting: "../examples/curve_fitting.rs",
    pose_graph: "../examples/pose_graph.rs",
    small_bundle: "../examples/small_bundle.rs",
    covariance: "../examples/covariance.rs",
    custom_loss: "../examples/custom_loss.rs",
    custom_manifold: "../examples/custom_manifold.rs",
    custom_prior: "../examples/custom_prior.rs",
    compare_solvers: "../examples/compare_solvers.rs",
    coordinate_descent: "../examples/coordinate_descent.rs",
    drive_with_checkpoint: "../examples/drive_with_checkpoint.rs",
}
