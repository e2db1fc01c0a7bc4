//! Damaged files and odd options, over every command: whatever comes, the program ends by itself with one of its exit codes, within
//! some memory, leaves nothing half-written and does not touch its inputs.
//!
//! `FUZZ_SECONDS` (60) says for how long, `FUZZ_SEED` (1) which cases; `tests/fuzz/commands.sh` sets them. Cases that fail are kept
//! in `target/fuzz-found`, a folder each with `command.txt`.

use crate::program::rowgram;
use rand::{RngExt, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::{Duration, Instant},
};

/// Address space of a run, kilobytes, and the longest time that it may take.
const MEMORY_KB: u64 = 6_000_000;
const LONGEST: Duration = Duration::from_secs(60);

/// Command lines with the files that may be damaged in them.
const COMMANDS: &[&str] = &[
    "segment picture.png -o out.png",
    "segment picture.tif -o out.tif",
    "segment picture.jpg -o out.png --hsv 30,79,30,163",
    "locate mask.png -o out.csv --gsd-m 0.01",
    "locate mask.tif -o out.csv --gaps gaps.csv --rows rows.csv",
    "locate mask.png -o out.csv --method paper --plants 12",
    "leaves mask.png -o out.csv",
    "leaves picture.tif -o out.gpkg --labels labels.tif",
    "leaves count mask.tif --regions regions.geojson --plots plots.geojson -o out.csv",
    "leaves count mask.tif --plots plots.gpkg --rho-px 9 -o out.csv",
    "leaves count mask.tif --plots plots.shp --rho-px 9 -o out.csv",
    "leaves density mask.png -o out.tif --window-px 21",
    "align features picture.jpg -o out --max-features 50",
    "align match picture.jpg picture.png -o out.csv --max-features 50",
    "segment thresholds picture.png --masks mask.png",
    "evaluate plants.csv truth.csv --radius-px 5,10",
    "adjust bal.txt --max-iterations 5",
    "adjust bal.txt.gz --max-iterations 5 -o out.txt",
    "adjust model --datum minimal",
    "adjust scene --datum minimal --report out",
    "adjust bundle.out --image-size-px 1000,750",
    "adjust block.toml",
    "convert model --to opensfm -o out.json",
    "convert bundle.out --image-size-px 1000,750 --to colmap-text -o out",
    "convert opensfm.json --to bundler -o out.out",
    "convert binary --to rowgram -o out",
    "convert scene --to colmap-binary -o out",
    "camera convert camera.toml --to opencv",
    "camera undistort picture.jpg --camera camera.toml -o out",
    "camera calibrate --corners corners.csv --board 4x3 --square-m 0.03 --size-px 640,480 -o out.toml",
    "surface dem --points points.csv --crs EPSG:32616 -o out.tif",
    "ortho --poses poses.csv --camera camera.toml --photos photos --dem dem.tif -o out.tif",
    "ortho query picture.tif --at 500001,4500001",
    "plots layout --corners surveyed.csv --field-map map.csv --crs EPSG:32616 --ranges 2 --plots-per-range 2 --rows-per-plot 2 \
     --row-spacing-m 0.7 --plot-length-m 4 --alley-m 1 -o out",
    "plots layout --refine plots.geojson -o out",
    "doctor field",
    "doctor map",
    "run field --dry-run",
    "run map --until segment",
    "season season.toml",
    "plan field -o out",
    "verify map --files",
    "init out",
    "synth mask --preset mid20 --rows 1 --row-length 1 -o out",
    "synth bundle --images 4 --points 40 -o out.txt",
    "view map",
    "completions bash",
    "completions --man",
];

