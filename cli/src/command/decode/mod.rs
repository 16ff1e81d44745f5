//! `fipa decode`: prints bytes as JSON, or explains them byte by byte.

mod explained;

use std::path::{Path, PathBuf};

use clap::Args;
use fipa::error::DecodeError;
use fipa::{Letter, Message, Payload};
use fipa_acl::Representation;
use fipa_acl::json::{letter_to_json, message_to_json};
use serde_json::{Value, json};

use crate::input::MAX_MESSAGE;
use crate::options::Global;
use crate::report::{self, Failure};
use crate::{input, output};

/// Print a recorded message or letter as JSON
///
/// Reads one encoded message (bit-efficient, FIPA00069; string, FIPA00070; XML, FIPA00071), or one
/// letter: an envelope (bit-efficient, FIPA00088; XML, FIPA00085) followed by a message. The first
/// bytes decide which. For invalid input, the error has the byte offset and the violated clause of
/// the standard.
///
/// With --explain it prints the meaning of every byte of a bit-efficient encoding, up to the first
/// error.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa decode letter.bin
  fipa decode message.be --compact | jq -r .message.performative
  echo 'fa 10 13 01' | fipa decode --hex
  fipa decode --explain letter.bin

JSON of a message:
  { \"message\": { \"performative\", \"sender\": agent, \"receivers\": [agent], \"reply_to\": [agent],
                 \"content\" (text) or \"content_base64\", \"language\", \"encoding\", \"ontology\",
                 \"protocol\", \"conversation_id\", \"reply_with\", \"in_reply_to\", \"reply_by\",
                 \"user_defined\": { name: text } } }
  agent: { \"name\", \"addresses\": [text], \"resolvers\": [agent], \"user_defined\" }

JSON of a letter:
  { \"envelope\": { \"base\": parameters, \"extensions\": [parameters], oldest first },
    \"effective\": parameters, the newest value of each,
    \"message\" as above, or \"payload_base64\" if the payload is not a valid message }
  parameters: { \"to\", \"from\", \"comments\", \"acl_representation\", \"payload_length\",
                \"payload_encoding\", \"date\", \"intended_receivers\", \"received\",
                \"transport_behaviour\", \"user_defined\" }

Keys without a value are omitted. Times are in UTC, with milliseconds.

JSON with --explain:
  { \"length\": number of bytes,
    \"spans\": [ { \"offset\", \"length\", \"depth\", \"meaning\" } ], in order, without gaps,
    \"error\": { \"offset\", \"problem\", \"clause\" }, if there is one }")]
pub(crate) struct Arguments {
    /// File to read; - for standard input
    #[arg(default_value = "-")]
    file: PathBuf,

    /// Read hexadecimal digits; white space, commas, colons and 0x between bytes are ignored
    #[arg(long)]
    hex: bool,

    /// Print the JSON on one line
    #[arg(long)]
    compact: bool,

    /// Print the bytes with their meaning
    #[arg(long, conflicts_with = "compact")]
    explain: bool,

    /// Print JSON with --explain, too
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: Arguments, _: &Global) -> Result<(), Failure> {
    let Arguments {
        file,
        hex,
        compact,
        explain,
        json,
    } = arguments;
    // A byte usually takes three characters.
    let mut bytes = input::read(&file, if hex { 3 * MAX_MESSAGE } else { MAX_MESSAGE })?;
    if hex {
        bytes = from_hex(&bytes, &file)?;
    }
    if let Some(problem) = unlike_any_message(&bytes) {
        return Err(Failure::failed(
            problem,
            input::name(&file),
            "give one complete message or letter as a file or on standard input; bytes in hexadecimal \
             digits need --hex",
        ));
    }
    if explain {
        return explained::print(&bytes, json, &file);
    }
    let decoded = if is_letter(&bytes) {
        letter(bytes, &file)
    } else {
        message(bytes)
    };
    let json = decoded.map_err(|error| malformed(&error, &file))?;
    if compact {
        output::json_line(&json)
    } else {
        output::json(&json)
    }
}

/// The problem of an input that is clearly no message and no letter.
fn unlike_any_message(bytes: &[u8]) -> Option<String> {
    let Some(first) = bytes.first() else {
        return Some("the input is empty: there is no message to decode".to_owned());
    };
    let is_envelope = matches!(first, 0xfd | 0xfe);
    if is_envelope || Representation::detect(bytes).is_some() {
        return None;
    }
    Some(format!(
        "the input is no message: it begins with the byte {first:#04x}; a bit-efficient message begins \
         with 0xfa, 0xfb or 0xfc, a bit-efficient letter with 0xfe or 0xfd, a message as text with ( and \
         XML with <"
    ))
}

/// Whether the input begins with an envelope: with a base (`FE`) or an extension (`FD`), FIPA00088
/// BaseEnvelopeHeader and ExtEnvelopeHeader, or with an `envelope` element in XML. Other input is
/// decoded as a message, whose error describes what is wrong.
fn is_letter(bytes: &[u8]) -> bool {
    matches!(bytes.first(), Some(0xfd | 0xfe)) || is_xml_envelope(bytes)
}

fn is_xml_envelope(bytes: &[u8]) -> bool {
    if Representation::detect(bytes) != Some(Representation::Xml) {
        return false;
    }
    // Declarations and comments before the first element begin with <? or <!.
    let mut tags = bytes.split(|&byte| byte == b'<').skip(1);
    let element = tags.find(|tag| !matches!(tag.first(), Some(b'?' | b'!')));
    let name = element.and_then(|element| element.get(..b"envelope".len()));
    name.is_some_and(|name| name.eq_ignore_ascii_case(b"envelope"))
}

fn message(bytes: Vec<u8>) -> Result<Value, DecodeError> {
    let payload = Payload {
        head: bytes.into(),
        ..Payload::default()
    };
    let message = Message::decode(&payload)?;
    Ok(json!({ "message": message_to_json(&message) }))
}

fn letter(bytes: Vec<u8>, file: &Path) -> Result<Value, DecodeError> {
    let (envelope, letter) = Letter::decode(bytes.into())?;
    let payload = letter.payload();
    let json = letter_to_json(&envelope, payload);
    if json.get("message").is_none() && !payload.is_empty() {
        let why = match Message::decode(payload) {
            Ok(_) => String::new(),
            Err(error) => format!(": {error}"),
        };
        report::warn(&format!(
            "{}: the payload after the {}-byte envelope is not a valid message{why}",
            input::name(file),
            letter.envelope_len()
        ));
    }
    Ok(json)
}

fn malformed(error: &DecodeError, file: &Path) -> Failure {
    Failure::failed(
        format!("{} ({})", error.problem(), error.clause()),
        format!("{}, byte {}", input::name(file), error.offset()),
        "check that the input is one complete message or letter, and whether --hex is missing; \
         --explain shows the bytes before the error",
    )
}

/// Parses hexadecimal digits.
fn from_hex(text: &[u8], file: &Path) -> Result<Vec<u8>, Failure> {
    let invalid = |problem: String, at: usize| {
        Failure::failed(
            problem,
            format!("{}, character {}", input::name(file), at + 1),
            "give two hexadecimal digits for each byte, or omit --hex",
        )
    };
    let mut bytes = Vec::with_capacity(text.len() / 2);
    let mut high: Option<u8> = None;
    for (at, &byte) in text.iter().enumerate() {
        let digit = match byte {
            b'0'..=b'9' => byte - b'0',
            b'a'..=b'f' => byte - b'a' + 10,
            b'A'..=b'F' => byte - b'A' + 10,
            b':' | b',' if high.is_none() => continue,
            // The prefix 0x of a byte: its zero is not a digit of the byte.
            b'x' | b'X' if high == Some(0) => {
                high = None;
                continue;
            }
            _ if byte.is_ascii_whitespace() && high.is_none() => continue,
            _ => {
                let found = char::from(byte);
                return Err(invalid(
                    format!("expected a hexadecimal digit, not {found:?}"),
                    at,
                ));
            }
        };
        match high.take() {
            None => high = Some(digit),
            Some(high) => bytes.push(high << 4 | digit),
        }
    }
    match high {
        None => Ok(bytes),
        Some(_) => Err(invalid(
            "the last byte has only one digit".to_owned(),
            text.len(),
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hexadecimal_text_is_read_in_the_usual_forms() {
        let expected = vec![0xfa, 0x00, 0x0b];
        for text in [
            "fa000b",
            "FA 00 0B\n",
            "fa:00:0b",
            "0xfa, 0x00, 0x0b",
            " fa00 0b ",
        ] {
            let bytes = from_hex(text.as_bytes(), Path::new("-"));
            assert_eq!(bytes.ok(), Some(expected.clone()), "{text:?}");
        }
        for text in ["f", "fa 0", "f a", "fg", "1x00", "fa-00"] {
            let bytes = from_hex(text.as_bytes(), Path::new("-"));
            assert!(bytes.is_err(), "{text:?}");
        }
    }
}
