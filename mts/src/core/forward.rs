//! Letters for agents of other processes: the gateway's role, and letters of legacy peers.

use std::collections::VecDeque;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_acl::{AclRepresentation, DecodeError, EncodeError, Letter, Message};
use fipa_sds::{Entry, Reach, Resolution, Role, Source, View};
use fipa_transport::{
    Answer, FailureReason, Hop, Incarnation, Kind, LegacySource, Location, Outcome, Parcel, PeerId,
    Signature, Stream, Ticket, Verdict, log_limit, quota_address,
};

use super::attempts::{Action, FailureTarget, Origin, Undelivered, Upstream};
use super::failures::{Stated, cannot_be_decoded, stated};
use super::inbox::{ask, link_of};
use super::lane::{Delivery, LaneId, LaneKey};
use super::limits::{Rate, SenderLimit};
use super::reading::{refused_name_of_legacy_peer, too_long};
use super::{Core, LetterReader, MAX_DEADLINE, News, Now, ReadLetter, own_lane, work};
use crate::dial::Claim;
use crate::gate::{self, LetterParts, Link};
use smallvec::smallvec;

use crate::failure::{Failed, sender_of};
use crate::stamp::{self, EnvelopeParts};

/// Time after which a sender is told that its letter is in custody, unless its outcome is known
/// earlier.
const CUSTODY_AFTER: Duration = Duration::from_millis(200);

/// Time from the registration of an agent until legacy peers have found it by mDNS. Avahi takes 1.2
/// s to resolve a new agent; a peer that receives a letter earlier cannot answer it.
const FOUND_AFTER: Duration = Duration::from_millis(1500);
/// Time that remains for the delivery of a letter that waits until its sender is found.
const LEFT_FOR_DELIVERY: Duration = Duration::from_millis(250);

/// Maximum number of receivers of one letter of a legacy peer. fipa_services writes one.
const MAX_UNFRAMED_RECEIVERS: usize = 64;
/// Maximum number of patterns among the receivers of one letter of a legacy peer.
const MAX_UNFRAMED_PATTERNS: usize = 1;
/// Maximum length of a legacy peer's pattern, in bytes: a longer one takes tens of milliseconds to
/// compile.
const MAX_UNFRAMED_PATTERN: usize = 128;

/// Maximum number of agents in the `reply-to` of a legacy peer's letter that become known by it.
const MAX_REPLY_TO: usize = 4;

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

