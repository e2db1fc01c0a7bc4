//! `rowgram evaluate`, as a user meets it.

use crate::{data, program::rowgram};
use insta::assert_snapshot;

const FOUND: &str = "row,u_px,v_px\n0,10.5,20\n0,30,24\n1,99,99\n";
const TRUTH: &str = "10,20\r\n30,20\r\n";

fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (name, content) in files {
        std::fs::write(folder.path().join(name), content).unwrap();
    }
    folder
}

#[test]
fn a_score_is_a_table_or_json() {
    let folder = folder(&[("found.csv", FOUND), ("truth", TRUTH)]);
    let run = rowgram(folder.path(), "evaluate found.csv truth --radius-px 2,5");
    assert_eq!((run.code, run.stderr.as_str()), (0, ""));
    assert_snapshot!(run.stdout, @r"
    truth 2, found 3 (+1)
    error of the matched at the largest radius: median 2.25 px, RMS 2.85 px
    radius px  precision  recall      F1
            2     0.3333  0.5000  0.4000
            5     0.6667  1.0000  0.8000
    ");
    let run = rowgram(folder.path(), "evaluate found.csv truth --radius-px 5 --json");
    assert_eq!((run.code, run.stderr.as_str()), (0, ""));
    assert_snapshot!(run.stdout, @r#"{"truth":2,"found":3,"count_error":1,"median_error_px":2.25,"rms_error_px":2.850438562747845,"radii":[{"radius_px":5.0,"precision":0.6666666666666666,"recall":1.0,"f1":0.8}]}"#);
}

#[test]
fn nothing_found_or_nothing_there_is_a_result() {
    let folder = folder(&[("none.csv", "u_px,v_px\n"), ("truth.csv", TRUTH)]);
    let run = rowgram(folder.path(), "evaluate none.csv truth.csv --radius-px 5 --json");
    assert_eq!(run.code, 0);
    assert_snapshot!(run.stdout, @r#"{"truth":2,"found":0,"count_error":-2,"median_error_px":null,"rms_error_px":null,"radii":[{"radius_px":5.0,"precision":null,"recall":0.0,"f1":0.0}]}"#);
    let run = rowgram(folder.path(), "evaluate none.csv none.csv --radius-px 5");
    assert_snapshot!(run.stdout, @r"
    truth 0, found 0 (+0)
    error of the matched at the largest radius: median -, RMS -
    radius px  precision  recall      F1
            5          -       -       -
    ");
}

#[test]
fn the_comparison_of_two_files_is_written() {
    let folder = folder(&[("found.csv", FOUND), ("truth.csv", TRUTH)]);
    let code = |output: &str| {
        rowgram(folder.path(), &format!("evaluate found.csv truth.csv --radius-px 5 {output}")).code
    };
    assert_eq!([code("-o score.json"), code("-o score.json"), code("-o score.csv")], [0, 2, 2]);
    assert_eq!(code("-o score.json --force"), 0);
    let text = std::fs::read_to_string(folder.path().join("score.json")).unwrap();
    assert!(text.contains("radii"), "{text}");
    assert!(!folder.path().join("score.csv").exists());
}

#[test]
fn bad_input_is_explained() {
    let folder = folder(&[
        ("found.csv", FOUND),
        ("truth.csv", TRUTH),
        ("damaged.csv", "x,y\n1,2\n\n3,\n"),
        ("infinite.csv", "x,y\n1,inf\n"),
        ("columns.csv", "east,north\n1,2\n"),
        ("empty.csv", ""),
    ]);
    let error = |arguments: &str| {
        let run = rowgram(folder.path(), &format!("evaluate {arguments}"));
        assert_eq!((run.code, run.stdout.as_str()), (2, ""), "{arguments}: {}", run.stderr);
        run.stderr
    };
    assert_snapshot!(error("found.csv damaged.csv --radius-px 5"), @r#"error: damaged.csv, line 4: y is "", expected a finite number"#);
    assert_snapshot!(error("infinite.csv truth.csv --radius-px 5"), @r#"error: infinite.csv, line 2: y is "inf", expected a finite number"#);
    assert_snapshot!(error("columns.csv truth.csv --radius-px 5"), @r#"error: columns.csv, line 1: expected a header with u_px,v_px or x,y, or two numbers, found "east,north""#);
    assert_snapshot!(error("empty.csv truth.csv --radius-px 5"), @"error: empty.csv: the file is empty, expected a header or rows");
    assert_snapshot!(error("missing.csv truth.csv --radius-px 5"), @"error: cannot read missing.csv: No such file or directory (os error 2)");
    assert_snapshot!(error("found.csv truth.csv --radius-px 5,-1"), @"error: --radius-px: radius -1: expected a positive number of pixels");
    assert_snapshot!(error("found.csv truth.csv --radius-px nan"), @"error: --radius-px: radius NaN: expected a positive number of pixels");
    assert!(error("found.csv truth.csv --radius-px 5,x").contains("invalid value 'x'"));
    assert!(error("found.csv truth.csv").contains("--radius"));
    assert!(error(". truth.csv --radius-px 5").contains("cannot read"));
}

#[test]
fn real_truth_is_its_own_best_score() {
    let Some(labels) = data::path("maize_plots/label") else { return };
    let mut files = 0;
    for label in std::fs::read_dir(labels).unwrap() {
        let positions = rowgram::io::points::read(&label.unwrap().path()).unwrap();
        let score = rowgram::score::Score::new(&positions, &positions, &[1.0]).unwrap();
        assert_eq!((score.rms_error_px, score.radii[0].f1), (Some(0.0), Some(1.0)));
        files += 1;
    }
    assert_eq!(files, 100);
}
