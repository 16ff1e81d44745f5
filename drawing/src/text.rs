//! The width of texts, and texts that fit.
//!
//! The viewer chooses the font. Widths are those of DejaVu Sans, which is wider than other fonts for screens.

use unicode_width::UnicodeWidthChar;

/// Maximum number of characters that are read of a text from outside.
const MAX_CHARS: usize = 2000;
/// Share by which bold letters are wider.
const BOLD: f64 = 1.12;

/// Returns the approximate width of a text, in the unit of the font size.
pub(crate) fn width(text: &str, size: f64, bold: bool) -> f64 {
    let all: f64 = text.chars().map(char_width).sum();
    all * size * if bold { BOLD } else { 1.0 }
}

fn char_width(c: char) -> f64 {
    match c {
        'i' | 'j' | 'l' | '\'' => 0.29,
        ' ' | '.' | ',' | ';' | ':' | '|' | '!' | 'I' | '/' | '\\' => 0.35,
        't' | 'f' | 'r' | '(' | ')' | '[' | ']' | '-' | '"' => 0.42,
        'm' | 'M' | 'W' | '@' | '%' | '…' | '—' => 1.0,
        'w' | '+' | '<' | '>' | '=' | '~' | '#' | '&' | '×' => 0.84,
        'A'..='Z' => 0.76,
        ' '..='~' => 0.64,
        c => match UnicodeWidthChar::width(c) {
            Some(0) => 0.0,
            Some(1) => 0.72,
            _ => 1.1,
        },
    }
}

/// Returns a text without the characters that XML excludes, and with references for those that have a meaning in it.
/// Characters that change the direction of the text around them would move other words.
pub(crate) fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\u{fffe}' | '\u{ffff}' | '\u{200e}' | '\u{200f}' => out.push('\u{fffd}'),
            '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => out.push('\u{fffd}'),
            c if c.is_whitespace() => out.push(' '),
            c if c.is_control() => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out
}

/// Cuts a text to a width. An ellipsis stands for the rest.
pub(crate) fn fit(text: &str, size: f64, bold: bool, most: f64) -> String {
    let start = || text.chars().take(MAX_CHARS);
    let whole: String = start().collect();
    if width(&whole, size, bold) <= most {
        return whole;
    }
    let mut room = most - width("…", size, bold);
    if room < 0.0 {
        return String::new();
    }
    let scale = width("m", size, bold);
    let first = start().take_while(|c| {
        room -= char_width(*c) * scale;
        room >= 0.0
    });
    first.collect::<String>().trim_end().to_owned() + "…"
}

/// Breaks a text into lines of a maximum width, between words where possible. The last line is cut.
pub(crate) fn wrapped(text: &str, size: f64, bold: bool, most: f64, lines: usize) -> Vec<String> {
    let mut all: Vec<String> = Vec::new();
    let mut line = String::new();
    let mut rest = text.split_whitespace();
    while let Some(word) = rest.next() {
        let longer = match line.is_empty() {
            true => word.to_owned(),
            false => format!("{line} {word}"),
        };
        if width(&longer, size, bold) <= most {
            line = longer;
        } else if all.len() + 1 >= lines || line.is_empty() {
            let words: Vec<&str> = rest.by_ref().collect();
            line = fit(&format!("{longer} {}", words.join(" ")), size, bold, most);
        } else {
            all.push(std::mem::replace(&mut line, word.to_owned()));
        }
    }
    if !line.is_empty() {
        all.push(fit(&line, size, bold, most));
    }
    all
}

/// Breaks a bold name into at most two lines of a maximum width, where its parts begin.
pub(crate) fn name_lines(name: &str, size: f64, most: f64) -> Vec<String> {
    if width(name, size, true) <= most {
        return vec![name.to_owned()];
    }
    let breaks = name.char_indices().filter(|(_, c)| "@-_./: ".contains(*c));
    let fits = breaks.map(|(at, c)| if c == '@' { at } else { at + c.len_utf8() });
    let mut parts = fits.filter_map(|at| name.split_at_checked(at));
    match parts.rfind(|(first, _)| width(first, size, true) <= most) {
        Some((first, rest)) if !first.is_empty() => {
            vec![first.to_owned(), fit(rest, size, true, most)]
        }
        _ => vec![fit(name, size, true, most)],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_fit() {
        assert_eq!(fit("rover", 15.0, false, 100.0), "rover");
        let cut = fit("a long name of an agent", 15.0, false, 100.0);
        assert!(
            cut.ends_with('…') && width(&cut, 15.0, false) <= 100.0,
            "{cut}"
        );
        assert_eq!(fit("rover", 15.0, false, 2.0), "");
        let lines = wrapped(
            "inform breaks the protocol of the dock",
            15.0,
            false,
            120.0,
            2,
        );
        assert_eq!(lines.len(), 2);
        assert!(lines[1].ends_with('…'), "{lines:?}");
        assert_eq!(wrapped("", 15.0, false, 120.0, 2), Vec::<String>::new());
    }

    #[test]
    fn names_break_at_their_parts() {
        assert_eq!(name_lines("rover", 15.0, 100.0), ["rover"]);
        let lines = name_lines("controller@host-a.example.org", 15.0, 110.0);
        assert_eq!(lines, ["controller", "@host-a.e…"]);
        assert_eq!(
            name_lines("gripper_of_the_dock", 15.0, 110.0)[0],
            "gripper_of_"
        );
    }

    #[test]
    fn texts_are_escaped() {
        let hostile = "<a href=\"x\">&\u{0}\u{202e}\u{ffff}\n";
        let expected = "&lt;a href=&quot;x&quot;&gt;&amp;\u{fffd}\u{fffd}\u{fffd} ";
        assert_eq!(escaped(hostile), expected);
    }
}
