//! *Bundle Adjustment in the Large* text files, plain, gzipped or, as they are published, by bzip2.
//!
//! ```text
//! cameras points observations
//! camera point u v                 one line per observation
//! ...
//! nine numbers per camera          rotation vector, translation, f, k1, k2
//! three numbers per point
//! ```
//!
//! Numbers are separated by any white space; what follows a `#` in a line is a comment. Conventions: [`rowgram_survey::camera::bal`].

use super::{
    FileError,
    memory::{read_file, read_to_end},
    output,
    words::{self, Fault, Words},
};
use rowgram_survey::problems::bundle::{Camera, Network, Observation};
use std::{io::Write, path::Path};

/// Reads a network.
///
/// # Errors
/// Where the file cannot be read, or is not such a file; names the line.
pub fn read(path: &Path) -> Result<Network, FileError> {
    let mut bytes = read_file(path)?;
    if bytes.starts_with(&[0x1f, 0x8b]) {
        bytes = unpacked(path, "gzip", flate2::read::MultiGzDecoder::new(bytes.as_slice()))?;
    } else if bytes.starts_with(b"BZh") {
        bytes = unpacked(path, "bzip2", bzip2::read::MultiBzDecoder::new(bytes.as_slice()))?;
    }
    let network = words::text(&bytes).and_then(parse);
    network.map_err(|(line, message)| FileError::malformed(path, line, message))
}

fn unpacked(path: &Path, kind: &str, reader: impl std::io::Read) -> Result<Vec<u8>, FileError> {
    read_to_end(path, reader).map_err(|error| match error {
        FileError::Read { source, .. } => {
            FileError::malformed(path, None, format!("damaged {kind} data: {source}"))
        }
        other => other,
    })
}

/// Reads a network from the text of a file.
///
/// # Errors
/// The one-based line and what is wrong there.
pub fn parse(text: &str) -> Result<Network, (Option<usize>, String)> {
    let mut words = Words::of_file(text);
    let counts: [usize; 3] = [
        words.number("the number of cameras")?,
        words.number("the number of points")?,
        words.number("the number of observations")?,
    ];
    let [cameras, points, observations] = counts;
    for (count, what) in counts.iter().zip(["cameras", "points", "observations"]) {
        if *count == 0 {
            return Err((Some(1), format!("the file has no {what}")));
        }
        // Every count needs at least two characters each of what follows; nothing is allocated
        // for a header that promises more than the file can hold.
        if *count > text.len() / 2 || u32::try_from(*count).is_err() {
            let message = format!("{count} {what} cannot be in a file of {} bytes", text.len());
            return Err((Some(1), message));
        }
    }
    let mut network = Network {
        cameras: Vec::with_capacity(cameras),
        points: Vec::with_capacity(points),
        observations: Vec::with_capacity(observations),
    };
    for _ in 0..observations {
        let camera = index(&mut words, "camera", cameras)?;
        let point = index(&mut words, "point", points)?;
        let image_px = [words.finite("u")?, words.finite("v")?];
        network.observations.push(Observation { camera, point, image_px });
    }
    for k in 0..cameras {
        let mut values = [0.0; 9];
        for (value, what) in values.iter_mut().zip(CAMERA_ENTRIES) {
            *value = words.finite(what).map_err(|(l, m)| (l, format!("camera {k}: {m}")))?;
        }
        let [a, b, c, x, y, z, f, k1, k2] = values;
        network.cameras.push(Camera {
            rotation_rad: [a, b, c],
            translation: [x, y, z],
            interior: [f, k1, k2],
        });
    }
    for k in 0..points {
        let mut point = [0.0; 3];
        for (value, what) in point.iter_mut().zip(["X", "Y", "Z"]) {
            *value = words.finite(what).map_err(|(l, m)| (l, format!("point {k}: {m}")))?;
        }
        network.points.push(point);
    }
    words.end()?;
    Ok(network)
}

fn index(words: &mut Words, what: &str, count: usize) -> Result<u32, Fault> {
    let index: u32 = words.number(&format!("the index of a {what}"))?;
    if (index as usize) < count {
        Ok(index)
    } else {
        Err(words.fault(format!("{what} {index} does not exist, there are {count}")))
    }
}

const CAMERA_ENTRIES: [&str; 9] = [
    "rotation x",
    "rotation y",
    "rotation z",
    "translation x",
    "translation y",
    "translation z",
    "f",
    "k1",
    "k2",
];

