//! Repeats two figures of the paper on the C++ libraries `fipa_acl` and `fipa_services`: the lengths of
//! encoded messages with one byte of content and 99 bytes in all other fields (its figure 7), and the
//! times of 1,000 cycles of encoding and decoding, for messages and for all pairs of envelope and
//! message (its figure 9). The published figures stand beside them. They were measured on another
//! machine, so no ratio is given.

use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

use fipa::{AgentId, Envelope, EnvelopeParams, Letter, Message, Payload, Performative, Time};
use fipa_acl::{AclRepresentation, Dialect, Representation};
use fipa_drawing::{Bar, Bars, Group};
use serde::Serialize;

use super::machine::Machine;
use super::report;
use crate::error::BenchError;

/// Cycles for one figure, as in the paper.
const CYCLES: usize = 1000;
/// Cycles for one figure in a quick measurement.
const QUICK_CYCLES: usize = 20;
/// Cycles before the measurement, which do not count.
const WARMING: usize = 20;
/// Cycles after which other tasks run, so that a signal is handled.
const BREATH: usize = 10;
/// Number of figures: messages without and in each envelope, at every size.
const STEPS: usize = MESSAGES.len() * (1 + ENVELOPES.len()) * SIZES.len();
/// Length of all other fields of the message together, in bytes.
const HEADER: usize = 99;

const MESSAGES: [Representation; 3] = [
    Representation::BitEfficient,
    Representation::String,
    Representation::Xml,
];
const ENVELOPES: [Representation; 2] = [Representation::BitEfficient, Representation::Xml];
const SIZES: [usize; 3] = [1, 1 << 10, 1 << 20];

/// The repeated evaluation: encoded lengths, and times of encoding and decoding.
///
/// Serialized as one object: `machine`, `cycles`, `sizes` and `times`, with times in microseconds.
#[derive(Debug, Serialize)]
pub struct Paper {
    pub(super) machine: Machine,
    /// Cycles of encoding and decoding for every figure.
    pub(super) cycles: usize,
    /// Figure 7.
    pub(super) sizes: Vec<Size>,
    /// Figure 9.
    pub(super) times: Vec<Times>,
}

/// Encoded length of a message or a letter, in bytes.
#[derive(Debug, Serialize)]
pub(super) struct Size {
    pub(super) message: &'static str,
    pub(super) envelope: Option<&'static str>,
    pub(super) bytes: usize,
    /// Length of the C++ library, measured elsewhere.
    pub(super) cpp_bytes: Option<usize>,
}

/// Times of encoding and decoding.
#[derive(Debug, Serialize)]
pub(super) struct Times {
    pub(super) message: &'static str,
    pub(super) envelope: Option<&'static str>,
    pub(super) content: usize,
    pub(super) encode_us: Spread,
    pub(super) decode_us: Spread,
    /// Times of the C++ library, measured elsewhere: encoding and decoding.
    pub(super) cpp_us: Option<[f64; 2]>,
}

#[derive(Debug, Clone, Copy, Serialize)]
pub(super) struct Spread {
    pub(super) mean: f64,
    pub(super) deviation: f64,
}

/// Sizes of the C++ library, measured elsewhere.
fn cpp_bytes(message: Representation, envelope: Option<Representation>) -> Option<usize> {
    use Representation::{BitEfficient, String, Xml};
    match (message, envelope) {
        (BitEfficient, None) => Some(162),
        (String, None) => Some(330),
        (Xml, None) => Some(624),
        (BitEfficient, Some(BitEfficient)) => Some(242),
        (BitEfficient, Some(Xml)) => Some(647),
        _ => None,
    }
}

