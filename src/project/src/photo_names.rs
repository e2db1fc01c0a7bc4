//! Names of photos: which one somebody means, and what files made of photos are called.

use rowgram_base::error::Error;
use rowgram_files::image_names::Names;
use std::{
    collections::{HashMap, HashSet},
    path::{Path, PathBuf},
};

/// The number of the photo that somebody names, in full or as much of it as no other photo has.
///
/// # Errors
/// A name of none, or of several.
pub(super) fn number_of<'a>(
    photos: impl IntoIterator<Item = &'a str>,
    wanted: &str,
) -> Result<usize, String> {
    let names = Names::new(photos);
    names.find(wanted).map(|k| k as usize).ok_or_else(|| match names.meant(wanted)[..] {
        [] => format!("there is no photo {wanted:?} with a pose"),
        [one] => format!("photo {wanted:?} is not {one}, which is in another folder"),
        ref all => format!("photo {wanted:?} may be any of {}; name it in full", all.join(", ")),
    })
}

/// A name for what is made of each photo: the first of its two where no other photo has it, else the second, with a number where that
/// is taken, too. Upper and lower case are the same to some file systems.
pub(super) fn distinct(names: &[[String; 2]]) -> Vec<String> {
    let mut uses: HashMap<String, usize> = HashMap::new();
    for [short, _] in names {
        *uses.entry(short.to_lowercase()).or_default() += 1;
    }
    let is_alone = |name: &str| uses.get(&name.to_lowercase()) == Some(&1);
    let mut taken: HashSet<String> = uses.keys().filter(|name| is_alone(name)).cloned().collect();
    let name = |[short, long]: &[String; 2]| match is_alone(short) {
        true => short.clone(),
        false => free(&mut taken, long),
    };
    names.iter().map(name).collect()
}

/// A name that is not taken yet, which it is then: the one that is wanted, else with a number.
pub(super) fn free(taken: &mut HashSet<String>, wanted: &str) -> String {
    let numbered = (2..).map(|number| format!("{wanted}-{number}"));
    let mut names = std::iter::once(wanted.to_owned()).chain(numbered);
    names.find(|name| taken.insert(name.to_lowercase())).unwrap_or_default()
}

/// Refuses two photos of which the same file would be made.
///
/// # Errors
/// Both, and the file.
pub(super) fn refuse_twins<'a>(
    photos: &[PathBuf],
    outputs: impl IntoIterator<Item = &'a PathBuf>,
) -> Result<(), Error> {
    let mut taken: HashMap<&Path, &Path> = HashMap::new();
    for (photo, output) in photos.iter().zip(outputs) {
        if let Some(other) = taken.insert(output, photo) {
            let [other, photo, output] = [other, photo, output].map(Path::display);
            return Err(Error::Argument(format!(
                "{other} and {photo} would both become {output}; give them in two calls with folders of their own"
            )));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_photo_is_named_in_full_or_by_a_stem_of_its_own() {
        let photos = ["100MEDIA/DJI_0001.JPG", "101MEDIA/DJI_0001.JPG", "DJI_0002.JPG", "pose"];
        for (wanted, expected) in [
            ("101MEDIA/DJI_0001.JPG", Some(1)),
            ("DJI_0002.JPG", Some(2)),
            ("DJI_0002", Some(2)),
            ("pose.png", Some(3)),
            ("flight/101MEDIA\\dji_0001.jpg", Some(1)),
            ("102MEDIA/DJI_0001.JPG", None),
            ("DJI_0003", None),
        ] {
            assert_eq!(number_of(photos, wanted).ok(), expected, "{wanted}");
        }
        let why = number_of(photos, "DJI_0001").unwrap_err();
        assert!(photos[..2].iter().all(|name| why.contains(name)), "{why}");
    }

    #[test]
    fn no_two_photos_have_one_output() {
        let names = [
            ["a", "100_a.jpg"],
            ["A", "101_A.jpg"],
            ["b", "b.jpg"],
            ["c", "x"],
            ["c", "X"],
            ["100_a.jpg", "100_a.jpg.jpg"],
        ];
        assert_eq!(
            distinct(&names.map(|pair| pair.map(str::to_owned))),
            ["100_a.jpg-2", "101_A.jpg", "b", "x", "X-2", "100_a.jpg"]
        );
    }
}
