//! What files, names and surroundings that mean no good can do: an error with its exit code, and nothing else.

use crate::program::{Run, rowgram};
use flate2::{Compression, write::ZlibEncoder};
use std::{
    ffi::{OsStr, OsString},
    fs::{self, File},
    io::Write,
    os::unix::ffi::{OsStrExt, OsStringExt},
    path::Path,
    process::Command,
};

/// The program with arguments as they are.
fn program(folder: &Path, arguments: &[&OsStr]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rowgram"));
    command.args(arguments).current_dir(folder);
    command
}

fn refused(run: &Run, words: &[&str]) {
    assert_eq!(run.code, 2, "{}", run.stderr);
    for word in words {
        assert!(run.stderr.contains(word), "no {word:?} in {}", run.stderr);
    }
}

/// A PNG of one colour a channel, small as a file.
fn flat_png(path: &Path, [width, height]: [u32; 2], colours: bool) {
    let mut out = b"\x89PNG\r\n\x1a\n".to_vec();
    let mut chunk = |kind: &[u8; 4], body: &[u8]| {
        let mut crc = flate2::Crc::new();
        crc.update(kind);
        crc.update(body);
        out.extend((body.len() as u32).to_be_bytes());
        out.extend(kind);
        out.extend(body);
        out.extend(crc.sum().to_be_bytes());
    };
    let mut head = [width.to_be_bytes(), height.to_be_bytes()].concat();
    head.extend([8, if colours { 2 } else { 0 }, 0, 0, 0]);
    chunk(b"IHDR", &head);
    let mut data = ZlibEncoder::new(Vec::new(), Compression::best());
    let row = vec![0; 1 + width as usize * if colours { 3 } else { 1 }];
    (0..height).for_each(|_| data.write_all(&row).unwrap());
    chunk(b"IDAT", &data.finish().unwrap());
    chunk(b"IEND", &[]);
    fs::write(path, out).unwrap();
}

/// A TIFF of strips whose header says what it likes.
fn tiff(path: &Path, [width, height]: [u32; 2], rows_per_strip: u32) {
    let strips = height.div_ceil(rows_per_strip);
    let tags = 9;
    let behind = 8 + 2 + 12 * tags + 4;
    let (offsets, counts) = (behind + 8, behind + 8 + 4 * strips);
    let data = counts + 4 * strips;
    let mut out = b"II*\0\x08\0\0\0".to_vec();
    out.extend((tags as u16).to_le_bytes());
    let mut entry = |tag: u16, kind: u16, count: u32, value: u32| {
        out.extend(tag.to_le_bytes());
        out.extend(kind.to_le_bytes());
        out.extend(count.to_le_bytes());
        out.extend(value.to_le_bytes());
    };
    entry(256, 4, 1, width);
    entry(257, 4, 1, height);
    entry(258, 3, 3, behind);
    entry(259, 3, 1, 1);
    entry(262, 3, 1, 2);
    entry(273, 4, strips, offsets);
    entry(277, 3, 1, 3);
    entry(278, 4, 1, rows_per_strip);
    entry(279, 4, strips, counts);
    out.extend([0; 4]);
    out.extend([8, 0, 8, 0, 8, 0, 0, 0]);
    (0..strips).for_each(|_| out.extend(data.to_le_bytes()));
    (0..strips).for_each(|_| out.extend(1000_u32.to_le_bytes()));
    out.extend([0; 1000]);
    fs::write(path, out).unwrap();
}

#[test]
fn variables_of_others_need_not_be_text_and_our_own_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let umlaut = OsString::from_vec(b"M\xfcller".to_vec());
    for command in ["doctor", "verify", "view"] {
        let arguments = [OsStr::new(command), OsStr::new(".")];
        let done = program(folder.path(), &arguments).env("OWNER", &umlaut).output().unwrap();
        assert!(matches!(done.status.code(), Some(0..=3)), "{command}: {:?}", done.status);
        let done =
            program(folder.path(), &arguments).env("ROWGRAM_ALIGN_SEED", &umlaut).output().unwrap();
        let said = String::from_utf8_lossy(&done.stderr);
        assert_eq!(done.status.code(), Some(2), "{command}: {said}");
        assert!(said.contains("ROWGRAM_ALIGN_SEED"), "{command}: {said}");
    }
}

