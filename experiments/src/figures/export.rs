//! From SVG to PDF and PNG, with the letters of a font that comes with the program: a picture looks the
//! same on a machine without fonts.

use crate::fail::Fail;
use resvg::{tiny_skia, usvg};
use rowgram::io::output;
use std::{path::Path, sync::Arc};

/// DejaVu Sans, cut down to Latin, Greek and the signs of mathematics.
const FONT: &[u8] = include_bytes!("../../assets/DejaVuSans.ttf");
/// Pixels of the PNG for each unit of the SVG.
const ZOOM: f32 = 1.5;

/// Writes `NAME.svg`, `NAME.pdf` and `NAME.png`.
pub(super) fn write(folder: &Path, name: &str, svg: &str) -> Result<(), Fail> {
    let fail = |what: &str, e: &dyn std::fmt::Display| {
        Fail::Failed(format!("{}: {what}: {e}", folder.join(name).display()))
    };
    let save = |end: &str, bytes: &[u8]| {
        output::write(&folder.join(format!("{name}.{end}")), true, |out| out.write_all(bytes))
    };
    let mut fonts = usvg::fontdb::Database::new();
    fonts.load_font_data(FONT.to_vec());
    fonts.set_sans_serif_family("DejaVu Sans");
    let options = usvg::Options {
        fontdb: Arc::new(fonts),
        font_family: "DejaVu Sans".to_owned(),
        ..Default::default()
    };
    let tree = usvg::Tree::from_str(svg, &options).map_err(|e| fail("SVG", &e))?;
    save("svg", svg.as_bytes())?;
    let pdf = svg2pdf::to_pdf(
        &tree,
        svg2pdf::ConversionOptions::default(),
        svg2pdf::PageOptions::default(),
    )
    .map_err(|e| fail("PDF", &e))?;
    save("pdf", &pdf)?;
    let size = tree.size();
    let (width, height) = ((size.width() * ZOOM) as u32, (size.height() * ZOOM) as u32);
    let mut pixels = tiny_skia::Pixmap::new(width, height)
        .ok_or_else(|| fail("PNG", &"the picture has no extent"))?;
    resvg::render(&tree, tiny_skia::Transform::from_scale(ZOOM, ZOOM), &mut pixels.as_mut());
    let png = pixels.encode_png().map_err(|e| fail("PNG", &e))?;
    save("png", &png)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn letters_are_drawn_without_the_fonts_of_the_machine() {
        let folder = tempfile::tempdir().unwrap();
        let svg = |text: &str| {
            format!(
                "<svg xmlns='http://www.w3.org/2000/svg' width='100' height='40'><text x='5' y='30' \
                 font-family='sans-serif' font-size='24'>{text}</text></svg>"
            )
        };
        write(folder.path(), "with", &svg("σ ± 0.5")).unwrap();
        write(folder.path(), "without", &svg("")).unwrap();
        let ink = |name: &str| {
            let picture = image::open(folder.path().join(name)).unwrap().to_rgba8();
            picture.pixels().filter(|pixel| pixel[3] > 128).count()
        };
        assert_eq!(ink("without.png"), 0);
        assert!(ink("with.png") > 200, "{}", ink("with.png"));
        let pdf = std::fs::read(folder.path().join("with.pdf")).unwrap();
        assert!(pdf.starts_with(b"%PDF-"));
        assert!(
            pdf.windows(6).any(|part| part == b"/Font " || part == b"/Font/" || part == b"/Font\n")
        );
    }
}
