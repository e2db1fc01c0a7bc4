//! Targets to print: a PDF with a page for each, in true size.
//!
//! A page is as large as the target with a white margin of a tenth of it and a line of text. It is drawn in black and white areas
//! only, so it stays sharp at any size.

use super::{
    TargetKind,
    shape::{Drawing, Shape},
};
use crate::mapping::MapError;
use std::fmt::Write;

/// Points of a page to a metre.
const POINTS_PER_M: f64 = 72.0 / 0.0254;
/// The longest side of a page, points (PDF 1.7, Annex C).
const MAX_PAGE: f64 = 14_400.0;
/// Margin around a target, in its whole width.
const MARGIN: f64 = 0.1;
/// Most pages.
pub const MAX_TARGETS: usize = 1000;

/// A PDF of targets of a size ([`super::TargetSearch::sizes_m`] says what that is): `count` of them, coded ones from number `first` on.
///
/// # Errors
/// A page that is larger than a PDF can have, codes that the kind does not have.
pub fn pdf(kind: TargetKind, size_m: f64, first: usize, count: usize) -> Result<Vec<u8>, MapError> {
    if let Some(codes) = kind.codes()
        && first.saturating_add(count) > codes
    {
        return Err(MapError(format!(
            "{kind} has the codes 0 to {}; expected a first code and a number of targets within them",
            codes - 1
        )));
    }
    if count == 0 || count > MAX_TARGETS || first > usize::MAX - count {
        return Err(MapError(format!("{count} targets: expected 1 to {MAX_TARGETS}")));
    }
    let size = size_m * POINTS_PER_M;
    let mut objects: Vec<String> = vec![String::new(); 2];
    objects.push("<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>".to_owned());
    let mut pages = Vec::new();
    for number in first..first + count {
        let drawing = Shape::drawing(kind, number);
        let whole = size * drawing.side;
        let margin = MARGIN * whole;
        let (width, height) = (whole + 2.0 * margin, whole + 2.0 * margin);
        if !(1.0..=MAX_PAGE).contains(&width) {
            return Err(MapError(format!(
                "a size of {:.1} cm makes pages of {:.1} cm; expected at most {:.0} cm",
                100.0 * size_m,
                100.0 * width / POINTS_PER_M,
                100.0 * MAX_PAGE / POINTS_PER_M
            )));
        }
        let mut content = String::new();
        draw(&mut content, &drawing, size, [0.5 * width, 0.5 * height]);
        let name = match kind.codes() {
            Some(_) => format!("{kind} {number}"),
            None => kind.to_string(),
        };
        // Grey, so that it is not taken for a part of the target.
        let text = (0.25 * margin).min(14.0);
        let _ = writeln!(
            content,
            "BT /F1 {text:.2} Tf 0.5 g {margin:.3} {:.3} Td ({name}, {:.1} cm) Tj ET",
            0.3 * margin,
            100.0 * size_m
        );
        let page = objects.len() + 1;
        pages.push(format!("{page} 0 R"));
        objects.push(format!(
            "<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.3} {height:.3}] /Contents {} 0 R /Resources << /Font << /F1 3 0 R >> >> >>",
            page + 1
        ));
        objects.push(format!("<< /Length {} >>\nstream\n{content}endstream", content.len()));
    }
    objects[0] = "<< /Type /Catalog /Pages 2 0 R >>".to_owned();
    objects[1] = format!("<< /Type /Pages /Kids [{}] /Count {} >>", pages.join(" "), pages.len());
    let mut file = "%PDF-1.4\n".to_owned();
    let mut places = Vec::new();
    for (k, object) in objects.iter().enumerate() {
        places.push(file.len());
        let _ = write!(file, "{} 0 obj\n{object}\nendobj\n", k + 1);
    }
    let start = file.len();
    let _ = write!(file, "xref\n0 {}\n0000000000 65535 f \n", objects.len() + 1);
    for place in places {
        let _ = writeln!(file, "{place:010} 00000 n ");
    }
    let _ = write!(
        file,
        "trailer\n<< /Size {} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n",
        objects.len() + 1
    );
    Ok(file.into_bytes())
}

/// Draws the black areas, then the white ones on them.
fn draw(content: &mut String, drawing: &Drawing, size: f64, middle: [f64; 2]) {
    for (grey, areas) in [(0, &drawing.black), (1, &drawing.white)] {
        let _ = writeln!(content, "{grey} g");
        for [left, top, width, height] in areas {
            // A page has its rows from below.
            let _ = writeln!(
                content,
                "{:.4} {:.4} {:.4} {:.4} re f",
                middle[0] + size * left,
                middle[1] - size * (top + height),
                size * width,
                size * height
            );
        }
    }
    if drawing.has_disc {
        // A circle of four cubic curves.
        let (r, c) = (0.5 * size, 0.5 * size * 0.552_284_75);
        let [x, y] = middle;
        let _ = writeln!(content, "1 g {:.4} {y:.4} m", x + r);
        for k in 0..4 {
            let (sin, cos) = (f64::from(k) * std::f64::consts::FRAC_PI_2).sin_cos();
            let turned = |a: f64, b: f64| [x + a * cos - b * sin, y + a * sin + b * cos];
            let ([ax, ay], [bx, by], [ex, ey]) = (turned(r, c), turned(c, r), turned(0.0, r));
            let _ = writeln!(content, "{ax:.4} {ay:.4} {bx:.4} {by:.4} {ex:.4} {ey:.4} c");
        }
        let _ = writeln!(content, "f");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_has_the_true_size_and_every_object_is_where_the_table_says() {
        for kind in TargetKind::ALL {
            let file = String::from_utf8(pdf(kind, 0.3, 4, 2).unwrap()).unwrap();
            let start: usize =
                file.rsplit("startxref\n").next().unwrap().lines().next().unwrap().parse().unwrap();
            assert!(file[start..].starts_with("xref"));
            let entries = file[start..].lines().skip(3).take_while(|line| line.ends_with("n "));
            let mut count = 0;
            for (k, entry) in entries.enumerate() {
                let at: usize = entry[..10].parse().unwrap();
                assert!(file[at..].starts_with(&format!("{} 0 obj", k + 1)), "{kind} {k}");
                count += 1;
            }
            assert_eq!(count, 7);
            assert_eq!(file.matches("/Type /Page ").count(), 2);
            let side = Shape::drawing(kind, 4).side * 1.2 * 0.3 * POINTS_PER_M;
            assert!(file.contains(&format!("/MediaBox [0 0 {side:.3} {side:.3}]")), "{kind}");
        }
        assert!(pdf(TargetKind::Aruco, 0.3, 49, 2).is_err());
        for kind in TargetKind::ALL {
            assert!(pdf(kind, 0.3, usize::MAX, 1).is_err(), "{kind}");
        }
        assert!(pdf(TargetKind::Disc, 9.0, 0, 1).is_err());
    }
}