/// Texts that numbers, words and names are exchanged for.
const TOKENS: &[&str] = &[
    "",
    "nan",
    "inf",
    "-inf",
    "0",
    "-0",
    "-1",
    "1e308",
    "-1e308",
    "1e-308",
    "4294967296",
    "18446744073709551616",
    "0.5",
    "1e9",
    "x",
    "\"",
    "'",
    "=1+1",
    "\u{0}",
    "\u{1b}[31m",
    "é",
    "\u{202e}",
    ",",
    ";",
    "\n",
    "[",
    "{",
    "null",
    "true",
    "../../x",
    "/",
    "EPSG:0",
    "EPSG:4326",
    "a,b",
];

/// Whatever a test needs, in a folder of its own.
fn seeds(at: &Path) {
    let run = |arguments: &str| {
        let run = rowgram(at, arguments);
        assert!([0, 3].contains(&run.code), "{arguments}: {}", run.stderr);
    };
    let write = |name: &str, text: &str| fs::write(at.join(name), text).unwrap();
    run("synth mask --preset mid20 --rows 2 --row-length 2 -o made -q");
    for (from, to) in
        [("mask.png", "mask.png"), ("plants.csv", "plants.csv"), ("plants.csv", "truth.csv")]
    {
        fs::copy(at.join("made").join(from), at.join(to)).unwrap();
    }
    let picture = image::open(at.join("made/picture.png")).unwrap().into_rgb8();
    let picture = image::imageops::crop_imm(
        &picture,
        0,
        0,
        96.min(picture.width()),
        80.min(picture.height()),
    )
    .to_image();
    picture.save(at.join("picture.png")).unwrap();
    picture.save(at.join("picture.jpg")).unwrap();
    use rowgram::{
        io::{geotiff, images},
        raster::{
            georeference::{Crs, Georeference},
            window::Window,
        },
    };
    let place = Georeference::north_up([500_000.0, 4_500_010.0], 0.05, Crs::projected(32616));
    let layout = |colour, size: (usize, usize)| geotiff::Layout {
        width: size.0,
        height: size.1,
        colour,
        georeference: Some(place),
        nodata: None,
    };
    crate::maps::write(&at.join("picture.tif"), &picture, place);
    let mask = images::read_mask(&at.join("mask.png")).unwrap();
    let values: Vec<u8> = mask.data.iter().map(|&leaf| 255 * leaf).collect();
    geotiff::write(
        &at.join("mask.tif"),
        false,
        &layout(geotiff::Colour::Classes, (mask.width, mask.height)),
        |writer| writer.put(Window::whole(mask.width, mask.height), &values),
    )
    .unwrap();
    let heights = vec![180.0_f32; 40 * 40];
    geotiff::write(
        &at.join("dem.tif"),
        false,
        &layout(geotiff::Colour::Values, (40, 40)),
        |writer| writer.put(Window::whole(40, 40), &heights),
    )
    .unwrap();
    for (folder, file) in
        [("map", "picture.tif"), ("photos", "picture.jpg"), ("field/images", "picture.jpg")]
    {
        fs::create_dir_all(at.join(folder)).unwrap();
        fs::copy(at.join(file), at.join(folder).join(file)).unwrap();
    }
    let square = |name: &str, x: f64, leaves: f64| {
        let (x, y) = (500_000.2 + x, 4_500_008.0);
        serde_json::json!({"type": "Feature", "properties": {"name": name, "leaves": leaves, "genotype": "B73"}, "geometry": {"type": "Polygon",
            "coordinates": [[[x, y], [x + 0.8, y], [x + 0.8, y + 1.5], [x, y + 1.5], [x, y]]]}})
    };
    let crs =
        serde_json::json!({"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32616"}});
    let polygons = serde_json::json!({"type": "FeatureCollection", "crs": crs, "features": [square("a", 0.0, 4.0), square("b", 1.0, 5.0), square("c", 2.0, 3.0)]});
    for name in ["plots.geojson", "regions.geojson", "map/plots.geojson"] {
        write(name, &polygons.to_string());
    }
    write(
        "surveyed.csv",
        "corner,easting_m,northing_m\nfirst,500000,4500000\nalong,500000,4500009\nacross,500002.8,4500000\n",
    );
    write("map.csv", "plot,genotype\n1,B73\n2,Mo17\n3,W22\n4,Oh43\n");
    run(&(COMMANDS
        .iter()
        .find(|line| line.starts_with("plots layout --corners"))
        .unwrap()
        .replace("-o out", "-o laid")
        + " -q"));
    for ending in ["gpkg", "shp", "shx", "dbf", "prj"] {
        fs::copy(
            at.join("laid/plots").with_extension(ending),
            at.join("plots").with_extension(ending),
        )
        .unwrap();
    }
    run("synth bundle --images 6 --points 60 -o bal.txt -q");
    run("synth bundle --images 6 --points 60 -o bal.txt.gz -q");
    run("synth flight --preset small --no-photos --tie-points 20 -o flight -q");
    for name in ["gcps.csv", "marks.csv", "geolocation.csv"] {
        fs::copy(at.join("flight").join(name), at.join("field").join(name)).unwrap();
    }
    fs::create_dir_all(at.join("model")).unwrap();
    for name in ["cameras.txt", "images.txt", "points3D.txt"] {
        fs::copy(at.join("flight/model").join(name), at.join("model").join(name)).unwrap();
    }
    fs::copy(at.join("flight/truth/camera.toml"), at.join("camera.toml")).unwrap();
    fs::copy(at.join("flight/truth/exterior_orientation.csv"), at.join("poses.csv")).unwrap();
    for (format, out) in [
        ("opensfm", "opensfm.json"),
        ("bundler", "bundle.out"),
        ("colmap-binary", "binary"),
        ("rowgram", "scene"),
    ] {
        run(&format!("convert model --to {format} -o {out} -q"));
    }
    let mut corners = "image,column,row,u_px,v_px\n".to_owned();
    let mut points = "x_m,y_m,z_m\n".to_owned();
    for k in 0..12 {
        let (column, row) = (k % 4, k / 4);
        for (image, tilt) in [("a", 0.9), ("b", 1.0), ("c", 1.1), ("d", 1.2)] {
            let (u, v) =
                (120.0 + 90.0 * f64::from(column) * tilt, 90.0 + 95.0 * f64::from(row) / tilt);
            corners += &format!("{image},{column},{row},{u},{v}\n");
        }
        points += &format!("{},{},{}\n", 500_000 + column, 4_500_000 + row, 180 + k % 3);
    }
    write("corners.csv", &corners);
    write("points.csv", &points);
    write(
        "block.toml",
        "model = \"scene\"\ncontrol = \"field/gcps.csv\"\nmarks = \"field/marks.csv\"\npositions = \"field/geolocation.csv\"\n",
    );
    write("field/rowgram.toml", "[project]\nname = \"field\"\n[align]\nseed = 3\n");
    write(
        "season.toml",
        "[[flights]]\ndate = \"2024-06-01\"\nproject = \"map\"\n[[flights]]\ndate = \"2024-06-20\"\nproject = \"field\"\n",
    );
    for folder in ["made", "laid", "flight"] {
        fs::remove_dir_all(at.join(folder)).unwrap();
    }
}

