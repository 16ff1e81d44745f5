//! `fipa encode`: encodes JSON as bytes.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use fipa::Envelope;
use fipa_acl::json::{Document, JsonError, document_from_json};
use fipa_acl::{AclRepresentation, Dialect, EncodeError, Representation};
use serde_json::Value;

use crate::input::MAX_MESSAGE;
use crate::options::Global;
use crate::report::{self, Failure};
use crate::{input, output};

/// Encode a message or a letter from JSON
///
/// Reads JSON in the format of `fipa decode`: a message, or a letter (an envelope with a message).
/// Writes the encoded bytes to standard output.
///
/// The `acl_representation` of an envelope sets the encoding of the message. If the envelope has
/// none, it is set from --representation. A `payload_length` is set to the length of the encoded
/// message. `effective` is ignored, because it follows from the envelope.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa encode message.json > message.be
  fipa decode letter.bin | jq '.message.content = \"hi\"' | fipa encode > other.bin
  echo '{ \"performative\": \"request\", \"content\": \"lift\" }' | fipa encode --hex
  fipa encode message.json --representation string --dialect jade
  fipa encode letter.json --envelope xml --dialect fipa-services > letter.xml

JSON of a message, optionally within { \"message\": … }:
  { \"performative\", \"sender\": agent, \"receivers\": [agent], \"reply_to\": [agent],
    \"content\" (text) or \"content_base64\", \"language\", \"encoding\", \"ontology\", \"protocol\",
    \"conversation_id\", \"reply_with\", \"in_reply_to\", \"reply_by\", \"user_defined\": { name: text } }
  agent: { \"name\", \"addresses\": [text], \"resolvers\": [agent], \"user_defined\" }

JSON of a letter:
  { \"envelope\": { \"base\": parameters, \"extensions\": [parameters], oldest first },
    \"message\" as above, or \"payload_base64\"; without both, the letter has an envelope only }
  parameters: { \"to\", \"from\", \"comments\", \"acl_representation\", \"payload_length\",
                \"payload_encoding\", \"date\", \"intended_receivers\", \"received\",
                \"transport_behaviour\", \"user_defined\" }

Only \"performative\" is required; a bit-efficient letter also needs \"date\" in the base, and
\"received\" in every extension. Times are RFC 3339, or relative as in +00000000T000030000 (30 s).")]
pub(crate) struct Arguments {
    /// File to read; - for standard input
    #[arg(default_value = "-")]
    file: PathBuf,

    /// Print hexadecimal digits, which `fipa decode --hex` reads
    #[arg(long)]
    hex: bool,

    /// Encoding of the message [default: acl_representation of the envelope, else bit-efficient]
    #[arg(long, value_enum, value_name = "ENCODING")]
    representation: Option<MessageEncoding>,

    /// Encoding of the envelope
    #[arg(
        long,
        value_enum,
        value_name = "ENCODING",
        default_value = "bit-efficient"
    )]
    envelope: EnvelopeEncoding,

    /// Dialect of the target implementation
    #[arg(long, value_enum, default_value = "standard")]
    dialect: Target,
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
enum Target {
    /// Strictly as in the FIPA standards
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

impl From<Target> for Dialect {
    fn from(target: Target) -> Self {
        match target {
            Target::Standard => Self::Standard,
            Target::FipaServices => Self::FipaServices,
            Target::Jade => Self::Jade,
        }
    }
}

const HELP_JSON: &str = "give one JSON document in the format of `fipa decode`, for example \
    { \"performative\": \"request\", \"content\": \"lift\" }";

/// Maximum input, in bytes: a message whose content is in base64.
const MAX_INPUT: u64 = MAX_MESSAGE / 3 * 4;

pub(crate) fn run(arguments: Arguments, _: &Global) -> Result<(), Failure> {
    let file = &arguments.file;
    let text = input::read(file, MAX_INPUT)?;
    input::check_not_empty(&text, file, HELP_JSON)?;
    let json: Value = serde_json::from_slice(&text).map_err(|error| invalid_json(&error, file))?;
    let document = document_from_json(&json).map_err(|error| invalid_document(&error, file))?;
    match &document {
        Document::Message(message) | Document::Letter(_, message) => {
            report::warn_of_performatives([message.performative()]);
        }
        Document::EncodedLetter(_, _) => {}
    }
    let bytes = encoded(document, &arguments)?;
    if arguments.hex {
        output::text(&hexadecimal(&bytes))
    } else {
        output::converted(&bytes)
    }
}

fn encoded(document: Document, arguments: &Arguments) -> Result<Vec<u8>, Failure> {
    let Arguments { file, dialect, .. } = arguments;
    let dialect = Dialect::from(*dialect);
    let refused = |error: EncodeError| not_encodable(&error, file);
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
                "--representation has no effect: the letter has no `message` to encode",
                input::name(file),
                "omit --representation, or give `message` instead of `payload_base64`",
            ));
        }
        Document::EncodedLetter(envelope, payload) => (envelope, payload.into()),
    };
    let encoded = envelope.encode(arguments.envelope.into(), dialect);
    Ok([encoded.map_err(refused)?, payload].concat())
}

/// The encoding of a letter's message. An envelope without `acl_representation` gets the requested
/// one; an envelope with a different one is an error.
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
            format!("the envelope has acl_representation {said}, but --representation is {asked}"),
            format!("{}, envelope: acl_representation", input::name(file)),
            "omit --representation or acl_representation",
        )),
        (None, None) => Err(Failure::failed(
            format!("cannot encode a message as {said}: not a supported encoding"),
            format!("{}, envelope: acl_representation", input::name(file)),
            "omit acl_representation, or give `payload_base64` instead of `message`",
        )),
    }
}

/// Corrects the payload lengths in an envelope that has them.
fn set_payload_length(envelope: &mut Envelope, len: u64) {
    let parts = envelope.extensions.iter_mut().chain([&mut envelope.base]);
    for payload_length in parts.filter_map(|part| part.payload_length.as_mut()) {
        *payload_length = len;
    }
}

/// Hexadecimal digits, sixteen bytes per line.
fn hexadecimal(bytes: &[u8]) -> String {
    let line = |bytes: &[u8]| {
        let digits: Vec<String> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        digits.join(" ") + "\n"
    };
    bytes.chunks(16).map(line).collect()
}

fn invalid_json(error: &serde_json::Error, file: &Path) -> Failure {
    let (line, column) = (error.line(), error.column());
    // The report has the position on a line of its own.
    let problem = error.to_string();
    let problem = problem.strip_suffix(&format!(" at line {line} column {column}"));
    Failure::failed(
        format!(
            "the input is not JSON: {}",
            problem.map_or_else(|| error.to_string(), str::to_owned)
        ),
        format!("{}, line {line}, column {column}", input::name(file)),
        HELP_JSON,
    )
}

fn invalid_document(error: &JsonError, file: &Path) -> Failure {
    let place = match error.path() {
        "" => input::name(file),
        path => format!("{}, {path}", input::name(file)),
    };
    Failure::failed(
        error.problem().to_string(),
        place,
        "`fipa encode --help` lists the fields of messages and letters",
    )
}

fn not_encodable(error: &EncodeError, file: &Path) -> Failure {
    Failure::failed(
        error.to_string(),
        input::name(file),
        "change the input, or choose another encoding (--representation, --envelope) or --dialect",
    )
}
