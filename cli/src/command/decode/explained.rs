//! `fipa decode --explain`: every byte with its meaning.

use std::fmt::Write as _;
use std::path::Path;

use fipa::error::DecodeError;
use fipa_acl::{Explanation, Problem, explain};
use serde_json::{Value, json};

use crate::report::Failure;
use crate::{input, output};

/// Bytes per line.
const LINE: usize = 16;
/// Maximum number of lines per span.
const MAX_LINES: usize = 4;

/// Prints the explanation up to the first error.
pub(super) fn print(bytes: &[u8], json: bool, file: &Path) -> Result<(), Failure> {
    let explanation = explain(bytes);
    if let Some(Problem::UnsupportedRepresentation(other)) =
        explanation.error.as_ref().map(DecodeError::problem)
    {
        return Err(Failure::failed(
            format!("cannot explain {other}: --explain supports only bit-efficient encodings"),
            input::name(file),
            "omit --explain",
        ));
    }
    if json {
        output::json(&as_json(bytes, &explanation))?;
    } else {
        output::text(&as_text(bytes, &explanation))?;
    }
    match &explanation.error {
        None => Ok(()),
        Some(error) => Err(super::malformed(error, file)),
    }
}

fn as_json(bytes: &[u8], explanation: &Explanation) -> Value {
    let spans = explanation.spans.iter().map(|span| {
        json!({
            "offset": span.offset, "length": span.len,
            "depth": span.depth, "meaning": span.meaning,
        })
    });
    let mut json = json!({ "length": bytes.len(), "spans": spans.collect::<Vec<Value>>() });
    if let (Some(error), Some(object)) = (&explanation.error, json.as_object_mut()) {
        let error = json!({
            "offset": error.offset(),
            "problem": error.problem().to_string(),
            "clause": error.clause(),
        });
        object.insert("error".to_owned(), error);
    }
    json
}

/// The offset, bytes and meaning of every span.
fn as_text(bytes: &[u8], explanation: &Explanation) -> String {
    let mut out = String::new();
    let mut end = 0;
    for span in &explanation.spans {
        end = span.offset + span.len;
        let meaning = format!("{:indent$}{}", "", span.meaning, indent = 2 * span.depth);
        lines(&mut out, bytes, span.offset..end, &meaning);
    }
    if explanation.error.is_some() {
        lines(
            &mut out,
            bytes,
            end..bytes.len(),
            "not decoded: see the error",
        );
    }
    out
}

/// Writes the lines of a span. Of a long span only the first lines are written.
fn lines(out: &mut String, bytes: &[u8], range: std::ops::Range<usize>, meaning: &str) {
    let begin = range.start;
    let bytes = bytes.get(range).unwrap_or_default();
    let shown = if bytes.len() > MAX_LINES * LINE {
        (MAX_LINES - 1) * LINE
    } else {
        bytes.len()
    };
    let (shown, rest) = bytes.split_at_checked(shown).unwrap_or((bytes, &[]));
    for (index, line) in shown.chunks(LINE).enumerate() {
        let digits: Vec<String> = line.iter().map(|byte| format!("{byte:02x}")).collect();
        let meaning = if index == 0 { meaning } else { "" };
        let (offset, digits) = (begin + index * LINE, digits.join(" "));
        let line = format!(
            "{offset:>8}  {digits:<width$}  {meaning}",
            width = 3 * LINE - 1
        );
        // Writing to a string cannot fail.
        let _ = writeln!(out, "{}", line.trim_end());
    }
    if !rest.is_empty() {
        let _ = writeln!(
            out,
            "{:>8}  … {} more bytes",
            begin + shown.len(),
            rest.len()
        );
    }
}
