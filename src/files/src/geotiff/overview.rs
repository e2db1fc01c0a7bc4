//! Tiles of overviews: each pixel from the 2 x 2 below it.
//!
//! Colours and values are means of the pixels that hold data, classes and records are one of the pixels.

use super::{
    Sample, TILE,
    write::{Colour, Layout},
};

/// A quarter of a tile: each pixel from 2 x 2, of which `valid` columns and rows belong to the raster.
pub(super) fn halve<T: Sample>(tile: &[T], valid: [usize; 2], layout: &Layout, fill: T) -> Vec<T> {
    const HALF: usize = TILE / 2;
    let bands = layout.bands();
    let mut out = vec![fill; HALF * HALF * bands];
    if let (Colour::Rgba, Some(bytes), Some(half)) =
        (layout.colour, T::as_bytes(tile), T::as_bytes_mut(&mut out))
    {
        halve_colours(bytes, valid, half);
        return out;
    }
    let nodata = layout.nodata.map(T::from_f64);
    for v in 0..valid[1].div_ceil(2) {
        for u in 0..valid[0].div_ceil(2) {
            let (columns, rows) = ((valid[0] - 2 * u).min(2), (valid[1] - 2 * v).min(2));
            let pixel = |i: usize, j: usize| {
                let at = ((2 * v + j) * TILE + 2 * u + i) * bands;
                &tile[at..at + bands]
            };
            let to = (v * HALF + u) * bands;
            let out = &mut out[to..to + bands];
            match layout.colour {
                Colour::Classes | Colour::Records(_) => out.copy_from_slice(pixel(0, 0)),
                Colour::Values | Colour::Rgb | Colour::Rgba => {
                    let (mut sums, mut count) = ([0.0f64; 4], 0.0);
                    for j in 0..rows {
                        for i in 0..columns {
                            let pixel = pixel(i, j);
                            let empty = match layout.colour {
                                Colour::Rgba => pixel[3].into() == 0.0,
                                _ => {
                                    nodata.is_some_and(|nodata| pixel.iter().all(|&x| x == nodata))
                                }
                            };
                            if !empty {
                                sums.iter_mut().zip(pixel).for_each(|(sum, &x)| *sum += x.into());
                                count += 1.0;
                            }
                        }
                    }
                    if count > 0.0 {
                        out.iter_mut()
                            .zip(sums)
                            .for_each(|(out, sum)| *out = T::from_f64(sum / count));
                        if layout.colour == Colour::Rgba {
                            out[3] = pixel_alpha(out[3]);
                        }
                    }
                }
            }
        }
    }
    out
}

/// As [`halve`], for bytes of red, green, blue and alpha.
fn halve_colours(tile: &[u8], valid: [usize; 2], half: &mut [u8]) {
    let (tile, half) = (tile.as_chunks::<4>().0, half.as_chunks_mut::<4>().0);
    for v in 0..valid[1].div_ceil(2) {
        let rows = [2 * v, (2 * v + 1).min(valid[1] - 1)].map(|v| &tile[v * TILE..][..valid[0]]);
        let out = &mut half[v * TILE / 2..][..valid[0].div_ceil(2)];
        let whole = 2 * v + 1 < valid[1];
        let pairs = [rows[0].as_chunks::<2>().0, rows[1].as_chunks::<2>().0];
        for u in 0..out.len() {
            if whole && u < pairs[0].len() {
                let ([a, b], [c, d]) = (pairs[0][u], pairs[1][u]);
                if a[3] & b[3] & c[3] & d[3] == 255 {
                    out[u] = mean_of_four([a, b, c, d]);
                    continue;
                }
            }
            let rows = if whole { &rows[..] } else { &rows[..1] };
            let (mut sums, mut count) = ([0u32; 4], 0);
            for row in rows {
                for pixel in &row[2 * u..(2 * u + 2).min(valid[0])] {
                    if pixel[3] > 0 {
                        for k in 0..4 {
                            sums[k] += u32::from(pixel[k]);
                        }
                        count += 1;
                    }
                }
            }
            if count > 0 {
                for k in 0..4 {
                    out[u][k] = ((2 * sums[k] + count) / (2 * count)) as u8;
                }
                out[u][3] = out[u][3].max(1);
            }
        }
    }
}

/// Means of bytes, rounded, two at a time in the halves of a word.
fn mean_of_four(pixels: [[u8; 4]; 4]) -> [u8; 4] {
    const EVEN: u32 = 0x00ff_00ff;
    let [a, b, c, d] = pixels;
    let [a, b, c, d] = [
        u32::from_le_bytes(a),
        u32::from_le_bytes(b),
        u32::from_le_bytes(c),
        u32::from_le_bytes(d),
    ];
    let even = (a & EVEN) + (b & EVEN) + (c & EVEN) + (d & EVEN) + 0x0002_0002;
    let odd =
        ((a >> 8) & EVEN) + ((b >> 8) & EVEN) + ((c >> 8) & EVEN) + ((d >> 8) & EVEN) + 0x0002_0002;
    (((even >> 2) & EVEN) | (((odd >> 2) & EVEN) << 8)).to_le_bytes()
}

/// What is partly there is there.
fn pixel_alpha<T: Sample>(alpha: T) -> T {
    if alpha.into() > 0.0 { alpha } else { T::from_f64(1.0) }
}
