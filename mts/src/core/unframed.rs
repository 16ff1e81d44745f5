//! Unframed letters: those of legacy peers, which have no stream and no sequence.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use fipa_acl::{AclRepresentation, DecodeError, EncodeError, Letter, Message};
use fipa_sds::{Entry, Reach, Resolution, View};
use fipa_transport::counts::{Direction, LetterOutcome};
use fipa_transport::{
    FailureReason, Incarnation, Kind, LegacySource, Outcome, Stream, log_limit, quota_address,
};

use super::action::Action;
use super::contacts::{Answered, answered};
use super::failures::cannot_be_decoded;
use super::lane::OpenLetter;
use super::lanes::own_lane;
use super::origin::Origin;
use super::reading::{refused_name_of_legacy_peer, too_long};
use super::undelivered::{FailureTarget, Undelivered};
use super::{Core, LetterReader, MAX_DEADLINE, News, Now, work};
use crate::failure::Failed;
use crate::gate::{self, LetterParts, Link};
use crate::stamp;

/// Maximum number of receivers of one letter of a legacy peer. fipa_services writes one.
const MAX_UNFRAMED_RECEIVERS: usize = 64;

/// Maximum number of patterns among the receivers of one letter of a legacy peer.
const MAX_UNFRAMED_PATTERNS: usize = 1;

/// Maximum length of a legacy peer's pattern, in bytes: a longer one takes tens of milliseconds to
/// compile.
const MAX_UNFRAMED_PATTERN: usize = 128;

/// Maximum number of agents that one letter of a legacy peer stands for.
const MAX_UNFRAMED_COPIES: usize = 1024;

/// Maximum number of receivers of a legacy peer's letter that are handled in one call. The core takes
/// 1 to 3 µs for the letter to an agent, and 20 µs for a failure message with a long name.
const UNFRAMED_PORTION: usize = 16;

/// A letter of a legacy peer, parsed as far as the core needs it, with its receivers looked up.
/// That takes time in proportion to the bytes of the letter and to the agents of this host, so it
/// happens before the core is locked.
#[derive(Debug)]
pub struct Unframed {
    letter: Letter,
    via: Kind,
    from: LegacySource,
    /// The receivers that the core has not handled yet.
    receivers: VecDeque<Receiver>,
    /// Whether the bytes of the letter were counted for failure messages.
    is_counted: bool,
    /// The agents of the letter to which answers may go, and the addresses that the letter states for them.
    answered: Vec<Answered>,
    /// Whether the sender was reported as a contact for the present portion of the receivers.
    is_contact: bool,
    /// The parts that a message about its failure repeats; `None` if there is to be none.
    failed: Option<Arc<Failed>>,
    /// The reason why the letter is refused, if it is.
    fault: Option<String>,
    /// The parts that the gate has read.
    parts: Option<LetterParts>,
}

impl Unframed {
    /// Parses the letter, which came from this source, and looks up its receivers. Refresh the
    /// directory before, and do not lock the core.
    ///
    /// # Errors
    /// Fails when the envelope cannot be parsed.
    pub fn read<V: View + ?Sized>(
        letter: Letter,
        via: Kind,
        from: LegacySource,
        view: &V,
    ) -> Result<Self, DecodeError> {
        let mut names = stamp::receivers(&letter, MAX_UNFRAMED_RECEIVERS + 1)?;
        let message = Message::decode(letter.payload());
        let failed = match &message {
            Ok(message) => Failed::of_message(message, &letter),
            Err(_) => Failed::of_envelope(&letter),
        };
        let mut letter = letter;
        let named = stamp::sender(&letter).unwrap_or_default();
        let (answered, mut fault) = match (refused_names(&names), message) {
            (Some(fault), _) => {
                names.truncate(1);
                (Vec::new(), Some(fault))
            }
            (None, Ok(message)) => {
                let answered = answered(&message, &letter, from);
                if letter.around_len() > Letter::MAX_AROUND
                    && let Ok(divided) = divide(&letter, &message)
                {
                    letter = divided;
                }
                let in_envelope = names.iter().chain([&named]).map(String::as_str);
                let fault = refused_name_of_legacy_peer(&message, in_envelope);
                (answered, fault.or_else(|| too_long(&letter)))
            }
            (None, Err(error)) => (Vec::new(), Some(cannot_be_decoded(&error))),
        };
        let first = names.first().cloned();
        let mut receivers = VecDeque::new();
        for name in names {
            let resolution = match fault {
                Some(_) => Resolution::None,
                None => {
                    let resolution = fipa_sds::resolve_legacy(view, &name, &named);
                    resolution.unwrap_or(Resolution::None)
                }
            };
            receivers.extend(receivers_of(name.into(), resolution));
        }
        if receivers.len() > MAX_UNFRAMED_COPIES {
            let first = first.map(|name| Receiver::Unknown(name.into()));
            receivers = first.into_iter().collect();
            fault = Some(format!(
                "the receivers of the letter are more than {MAX_UNFRAMED_COPIES} agents"
            ));
        }
        Ok(Self {
            letter,
            via,
            from,
            receivers,
            is_counted: false,
            answered,
            is_contact: false,
            failed: failed.map(Arc::new),
            fault,
            parts: None,
        })
    }

