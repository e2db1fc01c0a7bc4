//! The examples run, all of them, and none is long.

macro_rules! examples {
    ($($name:ident: $path:literal),+ $(,)?) => {
        $(
            #[path = $path]
            mod $name;
        )+

        $(
            #[test]
            fn $name() {
                $name::main().unwrap();
            }
        )+

        #[test]
        fn every_example_is_run_and_short() {
            let listed = [$(stringify!($name)),+];
            let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                let name = path.file_stem().unwrap().to_string_lossy().into_owned();
                assert!(listed.contains(&name.as_str()), "examples/{name}.rs is not run");
                let text = std::fs::read_to_string(&path).unwrap();
                let lines = text.lines().filter(|line| !line.trim_start().starts_with("//")).count();
                assert!(lines <= 70, "examples/{name}.rs has {lines} lines");
            }
        }
    };
}

examples! {
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
