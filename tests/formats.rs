//! `docs/formats.md` names every column of every table that is written.

use std::{collections::BTreeSet, fs, path::Path};

/// What stands between backticks in the page.
fn documented() -> BTreeSet<String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/formats.md");
    let page = fs::read_to_string(path).unwrap();
    page.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

/// Columns of the tables below a folder that the page does not name; a column named after a parameter of the lens is one.
fn undocumented(folder: &Path) -> Vec<String> {
    let documented = documented();
    let mut missing = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                if path.file_name().is_none_or(|name| name != "cache") {
                    folders.push(path);
                }
            } else if path.extension().is_some_and(|ending| ending == "csv") {
                let text = fs::read_to_string(&path).unwrap();
                let header = text.lines().next().unwrap_or_default();
                // OpenSfM's own table has a version where others have a header.
                let columns = header.split(',').filter(|name| !name.starts_with("OPENSFM_"));
                let unknown = columns.filter(|name| !documented.contains(*name));
                missing.extend(unknown.map(|name| format!("{}: {name}", path.display())));
            }
        }
    }
    missing
}

/// Fails where a table below `folder` has a column that `docs/formats.md` does not name.
pub(crate) fn assert_columns_are_documented(folder: &Path) {
    let missing = undocumented(folder);
    assert!(missing.is_empty(), "docs/formats.md does not name:\n  {}", missing.join("\n  "));
}

#[test]
fn a_column_that_nobody_knows_is_found() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("deep")).unwrap();
    fs::write(folder.path().join("deep/plants.csv"), "u_px,v_px,zeal\n1,2,3\n").unwrap();
    let missing = undocumented(folder.path());
    assert!(missing.len() == 1 && missing[0].ends_with("plants.csv: zeal"), "{missing:?}");
}

#[test]
fn every_key_of_a_camera_is_documented() {
    let documented = documented();
    for model in rowgram::camera::Model::ALL {
        for parameter in model.parameters() {
            // k1 to k6 and K0 to K3 are named as ranges where there are many.
            let name = parameter.name;
            let in_range = name.len() == 2 && name.starts_with('k');
            assert!(documented.contains(name) || in_range, "{name} of {}", model.word());
        }
    }
    for key in ["name", "model", "width_px", "height_px", "free", "[parameters]", "[correlation]"] {
        assert!(documented.contains(key), "{key}");
    }
}