    /// Parses the envelope of a letter that the transport has refused for this reason. Its message may be
    /// incomplete. Its sender gets a failure message for each receiver.
    ///
    /// # Errors
    /// Fails when the envelope cannot be parsed.
    pub fn refused(
        letter: Letter,
        via: Kind,
        from: LegacySource,
        reason: &str,
    ) -> Result<Self, DecodeError> {
        let mut names = stamp::receivers(&letter, MAX_UNFRAMED_RECEIVERS)?;
        names.truncate(MAX_UNFRAMED_RECEIVERS);
        let names = names.into_iter();
        Ok(Self {
            receivers: names.map(|it| Receiver::Unknown(it.into())).collect(),
            failed: Failed::of_envelope(&letter).map(Arc::new),
            letter,
            via,
            from,
            is_counted: false,
            answered: Vec::new(),
            is_contact: false,
            fault: Some(reason.to_owned()),
            parts: None,
        })
    }

    /// The content, if it is apart from the other bytes of the letter.
    #[must_use]
    pub fn content(&self) -> &Bytes {
        &self.letter.payload().content
    }

    /// Returns the letter with its [content](Self::content) in other memory.
    #[must_use]
    pub fn with_content(self, content: Bytes) -> Self {
        Self {
            letter: self.letter.with_content(content),
            ..self
        }
    }

    /// Whether the core has [handled](Core::handle_unframed) the letter for all receivers.
    #[must_use]
    pub fn is_handled(&self) -> bool {
        self.receivers.is_empty()
    }

    /// Has the gate read the letter, which otherwise happens while the core is locked.
    #[must_use]
    pub fn read_by(self, reader: &LetterReader) -> Self {
        Self {
            parts: reader.parts(&self.letter),
            ..self
        }
    }
}

/// A receiver of a legacy peer's letter.
#[derive(Debug)]
enum Receiver {
    /// An agent of this host.
    Here(Arc<Entry>),
    /// A name that no agent of this host has.
    Unknown(Arc<str>),
}

impl Receiver {
    fn name(&self) -> &Arc<str> {
        match self {
            Self::Here(entry) => &entry.name,
            Self::Unknown(name) => name,
        }
    }
}

/// The receivers that a name in an envelope stands for.
fn receivers_of(name: Arc<str>, resolution: Resolution) -> Vec<Receiver> {
    let (entries, mut missing) = match resolution {
        Resolution::Exact(entry) => (vec![entry], Vec::new()),
        Resolution::Multicast(entries) => (entries, Vec::new()),
        Resolution::Coalition {
            agents,
            mut missing,
            leaderless,
        } => {
            missing.extend(leaderless);
            // Members on other hosts cannot be reached from here, which the sender is told.
            let away = agents.iter().filter(|entry| entry.reach != Reach::Local);
            missing.extend(away.map(|entry| Arc::clone(&entry.name)));
            (agents, missing)
        }
        Resolution::None => (Vec::new(), Vec::new()),
    };
    let local = entries.into_iter();
    let mut agents = local.filter(|entry| entry.reach == Reach::Local).peekable();
    if agents.peek().is_none() && missing.is_empty() {
        missing.push(name);
    }
    let missing = missing.into_iter().map(Receiver::Unknown);
    missing.chain(agents.map(Receiver::Here)).collect()
}

