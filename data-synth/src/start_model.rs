//! Tie points as a sparse model in COLMAP's text form, with start values that know nothing of the truth.
//!
//! Every camera starts level at the receiver's position, its y axis along the course over ground; every point where the
//! rays of its measurements meet the height of the field's middle, on average; the lens without distortion. COLMAP
//! has the centre of the top-left pixel at (0.5, 0.5) and a camera frame with `y` down and `z` forward.
//!
//! Reference: <https://colmap.github.io/format.html>.

use crate::{flight::Shot, tie_points::TiePoint, twin::Twin};
use std::io::{self, Write};

type Result = io::Result<()>;

/// `model/cameras.txt`: one camera, without distortion.
///
/// # Errors
/// What the writer says, here and below.
pub fn cameras(twin: &Twin, out: &mut dyn Write) -> Result {
    let camera = &twin.config.camera;
    let (width, height) = (camera.width_px, camera.height_px);
    let (u, v) = (0.5 * f64::from(width), 0.5 * f64::from(height));
    writeln!(out, "# number model width height f cx cy")?;
    writeln!(out, "1 SIMPLE_PINHOLE {width} {height} {:?} {u:?} {v:?}", camera.c_px)
}

/// `model/images.txt`: every photo's start orientation and its measurements.
///
/// # Errors
/// What the writer says.
pub fn images(twin: &Twin, points: &[TiePoint], out: &mut dyn Write) -> Result {
    writeln!(out, "# number qw qx qy qz tx ty tz camera name; then u v point ...")?;
    let mut seen = vec![Vec::new(); twin.shots.len()];
    for (number, point) in points.iter().enumerate() {
        for sighting in &point.seen {
            seen[sighting.shot].push((number + 1, sighting.measured_px));
        }
    }
    for (number, (shot, seen)) in twin.shots.iter().zip(seen).enumerate() {
        let [right, forward] = level_axes(shot);
        // The rows of the rotation into COLMAP's frame: right, back, down.
        let rows = [[right[0], right[1], 0.0], [-forward[0], -forward[1], 0.0], [0.0, 0.0, -1.0]];
        // Its trace is -1: half a turn about a level axis, halfway between X and where X goes.
        let half = 0.5 * f64::atan2(rows[1][0], rows[0][0]);
        let centre = twin.site.grid_m(shot.gnss_m);
        let shift = rows.map(|row| -(0..3).map(|k| row[k] * centre[k]).sum::<f64>());
        writeln!(
            out,
            "{} 0 {:?} {:?} 0 {:?} {:?} {:?} 1 {}",
            number + 1,
            half.cos(),
            half.sin(),
            shift[0],
            shift[1],
            shift[2],
            shot.name
        )?;
        for (at, (point, [u, v])) in seen.into_iter().enumerate() {
            let gap = if at > 0 { " " } else { "" };
            write!(out, "{gap}{:.4} {:.4} {point}", u + 0.5, v + 0.5)?;
        }
        writeln!(out)?;
    }
    Ok(())
}

/// `model/points3D.txt`: every tie point's start position and its measurements.
///
/// # Errors
/// What the writer says.
pub fn points(twin: &Twin, points: &[TiePoint], out: &mut dyn Write) -> Result {
    writeln!(out, "# number x y z red green blue error image measurement ...")?;
    let mut measured = vec![0usize; twin.shots.len()];
    for (number, point) in points.iter().enumerate() {
        let mut place_m = [0.0; 3];
        for sighting in &point.seen {
            let meets = start_ground(twin, sighting.shot, sighting.measured_px);
            for (sum, part) in place_m.iter_mut().zip(meets) {
                *sum += part / point.seen.len() as f64;
            }
        }
        let [e, n, h] = twin.site.grid_m(place_m);
        write!(out, "{} {e:.4} {n:.4} {h:.4} 128 128 128 0", number + 1)?;
        for sighting in &point.seen {
            write!(out, " {} {}", sighting.shot + 1, measured[sighting.shot])?;
            measured[sighting.shot] += 1;
        }
        writeln!(out)?;
    }
    Ok(())
}

/// The level camera's x and y axes in (X, Y): y along the course over ground, or where the camera truly points if it
/// stands still.
fn level_axes(shot: &Shot) -> [[f64; 2]; 2] {
    let [vx, vy, _] = shot.velocity_m_s;
    let (x, y) =
        if vx == 0.0 && vy == 0.0 { (shot.rotation[0][1], shot.rotation[1][1]) } else { (vx, vy) };
    let length = f64::hypot(x, y);
    let forward = [x / length, y / length];
    [[forward[1], -forward[0]], forward]
}

/// Where a pixel of a start camera looks at height 0, metres.
fn start_ground(twin: &Twin, shot: usize, [u, v]: [f64; 2]) -> [f64; 3] {
    let camera = &twin.config.camera;
    let shot = &twin.shots[shot];
    let middle = [camera.width_px, camera.height_px].map(|n| 0.5 * (f64::from(n) - 1.0));
    let reach = shot.gnss_m[2] / camera.c_px;
    let (aside, ahead) = ((u - middle[0]) * reach, (middle[1] - v) * reach);
    let [right, forward] = level_axes(shot);
    let at = |k: usize| shot.gnss_m[k] + aside * right[k] + ahead * forward[k];
    [at(0), at(1), 0.0]
}