/// All files below a folder.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap().flatten() {
        match entry.path() {
            path if path.is_dir() => found.extend(files(&path)),
            path => found.push(path),
        }
    }
    found.sort();
    found
}

/// The words after `--` of a command's help that take a value.
fn options(at: &Path, line: &str) -> Vec<String> {
    let words =
        line.split_whitespace().take_while(|word| !word.contains('.') && !word.starts_with('-'));
    let help = rowgram(at, &(words.collect::<Vec<_>>().join(" ") + " --help")).stdout;
    let name = |line: &str| {
        let rest = &line[line.find("--")? + 2..];
        let name: String =
            rest.chars().take_while(|c| c.is_ascii_alphanumeric() || *c == '-').collect();
        rest[name.len()..].starts_with([' ', '[', '=']).then_some(name)
    };
    let lines = help.lines().filter(|line| line.trim_start().starts_with('-'));
    // What decides where results go is not odd, and what asks for hours is no fault.
    let tame = ["output", "port", "threads", "max-memory-mb", "help"];
    lines
        .filter_map(name)
        .filter(|name| !name.is_empty() && !tame.contains(&name.as_str()))
        .collect()
}

/// Some bytes made other ones.
fn damage(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    let is_text = std::str::from_utf8(bytes).is_ok();
    for _ in 0..random.random_range(1..5) {
        if bytes.is_empty() {
            return;
        }
        let at = random.random_range(0..bytes.len());
        let end = (at + random.random_range(1..40)).min(bytes.len());
        match random.random_range(0..8) {
            0 => bytes[at] ^= 1 << random.random_range(0..8),
            1 => bytes.truncate(at),
            2 => drop(bytes.drain(at..end)),
            3 => {
                let part = bytes[at..end].to_vec();
                bytes.splice(at..at, part.repeat(random.random_range(1..30)));
            }
            _ if is_text => {
                // A field of a table or a word.
                let is_edge = |byte: &u8| b" ,;:=\n\t\"[]{}".contains(byte);
                let from = bytes[..at].iter().rposition(is_edge).map_or(0, |k| k + 1);
                let to = bytes[at..].iter().position(is_edge).map_or(bytes.len(), |k| at + k);
                let token = TOKENS.choose(random).unwrap();
                bytes.splice(from..to.max(from), token.bytes());
            }
            kind => {
                // A number of a header: heads are where they matter most.
                let at = if kind < 7 { at % bytes.len().min(512) } else { at };
                let values: [u32; 6] = [0, 1, u32::MAX, u32::MAX / 2, 1 << 31, random.random()];
                let value = *values.choose(random).unwrap();
                let width = [1, 2, 4].into_iter().rev().nth(random.random_range(0..3)).unwrap();
                let value = if random.random() { value.to_le_bytes() } else { value.to_be_bytes() };
                for (k, byte) in value.into_iter().take(width).enumerate() {
                    if let Some(old) = bytes.get_mut(at + k) {
                        *old = byte;
                    }
                }
            }
        }
    }
}

