//! A test that runs each listed example, and one that every example is listed and short. Examples after `except` are run elsewhere.

macro_rules! examples {
    (except [$($other:literal),*] $($name:ident: $path:literal),+ $(,)?) => {
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
            let listed: &[&str] = &[$(stringify!($name),)+ $($other),*];
            let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                let name = path.file_stem().unwrap().to_string_lossy().into_owned();
                if path.extension().is_none_or(|extension| extension != "rs") {
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
