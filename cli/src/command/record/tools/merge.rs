//! `fipa record merge`: joins the recordings of several hosts.
//!
//! The messages of each file stay in their order. Of a letter that two hosts recorded, the first one in the merged order
//! stays. So no letter comes before one of the same host that caused it, whatever the error of the clocks is.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::fs::File;
use std::path::{Path, PathBuf};

use clap::Args;
use fipa_acl::escape;
use mcap::records::{Channel, MessageHeader, Metadata};

use super::super::file::reader::{FileReader, FileSchema, Item};
use super::super::file::writer::RecordingFile;
use super::super::file::{self, RecordingError, letter};
use super::super::fleet::{CLOCK_AT_START, CLOCK_AT_STOP, Clock};
use super::super::recorder::failed;
use super::{read_file, unreadable};
use crate::report::{self, Failure};
use crate::{input, output};

/// Maximum number of files.
const MAX_FILES: usize = 64;
/// Maximum number of letters whose identifiers are kept to find their repetitions.
const MAX_KNOWN: usize = 1 << 17;
/// Maximum length of the metadata of a file that is copied, in bytes.
const MAX_METADATA: usize = 1 << 20;

/// Name of the metadata record of a merged file.
const MERGED: &str = "fipa.merged";

/// Join the recordings of several hosts in one file
///
/// The times are those of the clock of the first file's host, if `fipa record fleet` has measured the clocks. A difference
/// below the error of its measurement changes nothing. A letter that two hosts recorded is copied once. The channels have
/// the name of their host, and the metadata of a file follow its number, for example 2/fipa.recording.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa record merge run1.crex-mts.mcap run1.rover-mts.mcap -o run1.mcap
  fipa replay run1.mcap --check")]
pub(in crate::command) struct Arguments {
    /// Recordings, at most 64
    #[arg(required = true, num_args = 1..=MAX_FILES)]
    files: Vec<PathBuf>,

    /// File to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

pub(in crate::command::record) fn run(arguments: &Arguments) -> Result<(), Failure> {
    let Arguments { files, output: to } = arguments;
    let abouts: Vec<About> = files
        .iter()
        .map(|it| About::read(it))
        .collect::<Result<_, _>>()?;
    let shifts = shifts(&abouts);
    let unwritable = |error: RecordingError| failed(&error, input::name(to));
    let mut merged = Merged::create(to, &abouts, &shifts).map_err(unwritable)?;
    let sources = files.iter().zip(abouts).zip(shifts);
    let mut sources: Vec<Source> = sources
        .map(|((path, about), shift)| Source::open(path, about.host, shift))
        .collect::<Result<_, _>>()?;
    for (number, source) in sources.iter_mut().enumerate() {
        source.advance(number, &mut merged)?;
    }
    let mut last = 0;
    while let Some(number) = next(&sources, last) {
        last = number;
        let Some(source) = sources.get_mut(number) else {
            break;
        };
        if let Some(message) = source.head.take() {
            merged.add(number, message).map_err(unwritable)?;
        }
        source.advance(number, &mut merged)?;
    }
    let (messages, joined) = merged.finish(files.len()).map_err(unwritable)?;
    output::text(&format!(
        "{messages} messages of {} files merged to {}, {joined} letters of two hosts joined\n",
        files.len(),
        input::name(to)
    ))
}

/// The source with the earliest message; of several, the one of the last message, because the bytes of a letter follow it.
fn next(sources: &[Source], last: usize) -> Option<usize> {
    let heads = sources.iter().enumerate();
    let heads = heads.filter_map(|(number, it)| Some((it.head.as_ref()?.order, number)));
    let first = heads.min_by_key(|(order, number)| (*order, *number != last, *number))?;
    Some(first.1)
}

/// The metadata of a file.
#[derive(Debug, Default)]
struct About {
    metadata: Vec<Metadata>,
    /// Name of the gateway of its host.
    host: String,
    /// The differences of clocks at the start and at the end.
    clocks: [Option<Clock>; 2],
}

impl About {
    fn read(path: &Path) -> Result<Self, Failure> {
        let mut about = Self {
            host: input::name(path),
            ..Self::default()
        };
        let mut bytes = 0;
        read_file(path, |item| {
            let Item::Metadata(metadata) = item else {
                return Ok(());
            };
            let pairs = metadata.metadata.iter();
            let len: usize = pairs.map(|(key, value)| key.len() + value.len() + 64).sum();
            bytes += len + metadata.name.len();
            match metadata.name.as_str() {
                _ if bytes > MAX_METADATA => return Ok(()),
                file::ABOUT => {
                    if let Some(gateway) = metadata.metadata.get("gateway") {
                        about.host.clone_from(gateway);
                    }
                }
                CLOCK_AT_START => about.clocks[0] = Clock::from_metadata(&metadata.metadata),
                CLOCK_AT_STOP => about.clocks[1] = Clock::from_metadata(&metadata.metadata),
                _ => {}
            }
            about.metadata.push(metadata);
            Ok(())
        })?;
        Ok(about)
    }