/// Why a run is a fault, if it is one.
fn fault(work: &Path, arguments: &[String], before: &BTreeMap<PathBuf, Vec<u8>>) -> Option<String> {
    let program = std::env::var("FUZZ_PROGRAM").unwrap_or(env!("CARGO_BIN_EXE_rowgram").to_owned());
    let script = format!("ulimit -v {MEMORY_KB}; exec \"$0\" \"$@\"");
    let log = |name: &str| fs::File::create(work.parent().unwrap().join(name)).unwrap();
    let mut child = Command::new("sh")
        .args(["-c", &script, &program])
        .args(arguments)
        .args(["--threads", "2"])
        .current_dir(work)
        .stdin(Stdio::null())
        .stdout(log("stdout"))
        .stderr(log("stderr"))
        .spawn()
        .unwrap();
    let begin = Instant::now();
    // A server goes on until it is stopped.
    let longest = if arguments[0] == "view" { Duration::from_secs(2) } else { LONGEST };
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if begin.elapsed() > longest {
            child.kill().unwrap();
            child.wait().unwrap();
            return (arguments[0] != "view").then(|| format!("no end within {LONGEST:?}"));
        }
        std::thread::sleep(Duration::from_millis(2));
    };
    let said = String::from_utf8_lossy(&fs::read(work.parent().unwrap().join("stderr")).unwrap())
        .into_owned();
    match status.code() {
        Some(0..=3) if !said.contains("panicked") => {}
        code => return Some(format!("exit {code:?}: {said}")),
    }
    let after = files(work);
    let litter = after.iter().find(|path| {
        let hidden = |part: &std::ffi::OsStr| {
            [".rowgram-", ".crops-", ".tmp"].iter().any(|p| part.to_string_lossy().starts_with(p))
        };
        path.strip_prefix(work).unwrap().iter().any(hidden)
    });
    if let Some(litter) = litter {
        return Some(format!("{} is left", litter.display()));
    }
    let is_forced = arguments.iter().any(|argument| argument.starts_with("--force"));
    let changed = before.iter().find(|(path, bytes)| fs::read(path).ok().as_ref() != Some(bytes));
    changed.filter(|_| !is_forced).map(|(path, _)| format!("{} is another now", path.display()))
}

