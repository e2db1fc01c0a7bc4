//! Cameras in files: our own `camera.toml`, and those of other programs.
//!
//! | program | file | pixel convention | lens |
//! |---|---|---|---|
//! | OpenCV | YAML of `FileStorage`: `camera_matrix`, `distortion_coefficients` | centre of the top-left pixel at (0, 0) | 5 or 8 terms, or fisheye |
//! | COLMAP | `cameras.txt` | centre of the top-left pixel at (0.5, 0.5) | `OPENCV`, `FULL_OPENCV`, `OPENCV_FISHEYE` |
//! | Metashape | camera XML: `f`, `cx`, `cy`, `k1`.. | `cx`, `cy` from the image's centre, v down; pixel centres at +0.5 | `frame` or `equidistant_fisheye` |
//! | OpenSfM | `camera_models.json` | focal length and offsets from the image's centre over the longer side | `brown` or `fisheye_opencv` |
//!
//! Metashape's `p1` and `p2` are OpenCV's `p2` and `p1`, its `b1` is `fx - fy`, and its `f` is `fy`.

use super::{FileError, output};
use rowgram_survey::camera::{Camera, Interior, Lens, Model};
use std::path::Path;

/// Reads a `camera.toml`.
///
/// # Errors
/// Names the file, the key and what was expected.
pub fn read(path: &Path) -> Result<Camera, FileError> {
    let text = crate::memory::read_text(path)?;
    Camera::from_toml(&text).map_err(|error| FileError::malformed(path, None, error.to_string()))
}

/// Writes a `camera.toml`.
///
/// # Errors
/// As [`output::write`].
pub fn write(path: &Path, force: bool, camera: &Camera) -> Result<(), FileError> {
    output::write(path, force, |out| out.write_all(camera.to_toml().as_bytes()))
}

/// A program that has a file of its own for cameras.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Program {
    /// OpenCV.
    OpenCv,
    /// COLMAP.
    Colmap,
    /// Agisoft Metashape.
    Metashape,
    /// OpenSfM.
    OpenSfm,
}

/// The parameters of OpenCV's model of Brown or of the fisheye, as the programs have them: `fx`,
/// `fy`, `cx`, `cy` with the centre of the top-left pixel at (0, 0).
struct Matrix {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
}

fn matrix(lens: &Interior) -> Matrix {
    let v = lens.values();
    Matrix { fx: v[0], fy: v[0] * v[1], cx: v[2], cy: v[3] }
}

fn term(lens: &Interior, name: &str) -> f64 {
    lens.value(name).unwrap_or(0.0)
}

/// Whether the rational terms are used: those of Brown's model; the fisheye has a k4 of its own.
fn is_rational(lens: &Interior) -> bool {
    lens.model() == Model::Brown && ["k4", "k5", "k6"].iter().any(|name| term(lens, name) != 0.0)
}

/// A lens of Brown's model or a fisheye in the words of a program.
///
/// # Errors
/// Says which terms the program has no place for.
pub fn to_program(lens: &Interior, name: &str, program: Program) -> Result<String, String> {
    let fisheye = match lens.model() {
        Model::Brown => false,
        Model::Fisheye => true,
        other => return Err(format!("a {} lens has to be fitted first", other.word())),
    };
    match program {
        Program::OpenCv => Ok(opencv(lens, fisheye)),
        Program::Colmap => Ok(colmap(lens, fisheye)),
        Program::Metashape => metashape(lens, fisheye),
        Program::OpenSfm => opensfm(lens, name, fisheye),
    }
}

fn opencv(lens: &Interior, fisheye: bool) -> String {
    let Matrix { fx, fy, cx, cy } = matrix(lens);
    let names: &[&str] = match (fisheye, is_rational(lens)) {
        (true, _) => &["k1", "k2", "k3", "k4"],
        (false, false) => &["k1", "k2", "p1", "p2", "k3"],
        (false, true) => &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
    };
    let terms: Vec<String> = names.iter().map(|name| real(term(lens, name))).collect();
    let [width, height] = lens.size_px();
    let model = if fisheye { "fisheye" } else { "pinhole" };
    format!(
        "%YAML:1.0\n---\nimage_width: {width}\nimage_height: {height}\ncamera_model: {model}\n\
         camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ {}, 0., {}, 0., {}, {}, 0., 0., 1. ]\n\
         distortion_coefficients: !!opencv-matrix\n   rows: {}\n   cols: 1\n   dt: d\n   data: [ {} ]\n",
        real(fx),
        real(cx),
        real(fy),
        real(cy),
        names.len(),
        terms.join(", ")
    )
}