/// The reason why a legacy peer's letter to these receivers is refused, if it is.
fn refused_names(names: &[String]) -> Option<String> {
    if names.len() > MAX_UNFRAMED_RECEIVERS {
        return Some(format!(
            "the letter has more than {MAX_UNFRAMED_RECEIVERS} receivers"
        ));
    }
    let is_pattern = |name: &&String| fipa_sds::is_legacy_pattern(name);
    let patterns: Vec<&String> = names.iter().filter(is_pattern).collect();
    if patterns.len() > MAX_UNFRAMED_PATTERNS {
        return Some(format!(
            "the letter has more than {MAX_UNFRAMED_PATTERNS} pattern among its receivers"
        ));
    }
    if patterns.iter().any(|it| it.len() > MAX_UNFRAMED_PATTERN) {
        return Some(format!(
            "the pattern has more than {MAX_UNFRAMED_PATTERN} bytes"
        ));
    }
    let flags = patterns.iter().any(|pattern| sets_flags(pattern));
    flags.then(|| "the pattern sets flags, as `(?i)` does".to_owned())
}

/// Whether a group of the pattern sets flags. A short pattern that ignores the case may take 40 ms to compile,
/// and the regular expressions of fipa_services have no flags.
fn sets_flags(pattern: &str) -> bool {
    let has_no_flags = |group: &str| group.starts_with([':', '<']) || group.starts_with("P<");
    let mut groups = pattern.split("(?").skip(1);
    groups.any(|group| !has_no_flags(group))
}

/// Returns the letter with its message in the encoding that keeps the content apart: a legacy peer's
/// message is in one piece, which would be copied while the core is locked.
fn divide(letter: &Letter, message: &Message) -> Result<Letter, DivideError> {
    let mut envelope = letter.parse_envelope()?;
    for part in std::iter::once(&mut envelope.base).chain(&mut envelope.extensions) {
        part.acl_representation = None;
        part.payload_length = None;
        part.payload_encoding = None;
    }
    envelope.base.acl_representation = Some(AclRepresentation::BitEfficient);
    let envelope = envelope.encode_standard()?;
    Ok(Letter::new(envelope, message.to_payload()))
}

