//! The part of a value of a topic that pages show: the beginning of a text, or an image.

use std::time::SystemTime;

use bytes::Bytes;
use fipa::protocol::Notification;
use imagesize::ImageType;
use serde_json::{Value, json};

use crate::command::dashboard::picture::{clipped, moment};

/// Maximum length of a value that is read, in bytes.
const MAX_LEN: u64 = 1 << 20;

/// Maximum number of pixels of an image. A small file can have many, and the browser takes memory for each.
const MAX_PIXELS: usize = 16 << 20;

/// Maximum length of a shown text, in characters.
const MAX_TEXT: usize = 1000;

/// Whether a value of this length is too large to be shown.
pub(super) fn is_too_large(bytes: u64) -> bool {
    bytes > MAX_LEN
}

/// A value of a topic.
#[derive(Debug)]
pub(super) struct TopicValue {
    at: SystemTime,
    len: usize,
    language: Option<String>,
    shown: Shown,
}

/// The part of a value that pages show.
#[derive(Debug, PartialEq, Eq)]
enum Shown {
    Text {
        text: String,
        is_cut: bool,
    },
    Image(Image),
    /// Neither a text nor an image of a known format, or too large.
    Nothing,
}

#[derive(Debug, PartialEq, Eq)]
struct Image {
    media_type: &'static str,
    width: usize,
    height: usize,
    content: Bytes,
}

impl TopicValue {
    pub(super) fn of(notification: &Notification) -> Self {
        let content = notification.content().map_or(&[][..], |content| content);
        let now = SystemTime::now();
        let age = notification.age().unwrap_or_default();
        Self {
            at: now.checked_sub(age).unwrap_or(now),
            len: content.len(),
            language: notification.language().map(clipped),
            shown: Shown::of(content),
        }
    }

    /// Whether it is too large to be shown.
    pub(super) fn is_too_large(&self) -> bool {
        is_too_large(self.len as u64)
    }

    /// The image, with its media type.
    pub(super) fn image(&self) -> Option<(&'static str, Bytes)> {
        match &self.shown {
            Shown::Image(image) => Some((image.media_type, image.content.clone())),
            _ => None,
        }
    }

    pub(super) fn row(&self, number: u64) -> Value {
        let (text, is_cut) = match &self.shown {
            Shown::Text { text, is_cut } => (Some(text), *is_cut),
            _ => (None, false),
        };
        let image = match &self.shown {
            Shown::Image(image) => json!({
                "media_type": image.media_type, "width": image.width, "height": image.height,
            }),
            _ => Value::Null,
        };
        json!({
            "number": number, "time": moment(self.at), "bytes": self.len, "language": self.language,
            "text": text, "cut": is_cut, "image": image,
        })
    }
}

impl Shown {
    fn of(content: &[u8]) -> Self {
        if is_too_large(content.len() as u64) {
            return Self::Nothing;
        }
        if let Some(image) = Image::of(content) {
            return Self::Image(image);
        }
        let is_text = |text: &&str| !text.chars().any(|c| c.is_control() && !c.is_whitespace());
        let Some(text) = std::str::from_utf8(content).ok().filter(is_text) else {
            return Self::Nothing;
        };
        match text.char_indices().nth(MAX_TEXT) {
            Some((end, _)) => Self::Text {
                text: text.get(..end).unwrap_or_default().to_owned(),
                is_cut: true,
            },
            None => Self::Text {
                text: text.to_owned(),
                is_cut: false,
            },
        }
    }
}

impl Image {
    /// Recognizes an image by its first bytes: a browser does not look at the media type that the publisher declares.
    fn of(content: &[u8]) -> Option<Self> {
        let media_type = match imagesize::image_type(content).ok()? {
            ImageType::Jpeg => "image/jpeg",
            ImageType::Png => "image/png",
            ImageType::Webp => "image/webp",
            _ => return None,
        };
        let size = imagesize::blob_size(content).ok()?;
        let pixels = size.width.checked_mul(size.height)?;
        (1..=MAX_PIXELS).contains(&pixels).then(|| Self {
            media_type,
            width: size.width,
            height: size.height,
            // A copy, because the memory belongs to the publisher.
            content: Bytes::copy_from_slice(content),
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The beginning of a PNG file with this size.
    fn png(width: u32, height: u32) -> Vec<u8> {
        let mut file = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR".to_vec();
        file.extend(width.to_be_bytes());
        file.extend(height.to_be_bytes());
        file.extend(b"\x08\x02\0\0\0");
        file
    }

    #[test]
    fn texts_are_cut_and_bytes_are_not_shown() {
        let short = Shown::of("(set 1.5)\n".as_bytes());
        assert_eq!(
            short,
            Shown::Text {
                text: "(set 1.5)\n".to_owned(),
                is_cut: false
            }
        );
        let Shown::Text { text, is_cut: true } = Shown::of("é".repeat(1001).as_bytes()) else {
            panic!("a long text is shown");
        };
        assert_eq!(text, "é".repeat(1000));
        for bytes in [&b"\xff\xfe"[..], b"a\0b", b"\x1b[2J"] {
            assert_eq!(Shown::of(bytes), Shown::Nothing, "{bytes:?}");
        }
        assert_eq!(Shown::of(&vec![b'a'; (1 << 20) + 1]), Shown::Nothing);
    }

    #[test]
    fn images_with_too_many_pixels_are_not_shown() {
        let Shown::Image(image) = Shown::of(&png(640, 480)) else {
            panic!("an image is shown");
        };
        assert_eq!(
            (image.media_type, image.width, image.height),
            ("image/png", 640, 480)
        );
        for (width, height) in [(0, 480), (50_000, 50_000), (u32::MAX, u32::MAX)] {
            assert_eq!(Shown::of(&png(width, height)), Shown::Nothing);
        }
        // A vector image can have scripts.
        let svg = Shown::of(b"<svg xmlns='http://www.w3.org/2000/svg'></svg>");
        assert!(matches!(svg, Shown::Text { .. }));
    }

    proptest! {
        #[test]
        fn any_bytes_after_the_begin_of_an_image_are_accepted(
            begin in prop::sample::select(vec![
                &b"\xff\xd8\xff"[..], b"\xff\xd8\xff\xe0\0\x10JFIF\0", b"\x89PNG\r\n\x1a\n", b"RIFF\0\0\0\0WEBPVP8 ",
                b"RIFF\0\0\0\0WEBPVP8L", b"RIFF\0\0\0\0WEBPVP8X",
            ]),
            rest in prop::collection::vec(prop_oneof![Just(0xff), Just(0xc0), any::<u8>()], 0..64),
        ) {
            let content = [begin, &rest].concat();
            if let Shown::Image(image) = Shown::of(&content) {
                prop_assert!(image.width * image.height <= MAX_PIXELS);
            }
        }
    }
}
