//! Least-squares matching: where exactly a small piece of one picture is in another, by the affine map and the
//! change of brightness under which their grey values differ least.
//!
//! ```text
//! g_1(p) - mean_1 = k (g_2(a + A p + q(p)) - mean_2)      p: pixels of a square window, weighted by a Gaussian
//! ```
//!
//! `q(p)`, of second degree, is given: perspective and a lens that bends rays curve the map, which over a window of
//! fifteen pixels is not much, but all of it to one side.
//!
//! Gauss-Newton from a start that is good to a pixel or so; the second picture is a cubic B-spline, whose values and
//! slopes are exact between pixels. The first is taken where its pixels are, so that nothing is interpolated there.
//!
//! References: F. Ackermann, *Digital image correlation: performance and potential application in photogrammetry*,
//! Photogrammetric Record 11, 1984; A. Gruen, *Adaptive least squares correlation*, South African Journal of
//! Photogrammetry 14, 1985; M. Unser, *Splines: a perfect fit for signal and image processing*, IEEE Signal
//! Processing Magazine 16, 1999.

use image::GrayImage;
use nalgebra::{SMatrix, SVector};

/// Half of the window, pixels.
pub const HALF: usize = 7;
/// Its side.
pub const SIDE: usize = 2 * HALF + 1;
/// Standard deviation of the Gaussian that weights it, pixels.
const SIGMA_PX: f64 = 0.6 * HALF as f64;
/// The pole of the filter that turns grey values into coefficients of the cubic B-spline.
const POLE: f32 = -0.267_949_2;
/// What is left of a grey value after as many steps of that is nothing.
const HORIZON: usize = 16;
/// The most steps.
const STEPS: usize = 15;
/// The longest of them, pixels.
const LONGEST_PX: f64 = 0.5;
/// Steps shorter than this change nothing, pixels.
const SHORTEST_PX: f64 = 0.002;
/// How firmly the shape is held compared with the position: what a window hardly shows of it does not run away.
const STIFFNESS: f64 = 0.02;
/// What is determined: position, shape, contrast, brightness.
const UNKNOWNS: usize = 8;

/// A window of the first picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Window {
    grey: [u8; SIDE * SIDE],
}

impl Window {
    /// The window about a pixel; `None` where the picture ends within it.
    pub fn of(picture: &GrayImage, [u, v]: [u32; 2]) -> Option<Window> {
        let half = HALF as u32;
        let inside = |at: u32, size: u32| at >= half && at + half < size;
        if !inside(u, picture.width()) || !inside(v, picture.height()) {
            return None;
        }
        let width = picture.width() as usize;
        let mut grey = [0; SIDE * SIDE];
        for (row, out) in grey.chunks_exact_mut(SIDE).enumerate() {
            let from = (v as usize - HALF + row) * width + u as usize - HALF;
            out.copy_from_slice(&picture.as_raw()[from..from + SIDE]);
        }
        Some(Window { grey })
    }
}

/// A picture between its pixels.
#[derive(Debug, Clone)]
pub struct BSplineImage {
    width: usize,
    height: usize,
    coefficients: Vec<f32>,
}

impl BSplineImage {
    /// The cubic B-spline through the grey values of a picture, which is its own mirror beyond its edges.
    pub fn new(picture: &GrayImage) -> BSplineImage {
        let (width, height) = (picture.width() as usize, picture.height() as usize);
        let mut coefficients: Vec<f32> = picture.as_raw().iter().map(|&v| f32::from(v)).collect();
        if width > 1 {
            coefficients.chunks_exact_mut(width).for_each(filter_row);
        }
        if height > 1 {
            filter_columns(&mut coefficients, width, height);
        }
        BSplineImage { width, height, coefficients }
    }

