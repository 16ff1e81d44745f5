//! A watcher of each host: every letter is seen once, in order, with the outcome that its sender is
//! told.

use super::Map;
use std::sync::Arc;
use std::time::{Instant, SystemTime};

use fipa_mts::core::Notice;
use fipa_mts::watch::record::{self, Wish};
use fipa_mts::watch::{Event, Fate, Joiner, Passage, Record, RecordSource};
use fipa_transport::{Incarnation, Outcome, wire};

use super::gates::number_in;
use super::{Breach, World};

/// The watcher of a host, and the letters that it has seen.
#[derive(Default)]
pub(super) struct Watching {
    joiner: Joiner,
    /// By the sender's incarnation and the sequence number.
    seen: Map<(Incarnation, u64), Arc<Passage>>,
    last: Map<Incarnation, u64>,
}

impl Watching {
    /// Passes a record of a process to the watcher, as the runtime does.
    pub(super) fn hear(
        &mut self,
        (now, utc): (Instant, SystemTime),
        process: usize,
        notice: &Notice,
    ) -> Result<(), Breach> {
        // The content begins with the number of the letter.
        let bytes = record::of(notice, Wish { content: 64 }, utc);
        let record = Record::parse(&bytes).map_err(|error| error.to_string())?;
        self.joiner
            .handle(now, RecordSource(process as u64), record);
        while let Some(event) = self.joiner.poll_event(now) {
            self.see(event)?;
        }
        Ok(())
    }

    fn see(&mut self, event: Event) -> Result<(), Breach> {
        let (passage, later) = match event {
            Event::Letter(passage) => (passage, false),
            Event::Later(passage) => (passage, true),
            // The fate is compared at the end; `Taken` stands for the same outcome.
            Event::Confirmed(_) => return Ok(()),
            other => return Err(format!("watched: {other:?}")),
        };
        let sender = passage.stream.sender;
        let key = (sender, passage.sequence);
        if self.seen.contains_key(&key) != later {
            return Err(format!(
                "seen twice, or news of what was not seen: {passage:?}"
            ));
        }
        // For senders of this host, which report the sending.
        if passage.submission.is_some() && !later {
            let last = self.last.insert(sender, passage.sequence).unwrap_or(0);
            if last >= passage.sequence {
                return Err(format!("{passage:?} was seen after the letter {last}"));
            }
        }
        let content = self.seen.remove(&key).map(|before| before.content.clone());
        let passage = match content {
            // An identical report is not repeated.
            Some(content) => Arc::new(Passage {
                content,
                ..Passage::clone(&passage)
            }),
            None => passage,
        };
        self.seen.insert(key, passage);
        Ok(())
    }
}

impl World {
    pub(super) fn check_watched(&mut self) -> Result<(), Breach> {
        for watching in &mut self.watching {
            while let Some(event) = watching.joiner.finish() {
                watching.see(event)?;
            }
        }
        if !self.watched {
            return Ok(());
        }
        let mut settled = Map::default();
        for watching in &self.watching {
            for passage in watching.seen.values().filter(|it| !it.from_service) {
                let outcome = match (&passage.fate, passage.via) {
                    (Fate::Settled(outcome), _) => outcome.clone(),
                    // The sender got the same outcome, or there would have been another event.
                    (Fate::Taken, Some(via)) if passage.submission.is_some() => {
                        Outcome::Delivered {
                            via,
                            attempts: Vec::new(),
                        }
                    }
                    _ => continue,
                };
                let Some(number) = number_in(&passage.content) else {
                    continue;
                };
                settled.insert((number, Arc::clone(&passage.receiver)), outcome);
            }
        }
        for (number, sent) in &self.sent {
            for (receiver, outcome) in &sent.outcomes {
                let seen = settled.get(&(*number, Arc::clone(receiver)));
                // Records of very many attempts leave out the attempts.
                if seen.map(wire::write_outcome) != Some(wire::write_outcome(outcome)) {
                    return Err(format!(
                        "letter {number} to {receiver}: {outcome}, and seen was {seen:?}"
                    ));
                }
            }
        }
        Ok(())
    }
}