/// Times of the C++ library in microseconds, measured elsewhere: encoding and decoding. They are
/// for messages and for the envelope around an encoded bit-efficient message; a letter needs both.
fn cpp_us(
    message: Representation,
    envelope: Option<Representation>,
    content: usize,
) -> Option<[f64; 2]> {
    use Representation::{BitEfficient, String, Xml};
    let at = SIZES.iter().position(|size| *size == content)?;
    let of_message = match message {
        BitEfficient => [[3.3, 74.0], [5.6, 67.0], [210.0, 4200.0]],
        String => [[5.2, 273.0], [5.5, 267.0], [490.0, 3600.0]],
        Xml => [[5.7, 13.0], [6.0, 22.0], [400.0, 9200.0]],
        _ => return None,
    };
    let of_envelope = match (message, envelope) {
        (_, None) => [[0.0, 0.0]; 3],
        (BitEfficient, Some(BitEfficient)) => [[3.4, 31.0], [3.0, 32.0], [61.0, 1770.0]],
        (BitEfficient, Some(Xml)) => [[4.9, 12.0], [5.0, 12.0], [74.0, 900.0]],
        _ => return None,
    };
    let ([encode, decode], [around, off]) = (of_message.get(at)?, of_envelope.get(at)?);
    Some([encode + around, decode + off])
}

/// A message with all fields; those beside the content have [`HEADER`] bytes together.
fn a_message(content: usize) -> Result<Message, String> {
    let agent = |name: &str| AgentId::new(name).map_err(|error| error.to_string());
    let texts = [
        "sender_01",
        "receiver_1",
        "reply_to_1",
        "language_1",
        "encoding_1",
        "ontology_1",
        "protocol_1",
        "conversat1",
        "replywith1",
        "inreplyto1",
    ];
    let [
        sender,
        receiver,
        reply_to,
        language,
        encoding,
        ontology,
        protocol,
        conversation,
        with,
        to,
    ] = texts;
    debug_assert_eq!(texts.iter().map(|text| text.len()).sum::<usize>(), HEADER);
    Message::builder(Performative::Inform)
        .sender(agent(sender)?)
        .receiver(agent(receiver)?)
        .reply_to(agent(reply_to)?)
        .language(language)
        .encoding(encoding)
        .ontology(ontology)
        .protocol(protocol)
        .conversation_id(conversation)
        .reply_with(with)
        .in_reply_to(to)
        .content(vec![b'a'; content])
        .build()
        .map_err(|error| error.to_string())
}

/// The encoded message, or the letter with it.
fn encode(
    message: &Message,
    representation: Representation,
    envelope: Option<Representation>,
) -> Result<Vec<u8>, String> {
    let failed = |error: fipa_acl::EncodeError| error.to_string();
    let payload = message.encode(representation, Dialect::Standard);
    let payload = payload.map_err(failed)?;
    let Some(wanted) = envelope else {
        return Ok(payload.into());
    };
    let date = Time::from_system_time(std::time::SystemTime::now());
    let base = EnvelopeParams {
        to: message.receivers().to_vec(),
        from: message.sender().cloned(),
        acl_representation: Some(AclRepresentation::from(name_in_envelope(representation))),
        payload_length: Some(payload.len() as u64),
        date: Some(date.map_err(|error| error.to_string())?),
        intended_receivers: message.receivers().to_vec(),
        ..EnvelopeParams::default()
    };
    let envelope = Envelope {
        base,
        extensions: Vec::new(),
    };
    let mut letter = Vec::from(envelope.encode(wanted, Dialect::Standard).map_err(failed)?);
    letter.extend_from_slice(&payload);
    Ok(letter)
}

fn decode(bytes: &bytes::Bytes, has_envelope: bool) -> Result<(), String> {
    let payload = if has_envelope {
        let decoded = Letter::decode(bytes.clone());
        let (envelope, letter) = decoded.map_err(|error| error.to_string())?;
        black_box(envelope);
        letter.payload().clone()
    } else {
        Payload::from(bytes.clone())
    };
    let message = Message::decode(&payload).map_err(|error| error.to_string())?;
    black_box(message);
    Ok(())
}

