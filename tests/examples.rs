//! The examples run.

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
                if path.extension().is_none_or(|extension| extension != "rs")
                    || NOT_HERE.contains(&name.as_str())
                {
                    continue;
                }
                assert!(listed.contains(&name.as_str()), "examples/{name}.rs is not run");
                let text = std::fs::read_to_string(&path).unwrap();
                let lines = text.lines().filter(|line| !line.trim_start().starts_with("//")).count();
                assert!(lines <= 70, "examples/{name}.rs has {lines} lines");
            }
        }
    };
}

/// Examples that other tests run.
const NOT_HERE: [&str; 1] = ["photos_to_plants"];

examples! {
    built_in_bundle: "../examples/built_in_bundle.rs",
    calibrate_corners: "../examples/calibrate_corners.rs",
    locate_array: "../examples/locate_array.rs",
    plant_priors: "../examples/plant_priors.rs",
    hexagonal_planting: "../examples/hexagonal_planting.rs",
    leaf_density: "../examples/leaf_density.rs",
}