    fn is_filtered(&self) -> bool {
        self.metadata.iter().any(|it| it.name == file::FILTERED)
    }

    fn domain(&self) -> Option<&str> {
        let about = self.metadata.iter().find(|it| it.name == file::ABOUT);
        about?.metadata.get("domain").map(String::as_str)
    }
}

/// The difference between the clock of a file and that of the first one, at one or two times of the file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
struct Shift(Vec<(i64, i64)>);

/// The difference at one time, and its maximum error.
struct Measured {
    at: i64,
    offset: i64,
    uncertainty: u64,
}

/// Returns the shift of each file. Warns of files without one.
fn shifts(abouts: &[About]) -> Vec<Shift> {
    let Some(first) = abouts.first() else {
        return Vec::new();
    };
    let shift = |about: &About| {
        Shift::between(first, about).unwrap_or_else(|| {
            report::warn(&format!(
                "the clocks of {} and {} were not compared by `fipa record fleet`; the times of both stay",
                escape(&first.host),
                escape(&about.host)
            ));
            Shift::default()
        })
    };
    abouts.iter().map(shift).collect()
}

impl Shift {
    /// `None` if the clocks were not compared.
    fn between(first: &About, other: &About) -> Option<Self> {
        if first.host == other.host {
            return Some(Self::default());
        }
        let clocks = first.clocks.iter().zip(&other.clocks);
        let measured: Vec<Measured> = clocks
            .filter_map(|(of_first, of_other)| {
                measured(first, of_first.as_ref(), other, of_other.as_ref())
            })
            .collect();
        if measured.is_empty() {
            return None;
        }
        // Clocks that may be the same are not changed: the measurement can be worse than they are.
        let is_within = |it: &Measured| it.offset.unsigned_abs() <= it.uncertainty;
        if measured.iter().all(is_within) {
            return Some(Self::default());
        }
        Some(Self(measured.iter().map(|it| (it.at, it.offset)).collect()))
    }

    /// Returns a time by the clock of the first file.
    fn apply(&self, nanos: u64) -> u64 {
        let time = i128::from(nanos);
        let offset = match *self.0.as_slice() {
            [] => 0,
            [(start, before), (end, after), ..] if start < end => {
                let [start, end, before, after] = [start, end, before, after].map(i128::from);
                let passed = time.clamp(start, end) - start;
                before + (after - before).saturating_mul(passed) / (end - start)
            }
            [(_, offset), ..] => i128::from(offset),
        };
        u64::try_from((time - offset).max(0)).unwrap_or(u64::MAX)
    }
}

/// The difference between the clocks of two hosts that were compared with one of a third host, or with each other.
fn measured(
    first: &About,
    of_first: Option<&Clock>,
    other: &About,
    of_other: Option<&Clock>,
) -> Option<Measured> {
    match (of_first, of_other) {
        (Some(a), Some(b)) if a.reference == b.reference => Some(Measured {
            at: b.at,
            offset: b.offset.checked_sub(a.offset)?,
            uncertainty: a.uncertainty.checked_add(b.uncertainty)?,
        }),
        (_, Some(b)) if b.reference == first.host => Some(Measured {
            at: b.at,
            offset: b.offset,
            uncertainty: b.uncertainty,
        }),
        (Some(a), _) if a.reference == other.host => Some(Measured {
            at: a.at.checked_sub(a.offset)?,
            offset: a.offset.checked_neg()?,
            uncertainty: a.uncertainty,
        }),
        _ => None,
    }
}

/// A file that is read.
struct Source {
    path: PathBuf,
    host: String,
    shift: Shift,
    /// `None` after its end.
    reader: Option<FileReader<File>>,
    head: Option<Head>,
    /// The latest time of the messages so far.
    latest: u64,
}

/// The next message of a file.
struct Head {
    /// Its place in the merged order.
    order: u64,
    /// Header with the channel and the times of the merged file.
    header: MessageHeader,
    data: Vec<u8>,
    kind: HeadKind,
}

enum HeadKind {
    /// A letter with this identifier.
    Letter(Option<String>),
    /// The bytes of a letter.
    Bytes,
    Other,
}

impl Source {
    fn open(path: &Path, host: String, shift: Shift) -> Result<Self, Failure> {
        let file = File::open(path).map_err(|error| unreadable(&error.into(), path))?;
        Ok(Self {
            path: path.to_owned(),
            host,
            shift,
            reader: Some(FileReader::new(file)),
            head: None,
            latest: 0,
        })
    }

