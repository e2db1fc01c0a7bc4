//! Every diagnostic of the program has an entry in docs/troubleshooting.md, and every entry is of a diagnostic.

use std::{collections::BTreeSet, fs, path::Path};

/// The text of all sources, without their unit tests.
fn sources(folder: &Path, text: &mut String) {
    let mut entries: Vec<_> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    entries.sort();
    for path in entries {
        if path.is_dir() {
            sources(&path, text);
        } else if path.extension().is_some_and(|ending| ending == "rs") {
            let all = fs::read_to_string(&path).unwrap();
            text.push_str(all.split("#[cfg(test)]").next().unwrap());
        }
    }
}

fn is_code(text: &str) -> bool {
    text.contains('-')
        && text.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-')
}

/// The codes that the sources give to `Diagnostic::info`, `warning`, `error` and `new` as literals.
fn given(text: &str) -> BTreeSet<&str> {
    let mut codes = BTreeSet::new();
    for call in text.split("Diagnostic::").skip(1) {
        let Some((name, arguments)) = call.split_once('(') else { continue };
        let arguments = match name {
            "info" | "warning" | "error" => arguments,
            "new" => arguments.split_once(',').map_or("", |(_, rest)| rest),
            _ => continue,
        };
        let literal =
            arguments.trim_start().strip_prefix('"').and_then(|rest| rest.split('"').next());
        codes.extend(literal.filter(|code| is_code(code)));
    }
    codes
}

/// The codes in the first column of the tables.
fn documented(page: &str) -> BTreeSet<&str> {
    let first = page.lines().filter_map(|line| line.strip_prefix("| `")?.split(" |").next());
    first.flat_map(|cell| cell.split('`').filter(|code| is_code(code))).collect()
}

#[test]
fn every_diagnostic_is_explained_and_exists() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut text = String::new();
    sources(&root.join("src"), &mut text);
    let page = fs::read_to_string(root.join("docs/troubleshooting.md")).unwrap();
    let (given, documented) = (given(&text), documented(&page));
    assert!(given.len() > 50, "{given:?}");
    let missing: Vec<_> = given.difference(&documented).collect();
    assert!(missing.is_empty(), "docs/troubleshooting.md does not explain {missing:?}");
    let gone: Vec<_> =
        documented.iter().filter(|code| !text.contains(&format!("\"{code}\""))).collect();
    assert!(gone.is_empty(), "docs/troubleshooting.md explains what no source says: {gone:?}");
}