fn copy(from: &Path, to: &Path) {
    for file in files(from) {
        let target = to.join(file.strip_prefix(from).unwrap());
        fs::create_dir_all(target.parent().unwrap()).unwrap();
        fs::copy(&file, target).unwrap();
    }
}

#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn damaged_files_and_odd_options_end_in_an_exit_code() {
    let number = |name: &str, otherwise: u64| {
        std::env::var(name).ok().map_or(otherwise, |text| text.parse().unwrap())
    };
    let (seconds, seed) = (number("FUZZ_SECONDS", 60), number("FUZZ_SEED", 1));
    let folder = tempfile::tempdir().unwrap();
    let (made, work) = (folder.path().join("seeds"), folder.path().join("work"));
    fs::create_dir_all(&made).unwrap();
    seeds(&made);
    let options: Vec<Vec<String>> = COMMANDS.iter().map(|line| options(&made, line)).collect();
    assert!(options.iter().flatten().count() > 300, "the help of commands is understood");
    let (begin, mut random) = (Instant::now(), ChaCha8Rng::seed_from_u64(seed));
    let (mut runs, mut faults) = (0, Vec::new());
    while begin.elapsed().as_secs() < seconds && faults.len() < 20 {
        let which = runs % COMMANDS.len();
        copy(&made, &work);
        let mut arguments: Vec<String> =
            COMMANDS[which].split_whitespace().map(str::to_owned).collect();
        // The first round is as it should be.
        if runs >= COMMANDS.len() {
            if random.random_bool(0.8) {
                let inside = |path: &&PathBuf| {
                    let name = path.strip_prefix(&work).unwrap().to_string_lossy().into_owned();
                    arguments.iter().any(|argument| name.starts_with(argument.as_str()))
                };
                let all = files(&work);
                let named: Vec<&PathBuf> = all.iter().filter(inside).collect();
                if let Some(path) = named.choose(&mut random) {
                    let mut bytes = fs::read(path).unwrap();
                    damage(&mut bytes, &mut random);
                    fs::write(path, bytes).unwrap();
                }
            }
            if random.random_bool(0.3) {
                for _ in 0..random.random_range(1..3) {
                    let (Some(option), token) =
                        (options[which].choose(&mut random), TOKENS.choose(&mut random).unwrap())
                    else {
                        break;
                    };
                    if !token.contains('\0') {
                        arguments.push(format!("--{option}={token}"));
                    }
                }
            }
        }
        let before: BTreeMap<PathBuf, Vec<u8>> =
            files(&work).into_iter().map(|path| (path.clone(), fs::read(path).unwrap())).collect();
        if let Some(why) = fault(&work, &arguments, &before) {
            let kept = Path::new(env!("CARGO_MANIFEST_DIR"))
                .join(format!("target/fuzz-found/{seed}-{runs}"));
            before.iter().for_each(|(path, bytes)| fs::write(path, bytes).unwrap());
            copy(&work, &kept);
            let line = format!("{arguments:?}\n{why}\n");
            fs::write(kept.join("command.txt"), &line).unwrap();
            println!("{}: {line}", kept.display());
            faults.push(format!("{}: {line}", kept.display()));
        }
        fs::remove_dir_all(&work).unwrap();
        runs += 1;
    }
    println!("{runs} runs, {} faults", faults.len());
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(runs > COMMANDS.len(), "{runs} runs within {seconds} s are not even all commands");
}
