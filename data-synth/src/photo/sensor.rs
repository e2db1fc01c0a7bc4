//! From the light on the sensor to the bytes of a photo: motion, lens blur, vignetting, exposure, noise, sRGB.

use super::{ImageConfig, raster::TILE};
use crate::streams::{Draw, Stage, pair, stream};
use image::RgbImage;
use rayon::prelude::*;

/// Light on the sensor: red, green and blue of every pixel, linear, 1 is saturation at the usual exposure.
pub(super) struct Frame {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) light: Vec<f32>,
}

impl Frame {
    /// Smears every pixel along the way that its block of `TILE` x `TILE` pixels moves during the exposure:
    /// `motion_px`, row by row of blocks.
    pub(super) fn smear(&mut self, motion_px: &[[f32; 2]]) {
        let longest = motion_px.iter().map(|m| f32::hypot(m[0], m[1])).fold(0.0, f32::max);
        if longest < 0.05 {
            return;
        }
        let (width, height) = (self.width, self.height);
        let columns = width.div_ceil(TILE);
        let source = std::mem::take(&mut self.light);
        let mut smeared = vec![0.0; source.len()];
        smeared.par_chunks_mut(3 * width).enumerate().for_each(|(v, row)| {
            for (u, out) in row.chunks_exact_mut(3).enumerate() {
                let [mu, mv] = motion_px[v / TILE * columns + u / TILE];
                let taps = (2.0 * f32::hypot(mu, mv)).ceil() as usize + 2;
                let share = 1.0 / taps as f32;
                for tap in 0..taps {
                    let part = (tap as f32 + 0.5) * share - 0.5;
                    let at = |value: f32, size: usize| value.clamp(0.0, (size - 1) as f32);
                    let (x, y) =
                        (at(u as f32 + part * mu, width), at(v as f32 + part * mv, height));
                    let (i, j) = (x as usize, y as usize);
                    let (s, t) = (x - i as f32, y - j as f32);
                    let (i1, j1) = ((i + 1).min(width - 1), (j + 1).min(height - 1));
                    for (channel, sum) in out.iter_mut().enumerate() {
                        let get = |i: usize, j: usize| source[3 * (j * width + i) + channel];
                        let upper = get(i, j) * (1.0 - s) + get(i1, j) * s;
                        let lower = get(i, j1) * (1.0 - s) + get(i1, j1) * s;
                        *sum += share * (upper * (1.0 - t) + lower * t);
                    }
                }
            }
        });
        self.light = smeared;
    }

    /// Blurs by a Gaussian with standard deviation `sigma_px`.
    pub(super) fn blur(&mut self, sigma_px: f64) {
        if sigma_px < 0.05 {
            return;
        }
        let reach = (3.0 * sigma_px).ceil() as usize;
        let mut kernel: Vec<f32> =
            (0..=reach).map(|i| (-0.5 * (i as f64 / sigma_px).powi(2)).exp() as f32).collect();
        let sum = kernel[0] + 2.0 * kernel[1..].iter().sum::<f32>();
        kernel.iter_mut().for_each(|weight| *weight /= sum);
        let (width, height) = (self.width, self.height);
        let line = 3 * width;
        let mut across = vec![0.0; self.light.len()];
        across.par_chunks_mut(line).zip(self.light.par_chunks(line)).for_each(|(out, row)| {
            for u in 0..width {
                for channel in 0..3 {
                    let mut value = kernel[0] * row[3 * u + channel];
                    for (step, weight) in kernel.iter().enumerate().skip(1) {
                        let (left, right) = (u.saturating_sub(step), (u + step).min(width - 1));
                        value += weight * (row[3 * left + channel] + row[3 * right + channel]);
                    }
                    out[3 * u + channel] = value;
                }
            }
        });
        self.light.par_chunks_mut(line).enumerate().for_each(|(v, out)| {
            let row = |v: usize| &across[v * line..(v + 1) * line];
            for (value, centre) in out.iter_mut().zip(row(v)) {
                *value = kernel[0] * centre;
            }
            for (step, weight) in kernel.iter().enumerate().skip(1) {
                let (above, below) = (row(v.saturating_sub(step)), row((v + step).min(height - 1)));
                for ((value, a), b) in out.iter_mut().zip(above).zip(below) {
                    *value += weight * (a + b);
                }
            }
        });
    }

    /// The picture: vignetting, exposure and white balance, noise, sRGB.
    pub(super) fn develop(
        &self,
        config: &ImageConfig,
        (seed, photo): (u64, usize),
        gains: [f64; 3],
    ) -> RgbImage {
        let gains = gains.map(|g| g as f32);
        let curve = tone_curve();
        let (width, height) = (self.width, self.height);
        let middle = [0.5 * (width as f32 - 1.0), 0.5 * (height as f32 - 1.0)];
        let corner2 = middle[0] * middle[0] + middle[1] * middle[1];
        let loss = config.vignetting as f32;
        let (read, shot) = (config.read_noise as f32, config.shot_noise as f32);
        let noisy = read > 0.0 || shot > 0.0;
        let mut image = RgbImage::new(width as u32, height as u32);
        image.par_chunks_mut(3 * width).enumerate().for_each(|(v, row)| {
            let mut rng = stream(seed, Stage::SensorRow, pair(photo, v));
            let dv = v as f32 - middle[1];
            let light = &self.light[3 * v * width..3 * (v + 1) * width];
            for (u, (out, light)) in row.chunks_exact_mut(3).zip(light.chunks_exact(3)).enumerate()
            {
                let du = u as f32 - middle[0];
                let fall = 1.0 - loss * (du * du + dv * dv) / corner2;
                for channel in 0..3 {
                    let mut value = light[channel] * fall * gains[channel];
                    if noisy {
                        let deviation = (read * read + shot * shot * value.max(0.0)).sqrt();
                        value += deviation * rng.normal() as f32;
                    }
                    let entry = (value.clamp(0.0, 1.0) * (CURVE - 1) as f32 + 0.5) as usize;
                    out[channel] = curve[entry];
                }
            }
        });
        image
    }
}

/// Exposure and white balance of a photo, as they vary from photo to photo.
pub(super) fn gains(config: &ImageConfig, seed: u64, photo: usize) -> [f64; 3] {
    let mut rng = stream(seed, Stage::Exposure, photo as u64);
    let gain = (config.exposure_spread * rng.normal()).exp();
    let [red, blue] = [rng.normal(), rng.normal()].map(|n| (config.white_balance_spread * n).exp());
    [gain * red, gain, gain * blue]
}

const CURVE: usize = 16384;

/// The sRGB transfer function in steps of 1/16383.
fn tone_curve() -> Vec<u8> {
    (0..CURVE)
        .map(|entry| {
            let linear = entry as f64 / (CURVE - 1) as f64;
            let coded = if linear <= 0.003_130_8 {
                12.92 * linear
            } else {
                1.055 * linear.powf(1.0 / 2.4) - 0.055
            };
            (255.0 * coded).round() as u8
        })
        .collect()
}