#[test]
fn the_exit_code_tells_where_nobody_reads_messages() {
    let folder = tempfile::tempdir().unwrap();
    for arguments in [&["locate", "none.png", "-o", "x.csv"][..], &["locate"], &["doctor", "none"]]
    {
        let arguments: Vec<&OsStr> = arguments.iter().map(OsStr::new).collect();
        let full = File::options().write(true).open("/dev/full").unwrap();
        let done = program(folder.path(), &arguments).stderr(full).status().unwrap();
        assert_eq!(done.code(), Some(2), "{arguments:?}");
    }
    // Warnings too.
    fs::write(
        folder.path().join("bal.txt"),
        "1 1 1\n0 0 1 1\n0\n0\n0\n0\n0\n0\n500\n0\n0\n0\n0\n-9\n",
    )
    .unwrap();
    let full = File::options().write(true).open("/dev/full").unwrap();
    let done = program(folder.path(), &["adjust", "bal.txt"].map(OsStr::new)).stderr(full).output();
    assert!(matches!(done.unwrap().status.code(), Some(0..=3)));
}

#[test]
fn what_a_header_promises_is_not_made_room_for() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    tiff(&at.join("wide.tif"), [u32::MAX / 2, 64], 9);
    tiff(&at.join("strip.tif"), [100_000, 100_000], 100_000);
    for name in ["wide.tif", "strip.tif"] {
        for (command, out) in [
            ("segment", "out.tif"),
            ("locate", "out.csv"),
            ("leaves density", "out.tif"),
            ("leaves count --rho-px 5", "out.csv"),
            ("leaves", "out.csv"),
        ] {
            let run = rowgram(at, &format!("{command} {name} -o {out} --max-memory-mb 2000"));
            refused(&run, &[name, "of memory", "2.0 GB may be used"]);
        }
    }
    assert_eq!(fs::read_dir(at).unwrap().count(), 2, "nothing is left");
}

#[test]
fn small_files_of_large_pictures_are_refused_with_both_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    flat_png(&at.join("mask.png"), [6000, 5000], false);
    flat_png(&at.join("photo.png"), [6000, 5000], true);
    assert!(fs::metadata(at.join("photo.png")).unwrap().len() < 200_000);
    for (command, limit_mb, words) in [
        ("locate mask.png -o p.csv", 100, "150 MB of memory, 100 MB may be used"),
        ("segment photo.png -o m.png", 200, "210 MB of memory, 200 MB may be used"),
        // Decoded it fits, its scale space does not.
        ("align features photo.png -o f", 1000, "1.2 GB of memory, 1.0 GB may be used"),
        ("align match photo.png photo.png -o m.csv", 1000, "1.2 GB of memory"),
    ] {
        let run = rowgram(at, &format!("{command} --max-memory-mb {limit_mb}"));
        refused(&run, &["6000 x 5000", words, "--max-memory-mb"]);
    }
    assert!(rowgram(at, "segment photo.png -o m.png --max-memory-mb 0").code == 2);
    let endless = rowgram(at, "evaluate /dev/zero /dev/zero --radius-px 5 --max-memory-mb 60");
    refused(&endless, &["/dev/zero", "no end"]);
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
    (0..200).for_each(|_| packed.write_all(&[b' '; 1 << 20]).unwrap());
    let packed = packed.finish().unwrap();
    assert!(packed.len() < 1 << 20);
    fs::write(at.join("bomb.txt.gz"), packed).unwrap();
    let bomb = rowgram(at, "adjust bomb.txt.gz --max-memory-mb 150");
    refused(&bomb, &["bomb.txt.gz", "no end within 50 MB"]);
}

