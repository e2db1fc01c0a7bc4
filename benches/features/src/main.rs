//! Finds and matches features for `compare.py` and says how long it took.
//!
//! ```text
//! features-probe detect PICTURE OUT MAX_FEATURES root|l2 REPEATS
//! features-probe match ONE OTHER REPEATS
//! ```
//!
//! `detect` writes OUT.points (five little-endian `f32` each) and OUT.descriptors, `match` reads
//! descriptors. Each repeat prints `seconds WALL PROCESSOR`; reading and writing files is not in it.

use rowgram::{
    features::{Descriptors, Norm, FeatureOptions, detect, grey, matching},
    io::images,
};
use std::{error::Error, path::Path, time::Instant};

fn main() -> Result<(), Box<dyn Error>> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    match words.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["detect", picture, out, budget, norm, repeats] => {
            let grey = grey(&images::read_photo(Path::new(picture))?);
            let norm = if norm == "root" { Norm::Root } else { Norm::L2 };
            let options = FeatureOptions { max_features: budget.parse()?, norm, ..FeatureOptions::default() };
            let found = timed(repeats, || detect(&grey, &options))?;
            let points = found.key_points.iter().flat_map(|p| {
                [p.u_px, p.v_px, p.sigma_px, p.angle_rad, p.response].map(f32::to_le_bytes)
            });
            std::fs::write(format!("{out}.points"), points.flatten().collect::<Vec<u8>>())?;
            std::fs::write(format!("{out}.descriptors"), found.descriptors.as_bytes())?;
        }
        ["match", one, other, repeats] => {
            let read = |path: &str| -> Result<Descriptors, Box<dyn Error>> {
                Ok(Descriptors::from_bytes(std::fs::read(path)?).ok_or("not descriptors")?)
            };
            let (one, other) = (read(one)?, read(other)?);
            let options = matching::MatchOptions::default();
            let matches =
                timed(repeats, || matching::match_descriptors(&one, &other, &options))?;
            println!("matches {}", matches.len());
        }
        _ => return Err("expected detect or match, see the source".into()),
    }
    Ok(())
}

/// Does it some times, printing how long each took; the last result.
fn timed<T>(repeats: &str, work: impl Fn() -> T) -> Result<T, Box<dyn Error>> {
    let mut result = None;
    for _ in 0..repeats.parse::<usize>()?.max(1) {
        let (wall, processor) = (Instant::now(), processor_seconds()?);
        result = Some(work());
        println!("seconds {} {}", wall.elapsed().as_secs_f64(), processor_seconds()? - processor);
    }
    result.ok_or_else(|| "nothing was done".into())
}

/// Processor time of all threads since the program began; the system counts it in hundredths.
fn processor_seconds() -> Result<f64, Box<dyn Error>> {
    let text = std::fs::read_to_string("/proc/self/stat")?;
    let fields: Vec<&str> =
        text.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks = |k: usize| -> Result<f64, Box<dyn Error>> {
        Ok(fields.get(k).ok_or("no times in /proc/self/stat")?.parse::<f64>()?)
    };
    // User and system time are fields 14 and 15 of the line, whose second has just been cut off.
    Ok((ticks(11)? + ticks(12)?) / 100.0)
}