    /// Value and slopes at `[u, v]`; `None` within a pixel of the left and the upper edge, or two of the others.
    #[inline]
    pub fn at(&self, at_px: [f64; 2]) -> Option<[f32; 3]> {
        let [u, v] = at_px;
        // Also false of what is no number.
        let inside = |at: f64, size: usize| at >= 1.0 && at < size as f64 - 2.0;
        if !inside(u, self.width) || !inside(v, self.height) {
            return None;
        }
        let (column, row) = (u as usize, v as usize);
        let (x, dx) = weights((u - column as f64) as f32);
        let (y, dy) = weights((v - row as f64) as f32);
        let from = (row - 1) * self.width + column - 1;
        // Columns first, four at once.
        let (mut down, mut slope) = ([0.0f32; 4], [0.0f32; 4]);
        for row in 0..4 {
            let c = &self.coefficients[from + row * self.width..][..4];
            for k in 0..4 {
                down[k] += y[row] * c[k];
                slope[k] += dy[row] * c[k];
            }
        }
        Some([across(&down, &x), across(&down, &dx), across(&slope, &x)])
    }
}

#[inline(always)]
fn across(values: &[f32; 4], weights: &[f32; 4]) -> f32 {
    (values[0] * weights[0] + values[1] * weights[1])
        + (values[2] * weights[2] + values[3] * weights[3])
}

/// The four values and slopes of the B-spline that reach a place between two nodes.
#[inline(always)]
fn weights(t: f32) -> ([f32; 4], [f32; 4]) {
    // Of 1, t, t^2, t^3.
    const ONE: [f32; 4] = [1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0, 0.0];
    const FIRST: [f32; 4] = [-0.5, 0.0, 0.5, 0.0];
    const SECOND: [f32; 4] = [0.5, -1.0, 0.5, 0.0];
    const THIRD: [f32; 4] = [-1.0 / 6.0, 0.5, -0.5, 1.0 / 6.0];
    let (mut values, mut slopes) = (ONE, FIRST);
    for k in 0..4 {
        values[k] += t * (FIRST[k] + t * (SECOND[k] + t * THIRD[k]));
        slopes[k] += t * (2.0 * SECOND[k] + 3.0 * t * THIRD[k]);
    }
    (values, slopes)
}

/// What the recursion has gathered before the first value, of one that mirrors itself there.
fn before(value: impl Fn(usize) -> f32, length: usize) -> f32 {
    let mut sum = value(0);
    let mut power = POLE;
    for k in 1..HORIZON.min(length) {
        sum += power * value(k);
        power *= POLE;
    }
    sum
}

/// What it begins with on the way back.
fn after(last: f32, before: f32) -> f32 {
    POLE / (POLE * POLE - 1.0) * (last + POLE * before)
}

/// A gain of six in each direction makes the coefficients those of a spline through the values.
const GAIN: f32 = 6.0;

fn filter_row(row: &mut [f32]) {
    let n = row.len();
    row[0] = before(|k| row[k], n);
    for k in 1..n {
        row[k] += POLE * row[k - 1];
    }
    row[n - 1] = after(row[n - 1], row[n - 2]);
    for k in (0..n - 1).rev() {
        row[k] = POLE * (row[k + 1] - row[k]);
    }
    row.iter_mut().for_each(|value| *value *= GAIN);
}

/// The same down all columns at once.
fn filter_columns(values: &mut [f32], width: usize, height: usize) {
    let first: Vec<f32> = (0..width).map(|u| before(|k| values[k * width + u], height)).collect();
    values[..width].copy_from_slice(&first);
    for v in 1..height {
        let (above, below) = values.split_at_mut(v * width);
        let above = &above[(v - 1) * width..];
        for (value, above) in below[..width].iter_mut().zip(above) {
            *value += POLE * above;
        }
    }
    let (above, last) = values.split_at_mut((height - 1) * width);
    for (value, above) in last.iter_mut().zip(&above[(height - 2) * width..]) {
        *value = after(*value, *above);
    }
    for v in (0..height - 1).rev() {
        let (above, below) = values.split_at_mut((v + 1) * width);
        for (value, below) in above[v * width..].iter_mut().zip(&below[..width]) {
            *value = POLE * (*below - *value);
        }
    }
    values.iter_mut().for_each(|value| *value *= GAIN);
}