#[test]
fn names_do_not_command_the_terminal() {
    let folder = tempfile::tempdir().unwrap();
    let name = OsStr::from_bytes(b"a\x1b]0;owned\x07\x1b[31mb.png");
    let run = |arguments: &[&OsStr]| program(folder.path(), arguments).output().unwrap();
    let said = |done: std::process::Output, code: i32| {
        assert_eq!(done.status.code(), Some(code));
        let said = [done.stdout, done.stderr].concat();
        let shown = String::from_utf8_lossy(&said).into_owned();
        assert!(!said.contains(&0x1b) && !said.contains(&7), "{shown:?}");
        shown
    };
    let check = |done: std::process::Output, code: i32| {
        let shown = said(done, code);
        assert!(shown.contains("\\u001b"), "{shown:?}");
    };
    check(run(&[OsStr::new("locate"), name, OsStr::new("-o"), OsStr::new("x.csv")]), 2);
    // Arguments that are none are shown without what commands the terminal.
    assert!(said(run(&[OsStr::new("locate"), OsStr::new("--no\x1b[31mne")]), 2).contains("--none"));
    fs::write(
        folder.path().join("bal.txt"),
        "1 1 1\n0 0 1 1\n0\n0\n0\n0\n0\n0\n500\n0\n0\n0\n0\n-9\n",
    )
    .unwrap();
    fs::rename(folder.path().join("bal.txt"), folder.path().join(name)).unwrap();
    let done = run(&[OsStr::new("adjust"), name]);
    assert!(![done.stdout, done.stderr].concat().contains(&0x1b), "a warning names the file");
}

#[test]
fn names_of_plots_are_text_in_tables() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let mask = image::GrayImage::from_fn(40, 40, |u, v| {
        image::Luma([if (u / 3 + v / 3) % 2 == 0 { 255 } else { 0 }])
    });
    mask.save(at.join("mask.png")).unwrap();
    let names = ["=HYPERLINK(\"http://x\")", "@a", "+b", "whole", "", "c,d", "e\nf"];
    let plot = |(k, name): (usize, &&str)| {
        let (u, v) = (5.0 * k as f64, 1.0);
        serde_json::json!({"type": "Feature", "properties": {"name": name}, "geometry": {"type": "Polygon", "coordinates":
            [[[u, v], [u + 4.0, v], [u + 4.0, v + 30.0], [u, v + 30.0], [u, v]]]}})
    };
    let plots: Vec<_> = names.iter().enumerate().map(plot).collect();
    let plots = serde_json::json!({"type": "FeatureCollection", "features": plots});
    fs::write(at.join("plots.geojson"), plots.to_string()).unwrap();
    let run = rowgram(at, "leaves count mask.png --plots plots.geojson --rho-px 5 -o counts.csv");
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(run.stderr.contains("plot whole"), "{}", run.stderr);
    let text = fs::read_to_string(at.join("counts.csv")).unwrap();
    assert!(
        text.contains("'=HYPERLINK") && text.contains("\n'@a,") && text.contains("\n'+b,"),
        "{text}"
    );
    let table = rowgram::io::csv_table::CsvTable::read(&at.join("counts.csv")).unwrap();
    let expected =
        ["whole", "=HYPERLINK(\"http://x\")", "@a", "+b", "plot whole", "unnamed 5", "c,d", "e\nf"];
    assert_eq!(table.texts("plot").unwrap(), expected);
}