    /// Reads the next message.
    fn advance(&mut self, number: usize, merged: &mut Merged) -> Result<(), Failure> {
        let Some(reader) = &mut self.reader else {
            return Ok(());
        };
        loop {
            let item = reader
                .next()
                .map_err(|error| unreadable(&error, &self.path))?;
            let (channel, schema, header, data) = match item {
                None => break,
                Some(Item::Metadata(_)) => continue,
                Some(Item::Message {
                    channel,
                    schema,
                    header,
                    data,
                }) => (channel, schema, header, data),
            };
            let is_letter = schema.is_some_and(|it| it.header.name == file::LETTER_SCHEMA.name);
            let kind = match channel.message_encoding.as_str() {
                file::LETTER => HeadKind::Bytes,
                _ if is_letter => HeadKind::Letter(letter::read_id(data)),
                _ => HeadKind::Other,
            };
            let channel_id = merged.channel(number, &self.host, channel, schema);
            let channel_id = channel_id.map_err(|error| failed(&error, merged.name.clone()))?;
            let log_time = self.shift.apply(header.log_time);
            self.latest = self.latest.max(log_time);
            self.head = Some(Head {
                order: self.latest,
                header: MessageHeader {
                    channel_id,
                    log_time,
                    publish_time: self.shift.apply(header.publish_time),
                    ..header
                },
                data: data.to_vec(),
                kind,
            });
            return Ok(());
        }
        self.reader = None;
        Ok(())
    }
}

/// The file that is written.
struct Merged {
    /// Its name in error reports.
    name: String,
    file: RecordingFile,
    /// Its channels by the number of a file and the channel there.
    channels: HashMap<(usize, u16), u16>,
    known: Known,
    /// The last letter of each file: its sequence number and whether it was left out.
    last: HashMap<usize, (u32, bool)>,
    shifts: BTreeMap<String, String>,
    messages: u64,
    joined: u64,
}

impl Merged {
    fn create(path: &Path, abouts: &[About], shifts: &[Shift]) -> Result<Self, RecordingError> {
        let mut file = RecordingFile::create(path)?;
        file.write_metadata(file::ABOUT, about(abouts))?;
        if abouts.iter().any(About::is_filtered) {
            file.write_metadata(file::FILTERED, BTreeMap::new())?;
        }
        for (number, about) in (1..).zip(abouts) {
            for metadata in &about.metadata {
                let name = format!("{number}/{}", metadata.name);
                file.write_metadata(&name, metadata.metadata.clone())?;
            }
        }
        let shifts = (1..).zip(shifts).map(|(number, shift): (u32, _)| {
            let offsets = shift.0.iter().map(|(_, offset)| offset.to_string());
            let offsets = offsets.collect::<Vec<_>>().join(" ");
            (format!("shift_ns/{number}"), offsets)
        });
        Ok(Self {
            name: input::name(path),
            file,
            channels: HashMap::new(),
            known: Known::default(),
            last: HashMap::new(),
            shifts: shifts.collect(),
            messages: 0,
            joined: 0,
        })
    }

    /// Returns the channel for that of a file.
    fn channel(
        &mut self,
        number: usize,
        host: &str,
        channel: &Channel,
        schema: Option<&FileSchema>,
    ) -> Result<u16, RecordingError> {
        if let Some(known) = self.channels.get(&(number, channel.id)) {
            return Ok(*known);
        }
        let format = self.file.format();
        let schema = match schema {
            Some(it) => format.add_schema(&it.header.name, &it.header.encoding, &it.data)?,
            None => 0,
        };
        let mut metadata = channel.metadata.clone();
        metadata
            .entry("host".to_owned())
            .or_insert_with(|| host.to_owned());
        let (topic, encoding) = (&channel.topic, &channel.message_encoding);
        let id = format.add_channel(schema, topic, encoding, &metadata)?;
        self.channels.insert((number, channel.id), id);
        Ok(id)
    }

