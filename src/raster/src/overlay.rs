//! What a person looks at: a mask or points drawn over a photo.

use super::Mask;
use image::{Rgb, RgbImage};
use rowgram_base::error::Error;

/// Colour for a leaf mask.
pub const MASK_COLOUR: Rgb<u8> = Rgb([255, 0, 255]);
/// Colour for pixels that are nearly as likely vegetation as not.
pub const DOUBTFUL_COLOUR: Rgb<u8> = Rgb([255, 150, 0]);
/// Colour for pixels that show nothing.
pub const NOTHING_COLOUR: Rgb<u8> = Rgb([60, 170, 255]);

/// Tints the plant pixels of a photo, and paints those at the edge of the mask.
///
/// # Errors
/// [`Error::Argument`] where mask and photo differ in size.
pub fn draw_mask(photo: &mut RgbImage, mask: &Mask, colour: Rgb<u8>) -> Result<(), Error> {
    let (width, height) = (photo.width() as usize, photo.height() as usize);
    if (width, height) != (mask.width, mask.height) {
        return Err(Error::Argument(format!(
            "the mask has {} x {} pixels, the photo {width} x {height}: expected the same size",
            mask.width, mask.height
        )));
    }
    for (u, v) in mask.plant_pixels() {
        // A wrapped -1 is outside as well.
        let inside = mask.get(u.wrapping_sub(1), v)
            && mask.get(u + 1, v)
            && v > 0
            && mask.get(u, v - 1)
            && mask.get(u, v + 1);
        let pixel = photo.get_pixel_mut(u as u32, v as u32);
        *pixel = if inside { blend(*pixel, colour) } else { colour };
    }
    Ok(())
}

/// Three parts of `under`, one of `over`.
fn blend(under: Rgb<u8>, over: Rgb<u8>) -> Rgb<u8> {
    let mixed = |i: usize| ((3 * u16::from(under.0[i]) + u16::from(over.0[i])) / 4) as u8;
    Rgb([mixed(0), mixed(1), mixed(2)])
}

/// Draws an upright cross at each point, with arms of `radius_px` pixels and a dark seam that keeps
/// it readable on any ground. Points `[u, v]` are in pixels; what lies outside the picture is not drawn.
pub fn draw_points(image: &mut RgbImage, points_px: &[[f64; 2]], colour: Rgb<u8>, radius_px: u32) {
    let radius = i64::from(radius_px.min(1 << 16));
    let half = radius / 8;
    for (seam, colour) in [(1, Rgb([0; 3])), (0, colour)] {
        for &[u, v] in points_px.iter().filter(|point| point.iter().all(|x| x.abs() < 1e9)) {
            let (u, v) = (u.round() as i64, v.round() as i64);
            let (long, thick) = (radius + seam, half + seam);
            fill(image, (u - long, v - thick), (u + long, v + thick), colour);
            fill(image, (u - thick, v - long), (u + thick, v + long), colour);
        }
    }
}

/// Draws a line through points `[u, v]`, pixels, `width_px` pixels wide; what lies outside the picture is not drawn.
/// From a place to itself it is a square.
pub fn draw_line(image: &mut RgbImage, points_px: &[[f64; 2]], colour: Rgb<u8>, width_px: u32) {
    let (before, after) = (i64::from(width_px.max(1) - 1) / 2, i64::from(width_px) / 2);
    let (width, height) = (f64::from(image.width()), f64::from(image.height()));
    for pair in points_px.windows(2) {
        let [from, to] = [pair[0], pair[1]];
        let [du, dv] = [to[0] - from[0], to[1] - from[1]];
        let steps = du.abs().max(dv.abs()).ceil().max(1.0);
        if steps.is_nan() || steps > 1e7 {
            continue;
        }
        for step in 0..=steps as u64 {
            let share = step as f64 / steps;
            let [u, v] = [from[0] + share * du, from[1] + share * dv].map(f64::round);
            let margin = f64::from(width_px);
            let is_near =
                u >= -margin && v >= -margin && u <= width + margin && v <= height + margin;
            if !is_near {
                continue;
            }
            let (u, v) = (u as i64, v as i64);
            fill(image, (u - before, v - before), (u + after, v + after), colour);
        }
    }
}

/// Fills the rectangle between two corners (both belong to it), as far as it lies in the picture.
fn fill(image: &mut RgbImage, from: (i64, i64), to: (i64, i64), colour: Rgb<u8>) {
    let (width, height) = (i64::from(image.width()), i64::from(image.height()));
    for v in from.1.max(0)..(to.1 + 1).min(height) {
        for u in from.0.max(0)..(to.0 + 1).min(width) {
            image.put_pixel(u as u32, v as u32, colour);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_edge_is_painted_and_the_inside_tinted() {
        let mut photo = RgbImage::from_pixel(5, 5, Rgb([100, 100, 100]));
        let mask = Mask::from_fn(5, 5, |u, v| u >= 2 && v >= 2);
        draw_mask(&mut photo, &mask, MASK_COLOUR).unwrap();
        assert_eq!(photo.get_pixel(2, 2), &MASK_COLOUR);
        assert_eq!(photo.get_pixel(3, 3).0, [138, 75, 138]);
        assert_eq!(photo.get_pixel(4, 4), &MASK_COLOUR, "the picture ends here");
        assert_eq!(photo.get_pixel(1, 2).0, [100; 3]);
        let error = draw_mask(&mut photo, &Mask::empty(4, 5), MASK_COLOUR).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the mask has 4 x 5 pixels, the photo 5 x 5: expected the same size"
        );
    }

    #[test]
    fn lines_have_their_width_and_end_at_the_edge() {
        let mut image = RgbImage::new(9, 9);
        let white = Rgb([255; 3]);
        draw_line(&mut image, &[[2.0, 4.0], [60.0, 4.0], [f64::NAN, 0.0]], white, 3);
        assert_eq!(image.pixels().filter(|&&pixel| pixel == white).count(), 8 * 3);
        assert_eq!((image.get_pixel(1, 3), image.get_pixel(8, 5)), (&white, &white));
    }

    #[test]
    fn crosses_are_centred_and_clipped() {
        let mut image = RgbImage::new(11, 11);
        let white = Rgb([255; 3]);
        draw_points(&mut image, &[[5.4, 4.6]], white, 3);
        let count = image.pixels().filter(|&&pixel| pixel == white).count();
        assert_eq!(count, 13, "two arms of 7 that share the centre");
        assert_eq!(image.get_pixel(5, 5), &white);
        assert_eq!(image.get_pixel(8, 5), &white);
        assert_ne!(image.get_pixel(9, 5), &white);
        let before = image.clone();
        let outside = [[f64::NAN, 1.0], [f64::INFINITY, 0.0], [1e300, 0.0], [-50.0, 4.0]];
        draw_points(&mut image, &outside, white, 3);
        assert_eq!(image, before);
        draw_points(&mut RgbImage::new(0, 0), &[[0.0, 0.0]], white, u32::MAX);
        draw_points(&mut image, &[[-1.0, 10.0]], white, 2);
        assert_eq!(image.get_pixel(1, 10), &white, "the part inside is drawn");
    }
}
