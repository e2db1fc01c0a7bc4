//! Grey pictures as numbers, and what the detector does to all of their pixels.

use image::GrayImage;
use rayon::prelude::*;

/// A grey picture: `width * height` values from 0 to 255, row by row; pixel centres at integers.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Grey {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) data: Vec<f32>,
}

/// Rows of one task; fixed, like all work that is shared between threads.
const ROWS: usize = 32;

impl Grey {
    pub(super) fn new(image: &GrayImage) -> Grey {
        let data = image.as_raw().iter().map(|&value| f32::from(value)).collect();
        Grey { width: image.width() as usize, height: image.height() as usize, data }
    }

    /// The picture at half the size, each pixel the mean of four: a position `p` of it is at
    /// `2 p + 0.5` here.
    pub(super) fn half(&self) -> Grey {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut data = vec![0.0; width * height];
        data.par_chunks_mut((ROWS * width).max(1)).enumerate().for_each(|(task, rows)| {
            for (k, row) in rows.chunks_exact_mut(width).enumerate() {
                let v = 2 * (task * ROWS + k);
                let upper = &self.data[v * self.width..v * self.width + 2 * width];
                let lower = &self.data[(v + 1) * self.width..(v + 1) * self.width + 2 * width];
                for u in 0..width {
                    row[u] =
                        0.25 * (upper[2 * u] + upper[2 * u + 1] + lower[2 * u] + lower[2 * u + 1]);
                }
            }
        });
        Grey { width, height, data }
    }

    /// Blurred by a Gaussian of 1.25 pixels, cut off at 3; the border repeats its last pixel.
    pub(super) fn blurred(&self) -> Grey {
        const WEIGHTS: [f32; 4] = [0.325_2, 0.236_2, 0.090_4, 0.010_8];
        let (width, height) = (self.width, self.height);
        let mut across = vec![0.0; width * height];
        across.par_chunks_mut((ROWS * width).max(1)).enumerate().for_each(|(task, rows)| {
            for (k, row) in rows.chunks_exact_mut(width).enumerate() {
                let start = (task * ROWS + k) * width;
                let source = &self.data[start..start + width];
                let at = |u: usize, d: isize| {
                    source[(u as isize + d).clamp(0, width as isize - 1) as usize]
                };
                let slow = |u: usize| {
                    WEIGHTS[0] * at(u, 0)
                        + (1..4).map(|d| WEIGHTS[d as usize] * (at(u, -d) + at(u, d))).sum::<f32>()
                };
                if width < 7 {
                    (0..width).for_each(|u| row[u] = slow(u));
                    continue;
                }
                for u in (0..3).chain(width - 3..width) {
                    row[u] = slow(u);
                }
                for (out, s) in row[3..width - 3].iter_mut().zip(source.windows(7)) {
                    *out = WEIGHTS[0] * s[3]
                        + WEIGHTS[1] * (s[2] + s[4])
                        + WEIGHTS[2] * (s[1] + s[5])
                        + WEIGHTS[3] * (s[0] + s[6]);
                }
            }
        });
        let mut data = vec![0.0; width * height];
        data.par_chunks_mut((ROWS * width).max(1)).enumerate().for_each(|(task, rows)| {
            for (k, row) in rows.chunks_exact_mut(width).enumerate() {
                let v = (task * ROWS + k) as isize;
                let line = |d: isize| {
                    let start = (v + d).clamp(0, height as isize - 1) as usize * width;
                    &across[start..start + width]
                };
                let [a, b, c, m, d, e, f] = [-3, -2, -1, 0, 1, 2, 3].map(line);
                for u in 0..width {
                    row[u] = WEIGHTS[0] * m[u]
                        + WEIGHTS[1] * (c[u] + d[u])
                        + WEIGHTS[2] * (b[u] + e[u])
                        + WEIGHTS[3] * (a[u] + f[u]);
                }
            }
        });
        Grey { width, height, data }
    }

    /// `Ixy^2 - Ixx Iyy`, positive where the picture is a saddle; 0 along the border.
    pub(super) fn saddle_response(&self) -> Vec<f32> {
        let (width, height) = (self.width, self.height);
        let mut response = vec![0.0; width * height];
        if width < 3 || height < 3 {
            return response;
        }
        response.par_chunks_mut(ROWS * width).enumerate().for_each(|(task, rows)| {
            for (k, row) in rows.chunks_exact_mut(width).enumerate() {
                let v = task * ROWS + k;
                if v == 0 || v + 1 >= height {
                    continue;
                }
                let line = |v: usize| &self.data[v * width..(v + 1) * width];
                let (above, here, below) = (line(v - 1), line(v), line(v + 1));
                for u in 1..width - 1 {
                    let xx = here[u - 1] - 2.0 * here[u] + here[u + 1];
                    let yy = above[u] - 2.0 * here[u] + below[u];
                    let xy = 0.25 * (above[u - 1] - above[u + 1] - below[u - 1] + below[u + 1]);
                    row[u] = xy * xy - xx * yy;
                }
            }
        });
        response
    }

    /// The value between pixels, bilinear; `None` outside the pixel centres.
    #[inline]
    pub(super) fn sample(&self, [u, v]: [f64; 2]) -> Option<f64> {
        if !(u >= 0.0 && v >= 0.0) {
            return None;
        }
        let (column, row) = (u as usize, v as usize);
        if column + 1 >= self.width || row + 1 >= self.height {
            return None;
        }
        let (du, dv) = ((u - column as f64) as f32, (v - row as f64) as f32);
        let start = row * self.width + column;
        let (upper, lower) =
            (&self.data[start..start + 2], &self.data[start + self.width..start + self.width + 2]);
        let top = upper[0] + du * (upper[1] - upper[0]);
        let bottom = lower[0] + du * (lower[1] - lower[0]);
        Some(f64::from(top + dv * (bottom - top)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_of_the_blur_add_up_and_halving_keeps_means() {
        let flat = Grey { width: 9, height: 8, data: vec![40.0; 72] };
        assert!(flat.blurred().data.iter().all(|v| (v - 40.0).abs() < 1e-3));
        let ramp = Grey {
            width: 10,
            height: 6,
            data: (0..60).map(|k| (k % 10) as f32 + 2.0 * (k / 10) as f32).collect(),
        };
        let half = ramp.half();
        for (k, value) in half.data.iter().enumerate() {
            let at = [2.0 * (k % 5) as f64 + 0.5, 2.0 * (k / 5) as f64 + 0.5];
            assert!((f64::from(*value) - ramp.sample(at).unwrap()).abs() < 1e-5);
        }
    }

    #[test]
    fn a_saddle_responds_and_an_edge_does_not() {
        let size = 21;
        let picture = |f: fn(f32, f32) -> f32| Grey {
            width: size,
            height: size,
            data: (0..size * size)
                .map(|k| f((k % size) as f32 - 10.0, (k / size) as f32 - 10.0))
                .collect(),
        };
        let middle = 10 * size + 10;
        let saddle = picture(|x, y| if (x + 0.5) * (y + 0.5) > 0.0 { 200.0 } else { 30.0 });
        let edge = picture(|x, y| if x + 0.3 * y > 0.0 { 200.0 } else { 30.0 });
        let strength = saddle.blurred().saddle_response()[middle];
        assert!(strength > 100.0, "{strength}");
        let along = edge.blurred().saddle_response();
        let largest = along.iter().copied().fold(0.0, f32::max);
        assert!(largest < 0.2 * strength, "{largest} of {strength}");
    }
}
