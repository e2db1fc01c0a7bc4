//! What becomes of a run when the machine fails it.

use crate::{
    program::rowgram,
    run::{results, two_alike},
};
use std::{fs, path::Path, process::Command};

/// Runs the project where no file may be larger, as on a disk that is full: the exit code and what was said.
fn run_with_files_of_at_most(folder: &Path, kilobytes: u64) -> (Option<i32>, String) {
    // The shell counts in units of 512 bytes.
    let blocks = 2 * kilobytes;
    let script = format!("trap '' XFSZ; ulimit -f {blocks}; exec \"$0\" run field -q");
    let done = Command::new("sh")
        .args(["-c", &script, env!("CARGO_BIN_EXE_rowgram")])
        .current_dir(folder)
        .output()
        .unwrap();
    (done.status.code(), String::from_utf8_lossy(&done.stderr).into_owned())
}

#[test]
fn a_full_disk_is_told_leaves_no_halves_and_with_room_the_run_goes_on_to_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let [whole, field] = two_alike(folder.path(), ["whole", "field"]);
    let done = rowgram(folder.path(), "run whole -q");
    assert_eq!(done.code, 0, "{}", done.stderr);
    let expected = results(&whole);
    let mut kilobytes = 1;
    let mut failures = 0;
    loop {
        let (code, said) = run_with_files_of_at_most(folder.path(), kilobytes);
        if code == Some(0) {
            break;
        }
        failures += 1;
        assert_eq!(code, Some(1), "with files of {kilobytes} kB: {said}");
        assert!(said.contains("cannot write") && said.contains("field/rowgram"), "{said}");
        assert!(said.contains("File too large"), "{said}");
        // What has its name is whole.
        for (name, bytes) in &expected {
            let file = field.join(name);
            assert!(!file.exists() || fs::read(&file).unwrap() == *bytes, "{said}");
        }
        kilobytes *= 2;
        assert!(kilobytes < 1 << 20, "{said}");
    }
    assert!(failures >= 4, "{failures}");
    let found = results(&field);
    assert!(expected.keys().eq(found.keys()), "{:?} {:?}", expected.keys(), found.keys());
    for (name, bytes) in &expected {
        assert!(found[name] == *bytes, "{name}");
    }
}
