//! The examples run.

#[path = "../src/optim/tests/example_runner.rs"]
#[macro_use]
mod example_runner;

examples! {
    except ["photos_to_plants"]
    built_in_bundle: "../examples/built_in_bundle.rs",
    calibrate_corners: "../examples/calibrate_corners.rs",
    locate_array: "../examples/locate_array.rs",
    plant_priors: "../examples/plant_priors.rs",
    hexagonal_planting: "../examples/hexagonal_planting.rs",
    leaf_density: "../examples/leaf_density.rs",
}
