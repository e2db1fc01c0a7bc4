//! What octaves are made from: the photo, the photo at twice its size, or the octave before.
//!
//! A picture goes on beyond its border as its mirror image about the outermost pixel centres
//! (`dcb|abcd|cba`).

use super::Upscale;
use image::GrayImage;

/// The longest piece of a row that is asked for at once.
pub(super) const LONGEST: usize = 1024;

/// A picture that gives pieces of its rows.
pub(super) trait Rows: Sync {
    /// Width and height, in pixels.
    fn size(&self) -> (usize, usize);

    /// Pixels `from..from + out.len()` of row `row`; both may lie outside, by mirroring.
    fn read(&self, row: isize, from: isize, out: &mut [f32]);
}

/// The pixel that stands at `index` when a line of `length` pixels is continued by mirroring.
pub(super) fn mirror(index: isize, length: usize) -> usize {
    let last = length as isize - 1;
    if (0..=last).contains(&index) {
        return index as usize;
    }
    if last <= 0 {
        return 0;
    }
    let folded = index.rem_euclid(2 * last);
    folded.min(2 * last - folded) as usize
}

/// A single-precision picture, grey values 0 to 255.
#[derive(Debug, Clone, Default)]
pub(super) struct Grid {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) data: Vec<f32>,
}

impl Rows for Grid {
    fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    fn read(&self, row: isize, from: isize, out: &mut [f32]) {
        let line = &self.data[mirror(row, self.height) * self.width..][..self.width];
        if from >= 0 && from as usize + out.len() <= self.width {
            out.copy_from_slice(&line[from as usize..][..out.len()]);
            return;
        }
        for (k, value) in out.iter_mut().enumerate() {
            *value = line[mirror(from + k as isize, self.width)];
        }
    }
}

/// The photo, at its own size or enlarged.
pub(super) struct Photo<'a> {
    pub(super) grey: &'a GrayImage,
    pub(super) upscale: Upscale,
}

impl Photo<'_> {
    /// For pixel `x` of the doubled line: the pixels of a line of `length` before and after its
    /// place, and the weight of the one after.
    fn between(&self, x: usize, length: usize) -> (usize, usize, f32) {
        let last = length - 1;
        let (before, weight) = match (self.upscale, x % 2) {
            (Upscale::None, _) => (x, 0.0),
            (Upscale::Precise, 0) => (x / 2, 0.0),
            (Upscale::Precise, _) => (x / 2, 0.5),
            // Left of the first centre there is only that pixel.
            (Upscale::HalfPixel, 0) if x == 0 => (0, 0.0),
            (Upscale::HalfPixel, 0) => (x / 2 - 1, 0.75),
            (Upscale::HalfPixel, _) => (x / 2, 0.25),
        };
        (before, (before + 1).min(last), weight)
    }
}

impl Rows for Photo<'_> {
    fn size(&self) -> (usize, usize) {
        let factor = self.upscale.factor() as usize;
        (self.grey.width() as usize * factor, self.grey.height() as usize * factor)
    }

    #[inline(always)]
    fn read(&self, row: isize, from: isize, out: &mut [f32]) {
        let (width, height) = self.size();
        let factor = self.upscale.factor() as usize;
        let (photo_width, photo_height) = (width / factor, height / factor);
        let (above, below, weight) = self.between(mirror(row, height), photo_height);
        let bytes = self.grey.as_raw();
        let above = &bytes[above * photo_width..][..photo_width];
        let below = &bytes[below * photo_width..][..photo_width];
        let end = from + out.len() as isize;
        if factor == 2 && out.len() < LONGEST && from >= 2 && end < width as isize - 2 {
            // Photo columns `first..` are enough for all pixels asked for.
            let (from, end) = (from as usize, end as usize);
            let first = from / 2 - 1;
            let mut line = [0.0f32; LONGEST / 2 + 3];
            let line = &mut line[..end / 2 + 2 - first];
            for ((value, &a), &b) in line.iter_mut().zip(&above[first..]).zip(&below[first..]) {
                *value = f32::from(a) * (1.0 - weight) + f32::from(b) * weight;
            }
            // Pairs of pixels from an even one on, of which the first may not be asked for.
            let mut pairs = [[0.0f32; 2]; LONGEST / 2 + 1];
            let pairs = &mut pairs[..line.len() - 2];
            let (even, odd) =
                if self.upscale == Upscale::HalfPixel { (0.75, 0.25) } else { (1.0, 0.5) };
            for (k, pair) in pairs.iter_mut().enumerate() {
                *pair = [
                    line[k] * (1.0 - even) + line[k + 1] * even,
                    line[k + 1] * (1.0 - odd) + line[k + 2] * odd,
                ];
            }
            out.copy_from_slice(&pairs.as_flattened()[from % 2..][..out.len()]);
            return;
        }
        for (k, value) in out.iter_mut().enumerate() {
            let column = mirror(from + k as isize, width);
            let (before, after, along) = self.between(column, photo_width);
            let at = |u: usize| f32::from(above[u]) * (1.0 - weight) + f32::from(below[u]) * weight;
            *value = at(before) * (1.0 - along) + at(after) * along;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mirroring_turns_about_the_outermost_pixels() {
        let line: Vec<usize> = (-4..8).map(|x| mirror(x, 4)).collect();
        assert_eq!(line, [2, 3, 2, 1, 0, 1, 2, 3, 2, 1, 0, 1]);
        assert_eq!((mirror(-3, 1), mirror(9, 1)), (0, 0));
    }

    #[test]
    fn a_doubled_photo_stands_where_it_should() {
        // A slope: every interpolated pixel has the value of its place.
        let grey = GrayImage::from_fn(40, 30, |u, v| image::Luma([(3 * u + 2 * v) as u8]));
        for (upscale, shift, factor) in [
            (Upscale::Precise, 0.0, 2.0),
            (Upscale::HalfPixel, 0.25, 2.0),
            (Upscale::None, 0.0, 1.0),
        ] {
            let photo = Photo { grey: &grey, upscale };
            let (width, height) = photo.size();
            assert_eq!((width as f32, height as f32), (40.0 * factor, 30.0 * factor));
            for row in [2, 5, height - 3] {
                let mut whole = vec![0.0; width];
                photo.read(row as isize, 0, &mut whole);
                for column in 2..width - 2 {
                    let u = column as f32 / factor - shift;
                    let v = row as f32 / factor - shift;
                    assert_eq!(whole[column], 3.0 * u + 2.0 * v, "{upscale:?} {column} {row}");
                }
                // Any piece is part of the whole.
                for (from, count) in [(2, 9), (3, 10), (7, 21), (width - 14, 11)] {
                    let mut piece = vec![0.0; count];
                    photo.read(row as isize, from as isize, &mut piece);
                    assert_eq!(piece, whole[from..from + count]);
                }
            }
        }
    }
}
