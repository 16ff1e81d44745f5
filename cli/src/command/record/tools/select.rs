//! Selects messages of a recording.

use clap::Args;
use fipa::{Matcher, Time};

use super::super::file;
use super::super::file::letter::RecordedLetter;
use super::super::file::reader::Item;
use crate::command::watch::filter::Filter;
use crate::report::{self, Failure};

// The messages to select. Not a doc comment: clap would print it as the help of the command.
#[derive(Debug, Args)]
pub(in crate::command) struct Selection {
    #[command(flatten)]
    letters: Filter,

    /// Only channels with this name, or channels matching this pattern, for example '/letters/arm_.*'; repeatable
    #[arg(long, value_name = "CHANNEL", value_parser = Matcher::parse)]
    topic: Vec<Matcher>,

    /// Only messages from this time on, for example 2026-03-01T12:00:00Z
    #[arg(long, value_name = "TIME", value_parser = nanos)]
    from: Option<u64>,

    /// Only messages before this time
    #[arg(long, value_name = "TIME", value_parser = nanos)]
    until: Option<u64>,
}

fn nanos(text: &str) -> Result<u64, String> {
    let expected = || "expected a time such as 2026-03-01T12:00:00Z".to_owned();
    let time = Time::from_rfc3339(text).map_err(|_| expected())?;
    let time = time.to_system_time(std::time::SystemTime::now());
    let since = time.duration_since(std::time::UNIX_EPOCH);
    let nanos = since.map_err(|_| expected())?.as_nanos();
    u64::try_from(nanos).map_err(|_| expected())
}

/// Selects the messages of one file.
pub(super) struct Selector<'a> {
    selection: &'a Selection,
    /// The last letter and the result for it, which holds for its bytes, too.
    last: Option<(u32, bool)>,
}

impl<'a> Selector<'a> {
    pub(super) fn new(selection: &'a Selection) -> Self {
        Self {
            selection,
            last: None,
        }
    }

    /// Whether an item is selected. Metadata always is. With conditions for letters, only letters are.
    pub(super) fn takes(&mut self, item: &Item<'_>) -> Result<bool, Failure> {
        let Item::Message {
            channel,
            schema,
            header,
            data,
        } = item
        else {
            return Ok(true);
        };
        let Selection {
            letters,
            topic,
            from,
            until,
        } = self.selection;
        let time = header.publish_time;
        let takes_channel = topic.is_empty() || topic.iter().any(|it| it.matches(&channel.topic));
        let takes_time =
            from.is_none_or(|from| time >= from) && until.is_none_or(|until| time < until);
        let is_candidate = takes_channel && takes_time;
        if letters.is_empty() {
            return Ok(is_candidate);
        }
        if channel.message_encoding == file::LETTER {
            let last = self
                .last
                .filter(|(sequence, _)| *sequence == header.sequence);
            return Ok(is_candidate && last.is_some_and(|(_, taken)| taken));
        }
        if !schema.is_some_and(|it| it.header.name == file::LETTER_SCHEMA.name) {
            return Ok(false);
        }
        let taken = match RecordedLetter::read(data, time) {
            Ok(letter) => letters.takes_letter(&letter.traits()),
            Err(error) => {
                report::warn(&format!("a letter is left out: {error}"));
                false
            }
        };
        self.last = Some((header.sequence, taken));
        Ok(is_candidate && taken)
    }
}