async fn times(
    representation: Representation,
    envelope: Option<Representation>,
    content: usize,
    cycles: usize,
) -> Result<Times, String> {
    let message = a_message(content)?;
    let bytes = bytes::Bytes::from(encode(&message, representation, envelope)?);
    let mut encoding = Vec::with_capacity(cycles);
    let mut decoding = Vec::with_capacity(cycles);
    for cycle in 0..WARMING + cycles {
        if cycle.is_multiple_of(BREATH) {
            tokio::task::yield_now().await;
        }
        let began = Instant::now();
        black_box(encode(black_box(&message), representation, envelope)?);
        let encoded = began.elapsed();
        let began = Instant::now();
        decode(black_box(&bytes), envelope.is_some())?;
        let decoded = began.elapsed();
        if cycle >= WARMING {
            encoding.push(encoded.as_secs_f64() * 1e6);
            decoding.push(decoded.as_secs_f64() * 1e6);
        }
    }
    Ok(Times {
        message: name(representation),
        envelope: envelope.map(name),
        content,
        encode_us: spread(&encoding),
        decode_us: spread(&decoding),
        cpp_us: cpp_us(representation, envelope, content),
    })
}

fn spread(values: &[f64]) -> Spread {
    let many = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / many;
    let squares = values.iter().map(|value| (value - mean).powi(2));
    Spread {
        mean,
        deviation: (squares.sum::<f64>() / many).sqrt(),
    }
}

fn name(representation: Representation) -> &'static str {
    match representation {
        Representation::BitEfficient => "bit-efficient",
        Representation::String => "string",
        Representation::Xml => "XML",
        _ => "other",
    }
}

fn name_in_envelope(representation: Representation) -> &'static str {
    match representation {
        Representation::String => "fipa.acl.rep.string.std",
        Representation::Xml => "fipa.acl.rep.xml.std",
        _ => "fipa.acl.rep.bitefficient.std",
    }
}

impl Paper {
    /// Number of steps that a measurement reports.
    pub const STEPS: usize = STEPS;

    /// Cycles of each figure in the paper.
    pub const CYCLES: usize = CYCLES;

    /// Cycles of each figure in a measurement of a few seconds.
    pub const QUICK_CYCLES: usize = QUICK_CYCLES;

    /// Measures all encodings. `progress` is called with the name of each step as it begins.
    ///
    /// # Errors
    ///
    /// [`BenchError::Encoding`] if a message cannot be encoded or decoded.
    pub async fn measure(
        machine: Machine,
        cycles: usize,
        progress: impl Fn(&str),
    ) -> Result<Self, BenchError> {
        let mut paper = Self {
            machine,
            cycles,
            sizes: Vec::new(),
            times: Vec::new(),
        };
        let measured = paper.measure_all(&progress).await;
        measured.map_err(BenchError::Encoding)?;
        Ok(paper)
    }

    async fn measure_all(&mut self, progress: &impl Fn(&str)) -> Result<(), String> {
        let envelopes = [None].into_iter().chain(ENVELOPES.map(Some));
        for envelope in envelopes {
            for message in MESSAGES {
                let bytes = encode(&a_message(1)?, message, envelope)?.len();
                self.sizes.push(Size {
                    message: name(message),
                    envelope: envelope.map(name),
                    bytes,
                    cpp_bytes: cpp_bytes(message, envelope),
                });
                for content in SIZES {
                    let what = label(name(message), envelope.map(name));
                    progress(&format!("{what}, {}", report::size(content)));
                    let times = times(message, envelope, content, self.cycles).await?;
                    self.times.push(times);
                }
            }
        }
        Ok(())
    }

    /// Writes `paper.md`, `paper-sizes.svg` and `paper-times.svg` into a directory.
    ///
    /// # Errors
    ///
    /// If a file cannot be written.
    pub fn write(&self, directory: &Path) -> Result<(), BenchError> {
        let write = |name: &str, text: String| {
            let path = directory.join(name);
            let written = std::fs::write(&path, text);
            written.map_err(|source| BenchError::Write { path, source })
        };
        write("paper.md", self.to_text())?;
        write("paper-sizes.svg", self.picture_of_sizes())?;
        write("paper-times.svg", self.picture_of_times())
    }

