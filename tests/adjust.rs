//! `rowgram adjust` as a person or a script calls it.

use crate::{
    data,
    engine::check_resume,
    nlls::toys::{network, perturb},
    program::{Run, rowgram_words},
};
use rowgram::{
    io::bal,
    nlls::{LeastSquares, Loss, Method, Options},
    problems::bundle::{Bundle, InteriorSharing},
};
use serde_json::Value;
use std::path::Path;

fn adjust(arguments: &[&str]) -> Run {
    rowgram_words(Path::new("."), &[&["adjust"], arguments].concat())
}

/// A perturbed block in a file.
fn block(folder: &Path) -> String {
    let mut block = network(61, 3, 100, 0.4);
    perturb(&mut block, 62, 1.0);
    let path = folder.join("block.txt");
    bal::write(&path, &block, false).unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn json_tells_what_the_adjustment_did() {
    let folder = tempfile::tempdir().unwrap();
    let file = block(folder.path());
    let out = folder.path().join("out.txt.gz").to_str().unwrap().to_owned();
    let trace = folder.path().join("trace.csv").to_str().unwrap().to_owned();
    let figure = folder.path().join("figure.svg").to_str().unwrap().to_owned();
    let output = adjust(&[&file, "--json", "-o", &out, "--trace", &trace, "--figure", &figure]);
    assert!(output.code == 0, "{}", output.stderr);
    let stdout = output.stdout;
    assert_eq!(stdout.lines().count(), 1);
    let report: Value = serde_json::from_str(&stdout).unwrap();
    let number = |key: &str| report[key].as_f64().unwrap_or_else(|| panic!("{key}: {report}"));
    assert!(number("final_cost") < number("initial_cost"));
    assert!(number("solve_seconds") > 0.0 && number("load_seconds") > 0.0);
    assert_eq!(
        report["observations"].as_u64().unwrap(),
        bal::read(out.as_ref()).unwrap().observations.len() as u64
    );
    let log = report["log"].as_array().unwrap();
    assert_eq!(log[0][0].as_u64(), Some(0));
    assert_eq!(log[0][1].as_f64(), Some(number("initial_cost")));
    assert_eq!(log[log.len() - 1][1].as_f64(), Some(number("final_cost")));
    assert!(report["stop"].as_str().unwrap().ends_with("converged"));
    let rows = std::fs::read_to_string(&trace).unwrap().lines().count() as u64;
    assert!(rows > report["iterations"].as_u64().unwrap());
    let drawing = std::fs::read_to_string(&figure).unwrap();
    assert!(drawing.starts_with("<svg") && drawing.contains("iteration"));
    assert!(drawing.matches("<circle").count() > 3, "a mark per moment");
    // Adjusting the result again finds nothing more to gain.
    let again = adjust(&[&out, "--json"]);
    let again: Value = serde_json::from_str(&again.stdout).unwrap();
    let (first, second) = (number("final_cost"), again["initial_cost"].as_f64().unwrap());
    assert!((first - second).abs() < 1e-9 * first, "{first} {second}");
}

#[test]
fn a_person_reads_a_summary() {
    let folder = tempfile::tempdir().unwrap();
    let file = block(folder.path());
    let output = adjust(&[&file, "--loss", "huber:1", "--method", "dogleg", "--threads", "1"]);
    assert!(output.code == 0, "{}", output.stderr);
    let text = output.stdout;
    for part in
        ["9 images, 100 points", "stopped because", "tie points", "rmse", "stored: the method"]
    {
        assert!(text.contains(part), "{text}");
    }
}

#[test]
fn every_solver_and_thread_count_gives_the_same_cost() {
    let folder = tempfile::tempdir().unwrap();
    let file = block(folder.path());
    let cost = |more: &[&str]| {
        let output = adjust(&[&[file.as_str(), "--json"], more].concat());
        let report: Value = serde_json::from_str(&output.stdout).unwrap();
        report["final_cost"].as_f64().unwrap()
    };
    let schur = cost(&[]);
    assert_eq!(schur.to_bits(), cost(&["--threads", "1"]).to_bits());
    for solver in ["sparse", "dense", "iterative-schur"] {
        assert!((cost(&["--solver", solver]) / schur - 1.0).abs() < 1e-8);
    }
    let path = |more: &[&str]| {
        let output = adjust(&[&[file.as_str(), "--json"], more].concat());
        let report: Value = serde_json::from_str(&output.stdout).unwrap();
        report["batches"][0]["path"].clone()
    };
    assert_eq!(path(&[]), "fused");
    assert_eq!(path(&["--solver", "dense"]), "dense");
}

#[test]
fn bad_input_is_refused_with_code_2_and_leaves_outputs_alone() {
    let folder = tempfile::tempdir().unwrap();
    let file = block(folder.path());
    let kept = folder.path().join("kept.txt");
    std::fs::write(&kept, "mine").unwrap();
    let kept_name = kept.to_str().unwrap().to_owned();
    let text = std::fs::read_to_string(&file).unwrap();
    let damaged = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let cut = damaged("cut.txt", &text[..text.len() / 2]);
    let word = damaged("word.txt", &text.replacen('\n', "\nzero ", 1));
    let empty = damaged("empty.txt", "");
    let unseen =
        damaged("unseen.txt", "1 2 1\n0 0 1 1\n0\n0\n0\n0\n0\n0\n1\n0\n0\n0\n0\n-1\n0\n0\n-1\n");
    let cases: [(&[&str], &str); 14] = [
        (&[&file, "--check", "A1"], "no names to join control to"),
        (&[&file, "--solver", "sprse"], "auto, schur, iterative-schur, sparse, dense"),
        (&[&file, "--threads", "100000"], "1024"),
        (&[&file, "-o", "/nowhere/out.txt"], "its folder does not exist"),
        (&[&cut], "line"),
        (&[&word], "line 2"),
        (&[&empty], "number of cameras"),
        (&[&unseen], "point 1 is seen by no camera"),
        (&["/nowhere.txt"], "/nowhere.txt"),
        (&[&file, "-o", &kept_name], "exists already"),
        (&[&file, "--loss", "huber"], "needs a scale"),
        (&[&file, "--cost-tolerance", "2"], "--cost-tolerance"),
        (&[&file, "--max-seconds", "-1"], "--max-seconds"),
        (&[&file, "--target-cost", "NaN"], "--target-cost"),
    ];
    for (arguments, part) in cases {
        let output = adjust(arguments);
        let message = output.stderr;
        assert_eq!(output.code, 2, "{arguments:?}: {message}");
        assert!(message.contains(part), "{arguments:?}: {message}");
        assert!(output.stdout.is_empty());
    }
    assert_eq!(std::fs::read_to_string(&kept).unwrap(), "mine");
    assert!(adjust(&[&file, "-o", &kept_name, "--force"]).code == 0);
    assert!(bal::read(&kept).is_ok());
}

#[test]
fn a_run_in_two_parts_writes_the_same_file_as_one() {
    let folder = tempfile::tempdir().unwrap();
    let file = block(folder.path());
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (whole, parts, checkpoint) = (path("whole.txt"), path("parts.txt"), path("state"));
    assert!(adjust(&[&file, "-o", &whole, "--max-iterations", "6"]).code == 0);
    let first = adjust(&[&file, "--max-iterations", "3", "--checkpoint", &checkpoint]);
    assert!(first.code == 0, "{}", first.stderr);
    let second = adjust(&[&file, "-o", &parts, "--max-iterations", "6", "--resume", &checkpoint]);
    assert!(second.code == 0, "{}", second.stderr);
    assert_eq!(std::fs::read(&whole).unwrap(), std::fs::read(&parts).unwrap());
    let other = adjust(&[&file, "--loss", "huber:1", "--resume", &checkpoint]);
    assert_eq!(other.code, 2, "{}", other.stderr);
}

#[test]
fn the_engine_resumes_to_the_same_bits_at_every_step() {
    let mut start = network(63, 2, 40, 0.4);
    perturb(&mut start, 64, 3.0);
    for method in [Method::LevenbergMarquardt, Method::Dogleg] {
        let bundle = Bundle::new(&start, InteriorSharing::PerImage, Loss::Huber(1.0)).unwrap();
        let make = || LeastSquares::new(Options { method, ..Options::default() });
        check_resume(make, &bundle.problem, bundle.problem.start(), 12);
    }
}

#[test]
fn every_block_of_the_data_runs() {
    let Some(folder) = data::path("ba_bal") else { return };
    for name in ["dubrovnik-1-1-pre.txt", "dubrovnik-3-7-pre.txt", "dubrovnik-3-7-18-pre.txt"] {
        let output = adjust(&[folder.join(name).to_str().unwrap(), "--json"]);
        assert!(output.code == 0, "{name}: {}", output.stderr);
        let report: Value = serde_json::from_str(&output.stdout).unwrap();
        assert!(report["final_cost"].as_f64() < report["initial_cost"].as_f64(), "{report}");
    }
}
