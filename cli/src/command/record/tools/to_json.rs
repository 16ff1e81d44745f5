//! `fipa record to-json`: prints the messages of a recording.

use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use clap::Args;
use serde_json::{Value, json};

use super::super::file;
use super::super::file::reader::Item;
use super::found::Found;
use super::select::{Selection, Selector};
use super::{read_file, read_quietly};
use crate::output;
use crate::report::Failure;

/// Print the messages of a recording as JSON, one object on a line
///
/// A message that is not JSON is printed in base64. The bytes of letters are printed with --raw only.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa record to-json run.mcap
  fipa record to-json run.mcap --agent arm_1 | jq .message.letter.message.content
  fipa record to-json run.mcap --topic /log | jq -r .message.message
  fipa record to-json run.mcap --failed | jq -c '.message | [.number, .time, .sender, .receiver, .reason]'

JSON, one object on a line:
  { \"topic\", \"time\": RFC 3339 with milliseconds, \"nanoseconds\": since 1970-01-01T00:00:00Z,
    \"host\": of a merged file, \"message\": if it is JSON, or \"base64\" }")]
pub(in crate::command) struct Arguments {
    /// Recording; - for standard input
    file: PathBuf,

    #[command(flatten)]
    selection: Selection,

    /// Only letters that were not delivered, each with its last outcome
    ///
    /// The outcome of a letter can be in a later event. So the command reads the file twice.
    #[arg(long, conflicts_with = "raw")]
    failed: bool,

    /// Print the bytes of letters, too
    #[arg(long)]
    raw: bool,
}

pub(in crate::command::record) fn run(arguments: &Arguments) -> Result<(), Failure> {
    let failed = arguments.failed.then(|| failed(&arguments.file));
    let failed = failed.transpose()?;
    let mut selector = Selector::new(&arguments.selection);
    read_file(&arguments.file, |item| {
        let is_selected = selector.takes(&item)?;
        let Item::Message {
            channel,
            header,
            data,
            ..
        } = item
        else {
            return Ok(());
        };
        if !is_selected || (channel.message_encoding == file::LETTER && !arguments.raw) {
            return Ok(());
        }
        let at = UNIX_EPOCH + Duration::from_nanos(header.publish_time);
        let mut line = json!({
            "topic": channel.topic, "time": output::moment(at), "nanoseconds": header.publish_time,
        });
        // A merged file has the host of each channel.
        if let Some(host) = channel.metadata.get("host") {
            line["host"] = host.as_str().into();
        }
        let message = match channel.message_encoding.as_str() {
            file::JSON => serde_json::from_slice::<Value>(data).ok(),
            _ => None,
        };
        let message = match (&failed, message) {
            (None, message) => message,
            (Some(failed), Some(Value::Object(mut letter))) => match failed.settle(&mut letter) {
                true => Some(Value::Object(letter)),
                false => return Ok(()),
            },
            (Some(_), _) => return Ok(()),
        };
        if let Some(object) = line.as_object_mut() {
            match message {
                Some(message) => object.insert("message".to_owned(), message),
                None => object.insert("base64".to_owned(), BASE64.encode(data).into()),
            };
        }
        output::json_line(&line)
    })?;
    Ok(())
}

/// Finds the letters that were not delivered.
fn failed(path: &Path) -> Result<Found, Failure> {
    if path == Path::new("-") {
        return Err(Failure::wrong_usage(
            "--failed reads the recording twice",
            "standard input",
            "give the name of a file",
        ));
    }
    let mut found = Found::default();
    read_quietly(path, |item| {
        found.add(&item);
        Ok(())
    })?;
    Ok(found)
}
