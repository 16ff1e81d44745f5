//! `fipa record info`: shows the metadata and the channels of recordings.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

use clap::Args;
use fipa_acl::escape;
use serde_json::{Value, json};

use super::super::file::reader::Item;
use super::found::Found;
use super::read_file;
use crate::report::Failure;
use crate::{input, output};

/// Show the metadata, the times and the channels of recordings
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa record info run.mcap
  fipa record info *.mcap --json | jq '.[].metadata[\"fipa.totals\"]'

JSON:
  [ { \"file\", \"closed\", \"damage\": text or null, \"first\" and \"last\": time or null, \"seconds\",
      \"messages\": number, \"channels\": { topic: { \"messages\", \"bytes\", \"encoding\", \"schema\" } },
      \"metadata\": { name: { key: text } },
      \"found\": [ { \"count\", \"kind\", \"command\": shows them } ] } ]")]
pub(in crate::command) struct Arguments {
    /// Recordings
    #[arg(required = true)]
    files: Vec<PathBuf>,

    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(in crate::command::record) fn run(arguments: &Arguments) -> Result<(), Failure> {
    let mut all = Vec::new();
    for file in &arguments.files {
        let about = About::read(file)?;
        match arguments.json {
            true => all.push(about.json(file)),
            false => output::text(&about.text(file))?,
        }
    }
    match arguments.json {
        true => output::json(&all),
        false => Ok(()),
    }
}

#[derive(Default)]
struct About {
    is_closed: bool,
    damage: Option<String>,
    times: Option<(u64, u64)>,
    messages: u64,
    channels: BTreeMap<String, ChannelAbout>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    metadata_bytes: usize,
    found: Found,
}

struct ChannelAbout {
    messages: u64,
    bytes: u64,
    encoding: String,
    schema: Option<String>,
}

impl About {
    fn read(path: &Path) -> Result<Self, Failure> {
        let mut about = Self::default();
        let end = read_file(path, |item| {
            about.add(item);
            Ok(())
        })?;
        about.is_closed = end.is_closed;
        about.damage = end
            .damage
            .map(|it| fipa::error::ErrorChain(&it).to_string());
        Ok(about)
    }

    fn add(&mut self, item: Item<'_>) {
        self.found.add(&item);
        match item {
            Item::Message {
                channel,
                schema,
                header,
                data,
            } => {
                self.messages += 1;
                let (first, last) = self.times.unwrap_or((header.log_time, header.log_time));
                self.times = Some((first.min(header.log_time), last.max(header.log_time)));
                if !self.channels.contains_key(&channel.topic) {
                    let about = ChannelAbout {
                        messages: 0,
                        bytes: 0,
                        encoding: channel.message_encoding.clone(),
                        schema: schema.map(|it| it.header.name.clone()),
                    };
                    self.channels.insert(channel.topic.clone(), about);
                }
                if let Some(about) = self.channels.get_mut(&channel.topic) {
                    about.messages += 1;
                    about.bytes = about.bytes.saturating_add(data.len() as u64);
                }
            }
            Item::Metadata(metadata) => {
                let pairs = metadata.metadata.iter();
                let bytes = pairs.map(|(key, value)| key.len() + value.len() + PAIR);
                let bytes = bytes.sum::<usize>() + metadata.name.len();
                // A file from outside may have any number of them.
                self.metadata_bytes = self.metadata_bytes.saturating_add(bytes);
                if self.metadata_bytes <= MAX_METADATA {
                    self.metadata.insert(metadata.name, metadata.metadata);
                }
            }
        }
    }

    fn span(&self) -> Duration {
        let (first, last) = self.times.unwrap_or_default();
        Duration::from_nanos(last.saturating_sub(first))
    }

