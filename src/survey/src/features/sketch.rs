//! What a person looks at: key points drawn on a photo, correspondences drawn between two.

use crate::features::{KeyPoint, matching::Match};
use image::{Rgb, RgbImage, imageops};
use rowgram_raster::overlay::draw_line;

/// Colours that are told apart by everybody (Okabe and Ito), used in turn.
const COLOURS: [Rgb<u8>; 6] = [
    Rgb([230, 159, 0]),
    Rgb([86, 180, 233]),
    Rgb([0, 158, 115]),
    Rgb([240, 228, 66]),
    Rgb([213, 94, 0]),
    Rgb([204, 121, 167]),
];

/// Draws a circle of three times its blur at each key point and its direction as a radius, larger
/// ones first so that the smaller stay visible.
pub fn draw_key_points(photo: &mut RgbImage, key_points: &[KeyPoint]) {
    let mut order: Vec<usize> = (0..key_points.len()).collect();
    order.sort_by(|&a, &b| key_points[b].sigma_px.total_cmp(&key_points[a].sigma_px));
    for index in order {
        let KeyPoint { u_px, v_px, sigma_px, angle_rad, .. } = key_points[index];
        let radius = (3.0 * sigma_px).max(2.0);
        let colour = COLOURS[index % COLOURS.len()];
        // Steps of about one pixel along the circle.
        let steps = (std::f32::consts::TAU * radius).ceil().min(1e5) as u32;
        for step in 0..steps {
            let turn = step as f32 / steps as f32 * std::f32::consts::TAU;
            put(photo, u_px + radius * turn.cos(), v_px + radius * turn.sin(), colour);
        }
        let end = [u_px + radius * angle_rad.cos(), v_px + radius * angle_rad.sin()];
        draw_line(photo, &[[u_px, v_px], end].map(|at| at.map(f64::from)), colour, 1);
    }
}

/// Two photos side by side, the second below or to the right so that the picture is compact, with a
/// line for each of the matches.
pub fn correspondences(
    first: (&RgbImage, &[KeyPoint]),
    second: (&RgbImage, &[KeyPoint]),
    matches: &[Match],
) -> RgbImage {
    let (width, height) = first.0.dimensions();
    let below = width > height;
    let (columns, rows) = second.0.dimensions();
    let (shift, size) = if below {
        ((0, height), (width.max(columns), height + rows))
    } else {
        ((width, 0), (width + columns, height.max(rows)))
    };
    let mut picture = RgbImage::new(size.0, size.1);
    imageops::replace(&mut picture, first.0, 0, 0);
    imageops::replace(&mut picture, second.0, shift.0.into(), shift.1.into());
    for (index, m) in matches.iter().enumerate() {
        let ends = (first.1.get(m.first as usize), second.1.get(m.second as usize));
        let (Some(from), Some(to)) = ends else { continue };
        let [from, to] = [from, to].map(|of| [of.u_px, of.v_px].map(f64::from));
        let to = [to[0] + f64::from(shift.0), to[1] + f64::from(shift.1)];
        draw_line(&mut picture, &[from, to], COLOURS[index % COLOURS.len()], 1);
    }
    picture
}

/// Paints the nearest pixel, if it is in the picture.
fn put(image: &mut RgbImage, u: f32, v: f32, colour: Rgb<u8>) {
    let (u, v) = (u.round(), v.round());
    if u >= 0.0 && v >= 0.0 && u < image.width() as f32 && v < image.height() as f32 {
        image.put_pixel(u as u32, v as u32, colour);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(u_px: f32, v_px: f32) -> KeyPoint {
        KeyPoint { u_px, v_px, sigma_px: 1.0, angle_rad: 0.0, response: 0.1 }
    }

    #[test]
    fn a_circle_and_its_direction() {
        let mut photo = RgbImage::new(20, 12);
        draw_key_points(&mut photo, &[point(8.0, 6.0), point(-50.0, 1e9), point(f32::NAN, 0.0)]);
        for (u, v, painted) in [(11, 6, true), (8, 3, true), (9, 6, true), (7, 6, false)] {
            assert_eq!(photo.get_pixel(u, v) == &COLOURS[0], painted, "{u} {v}");
        }
    }

    #[test]
    fn lines_go_from_photo_to_photo() {
        let (wide, high) = (RgbImage::new(30, 10), RgbImage::new(10, 30));
        let points = [point(2.0, 3.0)];
        let m = Match { first: 0, second: 0, distance_squared: 0 };
        let beyond = Match { first: 1, ..m };
        let stacked = correspondences((&wide, &points), (&high, &points), &[m, beyond]);
        assert_eq!(stacked.dimensions(), (30, 40));
        assert!((3..=13).all(|v| stacked.get_pixel(2, v) == &COLOURS[0]));
        let abreast = correspondences((&high, &points), (&wide, &points), &[m]);
        assert_eq!(abreast.dimensions(), (40, 30));
        assert!((2..=12).all(|u| abreast.get_pixel(u, 3) == &COLOURS[0]));
    }
}