/// Where a window is in the second picture: its middle, and the shape that it has there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Warp {
    /// Its middle, pixels.
    pub at_px: [f64; 2],
    /// Columns: how far one pixel to the right and one down reach.
    pub shape: [[f64; 2]; 2],
    /// What it is curved by, of `x^2`, `x y`, `y^2`; this is not looked for.
    pub curvature: [[f64; 2]; 3],
}

impl Warp {
    #[inline(always)]
    fn pixel(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let ([a, b], [c, d, e]) = (&self.shape, &self.curvature);
        let (xx, xy, yy) = (x * x, x * y, y * y);
        [
            self.at_px[0] + a[0] * x + b[0] * y + (c[0] * xx + d[0] * xy + e[0] * yy),
            self.at_px[1] + a[1] * x + b[1] * y + (c[1] * xx + d[1] * xy + e[1] * yy),
        ]
    }
}

/// A window that was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// Where it is.
    pub warp: Warp,
    /// Weighted correlation of the grey values.
    pub correlation: f64,
}

/// Weights and offsets of a window's pixels, which all windows share.
pub struct Template {
    weights: Vec<f64>,
    offsets: Vec<[f64; 2]>,
}

impl Default for Template {
    fn default() -> Template {
        let offsets: Vec<[f64; 2]> = (0..SIDE * SIDE)
            .map(|k| [(k % SIDE) as f64 - HALF as f64, (k / SIDE) as f64 - HALF as f64])
            .collect();
        let weight = |[x, y]: &[f64; 2]| (-0.5 * (x * x + y * y) / (SIGMA_PX * SIGMA_PX)).exp();
        let weights: Vec<f64> = offsets.iter().map(weight).collect();
        let sum: f64 = weights.iter().sum();
        Template { weights: weights.into_iter().map(|w| w / sum).collect(), offsets }
    }
}

impl Template {
    /// Finds a window in a picture near a start. `None` where it leaves the picture, shows nothing, or comes to no rest.
    pub fn find(&self, window: &Window, picture: &BSplineImage, start: Warp) -> Option<Match> {
        let mut first = [0.0f32; SIDE * SIDE];
        first.iter_mut().zip(&window.grey).for_each(|(out, &v)| *out = f32::from(v));
        let mut middle = 0.0;
        for (weight, v) in self.weights.iter().zip(&first) {
            middle += weight * f64::from(*v);
        }
        let mut power = 0.0;
        for (weight, v) in self.weights.iter().zip(&mut first) {
            *v -= middle as f32;
            power += weight * f64::from(*v * *v);
        }
        let mut second = [[0.0f32; 3]; SIDE * SIDE];
        let mut warp = start;
        for _ in 0..STEPS {
            let mut middle = 0.0;
            for ((at, weight), out) in self.offsets.iter().zip(&self.weights).zip(&mut second) {
                *out = picture.at(warp.pixel(*at))?;
                middle += weight * f64::from(out[0]);
            }
            let (mut both, mut own) = (0.0, 0.0);
            for ((weight, first), second) in self.weights.iter().zip(&first).zip(&mut second) {
                second[0] -= middle as f32;
                both += weight * f64::from(first * second[0]);
                own += weight * f64::from(second[0] * second[0]);
            }
            let contrast = (both / own) as f32;
            if !(contrast.is_finite() && contrast > 0.0) {
                return None;
            }
            let step = self.step(&first, &second, contrast)?;
            let length = step[0].hypot(step[1]);
            let share = (LONGEST_PX / length).min(1.0);
            for k in 0..2 {
                warp.at_px[k] += share * step[k];
                warp.shape[0][k] += share * step[2 + 2 * k];
                warp.shape[1][k] += share * step[3 + 2 * k];
            }
            if length < SHORTEST_PX {
                return Some(Match { warp, correlation: both / (own * power).sqrt() });
            }
        }
        None
    }