#[test]
fn numbers_that_cannot_be_computed_with_are_bad_input() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let mut good =
        "2 3 6\n0 0 1 2\n0 1 3 4\n0 2 -5 1\n1 0 1.5 2.5\n1 1 3.5 4.5\n1 2 -4.5 1.5\n".to_owned();
    for x in [0.0, 1.0] {
        good += &format!("0.01\n0.02\n0.03\n{x}\n0.1\n-0.2\n500\n0\n0\n");
    }
    good += "0\n0\n-10\n1\n1\n-12\n-1\n0.5\n-11\n";
    let write = |name: &str, text: &str| fs::write(at.join(name), text).unwrap();
    write("good.txt", &good);
    write("focal.txt", &good.replacen("500", "1e308", 1));
    write("observation.txt", &good.replacen("0 0 1 2", "0 0 1e200 2", 1));
    write("nan.txt", &good.replacen("-10", "nan", 1));
    assert_eq!(rowgram(at, "adjust good.txt").code, 0);
    refused(&rowgram(at, "adjust focal.txt"), &["focal.txt, line 14", "1e308"]);
    refused(&rowgram(at, "adjust observation.txt"), &["observation.txt, line 2", "1e200"]);
    refused(&rowgram(at, "adjust nan.txt"), &["nan.txt, line 28"]);
    refused(&rowgram(at, "adjust good.txt --cost-tolerance=1"), &["cost-tolerance"]);

    write(
        "corners.csv",
        "corner,easting_m,northing_m\nfirst,500000,4500000\nalong,500000,4500010.5\nacross,500009.12,4500000\n",
    );
    write(
        "far.csv",
        "corner,easting_m,northing_m\nfirst,1e308,4500000\nalong,500000,1e308\nacross,500030,-1e308\n",
    );
    write("map.csv", "plot,genotype\n1,a\0b\n2,c\n");
    let layout = "--crs EPSG:32616 --ranges 2 --plots-per-range 3 --rows-per-plot 4 --row-spacing-m 0.76 --plot-length-m 5 --alley-m 0.5";
    let run = |arguments: &str| rowgram(at, &format!("plots layout {layout} -o out {arguments}"));
    refused(&run("--corners far.csv"), &["far.csv, line 2", "easting_m is 1e308"]);
    refused(&run("--corners corners.csv --field-map map.csv"), &["map.csv, line 2", "NUL"]);
    for sigma in ["1e-300", "1e308"] {
        refused(
            &run(&format!("--corners corners.csv --corner-sigma-m {sigma}")),
            &["corner-sigma-m"],
        );
    }
    assert!(!at.join("out").exists(), "nothing is left");
}

/// Six photos of a synthetic flight with names that tables, spreadsheets and file systems have to quote, one whose name is not
/// UTF-8, and a picture of nothing.
#[test]
#[ignore = "slow"]
fn a_flight_with_odd_names_is_aligned_and_reported() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    assert_eq!(rowgram(at, "synth flight --preset small -o field -q").code, 0);
    let images = at.join("flight/images");
    fs::create_dir_all(&images).unwrap();
    let names = ["a,b.JPG", "\"c.JPG", "d\ne.JPG", "=f.JPG", "g.JPG"];
    for (k, name) in names.iter().enumerate() {
        let photo = at.join(format!("field/images/IMG_000{}.JPG", k + 1));
        fs::copy(photo, images.join(name)).unwrap();
    }
    let foreign = images.join(OsStr::from_bytes(b"K\xf6ln.JPG"));
    fs::copy(at.join("field/images/IMG_0006.JPG"), foreign).unwrap();
    image::RgbImage::new(64, 64).save(images.join("zzz.jpg")).unwrap();
    let doctor = rowgram(at, "doctor flight");
    assert!(doctor.stdout.contains("its name is not UTF-8"), "{}", doctor.stdout);
    let run = rowgram(at, "run flight --until align");
    // The picture of nothing and the one that is there twice are out: more than [checks] oriented_red lets pass.
    assert_eq!(run.code, 3, "{} {}", run.stdout, run.stderr);
    let again = rowgram(at, "align flight");
    assert_eq!(again.code, 3, "{} {}", again.stdout, again.stderr);
    for said in [&run.stderr, &again.stderr] {
        assert!(said.contains("photos oriented: 5 of 7"), "{said}");
    }
    assert!(run.stderr.contains("ln.JPG") && run.stderr.contains("not UTF-8"), "{}", run.stderr);
    assert!(!run.stderr.contains("no factor"), "{}", run.stderr);
    let page = fs::read_to_string(at.join("flight/rowgram/report.html")).unwrap();
    assert!(page.contains("a,b.JPG"), "the report names it");
    let pairs = at.join("flight/rowgram/align/report/pairs.csv");
    let table = rowgram::io::csv_table::CsvTable::read(&pairs).unwrap();
    let first = table.texts("first").unwrap();
    assert!(!first.is_empty() && first.iter().all(|name| names.contains(name)), "{first:?}");
}