/// An agent to which answers may go: the sender of a legacy peer's letter, or one of its `reply-to`.
#[derive(Debug)]
struct Answered {
    name: String,
    stated: Vec<Stated>,
    is_sender: bool,
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

/// The receivers that a name in an envelope stands for.
fn receivers_of(name: Arc<str>, resolution: Resolution) -> Vec<Receiver> {
    let (entries, mut missing) = match resolution {
        Resolution::Exact(entry) => (vec![entry], Vec::new()),
        Resolution::Multicast(entries) => (entries, Vec::new()),
        Resolution::Coalition {
            agents,
            mut missing,
        } => {
            // Members on other hosts cannot be reached from here, which the sender is told.
            let away = agents.iter().filter(|entry| entry.reach != Reach::Local);
            missing.extend(away.map(|entry| Arc::clone(&entry.name)));
            (agents, missing)
        }
        Resolution::None => (Vec::new(), Vec::new()),
    };
    let here = entries.into_iter();
    let mut here = here.filter(|entry| entry.reach == Reach::Local).peekable();
    if here.peek().is_none() && missing.is_empty() {
        missing.push(name);
    }
    let missing = missing.into_iter().map(Receiver::Unknown);
    missing.chain(here.map(Receiver::Here)).collect()
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

/// Returns the agents of a letter to which answers may go, with their addresses. The host name that the sender has
/// in its own address stands for the source of the letter; other host names in `reply-to` are left out.
fn answered(message: &Message, letter: &Letter, from: LegacySource) -> Vec<Answered> {
    let mut all = Vec::new();
    let mut hosts: Vec<String> = Vec::new();
    if let Some(sender) = sender_of(message, letter) {
        let stated = stated(sender.addresses().iter().map(|it| &**it), from);
        hosts.extend(stated.iter().filter_map(|it| it.host.clone()));
        all.push(Answered {
            name: sender.name().to_owned(),
            stated,
            is_sender: true,
        });
    }
    for agent in message.reply_to().iter().take(MAX_REPLY_TO) {
        if all.iter().any(|known| known.name == agent.name()) {
            continue;
        }
        let mut stated = stated(agent.addresses().iter().map(|it| &**it), from);
        stated.retain(|it| it.host.as_ref().is_none_or(|host| hosts.contains(host)));
        all.push(Answered {
            name: agent.name().to_owned(),
            stated,
            is_sender: false,
        });
    }
    all
}

/// Limits the rate at which agents become known by their letters: each is published to the processes of the host.
/// The agents of a platform have one address and may begin together, so a burst is larger than the rate.
pub(super) fn contact_limit() -> SenderLimit {
    SenderLimit::new(
        Rate::of(2.0),
        Rate::with_burst(50.0, 1000.0),
        Rate::with_burst(200.0, 4000.0),
    )
}

impl Core {
    /// Takes a letter for an agent of another process into custody, or returns the reason why not.
    /// `unanswered` is the arrival that may be answered later, `read` has the parts of the
    /// letter.
    pub(super) fn forward(
        &mut self,
        now: Now,
        (via, from, unanswered): (Kind, Hop, Option<(Kind, Ticket)>),
        parcel: &Parcel,
        letter: Letter,
        read: Option<Box<ReadLetter>>,
    ) -> Verdict {
        let (parts, envelope) = match read {
            Some(read) => (read.parts, read.envelope),
            None => (None, None),
        };
        let (entry, stamped, envelope) = match self.admit(now, parcel, (letter, envelope), &from) {
            Ok(admitted) => admitted,
            Err(refusal) => return Verdict::Now(refusal),
        };
        let stream = parcel.stream;
        let key = LaneKey::Custody(stream);
        let taken = match unanswered {
            Some(_) => Verdict::Later,
            None => Verdict::Now(Answer::Custody),
        };
        let mut upstream = Upstream {
            back: from.location.clone(),
            remote: from.is_remote(),
            transfer: parcel.transfer,
            unanswered,
        };
        if let Some(id) = self.lane_ids.get(&key).copied() {
            let mut kept = Some(upstream);
            self.with_lane(now, id, |lane, table| {
                let letter = (parcel.sequence, parcel.after);
                kept = kept
                    .take()
                    .and_then(|it| lane.adopt(now.instant, letter, it, table).err());
            });
            upstream = match kept {
                Some(upstream) => upstream,
                None => return taken,
            };
        }
        if self.ending {
            return Verdict::Now(Answer::Busy);
        }
        let id = self.lane(now, key, &entry.name);
        if let Some(lane) = self.lanes.get_mut(&id)
            && !lane.admits(parcel.sequence, stamped.len(), &self.table)
        {
            lane.wait_for_credit(from.location);
            return Verdict::Now(Answer::Busy);
        }
        if let Err(why) = self.admits(now, &entry.name, parts.as_ref(), link_of(via, &from)) {
            return Verdict::Now(Answer::failed(FailureReason::Refused, why));
        }
        let is_contact =
            from.is_remote() && self.report_contact(now.instant, stream.sender, envelope, &from);
        if is_contact {
            self.await_publication(id);
        }
        self.table
            .notice(stream, parcel.sequence, &entry.name, || News::Passed {
                via,
                remote: from.is_remote(),
                letter: stamped.clone(),
            });
        let deadline = now.instant + parcel.remaining.min(MAX_DEADLINE);
        let origin = Origin::Forwarded {
            upstreams: smallvec![upstream],
        };
        let letter_of = (stream.receiver, parcel.sequence);
        let mut delivery = Delivery::new(now.instant, origin, stamped, letter_of, deadline);
        delivery.after = parcel.after;
        delivery.custody_due = unanswered.map(|_| now.instant + CUSTODY_AFTER);
        let sender = (stream.sender, from.is_remote());
        if let Some(until) = self.found_by_peer(now, sender, &entry, parcel.remaining) {
            delivery.delay_until(until);
            if self.lanes.get(&id).is_some_and(|lane| lane.is_empty()) {
                let wait = until.saturating_duration_since(now.instant);
                log_limit::info!(
                    of: &*entry.name, receiver = %entry.name,
                    wait_ms = u64::try_from(wait.as_millis()).unwrap_or(u64::MAX),
                    "letters wait until the legacy peer has found their sender by mDNS"
                );
            }
        }
        self.put(now, id, delivery);
        taken
    }

    /// Returns the time until which a letter waits so that the receiver's legacy peer, which was
    /// found by mDNS, can find the sender. `None` if it need not wait. The wait uses at most part of
    /// the time that the letter has left.
    fn found_by_peer(
        &self,
        now: Now,
        (sender, is_remote): (Incarnation, bool),
        receiver: &Entry,
        remaining: Duration,
    ) -> Option<Instant> {
        let is_legacy = |location: &Location| location.signature() != Signature::Frames;
        if receiver.source != Source::Mdns || !receiver.locations.iter().any(is_legacy) {
            return None;
        }
        let ago = match self.table.view.registered(sender) {
            // A registration in the future means that the clock was set back.
            Some(sender) => now
                .utc
                .duration_since(sender.registered)
                .unwrap_or_default(),
            // An agent of this host that the view does not show yet has just registered.
            None if !is_remote => Duration::ZERO,
            None => return None,
        };
        let wait = FOUND_AFTER.checked_sub(ago)?;
        let latest = remaining - LEFT_FOR_DELIVERY.min(remaining / 2);
        let wait = wait.min(latest);
        (!wait.is_zero()).then(|| now.instant + wait)
    }

    /// Asks the gate, if there is one, about a letter that it has read.
    fn admits(
        &self,
        now: Now,
        receiver: &str,
        parts: Option<&LetterParts>,
        link: Link,
    ) -> Result<(), String> {
        match &self.reader.gate {
            Some(gate) => ask(&**gate, now.instant, receiver, parts, link),
            None => Ok(()),
        }
    }

    /// Checks whether this service forwards the letter; returns the receiver, the stamped letter, and
    /// the parts of its envelope.
    fn admit(
        &self,
        now: Now,
        parcel: &Parcel,
        (letter, envelope): (Letter, Option<Result<EnvelopeParts, DecodeError>>),
        from: &Hop,
    ) -> Result<(Arc<Entry>, Letter, EnvelopeParts), Answer> {
        let config = &self.table.config;
        let unknown = |why: &str| Answer::failed(FailureReason::NoSuchAgent, why);
        let refused = |why: String| Answer::failed(FailureReason::Refused, why);
        let Some(envelope) = envelope else {
            return Err(unknown("the agent is no longer in this process"));
        };
        let registration = parcel.stream.receiver;
        let Some(entry) = self.table.receiver(registration, &parcel.receiver) else {
            return Err(
                match self.table.departed.contains(now.instant, registration) {
                    true => Answer::Moved,
                    false => unknown("the agent is not known to the gateway"),
                },
            );
        };
        if entry.role != Role::Agent {
            return Err(refused(
                "letters for another gateway are not passed on".to_owned(),
            ));
        }
        // A gateway never relays between other hosts: letters from the network must be for its own.
        if from.is_remote() && entry.reach != Reach::Local {
            return Err(unknown("the agent is not on the gateway's host"));
        }
        let envelope = envelope.map_err(|error| refused(error.to_string()))?;
        if envelope.is_loop {
            return Err(Answer::failed(FailureReason::Loop, &*config.name));
        }
        let peer = PeerId::of(from.principal, Some(&from.location));
        let stamped = stamp::put(letter, &config.name, config.incarnation, &peer, now.utc)
            .map_err(|error| refused(error.to_string()))?;
        Ok((entry, stamped, envelope))
    }

    /// Reports the sender of a letter with this envelope as a contact if it is unknown, or known as a contact at
    /// another location, so that it can be answered. Returns whether it did.
    fn report_contact(
        &mut self,
        now: Instant,
        agent: Incarnation,
        envelope: EnvelopeParts,
        from: &Hop,
    ) -> bool {
        let view = &self.table.view;
        if !agent.is_known() {
            return false;
        }
        let registered = view.registered(agent);
        if let Some(known) = &registered {
            if known.source != Source::Contact {
                return false;
            }
            if known.locations.first() == Some(&from.location) {
                let name = Arc::clone(&known.name);
                self.table.actions.push_back(Action::HeardAgain { name });
                return false;
            }
        }
        // A letter that was forwarded by the receiver's previous gateway does not come from the
        // sender's location.
        let Some(name) = envelope.sender.filter(|_| envelope.stamps <= 1) else {
            return false;
        };
        let known = registered.or_else(|| view.named(&name));
        if known.is_some_and(|known| known.source != Source::Contact || *known.name != name) {
            return false;
        }
        let address = from.location.authority().parse::<SocketAddr>();
        let address = address.ok().map(|it| it.ip().to_canonical());
        if !self.contact_limit.take(now, address, &name) {
            tracing::debug!(at = %from.location, "rate limit of new agents exceeded; this one cannot be answered");
            return false;
        }
        let location = from.location.clone();
        self.table.actions.push_back(Action::Heard {
            name,
            agent,
            location,
            host: None,
        });
        true
    }

    /// Makes the letters of a lane wait until the contacts were published to the processes of this host, so that
    /// their receivers can answer.
    fn await_publication(&mut self, lane: LaneId) {
        if let Some(lane) = self.lanes.get_mut(&lane) {
            lane.want_refresh(&mut self.table);
        }
    }

    /// Reports an agent of a legacy peer as a contact, at the location that it states as its own. Only for an
    /// agent that is unknown, or known as a contact. Returns whether it did.
    fn report_legacy_contact(
        &mut self,
        now: Now,
        (name, stated): (String, Stated),
        from: IpAddr,
    ) -> bool {
        if !self.table.config.forwards {
            return false;
        }
        let Stated { location, host, .. } = stated;
        if let Some(known) = self.table.view.named(&name) {
            if !known.is_unregistered_contact() {
                return false;
            }
            if known.locations.contains(&location) {
                let address = location.authority().parse::<SocketAddr>();
                if address.is_ok_and(|address| address.ip().to_canonical() == from) {
                    let name = Arc::clone(&known.name);
                    self.table.actions.push_back(Action::HeardAgain { name });
                }
                return false;
            }
        }
        if !self
            .legacy_contact_limit
            .take(now.instant, Some(from), &name)
        {
            tracing::debug!(%from, "rate limit of new agents of legacy peers exceeded; this one cannot be answered");
            return false;
        }
        self.table.actions.push_back(Action::Heard {
            name,
            agent: Incarnation::UNKNOWN,
            location,
            host,
        });
        true
    }

    /// Reports the agents of a legacy peer's letter to which answers may go as contacts, as far as their addresses may
    /// be dialed. Returns whether it reported one.
    fn report_answered(&mut self, now: Now, answered: Vec<Answered>, from: IpAddr) -> bool {
        let mut has_reported = false;
        let mut endpoints: Vec<SocketAddr> = Vec::new();
        for agent in answered {
            let claim = |at: SocketAddr| match agent.is_sender {
                true => Claim::Return(from),
                false => Claim::Received {
                    is_host: at.ip().to_canonical() == from.to_canonical(),
                    // Answers to the sender go there, too.
                    is_endpoint: endpoints.contains(&at),
                },
            };
            let mut stated = agent.stated.into_iter();
            let Some(stated) = stated.find(|it| self.permits(it.at, claim(it.at))) else {
                continue;
            };
            if agent.is_sender {
                endpoints.push(stated.at);
            }
            has_reported |= self.report_legacy_contact(now, (agent.name, stated), from);
        }
        has_reported
    }

    /// Whether another letter of this process can wait in this lane.
    pub(super) fn holds_back(&self, now: Now, lane: LaneId, len: usize) -> bool {
        let lane = self.lanes.get(&lane);
        lane.is_some_and(|lane| lane.holds_back(now.instant, len, &self.table))
    }

    /// Whether this lane has room for a letter whose sender cannot be held back.
    pub(super) fn has_room_for_stranger(&self, lane: LaneId, len: usize) -> bool {
        let lane = self.lanes.get(&lane);
        lane.is_some_and(|lane| {
            lane.has_room(len, &self.table) && lane.fits_into_custody(len, &self.table)
        })
    }

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
            } else if unframed.parts.is_none() {
                unframed.parts = self.reader.parts(&unframed.letter);
            }
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
            source: gate::Source::at(from.address),
        };
        if let Err(why) = self.admits(now, &entry.name, parts.as_ref(), unproved) {
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
        let room = self.lanes.get(&lane);
        if !room.is_some_and(|lane| lane.has_room_for_legacy(letter.len(), &self.table)) {
            let reason = FailureReason::QueueFull;
            self.unframed_undelivered(&entry.name, unframed, (reason, String::new()));
            self.table
                .notice(stream, sequence, &entry.name, || News::Settled {
                    outcome: failed_for(reason),
                    sender: true,
                });
            return;
        }
        let until = now.instant + deadline.min(MAX_DEADLINE);
        let failed = failed.clone();
        if *is_contact {
            self.await_publication(lane);
        }
        let origin = Origin::LegacyPeer { from, failed };
        let letter_of = (stream.receiver, sequence);
        let delivery = Delivery::new(now.instant, origin, letter.clone(), letter_of, until);
        self.put(now, lane, delivery);
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
        });
    }
}

fn failed_for(reason: FailureReason) -> Outcome {
    Outcome::Failed {
        reason,
        attempts: Vec::new(),
    }
}