    fn json(&self, path: &Path) -> Value {
        let channels = self.channels.iter().map(|(topic, about)| {
            let about = json!({
                "messages": about.messages, "bytes": about.bytes, "encoding": about.encoding,
                "schema": about.schema,
            });
            (topic.clone(), about)
        });
        json!({
            "file": path.to_string_lossy(), "closed": self.is_closed, "damage": self.damage,
            "first": self.times.map(|(first, _)| time(first)),
            "last": self.times.map(|(_, last)| time(last)),
            "seconds": self.span().as_secs_f64(), "messages": self.messages,
            "channels": channels.collect::<serde_json::Map<String, Value>>(),
            "metadata": self.metadata,
            "found": self.found(path).map(|(count, kind, command)| {
                json!({ "count": count, "kind": kind, "command": command })
            }).collect::<Vec<Value>>(),
        })
    }

    /// The kinds of events that were found: their number, their name, and a command that shows them.
    fn found(&self, path: &Path) -> impl Iterator<Item = (u64, &'static str, String)> {
        let file = quoted(path);
        let events = |event: &str| {
            format!(
                "fipa record to-json {file} --topic /events | jq -r '.message | select(.event == \"{event}\")'"
            )
        };
        let texts = |event: &str| format!("{} | .text'", events(event).trim_end_matches('\''));
        let found = &self.found;
        let failed = u64::try_from(found.failed()).unwrap_or(u64::MAX);
        [
            (
                found.violations,
                "violation",
                format!("fipa replay {file} --check"),
            ),
            (
                failed,
                "letter not delivered",
                format!("fipa record to-json {file} --failed"),
            ),
            (found.abandoned, "abandoned lock", texts("lock_abandoned")),
            (found.lost, "lost lock", texts("lock_lost")),
            (found.hosts, "gone host", events("host_gone")),
        ]
        .into_iter()
        .filter(|(count, ..)| *count > 0)
    }

    fn text(&self, path: &Path) -> String {
        let mut text = format!("{}\n", input::name(path));
        let mut put = |key: &str, value: &str| {
            text.push_str(&format!("  {:<22}{}\n", escape(key), escape(value)));
        };
        let state = match (self.is_closed, &self.damage) {
            (true, _) => "closed".to_owned(),
            (false, None) => "not closed".to_owned(),
            (false, Some(damage)) => format!("damaged: {damage}"),
        };
        put("state", &state);
        if let Some((first, last)) = self.times {
            put("first message", &time(first));
            put("last message", &time(last));
            put("time", &format!("{:.3} s", self.span().as_secs_f64()));
        }
        put("messages", &self.messages.to_string());
        for (name, pairs) in &self.metadata {
            put(name, "");
            for (key, value) in pairs {
                put(&format!("  {key}"), value);
            }
        }
        let mut table = output::table(["CHANNEL", "MESSAGES", "BYTES", "ENCODING", "SCHEMA"]);
        for (topic, about) in &self.channels {
            table.add_row([
                escape(topic).into_owned(),
                about.messages.to_string(),
                about.bytes.to_string(),
                escape(&about.encoding).into_owned(),
                escape(about.schema.as_deref().unwrap_or("-")).into_owned(),
            ]);
        }
        text.push_str(&format!("{}\n", table.trim_fmt()));
        let mut table = output::table(["FOUND", "NUMBER", "COMMAND"]);
        let mut is_empty = true;
        for (count, kind, command) in self.found(path) {
            is_empty = false;
            table.add_row([
                kind.to_owned(),
                count.to_string(),
                escape(&command).into_owned(),
            ]);
        }
        if !is_empty {
            text.push_str(&format!("{}\n", table.trim_fmt()));
        }
        text
    }
}

/// Maximum length of the metadata that is shown, in bytes. Further records are not shown.
const MAX_METADATA: usize = 1 << 20;
/// Bytes that a pair counts in addition to its texts.
const PAIR: usize = 64;

/// The name of a file in a command of a shell.
fn quoted(path: &Path) -> String {
    let name = path.to_string_lossy();
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || "/._-+:,@".contains(letter);
    match name.chars().all(is_plain) {
        true => name.into_owned(),
        false => format!("'{}'", name.replace('\'', "'\\''")),
    }
}

fn time(nanos: u64) -> String {
    output::moment(UNIX_EPOCH + Duration::from_nanos(nanos))
}