    fn add(&mut self, number: usize, message: Head) -> Result<(), RecordingError> {
        let sequence = message.header.sequence;
        let is_left_out = match message.kind {
            HeadKind::Letter(id) => {
                let is_known = id.is_some_and(|id| self.known.is_of_another(id, number));
                self.joined += u64::from(is_known);
                self.last.insert(number, (sequence, is_known));
                is_known
            }
            HeadKind::Bytes => {
                let last = self.last.get(&number);
                last.is_some_and(|last| *last == (sequence, true))
            }
            HeadKind::Other => false,
        };
        if !is_left_out {
            let format = self.file.format();
            format.write_to_known_channel(&message.header, &message.data)?;
            self.messages += 1;
        }
        Ok(())
    }

    /// Closes the file. Returns the numbers of messages and of joined letters.
    fn finish(mut self, files: usize) -> Result<(u64, u64), RecordingError> {
        let mut about = self.shifts;
        about.insert("files".to_owned(), files.to_string());
        about.insert("joined_letters".to_owned(), self.joined.to_string());
        self.file.write_metadata(MERGED, about)?;
        self.file.finish()?;
        Ok((self.messages, self.joined))
    }
}

/// The metadata at the beginning of the merged file. It has a domain only if all files have the same.
fn about(abouts: &[About]) -> BTreeMap<String, String> {
    let hosts: Vec<&str> = abouts.iter().map(|it| it.host.as_str()).collect();
    let first = hosts.first().copied().unwrap_or_default();
    let mut about: BTreeMap<String, String> = [
        ("hosts", hosts.join(", ")),
        ("clock", format!("CLOCK_REALTIME of {first}")),
        ("version", env!("CARGO_PKG_VERSION").to_owned()),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into();
    let mut domains = abouts.iter().map(About::domain);
    if let Some(Some(domain)) = domains.next()
        && domains.all(|it| it == Some(domain))
    {
        about.insert("domain".to_owned(), domain.to_owned());
    }
    about
}

/// The identifiers of the last letters, with the numbers of their files.
#[derive(Default)]
struct Known {
    files: HashMap<String, usize>,
    order: VecDeque<String>,
}

impl Known {
    /// Whether another file had the letter before.
    fn is_of_another(&mut self, id: String, number: usize) -> bool {
        if let Some(known) = self.files.get(&id) {
            return *known != number;
        }
        if self.order.len() >= MAX_KNOWN
            && let Some(oldest) = self.order.pop_front()
        {
            self.files.remove(&oldest);
        }
        self.order.push_back(id.clone());
        self.files.insert(id, number);
        false
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::super::super::file::writer::{Stamp, Target};
    use super::*;

    fn clock(reference: &str, offset: i64, uncertainty: u64, at: i64) -> Clock {
        Clock {
            reference: reference.to_owned(),
            offset,
            uncertainty,
            at,
        }
    }

    fn host(name: &str, clocks: [Option<Clock>; 2]) -> About {
        About {
            host: name.to_owned(),
            clocks,
            ..About::default()
        }
    }

    #[test]
    fn a_difference_that_grows_is_interpolated() {
        let first = host("a", [None, None]);
        let fast = [clock("a", 100, 5, 1_000), clock("a", 300, 5, 2_000)];
        let shift = Shift::between(&first, &host("b", fast.map(Some))).unwrap();
        for (time, expected) in [
            (500, 400),
            (1_000, 900),
            (1_500, 1_300),
            (2_500, 2_200),
            (0, 0),
        ] {
            assert_eq!(shift.apply(time), expected, "{time}");
        }
        // Extreme values of a file from outside.
        let extreme = [
            clock("a", i64::MIN, 0, i64::MIN),
            clock("a", i64::MAX, 0, i64::MAX),
        ];
        let shift = Shift::between(&first, &host("b", extreme.map(Some))).unwrap();
        for time in [0, 1, u64::MAX] {
            shift.apply(time);
        }
    }

    #[test]
    fn hosts_are_compared_by_a_third_one_or_by_each_other() {
        let one = |it| [Some(it), None];
        let (b, c) = (
            host("b", one(clock("a", 70, 1, 9))),
            host("c", one(clock("a", 100, 1, 8))),
        );
        assert_eq!(Shift::between(&b, &c), Some(Shift(vec![(8, 30)])));
        let a = host("a", [None, None]);
        assert_eq!(Shift::between(&b, &a), Some(Shift(vec![(-61, -70)])));
        assert_eq!(Shift::between(&a, &host("d", [None, None])), None);
        assert_eq!(
            Shift::between(&b, &host("c", one(clock("x", 1, 1, 8)))),
            None
        );
        // A difference within its error is none.
        let near = host("c", one(clock("a", 71, 1, 8)));
        assert_eq!(Shift::between(&b, &near), Some(Shift::default()));
    }

    /// Writes a file with these letters: identifiers and times.
    fn write(path: &Path, host: &str, clock: Option<Clock>, letters: &[(&str, u64)]) {
        let mut file = RecordingFile::create(path).unwrap();
        let pairs = |key: &str, value: &str| BTreeMap::from([(key.to_owned(), value.to_owned())]);
        file.write_metadata(file::ABOUT, pairs("gateway", host))
            .unwrap();
        for (sequence, (id, nanos)) in (1..).zip(letters) {
            let letter = json!({ "letter_id": id, "host": host });
            let target = |topic, encoding, schema| Target {
                topic,
                encoding,
                schema,
            };
            let stamp = Stamp {
                nanos: *nanos,
                sequence,
            };
            let json = target("/letters/x", file::JSON, Some(file::LETTER_SCHEMA));
            file.write(json, stamp, letter.to_string().as_bytes())
                .unwrap();
            let raw = target("/letters/x/raw", file::LETTER, None);
            file.write(raw, stamp, id.as_bytes()).unwrap();
        }
        if let Some(clock) = clock {
            let name = CLOCK_AT_STOP;
            let mut about = pairs("reference", &clock.reference);
            about.extend(pairs("offset_ns", &clock.offset.to_string()));
            about.extend(pairs("uncertainty_ns", &clock.uncertainty.to_string()));
            about.extend(pairs("at_ns", &clock.at.to_string()));
            file.write_metadata(name, about).unwrap();
        }
        file.finish().unwrap();
    }

    #[test]
    fn a_letter_of_two_hosts_is_copied_once_and_times_are_those_of_the_first_host() {
        let directory = tempfile::tempdir().unwrap();
        let [a, b, to] = ["a", "b", "to"].map(|it| directory.path().join(it));
        // The clock of b is ahead by 1,000. Letter 2 is an answer to letter 1.
        write(&a, "a", None, &[("1", 100), ("2", 140), ("3", 150)]);
        let ahead = clock("a", 1_000, 10, 1_100);
        write(
            &b,
            "b",
            Some(ahead),
            &[("1", 1_110), ("2", 1_120), ("4", 1_145)],
        );
        run(&Arguments {
            files: vec![a, b],
            output: to.clone(),
        })
        .unwrap();
        let (mut letters, mut raw, mut metadata) = (Vec::new(), Vec::new(), Vec::new());
        read_file(&to, |item| {
            match item {
                Item::Metadata(it) => metadata.push(it.name),
                Item::Message {
                    header,
                    data,
                    channel,
                    ..
                } if channel.message_encoding == "json" => {
                    let letter: Value = serde_json::from_slice(data).unwrap();
                    assert_eq!(letter["host"], *channel.metadata["host"]);
                    let id = letter["letter_id"].as_str().unwrap().to_owned();
                    letters.push((id, header.log_time));
                }
                Item::Message { data, .. } => raw.push(String::from_utf8(data.to_vec()).unwrap()),
            }
            Ok(())
        })
        .unwrap();
        let expected = [("1", 100), ("2", 120), ("4", 145), ("3", 150)];
        assert_eq!(letters, expected.map(|(id, time)| (id.to_owned(), time)));
        assert_eq!(raw, ["1", "2", "4", "3"]);
        for name in [
            "fipa.recording",
            "1/fipa.recording",
            "2/fipa.clock.stop",
            MERGED,
        ] {
            assert!(metadata.iter().any(|it| it == name), "{name}: {metadata:?}");
        }
    }

    /// The measurement can be wrong by its uncertainty, and the order within a host is the true one.
    #[test]
    fn an_answer_follows_its_letter_whatever_the_clocks_are() {
        let directory = tempfile::tempdir().unwrap();
        let [a, b, to] = ["a", "b", "to"].map(|it| directory.path().join(it));
        write(&a, "a", None, &[("1", 1_000), ("2", 1_100)]);
        write(&b, "b", None, &[("1", 10), ("2", 20)]);
        run(&Arguments {
            files: vec![a, b],
            output: to.clone(),
        })
        .unwrap();
        let mut ids = Vec::new();
        read_file(&to, |item| {
            if let Item::Message { data, channel, .. } = item
                && channel.message_encoding == "json"
            {
                ids.push(letter::read_id(data).unwrap());
            }
            Ok(())
        })
        .unwrap();
        assert_eq!(ids, ["1", "2"]);
    }
}