    /// One step of Gauss-Newton: position `u, v`, shape `u_x, u_y, v_x, v_y`, contrast, brightness.
    fn step(
        &self,
        first: &[f32],
        second: &[[f32; 3]],
        contrast: f32,
    ) -> Option<SVector<f64, UNKNOWNS>> {
        // Line by line of the window in single precision, whose sums are short; all of them in double.
        let mut normal = [[0.0f64; UNKNOWNS]; UNKNOWNS];
        let mut right = [0.0f64; UNKNOWNS];
        for line in 0..SIDE {
            let mut of_line = [[0.0f32; UNKNOWNS]; UNKNOWNS];
            let mut right_of_line = [0.0f32; UNKNOWNS];
            for k in line * SIDE..(line + 1) * SIDE {
                let weight = self.weights[k] as f32;
                let (x, y) = (self.offsets[k][0] as f32, self.offsets[k][1] as f32);
                let [value, by_u, by_v] = second[k];
                let (u, v) = (contrast * by_u, contrast * by_v);
                let row = [u, v, u * x, u * y, v * x, v * y, value, 1.0];
                let left = weight * (first[k] - contrast * value);
                for i in 0..UNKNOWNS {
                    let weighted = weight * row[i];
                    right_of_line[i] += left * row[i];
                    for j in 0..UNKNOWNS {
                        of_line[i][j] += weighted * row[j];
                    }
                }
            }
            for i in 0..UNKNOWNS {
                right[i] += f64::from(right_of_line[i]);
                for j in 0..UNKNOWNS {
                    normal[i][j] += f64::from(of_line[i][j]);
                }
            }
        }
        let stiff = STIFFNESS * (2..6).map(|k| normal[k][k]).sum::<f64>() / 4.0;
        (2..6).for_each(|k| normal[k][k] += stiff);
        let normal = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::from_fn(|i, j| normal[i][j]);
        let step = normal.cholesky()?.solve(&SVector::from(right));
        step.iter().all(|v| v.is_finite()).then_some(step)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const UNTURNED: [[f64; 2]; 2] = [[1.0, 0.0], [0.0, 1.0]];
    const FLAT: [[f64; 2]; 3] = [[0.0; 2]; 3];

    /// A picture that is known everywhere: waves of all directions, not shorter than five pixels.
    fn scene([x, y]: [f64; 2]) -> f64 {
        let waves = [[0.31, 0.17], [-0.22, 0.41], [0.05, -0.35], [0.61, 0.52], [-0.7, 0.33]];
        let sum: f64 = waves
            .iter()
            .enumerate()
            .map(|(k, [a, b])| (a * x + b * y + 1.7 * k as f64).sin())
            .sum();
        120.0 + 18.0 * sum
    }

    fn picture(of: impl Fn([f64; 2]) -> f64) -> GrayImage {
        GrayImage::from_fn(120, 90, |u, v| {
            image::Luma([of([f64::from(u), f64::from(v)]).round().clamp(0.0, 255.0) as u8])
        })
    }

    #[test]
    fn the_spline_goes_through_the_pixels_and_is_smooth_between() {
        let grey = picture(scene);
        let smooth = BSplineImage::new(&grey);
        let mut worst = [0.0f64; 3];
        for v in 2..87u32 {
            for u in 2..117u32 {
                let at = [f64::from(u), f64::from(v)];
                let through = f64::from(smooth.at(at).unwrap()[0]);
                worst[0] = worst[0].max((through - f64::from(grey.get_pixel(u, v).0[0])).abs());
                if u < 115 && v < 85 {
                    let between = [at[0] + 0.37, at[1] + 0.81];
                    let [value, by_u, _] = smooth.at(between).unwrap().map(f64::from);
                    worst[1] = worst[1].max((value - scene(between)).abs());
                    let h = 0.01;
                    let [a, b] = [-h, h]
                        .map(|h| f64::from(smooth.at([between[0] + h, between[1]]).unwrap()[0]));
                    worst[2] = worst[2].max((by_u - (b - a) / (2.0 * h)).abs());
                }
            }
        }
        // Rounding to whole grey values is off by a half at most, which the spline's gain nearly doubles.
        assert!(worst[0] < 1e-3 && worst[1] < 1.5 && worst[2] < 0.05, "{worst:?}");
        assert_eq!(smooth.at([0.9, 20.0]), None);
        assert_eq!(smooth.at([20.0, 88.0]), None);
        assert_eq!(smooth.at([f64::NAN, 20.0]), None);
    }

    #[test]
    fn a_window_is_found_to_a_hundredth_of_a_pixel_turned_stretched_and_in_other_light() {
        let first = picture(scene);
        // The second picture at p shows what the first has at B p + b.
        let map = |[x, y]: [f64; 2]| [1.06 * x + 0.08 * y - 6.3, -0.05 * x + 0.93 * y + 4.9];
        let second = BSplineImage::new(&picture(|p| 40.0 + 0.7 * scene(map(p))));
        let template = Template::default();
        let (mut worst, mut count) = (0.0f64, 0);
        for v in (20..70).step_by(7) {
            for u in (20..95).step_by(7) {
                let window = Window::of(&first, [u, v]).unwrap();
                // Where it truly is: B p + b = (u, v).
                let (x, y) = (f64::from(u) + 6.3, f64::from(v) - 4.9);
                let determinant = 1.06 * 0.93 + 0.05 * 0.08;
                let truth =
                    [(0.93 * x - 0.08 * y) / determinant, (0.05 * x + 1.06 * y) / determinant];
                let at_px = [truth[0] + 0.7, truth[1] - 0.6];
                let start = Warp { at_px, shape: UNTURNED, curvature: FLAT };
                let found = template.find(&window, &second, start).unwrap();
                let off = [0, 1].map(|k| (found.warp.at_px[k] - truth[k]).abs());
                worst = worst.max(off[0].max(off[1]));
                assert!(found.correlation > 0.99);
                count += 1;
            }
        }
        assert!(count > 60 && worst < 0.03, "{worst} of {count}");
    }

    #[test]
    fn a_map_that_is_curved_does_not_draw_the_window_aside() {
        // What the second picture has at a + p + q(p) the first has at p; q is found from its inverse, to third order.
        let bend = [[0.004, -0.002], [0.003, 0.001], [-0.002, 0.005]];
        let curve = |[x, y]: [f64; 2]| {
            [0, 1].map(|k| bend[0][k] * x * x + bend[1][k] * x * y + bend[2][k] * y * y)
        };
        let first = picture(scene);
        let window = Window::of(&first, [60, 45]).unwrap();
        let second = BSplineImage::new(&picture(|[u, v]| {
            let target = [u - 60.0, v - 45.0];
            let mut p = target;
            for _ in 0..30 {
                let q = curve(p);
                p = [target[0] - q[0], target[1] - q[1]];
            }
            let near = p[0].abs() < 15.0 && p[1].abs() < 15.0;
            if near { scene([60.0 + p[0], 45.0 + p[1]]) } else { 128.0 }
        }));
        let off = |curvature: [[f64; 2]; 3]| {
            let start = Warp { at_px: [60.3, 44.8], shape: UNTURNED, curvature };
            let found = Template::default().find(&window, &second, start).unwrap().warp.at_px;
            (found[0] - 60.0).hypot(found[1] - 45.0)
        };
        assert!(off(bend) < 0.01 && off(FLAT) > 0.03, "{} {}", off(bend), off(FLAT));
    }

    #[test]
    fn what_shows_nothing_or_leaves_the_picture_is_not_found() {
        let flat = GrayImage::from_pixel(60, 60, image::Luma([90]));
        let grey = picture(scene);
        let template = Template::default();
        let start = |at_px: [f64; 2]| Warp { at_px, shape: UNTURNED, curvature: FLAT };
        let window = Window::of(&grey, [30, 30]).unwrap();
        assert_eq!(template.find(&window, &BSplineImage::new(&flat), start([30.0, 30.0])), None);
        assert_eq!(template.find(&window, &BSplineImage::new(&grey), start([6.0, 30.0])), None);
        assert_eq!(Window::of(&grey, [6, 30]), None);
        assert_eq!(Window::of(&grey, [30, 83]), None);
        assert!(Window::of(&grey, [7, 82]).is_some());
    }
}