    /// The tables, in Markdown.
    pub fn to_text(&self) -> String {
        let mut text = format!(
            "# Repetition of the paper's evaluation\n\n\
             Written by `fipa bench paper` on {}; {:.0} % of the CPU time used by other processes before.\n\
             The columns *C++* have `fipa_acl` and `fipa_services`, **measured elsewhere** (two shared \
             cores, -O3,\nanother machine at another time). They are for orientation; do not compute \
             ratios from them.\n\n\
             ## Encoded length (figure 7)\n\n\
             1 byte of content and {HEADER} bytes in ten other fields, in the standard's dialect.\n\n\
             ![lengths](paper-sizes.svg)\n\n\
             | envelope | message | bytes | overhead | C++, measured elsewhere |\n|---|---|---|---|---|\n",
            self.machine,
            self.machine.busy * 100.0,
        );
        for size in &self.sizes {
            let cpp = size.cpp_bytes.map(|bytes| bytes.to_string());
            text.push_str(&format!(
                "| {} | {} | {} | {} | {} |\n",
                size.envelope.unwrap_or(""),
                size.message,
                size.bytes,
                size.bytes - HEADER - 1,
                cpp.unwrap_or_default(),
            ));
        }
        text.push_str(&format!(
            "\n## Time of encoding and decoding (figure 9)\n\n\
             {} cycles, mean ± standard deviation in microseconds. Encoding returns one buffer with a \
             copy of the\ncontent. Decoding returns owned values; where the encoding allows it, the \
             content shares the input buffer.\nA letter is encoded and decoded with its envelope and \
             its message. The C++ figures of a letter are the\nsums of those of the message and of the \
             envelope.\n\n\
             ![times](paper-times.svg)\n\n\
             | envelope | message | content | encode | decode | C++ encode | C++ decode |\n\
             |---|---|---|---|---|---|---|\n",
            self.cycles
        ));
        for times in &self.times {
            let shown = |spread: Spread| format!("{:.2} ± {:.2}", spread.mean, spread.deviation);
            let [encode, decode] = times.cpp_us.map_or([String::new(), String::new()], |both| {
                both.map(|time| format!("{time:.1}"))
            });
            text.push_str(&format!(
                "| {} | {} | {} | {} | {} | {encode} | {decode} |\n",
                times.envelope.unwrap_or(""),
                times.message,
                report::size(times.content),
                shown(times.encode_us),
                shown(times.decode_us),
            ));
        }
        text
    }

    fn picture_of_sizes(&self) -> String {
        let groups = self.sizes.iter().map(|size| Group {
            name: label(size.message, size.envelope),
            bars: vec![Bar {
                series: 0,
                value: size.bytes as f64,
                deviation: 0.0,
                mark: size.cpp_bytes.map(|bytes| bytes as f64),
            }],
        });
        let bars = Bars {
            title: "Encoded length: 1 byte of content, 99 bytes in all other fields".to_owned(),
            series: vec!["this library".to_owned()],
            mark: "C++, measured elsewhere".to_owned(),
            groups: groups.collect(),
            unit: |bytes| format!("{bytes:.0} B"),
            logarithmic: false,
        };
        bars.svg()
    }

    fn picture_of_times(&self) -> String {
        let shown = self.times.iter().filter(|times| times.content > 1);
        let groups = shown.map(|times| {
            let bar = |series, spread: Spread, mark: Option<f64>| Bar {
                series,
                value: spread.mean,
                deviation: spread.deviation,
                mark,
            };
            let [encode, decode] = times.cpp_us.map_or([None, None], |both| both.map(Some));
            Group {
                name: format!(
                    "{}, {}",
                    label(times.message, times.envelope),
                    report::size(times.content)
                ),
                bars: vec![
                    bar(0, times.encode_us, encode),
                    bar(1, times.decode_us, decode),
                ],
            }
        });
        let title = format!(
            "Time of encoding and decoding: mean and standard deviation of {} cycles",
            self.cycles
        );
        let bars = Bars {
            title,
            series: vec!["encode".to_owned(), "decode".to_owned()],
            mark: "C++, measured elsewhere".to_owned(),
            groups: groups.collect(),
            unit: super::plot::duration,
            logarithmic: true,
        };
        bars.svg()
    }
}

fn label(message: &str, envelope: Option<&str>) -> String {
    match envelope {
        None => format!("{message} message"),
        Some(envelope) => format!("{message} in {envelope} envelope"),
    }
}
