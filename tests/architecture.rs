//! The import rules of ARCHITECTURE.md, read off the sources.
//!
//! Comments, `mod tests` at the end of a file and files named `tests.rs` do not count; modules that are not there break no
//! rule.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// One source file: its path below the root and the code in it, line by line.
struct Source {
    path: String,
    first_line: String,
    code: Vec<(usize, String)>,
}

impl Source {
    fn read(root: &Path, file: &Path) -> Source {
        let text = fs::read_to_string(file).unwrap();
        let path = file.strip_prefix(root).unwrap().to_string_lossy().replace('\\', "/");
        let lines: Vec<&str> = text.lines().collect();
        let tests = lines.windows(2).position(|pair| {
            pair[0].trim() == "#[cfg(test)]"
                && pair[1].trim_start().starts_with("mod ")
                && pair[1].ends_with('{')
        });
        let end = if path.ends_with("/tests.rs") { 0 } else { tests.unwrap_or(lines.len()) };
        let code = lines[..end]
            .iter()
            .enumerate()
            .filter(|(_, line)| !line.trim_start().starts_with("//"))
            .map(|(number, line)| (number + 1, (*line).to_owned()))
            .collect();
        Source { path, first_line: lines.first().unwrap_or(&"").to_string(), code }
    }

    /// Whether the file belongs to one of these modules, given below `src/` without `.rs`.
    fn within(&self, modules: &[&str]) -> bool {
        modules.iter().any(|module| {
            let below = self.path.strip_prefix("src/").and_then(|path| path.strip_prefix(module));
            below.is_some_and(|rest| rest == ".rs" || rest.starts_with('/'))
        })
    }

    /// The lines that have `word` in them as a word of its own.
    fn mentions<'s>(&'s self, word: &'s str) -> impl Iterator<Item = String> + 's {
        self.code.iter().filter(move |(_, line)| has_word(line, word)).map(move |(number, line)| {
            format!("{}:{number} mentions {word}: {}", self.path, line.trim())
        })
    }
}

fn has_word(line: &str, word: &str) -> bool {
    let part_of_name = |c: char| c.is_alphanumeric() || c == '_';
    line.match_indices(word).any(|(at, _)| {
        let before = line[..at].chars().next_back();
        let after = line[at + word.len()..].chars().next();
        let open = |end: Option<char>, edge: Option<char>| {
            !(edge.is_some_and(part_of_name) && end.is_some_and(part_of_name))
        };
        open(before, word.chars().next()) && open(after, word.chars().next_back())
    })
}

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn sources(below: &str) -> Vec<Source> {
    let mut folders = vec![root().join(below)];
    let mut found = Vec::new();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs")
                && path.file_name().is_none_or(|name| name != "tests.rs")
            {
                found.push(Source::read(&root(), &path));
            }
        }
    }
    found.sort_by(|a, b| a.path.cmp(&b.path));
    assert!(!found.is_empty(), "no sources below {below}");
    found
}

fn assert_none(offences: impl IntoIterator<Item = String>, rule: &str) {
    let offences: Vec<String> = offences.into_iter().collect();
    assert!(offences.is_empty(), "{rule}:\n  {}", offences.join("\n  "));
}

/// The modules that compute and do nothing else.
const CORE: &[&str] = &[
    "geometry", "camera", "engine", "nlls", "descent", "convex", "problems", "target", "features",
];

#[test]
fn the_numerical_core_opens_no_files_prints_nothing_reads_no_clock() {
    const FORBIDDEN: &[&str] = &[
        "std::fs",
        "fs::",
        "File::open",
        "File::create",
        "OpenOptions",
        "std::io",
        "std::env",
        "println!",
        "print!",
        "eprintln!",
        "eprint!",
        "tracing",
        "Instant",
        "SystemTime",
        "std::time",
        "indicatif",
    ];
    let sources = sources("src");
    let core = sources.iter().filter(|source| source.within(CORE));
    let found = core.flat_map(|source| FORBIDDEN.iter().flat_map(|word| source.mentions(word)));
    assert_none(found, "the numerical core opens no files, prints nothing, reads no clock");
}

#[test]
fn arrows_point_down() {
    /// Who must not know of whom.
    const RULES: &[(&[&str], &[&str])] = &[
        (&["features"], &["io", "cli", "drive", "sfm", "raster", "phenotype", "score", "nlls"]),
        (CORE, &["io", "cli", "drive", "sfm", "raster", "phenotype", "score"]),
        (CORE, &["io", "cli", "drive", "sfm", "raster", "mapping", "phenotype", "score"]),
        (&["geometry"], &["camera", "engine", "nlls", "descent", "convex", "problems"]),
        (&["camera"], &["engine", "nlls", "descent", "convex", "problems"]),
        (&["engine"], &["nlls", "descent", "convex", "problems"]),
        (&["nlls"], &["descent", "convex", "problems"]),
        (&["descent"], &["nlls", "convex", "problems"]),
        (&["convex"], &["nlls", "descent", "problems"]),
        (&["drive"], &["nlls", "descent", "convex", "problems", "sfm", "raster", "phenotype"]),
        (&["io"], &["drive", "sfm", "phenotype", "cli"]),
        (&["sfm"], &["io", "cli", "drive", "raster", "phenotype", "score"]),
        (&["crs"], &["io", "cli", "drive", "sfm", "problems", "nlls", "raster", "phenotype"]),
        (&["drive", "raster", "phenotype", "sfm", "score", "error"], &["cli"]),
        (&["raster", "mapping", "phenotype", "sfm", "score"], &["io"]),
        (&["drive", "raster", "mapping", "phenotype", "sfm", "score", "error"], &["cli"]),
    ];
    let sources = sources("src");
    let mut found = Vec::new();
    for (who, whom) in RULES {
        for source in sources.iter().filter(|source| source.within(who)) {
            for module in *whom {
                found.extend(source.mentions(&format!("crate::{module}")));
                found.extend(nested_imports(source, module));
            }
        }
    }
    assert_none(found, "a module imports from above");
}