/// The reason why a letter cannot be [divided](divide).
#[derive(Debug, thiserror::Error)]
enum DivideError {
    #[error(transparent)]
    Decode(#[from] DecodeError),
    #[error(transparent)]
    Encode(#[from] EncodeError),
}

impl Core {
    /// Handles a legacy peer's letter for the next agents of this host in its envelope, at most a
    /// portion of them. Call it until the letter is [handled](Unframed::is_handled), and release the
    /// lock of the core in between. If its message cannot be decoded, or it has too many receivers,
    /// the letter is refused, and its sender gets a failure message.
    pub fn handle_unframed(&mut self, now: Now, deadline: Duration, unframed: &mut Unframed) {
        if !std::mem::replace(&mut unframed.is_counted, true) {
            let (from, len) = (unframed.from.address, unframed.letter.len());
            self.failure_limit.credit(now.instant, from, len);
            if let Some(fault) = &unframed.fault {
                log_limit::info!(of: quota_address(from), %from, "refused a letter of a legacy peer: {fault}");
            }
        }
        // The gate may be active only since the previous portion.
        if unframed.fault.is_none() && unframed.parts.is_none() {
            unframed.parts = self.reader.parts(&unframed.letter);
        }
        unframed.is_contact = false;
        for _ in 0..UNFRAMED_PORTION {
            let Some(receiver) = unframed.receivers.pop_front() else {
                break;
            };
            work::steps(1);
            let why = match (&receiver, &unframed.fault) {
                (_, Some(fault)) => (FailureReason::Refused, fault.clone()),
                (Receiver::Here(entry), None) => {
                    self.unframed_arrived(now, deadline, unframed, entry);
                    continue;
                }
                (Receiver::Unknown(name), None) => {
                    log_limit::info!(of: quota_address(unframed.from.address), receiver = %name, from = %unframed.from.address, "cannot deliver an unframed letter: no agent of this host has the name");
                    (FailureReason::NoSuchAgent, String::new())
                }
            };
            self.unframed_failed(receiver.name(), unframed, why);
        }
        self.send_failures(now);
    }

    /// Handles a legacy peer's letter for an agent of this host.
    fn unframed_arrived(
        &mut self,
        now: Now,
        deadline: Duration,
        unframed: &mut Unframed,
        entry: &Arc<Entry>,
    ) {
        let Unframed {
            letter,
            via,
            from,
            answered,
            failed,
            parts,
            is_contact,
            ..
        } = unframed;
        let (via, from) = (*via, *from);
        let unproved = Link {
            via,
            service: Incarnation::UNKNOWN,
            user: None,
            source: gate::LetterSource::at(from.address),
        };
        if let Err(why) = self.ask_gate(now, &entry.name, parts.as_ref(), unproved) {
            let why = (FailureReason::Refused, why);
            self.unframed_failed(&entry.name, unframed, why);
            return;
        }
        let answered = std::mem::take(answered);
        if !answered.is_empty() {
            *is_contact = self.report_answered(now, answered, from.address);
        }
        let stream_sender = self.table.config.incarnation;
        let stream = Stream::between(stream_sender, entry.incarnation);
        let sequence = self.sequence_of(stream_sender);
        if let Some(inbox) = self.agents.get_mut(&entry.incarnation)
            && inbox.push_unframed(letter.clone(), via, from.address)
        {
            let outcome = LetterOutcome::Delivered;
            self.table
                .counts()
                .letter(Direction::Received, Some(via), outcome);
            self.table
                .notice(stream, sequence, &entry.name, || News::Taken {
                    via: Some(via),
                    letter: letter.clone(),
                });
            let agent = entry.incarnation;
            self.table.actions.push_back(Action::Deliverable { agent });
            return;
        }
        self.table
            .notice(stream, sequence, &entry.name, || News::Passed {
                via,
                remote: true,
                letter: letter.clone(),
            });
        let lane = self.lane(now, own_lane(stream_sender, entry), &entry.name);
        let until = now.instant + deadline.min(MAX_DEADLINE);
        let failed = failed.clone();
        if *is_contact || self.is_ahead {
            self.await_publication(lane);
        }
        let address = from.address;
        let origin = Origin::LegacyPeer { from, failed };
        let letter_of = (stream.receiver, sequence);
        let open_letter = OpenLetter::new(now.instant, origin, letter.clone(), letter_of, until);
        self.put_unframed(now, lane, open_letter, address);
    }

    /// Reports that a legacy peer's letter cannot be delivered to this receiver.
    fn unframed_failed(
        &mut self,
        receiver: &Arc<str>,
        unframed: &Unframed,
        (reason, detail): (FailureReason, String),
    ) {
        let own = self.table.config.incarnation;
        let stream = Stream::between(own, Incarnation::UNKNOWN);
        let sequence = self.sequence_of(own);
        self.table
            .notice(stream, sequence, receiver, || News::Passed {
                via: unframed.via,
                remote: true,
                letter: unframed.letter.clone(),
            });
        self.table
            .notice(stream, sequence, receiver, || News::Settled {
                outcome: failed_for(reason),
                sender: true,
            });
        self.unframed_undelivered(receiver, unframed, (reason, detail));
    }

    /// Has the source of a legacy peer's letter told that this receiver does not get it.
    fn unframed_undelivered(
        &mut self,
        receiver: &Arc<str>,
        unframed: &Unframed,
        (reason, detail): (FailureReason, String),
    ) {
        let Some(failed) = unframed.failed.clone() else {
            return;
        };
        let from = unframed.from;
        self.table.undelivered.push_back(Undelivered {
            sender: FailureTarget::LegacyPeer { from, failed },
            receiver: Arc::clone(receiver),
            letter: unframed.letter.clone(),
            reason,
            detail,
            count: 1,
        });
    }
}

pub(super) fn failed_for(reason: FailureReason) -> Outcome {
    Outcome::Failed {
        reason,
        attempts: Vec::new(),
    }
}
