//! The rules of ARCHITECTURE.md that the compiler cannot keep. What a crate may import, its `Cargo.toml` says.
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
            (pair[0].trim() == "#[cfg(test)]" || pair[0].trim().starts_with("#[cfg(all(test,"))
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
                // What cargo builds is not ours.
                if path.file_name().is_none_or(|name| name != "target") {
                    folders.push(path);
                }
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
        "Instant",
        "SystemTime",
        "std::time",
        "indicatif",
    ];
    /// The driver and its files are what the engines leave to others.
    const EXCEPT: &[&str] = &["src/optim/src/drive/", "src/optim/src/output.rs"];
    let core =
        ["optim", "raster", "survey", "plants"].map(|name| sources(&format!("src/{name}/src")));
    let core = core.iter().flatten();
    let core = core.filter(|source| !EXCEPT.iter().any(|path| source.path.starts_with(path)));
    let found = core.flat_map(|source| FORBIDDEN.iter().flat_map(|word| source.mentions(word)));
    assert_none(found, "the numerical core opens no files, prints nothing, reads no clock");
}

/// Names of the packages that a crate is built from.
fn packages_of(arguments: &str) -> Vec<String> {
    let output = std::process::Command::new(env!("CARGO"))
        .args("tree -e normal --prefix none --offline --locked".split(' '))
        .args(arguments.split(' '))
        .current_dir(root())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    let packages: Vec<String> =
        text.lines().filter_map(|line| line.split_whitespace().next()).map(str::to_owned).collect();
    assert!(packages.iter().any(|name| name == "faer"), "this is no list of dependencies: {text}");
    packages
}

fn assert_without(packages: &[String], unwanted: &[&str], rule: &str) {
    let found = packages.iter().filter(|name| unwanted.contains(&name.as_str()));
    assert_none(found.cloned(), rule);
}

#[test]
fn the_library_alone_needs_no_program_report_database_or_generator() {
    assert_without(
        &packages_of("-p rowgram --no-default-features"),
        &["clap", "maud", "rusqlite", "libsqlite3-sys", "data-synth"],
        "the library without default features depends on something of the program",
    );
}

#[test]
fn the_engines_need_no_picture_table_or_terminal() {
    let packages = packages_of("-p rowgram-optim");
    assert_without(
        &packages,
        &["clap", "csv", "image", "indicatif", "png", "tiff", "tracing", "zune-jpeg"],
        "the engines depend on something that is not numerical",
    );
    let ours = packages.iter().filter(|name| name.starts_with("rowgram-"));
    assert_none(ours.filter(|name| *name != "rowgram-optim").cloned(), "the engines stand alone");
}

#[test]
fn dependencies_may_be_passed_on() {
    /// Licences that ask for no more than to be named.
    const ALLOWED: &[&str] = &[
        "MIT",
        "MIT-0",
        "Apache-2.0",
        "Apache-2.0 WITH LLVM-exception",
        "BSD-2-Clause",
        "BSD-3-Clause",
        "0BSD",
        "BSL-1.0",
        "CC0-1.0",
        "IJG",
        "ISC",
        "Unicode-3.0",
        "Unlicense",
        "Zlib",
        "bzip2-1.0.6",
    ];
    // Of this platform: those of others need not have been downloaded.
    let version = std::process::Command::new("rustc").arg("-vV").output().unwrap();
    let version = String::from_utf8(version.stdout).unwrap();
    let host = version.lines().find_map(|line| line.strip_prefix("host: ")).unwrap();
    let output = std::process::Command::new(env!("CARGO"))
        .args(["metadata", "--format-version", "1", "--offline", "--locked"])
        .args(["--filter-platform", host])
        .current_dir(root())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let metadata: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let packages = metadata["packages"].as_array().unwrap();
    assert!(packages.len() > 100, "these are no dependencies: {packages:?}");
    // One of each choice, and all of what is joined.
    let is_allowed = |licence: &str| {
        let licence = licence.replace(['(', ')'], "").replace('/', " OR ");
        licence
            .split(" AND ")
            .all(|part| part.split(" OR ").any(|one| ALLOWED.contains(&one.trim())))
    };
    let found = packages.iter().filter_map(|package| {
        let licence = package["license"].as_str().unwrap_or("none stated");
        let line = format!("{} {}: {licence}", package["name"], package["version"]);
        (!is_allowed(licence)).then_some(line)
    });
    assert_none(found, "the licence of a dependency is not one of those that are allowed");
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
