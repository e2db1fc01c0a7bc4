//! Images by what other files call them.

use rowgram_survey::scene::Image;
use std::collections::HashMap;
use unicode_normalization::UnicodeNormalization;

/// A name as it is compared and shown: letters composed (macOS takes umlauts apart), folders by slashes.
pub fn composed(name: &str) -> String {
    name.nfc().map(|c| if c == '\\' { '/' } else { c }).collect()
}

/// Finds images by what other files call them: by the whole name, else by its end from a folder on, else by the name of the
/// file without its ending, each where only one image has it.
pub struct Names<'a> {
    whole: HashMap<String, usize>,
    /// By the last parts of the path, and by the stem in lower case; none where several have it.
    ends: HashMap<String, Option<usize>>,
    names: Vec<&'a str>,
}

/// What a name may be shortened to: without its first folders, without its ending.
fn shortened(name: &str) -> Vec<String> {
    let file = name.rsplit('/').next().unwrap_or(name);
    let stem = |of: &str| {
        let cut = of.rsplit_once('.').filter(|(_, ending)| !ending.contains('/'));
        cut.map_or(of, |(stem, _)| stem).to_lowercase()
    };
    let folders = name.char_indices().filter(|(_, c)| *c == '/').map(|(at, _)| &name[at + 1..]);
    let mut found: Vec<String> = std::iter::once(name).chain(folders).map(stem).collect();
    found.push(stem(file));
    found.dedup();
    found
}

impl<'a> Names<'a> {
    /// Images in the order of their names.
    pub fn new(names: impl IntoIterator<Item = &'a str>) -> Names<'a> {
        let names: Vec<&str> = names.into_iter().collect();
        let (mut whole, mut ends) = (HashMap::new(), HashMap::new());
        for (k, name) in names.iter().enumerate() {
            let name = composed(name);
            for end in shortened(&name) {
                let place = ends.entry(end).or_insert(Some(k));
                if *place != Some(k) {
                    *place = None;
                }
            }
            whole.insert(name, k);
        }
        Names { whole, ends, names }
    }

    /// The names of the images of a block.
    pub fn of(images: &'a [Image]) -> Names<'a> {
        Names::new(images.iter().map(|image| image.name.as_str()))
    }

    /// The name of the first image, where there is any.
    pub fn first(&self) -> Option<&'a str> {
        self.names.first().copied()
    }

    /// The names of all images that this shortened name may mean.
    pub fn meant(&self, name: &str) -> Vec<&'a str> {
        let ends = shortened(&composed(name));
        let is_meant = |of: &&&str| shortened(&composed(of)).iter().any(|end| ends.contains(end));
        self.names.iter().filter(is_meant).copied().collect()
    }

    /// The place of the image of this name.
    pub fn find(&self, name: &str) -> Option<u32> {
        let name = composed(name);
        let whole = self.whole.get(&name).copied();
        let ends = shortened(&name);
        let shorter = || {
            let end = ends.iter().find(|end| self.ends.contains_key(*end))?;
            let found = self.ends.get(end).copied().flatten()?;
            // Folders on both sides have to agree.
            let by_file_alone = !end.contains('/') && name.contains('/');
            (!by_file_alone || !self.names[found].contains('/')).then_some(found)
        };
        whole.or_else(shorter).map(|k| k as u32)
    }

    /// The image whose name has this number as its last one, where only one has it.
    pub fn numbered(&self, number: u32) -> Option<u32> {
        let numbers = |name: &str| -> Vec<u32> {
            let file = name.rsplit('/').next().unwrap_or(name);
            let groups = file.split(|c: char| !c.is_ascii_digit()).filter(|g| !g.is_empty());
            groups.filter_map(|group| group.parse().ok()).collect()
        };
        let mut found =
            (0..self.names.len()).filter(|&k| numbers(self.names[k]).last() == Some(&number));
        found.next().filter(|_| found.next().is_none()).map(|k| k as u32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_found_by_what_others_call_them() {
        let names = Names::new([
            "100MEDIA/DJI_0001.JPG",
            "101MEDIA/DJI_0001.JPG",
            "101MEDIA/DJI_0002.JPG",
            "Ko\u{308}ln.jpg",
        ]);
        assert_eq!(names.meant("DJI_0001"), ["100MEDIA/DJI_0001.JPG", "101MEDIA/DJI_0001.JPG"]);
        for (name, found) in [
            ("100MEDIA/DJI_0001.JPG", Some(0)),
            ("101MEDIA\\DJI_0001.JPG", Some(1)),
            ("C:\\flight\\101MEDIA\\DJI_0001.jpg", Some(1)),
            ("DJI_0001.JPG", None),
            ("dji_0002.tif", Some(2)),
            ("102MEDIA/DJI_0002.JPG", None),
            ("somewhere/K\u{f6}ln.jpg", Some(3)),
            ("K\u{f6}ln.jpg", Some(3)),
            ("K\u{f6}ln", Some(3)),
            ("other.jpg", None),
        ] {
            assert_eq!(names.find(name), found, "{name}");
        }
        assert_eq!(
            (names.numbered(2), names.numbered(1), names.numbered(7)),
            (Some(2), None, None)
        );
    }
}
