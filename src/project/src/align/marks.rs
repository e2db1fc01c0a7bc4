//! Image measurements that cannot be where they are.

use super::inputs::Photo;
use rowgram_base::monitor::{Diagnostic, Monitor};
use rowgram_survey::scene::GroundObservation;

/// A mark so far outside of its photo is no slip of a pointer, pixels.
const OUTSIDE_PX: f64 = 2.0;

fn is_within([u, v]: [f64; 2], photo: &Photo) -> bool {
    let [width, height] = photo.size_px.map(f64::from);
    (-OUTSIDE_PX..=width + OUTSIDE_PX).contains(&u)
        && (-OUTSIDE_PX..=height + OUTSIDE_PX).contains(&v)
}

/// Names image measurements that lie outside of their photos, or that are no pixels, with the likely cause; what is done
/// about them the block decides.
pub(super) fn outside(marks: &[GroundObservation], photos: &[Photo], monitor: &mut dyn Monitor) {
    let photo = |mark: &GroundObservation| &photos[mark.image as usize];
    let out: Vec<&GroundObservation> =
        marks.iter().filter(|mark| !is_within(mark.image_px, photo(mark))).collect();
    let exchanged = |mark: &GroundObservation| {
        let [u, v] = mark.image_px;
        is_within([v, u], photo(mark))
    };
    let normalised =
        marks.len() > 2 && marks.iter().all(|mark| mark.image_px.iter().all(|v| v.abs() <= 1.0));
    let message = if normalised {
        "all lie within one pixel of the corner of their photos: they seem to be shares of the width and height; expected pixels".to_owned()
    } else if let Some(first) = out.first() {
        let cause = if marks.iter().all(exchanged) {
            "; column and row seem to be exchanged"
        } else {
            "; they seem to be of photos of another size"
        };
        format!(
            "{} of {} lie outside of their photos, the first in {}{cause}",
            out.len(),
            marks.len(),
            photo(first).name
        )
    } else {
        return;
    };
    monitor.diagnostic(&Diagnostic::warning("marks-outside", "marks", message).with_remedy(
        "expected u_px to the right and v_px downwards from the centre of the top-left pixel",
    ));
}
