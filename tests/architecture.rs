//! The rules of ARCHITECTURE.md, read from that page and compared with the sources.
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

/// ARCHITECTURE.md, which has the rules.
fn page() -> String {
    fs::read_to_string(root().join("ARCHITECTURE.md")).unwrap()
}

/// The lines of a fenced block of the page, each as its words.
fn block(page: &str, name: &str) -> Vec<Vec<String>> {
    let begin = format!("```{name}\n");
    let at = page.find(&begin).unwrap_or_else(|| panic!("ARCHITECTURE.md has no block {name}"));
    let text = &page[at + begin.len()..];
    let text = &text[..text.find("\n```").unwrap()];
    text.lines().map(|line| line.split_whitespace().map(str::to_owned).collect()).collect()
}

/// The rows of the table under a heading of the page: for each cell what stands in it between backticks.
fn table(page: &str, heading: &str) -> Vec<Vec<Vec<String>>> {
    let text = &page[page.find(heading).unwrap_or_else(|| panic!("no heading {heading}"))..];
    let rows = text.lines().skip_while(|line| !line.starts_with('|'));
    let rows = rows.take_while(|line| line.starts_with('|')).skip(2);
    let ticked = |cell: &str| cell.split('`').skip(1).step_by(2).map(str::to_owned).collect();
    rows.map(|row| row.trim_matches('|').split('|').map(ticked).collect()).collect()
}

fn words(lines: Vec<Vec<String>>) -> Vec<String> {
    lines.into_iter().flatten().collect()
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
        "tracing",
        "Instant",
        "SystemTime",
        "std::time",
        "indicatif",
    ];
    let core = words(block(&page(), "core"));
    let core: Vec<&str> = core.iter().map(String::as_str).collect();
    let sources = sources("src");
    let core = sources.iter().filter(|source| source.within(&core));
    let found = core.flat_map(|source| FORBIDDEN.iter().flat_map(|word| source.mentions(word)));
    assert_none(found, "the numerical core opens no files, prints nothing, reads no clock");
}

/// Files of the crate itself, which belong to no floor.
const OUTSIDE: [&str; 4] = ["lib", "main", "build_id", "error"];

#[test]
fn arrows_point_down() {
    let page = page();
    let floors = block(&page, "floors");
    let uses_error = words(block(&page, "uses-error"));
    let floor_of =
        |module: &str| floors.iter().position(|floor| floor.iter().any(|other| other == module));
    let mut found = Vec::new();
    for source in sources("src") {
        let below = source.path.strip_prefix("src/").unwrap();
        let module = below.split(['/', '.']).next().unwrap();
        if OUTSIDE.contains(&module) {
            continue;
        }
        let Some(floor) = floor_of(module) else {
            found.push(format!("{} belongs to no floor", source.path));
            continue;
        };
        for (other, other_floor) in
            floors.iter().enumerate().flat_map(|(k, names)| names.iter().map(move |n| (n, k)))
        {
            if other_floor <= floor && other != module {
                found.extend(source.mentions(&format!("crate::{other}")));
                found.extend(nested_imports(&source, other));
            }
        }
        if !uses_error.iter().any(|name| name == module) {
            found.extend(source.mentions("crate::error"));
            found.extend(nested_imports(&source, "error"));
        }
    }
    found.dedup();
    assert_none(found, "a module imports from its own floor or from above");
}

#[test]
fn the_floors_are_those_of_the_sources() {
    let floors = words(block(&page(), "floors"));
    let there = |name: &String| {
        root().join("src").join(name).is_dir() || root().join(format!("src/{name}.rs")).is_file()
    };
    let gone = floors.iter().filter(|name| !there(name)).cloned();
    assert_none(gone, "a module of ARCHITECTURE.md is not there");
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
    let rows = table(&page(), "## One place each");
    assert!(rows.len() > 15, "the table was not understood: {} rows", rows.len());
    let sources = sources("src");
    let mut found = Vec::new();
    for row in &rows {
        let [_, mentions, places] = row.as_slice() else { panic!("{row:?}: expected three cells") };
        assert!(!mentions.is_empty() && !places.is_empty(), "{row:?} has an empty cell");
        let places: Vec<&str> = places.iter().map(String::as_str).collect();
        for source in sources.iter().filter(|source| !source.within(&places)) {
            found.extend(mentions.iter().flat_map(|word| source.mentions(word)));
        }
    }
    assert_none(found, "a dependency or a side effect is out of its place");
}

#[test]
fn the_library_alone_needs_no_program_report_database_or_generator() {
    let output = std::process::Command::new(env!("CARGO"))
        .args("tree -p rowgram -e normal --no-default-features --prefix none".split(' '))
        .args(["--offline", "--locked"])
        .current_dir(root())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    let packages: Vec<&str> =
        text.lines().filter_map(|line| line.split_whitespace().next()).collect();
    assert!(packages.contains(&"faer"), "this is no list of dependencies: {text}");
    let unwanted = ["clap", "maud", "rusqlite", "libsqlite3-sys", "data-synth"];
    assert_none(
        unwanted.iter().filter(|name| packages.contains(name)).map(|name| (*name).to_owned()),
        "the library without default features depends on something of the program",
    );
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
