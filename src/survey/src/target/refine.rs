//! Corners to a fraction of a pixel.
//!
//! *Gradients* (Foerstner and Guelch, 1987; the method of OpenCV's `cornerSubPix`): on every edge
//! through the corner `q` the gradient is across the edge, so `g_i . (p_i - q) = 0`, and
//! `q = (sum w g g^T)^-1 sum w g g^T p` over a window, repeated with the window on the new `q`.

use super::grey::Grey;

const MAX_ITERATIONS: usize = 30;
/// A corner that moves less has arrived, in pixels.
const TOLERANCE_PX: f64 = 1e-4;

/// The corner near `start` in a window that reaches `half_px` pixels to each side; `None` where it
/// leaves the picture or the window, or where there is no corner.
pub(super) fn refine(picture: &Grey, start: [f64; 2], half_px: usize) -> Option<[f64; 2]> {
    let mut at = start;
    for _ in 0..MAX_ITERATIONS {
        let next = by_gradients(picture, at, half_px)?;
        let moved = (next[0] - at[0]).hypot(next[1] - at[1]);
        at = next;
        let drift = (at[0] - start[0]).hypot(at[1] - start[1]);
        if drift.is_nan() || drift > half_px as f64 {
            return None;
        }
        if moved < TOLERANCE_PX {
            break;
        }
    }
    Some(at)
}

/// Whether the picture has everything within `reach` pixels.
fn covers(picture: &Grey, at: [f64; 2], reach: f64) -> bool {
    at[0] >= reach
        && at[1] >= reach
        && at[0] + reach < picture.width as f64 - 1.0
        && at[1] + reach < picture.height as f64 - 1.0
}

/// Values on a square grid centred on `at`, interpolated with one set of weights.
struct Window<'a> {
    picture: &'a Grey,
    corner: usize,
    weights: [f32; 4],
}

impl Window<'_> {
    fn new(picture: &Grey, at: [f64; 2], half: usize) -> Option<Window<'_>> {
        if !covers(picture, at, half as f64 + 1.0) {
            return None;
        }
        let (column, row) = (at[0].floor(), at[1].floor());
        let (du, dv) = ((at[0] - column) as f32, (at[1] - row) as f32);
        let corner = (row as usize - half) * picture.width + column as usize - half;
        let weights = [(1.0 - du) * (1.0 - dv), du * (1.0 - dv), (1.0 - du) * dv, du * dv];
        Some(Window { picture, corner, weights })
    }

    #[inline]
    fn value(&self, column: usize, row: usize) -> f32 {
        let width = self.picture.width;
        let at = self.corner + row * width + column;
        let data = &self.picture.data;
        self.weights[0] * data[at]
            + self.weights[1] * data[at + 1]
            + self.weights[2] * data[at + width]
            + self.weights[3] * data[at + width + 1]
    }
}

fn by_gradients(picture: &Grey, at: [f64; 2], half: usize) -> Option<[f64; 2]> {
    // One more pixel on each side for the central differences.
    let window = Window::new(picture, at, half + 1)?;
    let side = 2 * half + 3;
    let (mut below, mut here, mut above) = (vec![0.0; side], vec![0.0; side], vec![0.0; side]);
    let fill = |row: usize, line: &mut [f32]| {
        for (column, value) in line.iter_mut().enumerate() {
            *value = window.value(column, row);
        }
    };
    fill(0, &mut above);
    fill(1, &mut here);
    let scale = half as f64 + 0.5;
    let mut sums = [0.0; 5];
    for row in 1..side - 1 {
        fill(row + 1, &mut below);
        let y = row as f64 - half as f64 - 1.0;
        for column in 1..side - 1 {
            let x = column as f64 - half as f64 - 1.0;
            let weight = (-(x * x + y * y) / (scale * scale)).exp();
            let gx = 0.5 * f64::from(here[column + 1] - here[column - 1]);
            let gy = 0.5 * f64::from(below[column] - above[column]);
            let (xx, xy, yy) = (weight * gx * gx, weight * gx * gy, weight * gy * gy);
            sums[0] += xx;
            sums[1] += xy;
            sums[2] += yy;
            sums[3] += xx * x + xy * y;
            sums[4] += xy * x + yy * y;
        }
        std::mem::swap(&mut above, &mut here);
        std::mem::swap(&mut here, &mut below);
    }
    let [xx, xy, yy, bx, by] = sums;
    let determinant = xx * yy - xy * xy;
    // An edge alone has no corner.
    if determinant <= 1e-4 * (xx + yy) * (xx + yy) {
        return None;
    }
    Some([at[0] + (yy * bx - xy * by) / determinant, at[1] + (xx * by - xy * bx) / determinant])
}
