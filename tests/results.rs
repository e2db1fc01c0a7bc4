//! What is in a folder of results: what stays whatever is done, and what a verification sees.

use crate::{program::rowgram, run::orthomosaic};
use serde_json::Value;
use std::{fs, path::Path};

/// The stages that need an orthomosaic only, without the slow ones.
const SKIP: &str = "--set stages.skip=[\"leaves\",\"leaf-density\"]";

fn text(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

#[test]
fn a_run_leaves_alone_what_it_did_not_write_and_a_verification_sees_what_others_did() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let field = root.join("field");
    orthomosaic(&field);
    let results = field.join("rowgram");
    let run = |words: &str| rowgram(root, &format!("run field -q {SKIP} {words}"));

    // Somebody's files: kept in place, or refused by name before any work.
    fs::create_dir_all(results.join("segment")).unwrap();
    fs::create_dir_all(results.join("dem")).unwrap();
    for (name, words) in [("segment/survey.tif", "survey"), ("dem/notes.txt", "notes")] {
        fs::write(results.join(name), words).unwrap();
    }
    fs::write(results.join("report.html"), "my report").unwrap();
    let refused = run("");
    assert_eq!(refused.code, 2, "{}", refused.stderr);
    assert!(refused.stderr.contains("report.html"), "{}", refused.stderr);
    assert!(!results.join("segment/mask.tif").exists());
    fs::remove_file(results.join("report.html")).unwrap();
    let done = run("");
    assert_eq!(done.code, 0, "{}", done.stderr);
    assert_eq!(text(&results.join("segment/survey.tif")), "survey");
    assert_eq!(text(&results.join("dem/notes.txt")), "notes");

    // Part of a run leaves the report of all of it.
    let pages = || ["report.html", "stats.json"].map(|name| fs::read(results.join(name)).unwrap());
    let before = pages();
    let part = run("--until segment --from segment");
    assert_eq!(part.code, 0, "{}", part.stderr);
    assert!(
        pages() == before && part.stdout.contains("of a run of more stages"),
        "{}",
        part.stdout
    );

    // One of its own results is no input.
    let traits = results.join("plots/traits.geojson");
    let kept = fs::read(&traits).unwrap();
    let own = run("--set project.plots=rowgram/plots/traits.geojson");
    assert_eq!(own.code, 2, "{}", own.stderr);
    assert!(own.stderr.contains("its own results"), "{}", own.stderr);
    assert!(fs::read(&traits).unwrap() == kept);

    // Edited since: refused by name, or kept beside.
    let plants = results.join("locate/plants.csv");
    let whole = fs::read(&plants).unwrap();
    fs::write(&plants, "u_px,v_px\n").unwrap();
    let refused = run("");
    assert_eq!(refused.code, 2, "{}", refused.stderr);
    assert!(refused.stderr.contains("plants.csv"), "{}", refused.stderr);
    assert_eq!(text(&plants), "u_px,v_px\n");
    let forced = run("--force");
    assert_eq!(forced.code, 0, "{}", forced.stderr);
    assert!(fs::read(&plants).unwrap() == whole);
    assert_eq!(text(&results.join("locate/plants.csv.edited")), "u_px,v_px\n");

    // What nobody wrote is told, and without it all is as it was.
    let verify = |words: &str| rowgram(root, &format!("verify field -q {words}"));
    let foreign = verify("--files");
    assert_eq!(foreign.code, 3);
    for name in ["survey.tif", "notes.txt", "plants.csv.edited"] {
        assert!(foreign.stdout.contains(name), "{name}: {}", foreign.stdout);
        let all = ["segment", "dem", "locate"].map(|stage| results.join(stage).join(name));
        all.iter().for_each(|path| drop(fs::remove_file(path)));
    }
    let same = verify("");
    assert_eq!(same.code, 0, "{} {}", same.stdout, same.stderr);

    // Everything that others change is seen, and nothing forged is shown.
    let stats: Value = serde_json::from_str(&text(&results.join("stats.json"))).unwrap();
    let plants = stats["results"]["locate"]["plants"].to_string();
    for stage in stats["stages"].as_array().unwrap() {
        let is_done = matches!(stage["ending"].as_str(), Some("done" | "kept"));
        assert_eq!(stage["seconds"].as_f64().is_some(), is_done, "{stage}");
    }
    type Change<'a> = &'a dyn Fn(&str) -> String;
    let changes: [(&str, Change<'_>); 8] = [
        ("rowgram/stages/locate.json", &|text| {
            let forged = text.replace(&format!("\"plants\": {plants}"), "\"plants\": 999999");
            assert!(forged != text, "{text}");
            forged
        }),
        ("rowgram/stages/plots.json", &|text| {
            let mut record: Value = serde_json::from_str(text).unwrap();
            record["outputs"] = Value::Array(Vec::new());
            record.to_string()
        }),
        ("rowgram/stages/segment.json", &|text| {
            text.replacen("\"sha256\": \"", "\"sha256\": \"0", 1)
        }),
        ("rowgram/stats.json", &|text| text.to_owned() + " "),
        ("rowgram/report.html", &|text| text.to_owned() + " "),
        ("rowgram/stac.json", &|text| text.to_owned() + " "),
        ("rowgram/rowgram-manifest.json", &|text| text.replacen("\"bytes\": ", "\"bytes\": 1", 1)),
        ("rowgram.toml", &|text| text.to_owned() + "# later\n"),
    ];
    for (name, change) in changes {
        let path = field.join(name);
        let Ok(before) = fs::read_to_string(&path) else {
            assert_eq!(name, "rowgram/stac.json", "an orthomosaic without photos has no time");
            continue;
        };
        fs::write(&path, change(&before)).unwrap();
        let seen = verify("--files");
        assert_eq!(seen.code, 3, "{name}: {}", seen.stdout);
        let file = Path::new(name).file_name().unwrap().to_str().unwrap();
        assert!(seen.stdout.contains(file), "{name}: {}", seen.stdout);
        fs::write(&path, before).unwrap();
    }
    let record = results.join("stages/evaluate.json");
    fs::rename(&record, root.join("aside.json")).unwrap();
    let gone = verify("--files");
    assert!(gone.code == 3 && gone.stdout.contains("evaluate.json"), "{}", gone.stdout);
    fs::rename(root.join("aside.json"), &record).unwrap();
    assert_eq!(verify("--files").code, 0);
    let path = results.join("stages/locate.json");
    fs::write(&path, text(&path).replace(&format!("\"plants\": {plants}"), "\"plants\": 999999"))
        .unwrap();
    let again = run("");
    assert!(
        again.code == 0 && !again.stdout.contains("999999"),
        "{} {}",
        again.stdout,
        again.stderr
    );
    fs::write(results.join("stats.json"), text(&results.join("stats.json")) + " ").unwrap();
    let changed = verify("--files");
    assert!(changed.code == 3 && (changed.stdout + &changed.stderr).contains("stats.json"));
}
