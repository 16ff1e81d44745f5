//! Colors.

use std::fmt;

/// A color: red, green and blue.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Color(pub u8, pub u8, pub u8);

impl Color {
    /// Dark text and lines.
    pub(crate) const INK: Self = Self(0x22, 0x29, 0x33);
    /// Text of less weight.
    pub(crate) const GRAY: Self = Self(0x5a, 0x63, 0x6e);
    /// Lines of scales.
    pub(crate) const FAINT: Self = Self(0xdd, 0xe1, 0xe6);
    pub(crate) const WHITE: Self = Self(0xff, 0xff, 0xff);
    /// Violations and faults.
    pub(crate) const RED: Self = Self(0xc2, 0x18, 0x1f);

    /// The colors of Okabe and Ito, which the color-blind tell apart, without red and yellow.
    const PALETTE: [Self; 6] = [
        Self(0x00, 0x72, 0xb2),
        Self(0xe6, 0x9f, 0x00),
        Self(0x00, 0x9e, 0x73),
        Self(0xcc, 0x79, 0xa7),
        Self(0x56, 0xb4, 0xe9),
        Self(0x7a, 0x5c, 0x3a),
    ];

    /// Returns a color for the thing with a number: an agent, a coalition. There are six, then they repeat.
    #[must_use]
    pub fn nth(number: usize) -> Self {
        let [first, ..] = Self::PALETTE;
        let at = number % Self::PALETTE.len();
        Self::PALETTE.get(at).copied().unwrap_or(first)
    }

    /// Returns a light tone of the color, for areas behind text.
    pub(crate) fn light(self) -> Self {
        let light = |part: u8| 255 - (255 - part) / 4;
        Self(light(self.0), light(self.1), light(self.2))
    }
}

impl fmt::Display for Color {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "#{:02x}{:02x}{:02x}", self.0, self.1, self.2)
    }
}
