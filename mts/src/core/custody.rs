//! Letters for agents of other processes, which a gateway takes into custody.

use std::time::{Duration, Instant};

use fipa_acl::{DecodeError, Letter};
use fipa_sds::{Entry, Source};
use fipa_transport::{
    Answer, FailureReason, Hop, Incarnation, Location, PeerId, Reaction, Signature, log_limit,
};
use smallvec::smallvec;

use super::contacts::TooManyContacts;
use super::ids::LaneKey;
use super::inbox::link_of;
use super::label::{ArrivalLink, Label};
use super::lane::OpenLetter;
use super::origin::{Origin, Upstream};
use super::{Core, MAX_DEADLINE, News, Now};
use crate::LetterParts;
use crate::stamp::{self, EnvelopeParts};

/// Time after which a sender is told that its letter is in custody, unless its outcome is known
/// earlier.
const CUSTODY_AFTER: Duration = Duration::from_millis(200);

/// Time from the registration of an agent until legacy peers have found it by mDNS. Avahi takes 1.2
/// s to resolve a new agent; a peer that receives a letter earlier cannot answer it.
const FOUND_AFTER: Duration = Duration::from_millis(1500);
/// Time after a first letter in which the gateway of its sender usually announces the sender.
const ANNOUNCED_AFTER: Duration = Duration::from_millis(500);
/// Time that remains for the delivery of a letter that waits until its sender is found.
const LEFT_FOR_DELIVERY: Duration = Duration::from_millis(250);

impl Core {
    /// Takes a letter for an agent of another process into custody, or returns the reason why not.
    pub(super) fn forward(
        &mut self,
        now: Now,
        link: ArrivalLink,
        label: &Label,
        letter: Letter,
        (envelope, parts): (Result<EnvelopeParts, DecodeError>, Option<LetterParts>),
    ) -> Reaction {
        let ArrivalLink { via, from, ticket } = link;
        let unanswered = ticket.map(|ticket| (via, ticket));
        let receiver = self.find_receiver(now, label, &from);
        let stamped =
            receiver.and_then(|entry| Ok((entry, self.stamped(now, letter, envelope, &from)?)));
        let (entry, (stamped, envelope)) = match stamped {
            Ok(stamped) => stamped,
            Err(refusal) => return Reaction::Now(refusal),
        };
        let stream = label.stream;
        let key = LaneKey::Custody(stream);
        let taken = match unanswered {
            Some(_) => Reaction::Later,
            None => Reaction::Now(Answer::Custody),
        };
        let mut upstream = Upstream {
            back: from.location.clone(),
            remote: from.is_remote(),
            transfer: label.transfer,
            unanswered,
        };
        if let Some(id) = self.lane_ids.get(&key).copied() {
            let mut not_adopted = Some(upstream);
            self.with_lane(now, id, |lane, table| {
                not_adopted = not_adopted
                    .take()
                    .and_then(|it| lane.adopt(now.instant, label, it, table).err());
            });
            upstream = match not_adopted {
                Some(upstream) => upstream,
                None => return taken,
            };
        }
        if self.ending {
            return Reaction::Now(Answer::Busy);
        }
        let is_first = !self.lane_ids.contains_key(&key);
        let id = self.lane(now, key, &entry.name);
        if let Some(lane) = self.lanes.get_mut(&id)
            && !lane.takes_into_custody(label.sequence, stamped.len(), &self.table)
        {
            lane.wait_for_credit(from.location);
            return Reaction::Now(Answer::Busy);
        }
        if let Err(why) = self.ask_gate(now, &entry.name, parts.as_ref(), link_of(via, &from)) {
            return Reaction::Now(Answer::failed(FailureReason::Refused, why));
        }
        let mut announced_by = None;
        if from.is_remote() {
            match self.report_contact(now.instant, stream.sender, envelope, &from) {
                Ok(true) => self.await_publication(id),
                Ok(false) if is_first && self.is_ahead => self.await_publication(id),
                Err(TooManyContacts) if is_first => {
                    let wait = ANNOUNCED_AFTER.min(label.remaining / 2);
                    announced_by = Some(now.instant + wait);
                }
                _ => {}
            }
        }
        self.table
            .notice(stream, label.sequence, &entry.name, || News::Passed {
                via,
                remote: from.is_remote(),
                letter: stamped.clone(),
            });
        let deadline = now.instant + label.remaining.min(MAX_DEADLINE);
        let origin = Origin::Forwarded {
            upstreams: smallvec![upstream],
        };
        let letter_of = (stream.receiver, label.sequence);
        let mut open_letter = OpenLetter::new(now.instant, origin, stamped, letter_of, deadline);
        open_letter.after = label.after;
        open_letter.custody_due = unanswered.map(|_| now.instant + CUSTODY_AFTER);
        if let Some(until) = announced_by {
            open_letter.delay_until(until);
        }
        let sender = (stream.sender, from.is_remote());
        if let Some(until) = self.found_by_peer(now, sender, &entry, label.remaining) {
            open_letter.delay_until(until);
            if self.lanes.get(&id).is_some_and(|lane| lane.is_empty()) {
                let wait = until.saturating_duration_since(now.instant);
                log_limit::info!(
                    of: &*entry.name, receiver = %entry.name,
                    wait_ms = u64::try_from(wait.as_millis()).unwrap_or(u64::MAX),
                    "letters wait until the legacy peer has found their sender by mDNS"
                );
            }
        }
        self.put(now, id, open_letter);
        taken
    }

    /// Returns the letter with the stamp of this service, and the parts of its envelope.
    ///
    /// # Errors
    /// The answer that refuses a letter that has been here before, or whose envelope takes no stamp.
    fn stamped(
        &self,
        now: Now,
        letter: Letter,
        envelope: Result<EnvelopeParts, DecodeError>,
        from: &Hop,
    ) -> Result<(Letter, EnvelopeParts), Answer> {
        let config = &self.table.config;
        let refused = |why: String| Answer::failed(FailureReason::Refused, why);
        let envelope = envelope.map_err(|error| refused(error.to_string()))?;
        if envelope.is_loop {
            return Err(Answer::failed(FailureReason::Loop, &*config.name));
        }
        let peer = PeerId::of(from.principal, Some(&from.location));
        let stamped = stamp::put(letter, &config.name, config.incarnation, &peer, now.utc)
            .map_err(|error| refused(error.to_string()))?;
        Ok((stamped, envelope))
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
}
