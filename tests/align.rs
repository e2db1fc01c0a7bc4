//! `rowgram align` as a program: what it refuses and how it says so. The geometry is tested on flights made
//! from numbers, in `sfm`.

use crate::program::rowgram;
use std::fs;

#[test]
fn a_folder_that_is_none_or_without_photos_is_bad_input() {
    let folder = tempfile::tempdir().unwrap();
    let run = rowgram(folder.path(), "align missing");
    assert_eq!(run.code, 2);
    let said = run.stderr;
    assert!(said.contains("expected a folder with photos"), "{said}");

    fs::create_dir(folder.path().join("images")).unwrap();
    let run = rowgram(folder.path(), "align .");
    assert_eq!(run.code, 2);
    let said = run.stderr;
    assert!(said.contains("0 photos") && said.contains("at least 3"), "{said}");
}

#[test]
fn options_that_cannot_be_are_refused_before_any_work() {
    for (options, part) in [
        ("--tolerance 0", "--tolerance-px 0: expected a number greater than 0"),
        ("--max-features 10", "--max-features 10: expected"),
        ("--lens wide", "--lens \"wide\": expected one of: auto, brown, smac"),
        ("--from adjust --until match", "--from: it comes after"),
    ] {
        let run = rowgram(std::env::temp_dir().as_path(), &format!("align nowhere {options}"));
        assert_eq!(run.code, 2, "{options}");
        assert!(run.stderr.contains(part), "{options}: {}", run.stderr);
    }
}

#[test]
fn dead_files_and_doubles_are_named_and_a_name_of_no_system_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let images = folder.path().join("images");
    fs::create_dir(&images).unwrap();
    let save = |name: &str, shade: u8| {
        image::RgbImage::from_pixel(64, 48, image::Rgb([shade; 3]))
            .save(images.join(name))
            .unwrap();
    };
    save("a.png", 10);
    save("b.png", 200);
    save("e.png", 90);
    fs::copy(images.join("a.png"), images.join("c.png")).unwrap();
    fs::write(images.join("d.jpg"), b"no picture").unwrap();
    let run = rowgram(folder.path(), "align . --until inspect");
    assert_eq!(run.code, 0);
    let said = run.stderr;
    assert!(said.contains("c.png: left out: it is the same file as a.png"), "{said}");
    assert!(said.contains("d.jpg: left out: it is no picture"), "{said}");

    let run = rowgram(folder.path(), "align . --crs EPSG:99999");
    assert_eq!(run.code, 2);
    let said = run.stderr;
    assert!(said.contains("EPSG:99999 is not a known"), "{said}");

    // Another process works on the project.
    let results = folder.path().join("rowgram");
    let lock = fs::File::create(results.join(".lock")).unwrap();
    lock.lock().unwrap();
    let run = rowgram(folder.path(), "align .");
    assert_eq!(run.code, 2);
    let said = run.stderr;
    assert!(said.contains("another rowgram process is working here"), "{said}");
    drop(lock);

    // Photos of nothing: nothing can be oriented, and that is said.
    let run = rowgram(folder.path(), "align .");
    assert_eq!(run.code, 3);
    let said = run.stderr;
    assert!(said.contains("shows next to nothing") && said.contains("could be oriented"), "{said}");
}