/// `use crate::{a, b::c}` over any number of lines: mentions of `module` at its first level.
fn nested_imports(source: &Source, module: &str) -> Vec<String> {
    let text: String = source.code.iter().map(|(_, line)| format!("{line}\n")).collect();
    let mut found = Vec::new();
    for (at, opening) in text.match_indices("crate::{") {
        let mut depth = 1;
        let mut first_level = String::new();
        for c in text[at + opening.len()..].chars() {
            match c {
                '{' => depth += 1,
                '}' => depth -= 1,
                _ if depth == 1 => first_level.push(c),
                _ => {}
            }
            if depth == 0 {
                break;
            }
        }
        let names = first_level.split(',').filter_map(|path| path.trim().split("::").next());
        if names.into_iter().any(|name| name == module) {
            found.push(format!("{} imports crate::{module}", source.path));
        }
    }
    found
}

#[test]
fn each_dependency_has_its_place() {
    /// What may be mentioned only where.
    const PLACES: &[(&[&str], &[&str])] = &[
        (&["argmin"], &["drive/executor", "drive/simplex"]),
        (&["clarabel"], &["convex"]),
        (&["proj4rs", "crs_definitions"], &["crs"]),
        (&["las"], &["io/cloud"]),
        // The second is the generator's module of the same name.
        (&["exif"], &["io/photo", "cli/synth/flight"]),
        (&["faer"], &["nlls/cholesky"]),
        (
            &["geotiff_reader", "tiff_core", "tiff_reader", "tiff_writer", "ndarray"],
            &["io/geotiff"],
        ),
        (&["indicatif"], &["drive", "cli"]),
        (&["fdeflate"], &["io/geotiff"]),
        (&["shapefile"], &["io/polygons"]),
        (&["rusqlite"], &["io/gpkg", "io/polygons"]),
        (&["pulp"], &["features", "raster/pixels", "lanes", "nlls/fused", "mapping"]),
        (&["spade"], &["mapping/dem"]),
        (&["mwmatching"], &["phenotype/leaves/bridge"]),
        (&["zune_jpeg"], &["io/images"]),
        (&["clap"], &["cli"]),
        (&["tempfile"], &["io/output", "cli/doctor", "cli/verify"]),
        (&["std::fs", "fs::", "File::open", "File::create", "OpenOptions"], &["io", "cli"]),
        (&["Instant", "SystemTime"], &["drive", "cli"]),
    ];
    let sources = sources("src");
    let mut found = Vec::new();
    for (words, places) in PLACES {
        for source in sources.iter().filter(|source| !source.within(places)) {
            found.extend(words.iter().flat_map(|word| source.mentions(word)));
        }
    }
    assert_none(found, "a dependency or a side effect is out of its place");
}

#[test]
fn argmin_is_no_part_of_the_interface() {
    let sources = sources("src");
    let executor = sources.iter().filter(|source| source.path == "src/drive/executor.rs");
    let public = executor.flat_map(|source| source.mentions("pub"));
    let leaks = public.filter(|line| !line.contains("pub(super)") && !line.contains("pub(crate)"));
    assert_none(leaks, "the one file that knows argmin exports nothing");
}

#[test]
fn random_generators_are_portable_and_passed_in() {
    const FORBIDDEN: &[&str] =
        &["StdRng", "SmallRng", "thread_rng", "ThreadRng", "rand::rng", "rand::random"];
    let all = [sources("src"), sources("data-synth/src"), sources("experiments/src")];
    let found = all.iter().flatten();
    let found = found.flat_map(|source| FORBIDDEN.iter().flat_map(|word| source.mentions(word)));
    assert_none(found, "only named portable generators, passed in");
}

#[test]
fn the_generator_knows_nothing_of_the_estimator() {
    let found: Vec<String> = sources("data-synth/src")
        .iter()
        .flat_map(|source| source.mentions("rowgram").collect::<Vec<_>>())
        .collect();
    assert_none(found, "data-synth does not mention rowgram");
    let manifest = fs::read_to_string(root().join("data-synth/Cargo.toml")).unwrap();
    let dependencies = &manifest[manifest.find("[dependencies]").unwrap()..];
    assert!(!dependencies.contains("rowgram"), "data-synth does not depend on rowgram");
}

#[test]
fn files_say_what_they_are_and_stay_short() {
    /// About 400, tests not counted; a little more is no offence.
    const LONGEST: usize = 450;
    let all = [
        sources("src"),
        sources("data-synth/src"),
        sources("experiments/src"),
        sources("tests"),
        sources("benches"),
    ];
    let mut found = Vec::new();
    for source in all.iter().flatten() {
        if !source.first_line.starts_with("//!") {
            found.push(format!("{} does not open with //!", source.path));
        }
        let length = source.code.last().map_or(0, |(number, _)| *number);
        if !source.path.starts_with("tests/") && length > LONGEST {
            found.push(format!("{} has {length} lines before its tests", source.path));
        }
    }
    assert_none(found, "a file opens with //! and has about 400 lines at most");
}

#[test]
fn words_are_whole_words() {
    assert!(has_word("use argmin::core;", "argmin"));
    assert!(!has_word("let argminimum = 1;", "argmin"));
    assert!(!has_word("FileError::read(path)", "File"));
    assert!(has_word("crate::io::output", "crate::io"));
    assert!(!has_word("crate::iota", "crate::io"));
    assert!(has_word("println!(\"\")", "println!") && !has_word("eprintln!(\"\")", "println!"));
}
