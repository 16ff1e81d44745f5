//! `fipa encode`: JSON as bytes.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use fipa::{Envelope, Message};
use fipa_acl::json::{Document, JsonError, document_from_json};
use fipa_acl::{AclRepresentation, Dialect, EncodeError, Representation};
use serde_json::Value;

use crate::options::Global;
use crate::report::Failure;
use crate::{input, output};

/// Write a message or a letter as bytes, given as JSON
///
/// Reads the JSON that `fipa decode` prints: a message, or a letter, which is an envelope with a
/// message behind it, and writes it to standard output in the encoding asked for.
///
/// In a letter, the envelope says how the message is encoded (`acl_representation`); left out, it
/// is put in, as --representation says. A `payload_length` becomes the length of the encoded
/// message. `effective` follows from the envelope and is passed over.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa encode message.json > message.be
  fipa decode letter.bin | jq '.message.content = \"hi\"' | fipa encode > other.bin
  echo '{ \"performative\": \"request\", \"content\": \"lift\" }' | fipa encode --hex
  fipa encode message.json --representation string --dialect jade
  fipa encode letter.json --envelope xml --dialect fipa-services > letter.xml

JSON of a message, with or without { \"message\": … } around it:
  { \"performative\", \"sender\": agent, \"receivers\": [agent], \"reply_to\": [agent],
    \"content\" (text) or \"content_base64\", \"language\", \"encoding\", \"ontology\", \"protocol\",
    \"conversation_id\", \"reply_with\", \"in_reply_to\", \"reply_by\", \"user_defined\": { name: text } }
  agent: { \"name\", \"addresses\": [text], \"resolvers\": [agent], \"user_defined\" }

JSON of a letter:
  { \"envelope\": { \"base\": parameters, \"extensions\": [parameters], oldest first },
    \"message\" as above, or \"payload_base64\", or neither for an envelope alone }
  parameters: { \"to\", \"from\", \"comments\", \"acl_representation\", \"payload_length\",
                \"payload_encoding\", \"date\", \"intended_receivers\", \"received\",
                \"transport_behaviour\", \"user_defined\" }

Only \"performative\" has to be there; in bit-efficient letters also \"date\" in the base, and
\"received\" in every extension. Times are RFC 3339, or relative as in +00000000T000030000 (30 s).")]
pub(crate) struct Arguments {
    /// The file to read; - for standard input
    #[arg(default_value = "-")]
    file: PathBuf,

    /// Print hexadecimal digits, which `fipa decode --hex` reads
    #[arg(long)]
    hex: bool,

    /// The encoding of the message [default: what the envelope says, else bit-efficient]
    #[arg(long, value_enum, value_name = "ENCODING")]
    representation: Option<MessageEncoding>,

    /// The encoding of the envelope
    #[arg(
        long,
        value_enum,
        value_name = "ENCODING",
        default_value = "bit-efficient"
    )]
    envelope: EnvelopeEncoding,

    /// Whose reader it is for
    #[arg(long, value_enum, default_value = "standard")]
    dialect: Reader,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum MessageEncoding {
    /// FIPA00069
    BitEfficient,
    /// FIPA00070
    String,
    /// FIPA00071
    Xml,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum EnvelopeEncoding {
    /// FIPA00088
    BitEfficient,
    /// FIPA00085
    Xml,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Reader {
    /// The standards to the letter
    Standard,
    /// The C++ libraries fipa_acl and fipa_services
    FipaServices,
    /// JADE
    Jade,
}

impl From<MessageEncoding> for Representation {
    fn from(encoding: MessageEncoding) -> Self {
        match encoding {
            MessageEncoding::BitEfficient => Self::BitEfficient,
            MessageEncoding::String => Self::String,
            MessageEncoding::Xml => Self::Xml,
        }
    }
}

impl From<EnvelopeEncoding> for Representation {
    fn from(encoding: EnvelopeEncoding) -> Self {
        match encoding {
            EnvelopeEncoding::BitEfficient => Self::BitEfficient,
            EnvelopeEncoding::Xml => Self::Xml,
        }
    }
}

impl From<Reader> for Dialect {
    fn from(reader: Reader) -> Self {
        match reader {
            Reader::Standard => Self::Standard,
            Reader::FipaServices => Self::FipaServices,
            Reader::Jade => Self::Jade,
        }
    }
}

/// The largest content as base64, and ample room for what stands around it.
const MOST: u64 = Message::MAX_CONTENT / 3 * 4 + (1 << 20);

pub(crate) fn run(arguments: Arguments, _: &Global) -> Result<(), Failure> {
    let file = &arguments.file;
    let text = input::read(file, MOST)?;
    let json: Value = serde_json::from_slice(&text).map_err(|error| no_json(&error, file))?;
    let document = document_from_json(&json).map_err(|error| misdescribed(&error, file))?;
    let bytes = encoded(document, &arguments)?;
    if arguments.hex {
        output::text(&hexadecimal(&bytes))
    } else {
        output::bytes(&bytes)
    }
}

fn encoded(document: Document, arguments: &Arguments) -> Result<Vec<u8>, Failure> {
    let Arguments { file, dialect, .. } = arguments;
    let dialect = Dialect::from(*dialect);
    let refused = |error: EncodeError| unwritable(&error, file);
    let asked = arguments.representation.map(Representation::from);
    let (envelope, payload) = match document {
        Document::Message(message) => {
            let representation = asked.unwrap_or(Representation::BitEfficient);
            let bytes = message.encode(representation, dialect).map_err(refused)?;
            return Ok(bytes.into());
        }
        Document::Letter(mut envelope, message) => {
            let representation = agreed(&mut envelope, asked, file)?;
            let payload = message.encode(representation, dialect).map_err(refused)?;
            set_payload_length(&mut envelope, payload.len() as u64);
            (envelope, payload)
        }
        Document::EncodedLetter(_, _) if asked.is_some() => {
            return Err(Failure::wrong_usage(
                "there is no message to encode: the letter has an encoded payload, or none",
                input::name(file),
                "leave out --representation, or give the message instead of payload_base64",
            ));
        }
        Document::EncodedLetter(envelope, payload) => (envelope, payload.into()),
    };
    let encoded = envelope.encode(arguments.envelope.into(), dialect);
    Ok([encoded.map_err(refused)?, payload].concat())
}

/// How the message of a letter is to be encoded: as its envelope says, which has to say it and
/// must not say anything else than asked for.
fn agreed(
    envelope: &mut Envelope,
    asked: Option<Representation>,
    file: &Path,
) -> Result<Representation, Failure> {
    let Some(said) = envelope.effective().acl_representation else {
        let used = asked.unwrap_or(Representation::BitEfficient);
        envelope.base.acl_representation = Some(used.into());
        return Ok(used);
    };
    let known = [
        Representation::BitEfficient,
        Representation::String,
        Representation::Xml,
    ];
    let known = known
        .into_iter()
        .find(|known| said == AclRepresentation::from(*known));
    match (known, asked) {
        (Some(known), None) => Ok(known),
        (Some(known), Some(asked)) if known == asked => Ok(known),
        (_, Some(asked)) => Err(Failure::wrong_usage(
            format!("the envelope says that the message is {said}, which is not {asked}"),
            format!("{}, envelope: acl_representation", input::name(file)),
            "leave out --representation, or acl_representation",
        )),
        (None, None) => Err(Failure::failed(
            format!("messages cannot be encoded as {said}"),
            format!("{}, envelope: acl_representation", input::name(file)),
            "leave it out, or give payload_base64 instead of the message",
        )),
    }
}

/// Where an envelope says a length it says the right one.
fn set_payload_length(envelope: &mut Envelope, len: u64) {
    let parts = envelope.extensions.iter_mut().chain([&mut envelope.base]);
    for said in parts.filter_map(|part| part.payload_length.as_mut()) {
        *said = len;
    }
}

/// Sixteen bytes a line.
fn hexadecimal(bytes: &[u8]) -> String {
    let line = |bytes: &[u8]| {
        let digits: Vec<String> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        digits.join(" ") + "\n"
    };
    bytes.chunks(16).map(line).collect()
}

fn no_json(error: &serde_json::Error, file: &Path) -> Failure {
    let (line, column) = (error.line(), error.column());
    // The place is told apart from what is wrong.
    let what = error.to_string();
    let what = what.strip_suffix(&format!(" at line {line} column {column}"));
    Failure::failed(
        format!(
            "not JSON: {}",
            what.map_or_else(|| error.to_string(), str::to_owned)
        ),
        format!("{}, line {line}, column {column}", input::name(file)),
        "give one JSON document, such as `fipa decode` prints",
    )
}

fn misdescribed(error: &JsonError, file: &Path) -> Failure {
    let place = match error.path() {
        "" => input::name(file),
        path => format!("{}, {path}", input::name(file)),
    };
    Failure::failed(
        error.problem().to_string(),
        place,
        "see `fipa encode --help` for what a message and a letter consist of",
    )
}

fn unwritable(error: &EncodeError, file: &Path) -> Failure {
    Failure::failed(
        error.to_string(),
        input::name(file),
        "change it, or choose another encoding (--representation, --envelope) or --dialect",
    )
}