/// A number that YAML and XML readers take for a real one.
fn real(value: f64) -> String {
    format!("{value:?}")
}

fn colmap(lens: &Interior, fisheye: bool) -> String {
    let Matrix { fx, fy, cx, cy } = matrix(lens);
    let (model, names): (_, &[&str]) = match fisheye {
        true => ("OPENCV_FISHEYE", &["k1", "k2", "k3", "k4"]),
        false if !is_rational(lens) && term(lens, "k3") == 0.0 => {
            ("OPENCV", &["k1", "k2", "p1", "p2"])
        }
        false => ("FULL_OPENCV", &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]),
    };
    let terms: Vec<String> = names.iter().map(|name| real(term(lens, name))).collect();
    let [width, height] = lens.size_px();
    format!(
        "# Camera list with one line of data per camera:\n\
         #   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n# Number of cameras: 1\n\
         1 {model} {width} {height} {} {} {} {} {}\n",
        real(fx),
        real(fy),
        real(cx + 0.5),
        real(cy + 0.5),
        terms.join(" ")
    )
}

fn metashape(lens: &Interior, fisheye: bool) -> Result<String, String> {
    if is_rational(lens) {
        return Err("Metashape has no place for k4, k5, k6 of the rational model".into());
    }
    let Matrix { fx, fy, cx, cy } = matrix(lens);
    let [width, height] = lens.size_px();
    let mut lines = vec![
        format!(
            "  <projection>{}</projection>",
            if fisheye { "equidistant_fisheye" } else { "frame" }
        ),
        format!("  <width>{width}</width>"),
        format!("  <height>{height}</height>"),
        format!("  <f>{}</f>", real(fy)),
        format!("  <cx>{}</cx>", real(cx + 0.5 - 0.5 * f64::from(width))),
        format!("  <cy>{}</cy>", real(cy + 0.5 - 0.5 * f64::from(height))),
        format!("  <b1>{}</b1>", real(fx - fy)),
    ];
    let terms: &[(&str, &str)] = if fisheye {
        &[("k1", "k1"), ("k2", "k2"), ("k3", "k3"), ("k4", "k4")]
    } else {
        &[("k1", "k1"), ("k2", "k2"), ("k3", "k3"), ("p1", "p2"), ("p2", "p1")]
    };
    for (own, ours) in terms {
        lines.push(format!("  <{own}>{}</{own}>", real(term(lens, ours))));
    }
    Ok(format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<calibration>\n{}\n</calibration>\n",
        lines.join("\n")
    ))
}

fn opensfm(lens: &Interior, name: &str, fisheye: bool) -> Result<String, String> {
    if is_rational(lens) {
        return Err("OpenSfM has no place for k4, k5, k6 of the rational model".into());
    }
    let Matrix { fx, fy, cx, cy } = matrix(lens);
    let [width, height] = lens.size_px();
    let side = f64::from(width.max(height));
    // Its image coordinates are of pixels whose centres are at integers.
    let offset = |c: f64, n: u32| (c - 0.5 * (f64::from(n) - 1.0)) / side;
    let mut camera = serde_json::json!({
        "projection_type": if fisheye { "fisheye_opencv" } else { "brown" },
        "width": width,
        "height": height,
        "focal_x": fx / side,
        "focal_y": fy / side,
        "c_x": offset(cx, width),
        "c_y": offset(cy, height),
    });
    let terms: &[&str] =
        if fisheye { &["k1", "k2", "k3", "k4"] } else { &["k1", "k2", "p1", "p2", "k3"] };
    for term_name in terms {
        camera[*term_name] = term(lens, term_name).into();
    }
    let key = if name.is_empty() { "rowgram" } else { name };
    let all = serde_json::json!({ key: camera });
    serde_json::to_string_pretty(&all).map(|text| text + "\n").map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_k4_of_a_fisheye_is_not_that_of_the_rational_model() {
        let fisheye = [50.0, 1.0, 20.0, 15.0, 0.1, 0.0, 0.0, 0.01];
        let fisheye = Interior::new(Model::Fisheye, [40, 30], &fisheye).unwrap();
        let mut brown = vec![50.0, 1.0, 20.0, 15.0];
        brown.resize(Model::Brown.parameters().len(), 0.0);
        brown[9] = 0.01;
        let rational = Interior::new(Model::Brown, [40, 30], &brown).unwrap();
        for program in [Program::Metashape, Program::OpenSfm] {
            assert!(to_program(&fisheye, "lens", program).unwrap().contains("0.01"));
            assert!(to_program(&rational, "lens", program).is_err());
        }
    }
}
