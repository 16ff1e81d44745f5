//! Line breaks and indentation, added to SL text on one line.

use crate::SlDialect;
use crate::lex::{Lexer, Token};

/// Maximum length of a list on one line, in bytes.
const WIDTH: usize = 80;
/// Number of columns per level.
const STEP: usize = 2;
/// Maximum indentation, which bounds the number of blanks for deep text.
const MAX_INDENT: usize = 60;

/// A token of the text on one line.
struct Span {
    start: usize,
    end: usize,
    kind: Kind,
}

enum Kind {
    /// An opening parenthesis, and the end of its list.
    Open(usize),
    Close,
    /// The name of a parameter, whose value stays on its line.
    Name,
    Other,
}

/// Returns the printer's text with long lists on several lines.
pub(super) fn indented(line: &[u8]) -> Vec<u8> {
    let spans = spans(line);
    let mut out = Vec::with_capacity(line.len() * 2);
    let mut depth = 0_usize;
    // A list that fits is copied up to here.
    let mut flat_until = 0;
    let mut first_of_list = false;
    let mut after_name = false;
    for span in &spans {
        let text = line.get(span.start..span.end).unwrap_or_default();
        if span.start < flat_until {
            continue;
        }
        if matches!(span.kind, Kind::Close) {
            depth = depth.saturating_sub(1);
            out.push(b')');
            first_of_list = false;
            continue;
        }
        if after_name {
            out.push(b' ');
        } else if !first_of_list && !out.is_empty() {
            out.push(b'\n');
            out.resize(out.len() + columns(depth), b' ');
        }
        after_name = matches!(span.kind, Kind::Name);
        first_of_list = false;
        match span.kind {
            Kind::Open(end) if columns(depth) + (end - span.start) > WIDTH => {
                depth += 1;
                first_of_list = true;
                out.push(b'(');
            }
            Kind::Open(end) => {
                flat_until = end;
                out.extend_from_slice(line.get(span.start..end).unwrap_or_default());
            }
            _ => out.extend_from_slice(text),
        }
    }
    out
}

fn columns(depth: usize) -> usize {
    (depth * STEP).min(MAX_INDENT)
}

/// Returns the tokens. An opening parenthesis has the offset at which its list ends.
fn spans(line: &[u8]) -> Vec<Span> {
    // Only the extent of byte strings matters, which the standard's rules give in every dialect.
    let mut lexer = Lexer::new(line, SlDialect::Standard);
    let mut spans: Vec<Span> = Vec::new();
    let mut open = Vec::new();
    loop {
        lexer.peek();
        let start = lexer.offset();
        let kind = match lexer.next() {
            Ok(Token::End) | Err(_) => return spans,
            Ok(Token::Open) => {
                open.push(spans.len());
                Kind::Open(line.len())
            }
            Ok(Token::Close) => {
                let opening = open.pop().and_then(|index: usize| spans.get_mut(index));
                if let Some(opening) = opening {
                    opening.kind = Kind::Open(lexer.offset());
                }
                Kind::Close
            }
            Ok(Token::Parameter(_)) => Kind::Name,
            Ok(_) => Kind::Other,
        };
        let end = lexer.offset();
        spans.push(Span { start, end, kind });
    }
}