/// Writes a network with full precision; gzipped where the name ends in `.gz`.
///
/// # Errors
/// As [`output::write`].
pub fn write(path: &Path, network: &Network, force: bool) -> Result<(), FileError> {
    output::write(path, force, |out| {
        if path.extension().is_some_and(|extension| extension == "gz") {
            let mut gzip = flate2::write::GzEncoder::new(out, flate2::Compression::default());
            write_text(&mut gzip, network)?;
            gzip.finish().map(|_| ())
        } else {
            write_text(out, network)
        }
    })
}

fn write_text(out: &mut dyn Write, network: &Network) -> std::io::Result<()> {
    let Network { cameras, points, observations } = network;
    writeln!(out, "{} {} {}", cameras.len(), points.len(), observations.len())?;
    for o in observations {
        writeln!(out, "{} {} {:e} {:e}", o.camera, o.point, o.image_px[0], o.image_px[1])?;
    }
    for camera in cameras {
        for v in camera.rotation_rad.iter().chain(&camera.translation).chain(&camera.interior) {
            writeln!(out, "{v:e}")?;
        }
    }
    for v in points.iter().flatten() {
        writeln!(out, "{v:e}")?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SMALL: &str =
        "1 2 2\n0 0 1.5 -2\n0 1 3e1 4\n.1 .2 .3\n1 2 3 500 -0.1 0.01\n0 0 -5\n1\n1\n-6\n";

    #[test]
    fn what_is_written_is_read_back() {
        let network = parse(SMALL).unwrap();
        assert_eq!(network.cameras[0].interior, [500.0, -0.1, 0.01]);
        assert_eq!(network.points[1], [1.0, 1.0, -6.0]);
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.txt", "a.txt.gz"] {
            let path = folder.path().join(name);
            write(&path, &network, false).unwrap();
            assert_eq!(read(&path).unwrap(), network);
        }
    }

    #[test]
    fn published_forms_are_read() {
        let network = parse(SMALL).unwrap();
        let commented =
            format!("# made by a program\n{}# end", SMALL.replacen('\n', " # counts\n", 1));
        assert_eq!(parse(&commented).unwrap(), network);
        assert_eq!(parse(&commented.replace("500", "x")).unwrap_err().0, Some(6));
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt.bz2");
        let mut packed = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::best());
        packed.write_all(SMALL.as_bytes()).unwrap();
        let packed = packed.finish().unwrap();
        std::fs::write(&path, &packed).unwrap();
        assert_eq!(read(&path).unwrap(), network);
        std::fs::write(&path, &packed[..packed.len() / 2]).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("bzip2"));
    }

    #[test]
    fn the_line_of_an_error_is_named() {
        for (damage, line, part) in [
            (("0 1 3e1 4", "0 2 3e1 4"), 3, "point 2 does not exist"),
            (("0 1 3e1 4", "0 1 NaN 4"), 3, "finite"),
            (("0 1 3e1 4", "0 1 x 4"), 3, "expected u"),
            (("-6\n", "-6\n7\n"), 10, "end of the file"),
            (("-6\n", ""), 9, "the file ends where Z"),
            (("500", "inf"), 5, "finite"),
            (("1 2 2", "1 2 99999999"), 1, "cannot be in a file"),
            (("1 2 2", "0 2 2"), 1, "no cameras"),
            (("1 2 2", "-1 2 2"), 1, "number of cameras"),
        ] {
            let (at, message) = parse(&SMALL.replacen(damage.0, damage.1, 1)).unwrap_err();
            assert!(
                at == Some(line) && message.contains(part),
                "{damage:?}: line {at:?}: {message}"
            );
        }
        assert!(parse("").unwrap_err().1.contains("ends"));
    }

    proptest! {
        #[test]
        fn damage_is_an_error_or_another_network(
            at in 0..SMALL.len(),
            byte in any::<u8>(),
            cut in 0..SMALL.len(),
        ) {
            let mut bytes = SMALL.as_bytes().to_vec();
            bytes[at] = byte;
            bytes.truncate(cut);
            if let Ok(text) = std::str::from_utf8(&bytes)
                && let Ok(network) = parse(text)
            {
                let finite = network.points.iter().flatten().all(|v| v.is_finite());
                prop_assert!(finite);
            }
        }

        #[test]
        fn damaged_gzip_is_an_error(at in 0..64usize, byte in any::<u8>()) {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("a.gz");
            write(&path, &parse(SMALL).unwrap(), false).unwrap();
            let mut bytes = std::fs::read(&path).unwrap();
            let at = at % bytes.len();
            bytes[at] ^= byte;
            std::fs::write(&path, &bytes).unwrap();
            // Some bits of the header mean nothing; none may cause a panic.
            let _ = read(&path);
        }
    }
}
