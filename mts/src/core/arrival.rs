//! Parcels that arrive: what they claim is checked, an unknown receiver is refused, and a letter for an agent of this process
//! goes into its queue.

use std::sync::Arc;

use fipa_acl::Letter;
use fipa_sds::{Entry, Reach, Role};
use fipa_transport::counts::{Direction, Event, LetterOutcome};
use fipa_transport::{
    Answer, Arrival, Body, FailureReason, Hop, Incarnation, Kind, Parcel, Reaction, Realm, Report,
};

use super::action::Action;
use super::ids::LaneKey;
use super::inbox::{Inbox, Received, ask};
use super::label::{ArrivalLink, HandedOver, Label, PredecessorNote};
use super::principals::PrincipalError;
use super::{Core, News, Now, ReadLetter, reading, work};
use crate::gate::{LetterParts, Link};

impl Core {
    /// Handles a parcel that arrived by this kind of transport.
    #[inline]
    pub fn handle_arrival(&mut self, now: Now, via: Kind, arrival: Arrival) -> Reaction {
        let read = self.reader.read_arrival(&arrival);
        self.handle_read_arrival(now, via, arrival, read)
    }

    /// Handles a parcel whose letter the [reader](Self::reader) of this core has
    /// [read](super::LetterReader::read_arrival) before the core was locked. A gateway refuses a letter that
    /// was not read. With a gate, a letter that was not read is read here.
    pub fn handle_read_arrival(
        &mut self,
        now: Now,
        via: Kind,
        arrival: Arrival,
        read: Option<Box<ReadLetter>>,
    ) -> Reaction {
        let Arrival {
            mut parcel,
            from,
            ticket,
        } = arrival;
        work::steps(1);
        let is_letter = matches!(parcel.body, Body::Letter(_));
        let view = &*self.table.view;
        if let Err(error) = self.principals.check_service(&from, is_letter, view) {
            return Reaction::Now(Answer::failed(FailureReason::Refused, error.to_string()));
        }
        if from.is_remote() {
            parcel.stream.realm = match parcel.body {
                Body::Letter(_) | Body::Predecessor => self.principals.realm(&from),
                // About letters of agents of this host.
                Body::Report(_) | Body::Credit => Realm::UNPROVED,
            };
        }
        // Taken apart here: passing the body on would copy it once more.
        let Parcel {
            receiver,
            stream,
            sequence,
            after,
            transfer,
            remaining,
            body,
        } = parcel;
        let label = Label {
            receiver,
            stream,
            sequence,
            after,
            transfer,
            remaining,
        };
        match body {
            Body::Letter(letter) => {
                let link = ArrivalLink { via, from, ticket };
                self.handle_letter(now, link, &label, (letter, read))
            }
            Body::Report(report) => self.handle_report(now, &label, &from, report),
            Body::Credit => self.handle_credit(now, &label, &from),
            Body::Predecessor => self.handle_predecessor(now, &label, &from),
        }
    }

    /// Puts a letter for an agent of this process into its queue, and takes one for another agent into custody.
    // A call would copy the letter once more.
    #[inline(always)]
    fn handle_letter(
        &mut self,
        now: Now,
        link: ArrivalLink,
        label: &Label,
        (letter, read): (Letter, Option<Box<ReadLetter>>),
    ) -> Reaction {
        let ArrivalLink { via, from, ticket } = link;
        let read = self.reader.completed(read, &letter, from.is_remote());
        if let Err(refusal) = self.check_letter(label, &from, &letter, read.as_deref()) {
            self.count_refusal(via, &refusal);
            return Reaction::Now(refusal);
        }
        let registration = label.stream.receiver;
        let Some(inbox) = self.agents.get_mut(&registration) else {
            // A service that does not forward has not read the envelope.
            let (parts, envelope) = read.map_or((None, None), |read| (read.parts, read.envelope));
            let Some(envelope) = envelope else {
                let why = "the agent is no longer in this process";
                return Reaction::Now(Answer::failed(FailureReason::NoSuchAgent, why));
            };
            let link = ArrivalLink { via, from, ticket };
            let reaction = self.forward(now, link, label, letter, (envelope, parts));
            if let Reaction::Now(answer) = &reaction {
                self.count_refusal(via, answer);
            }
            self.send_failures(now);
            return reaction;
        };
        let seen = self.table.watched.then(|| letter.clone());
        let parts = read.as_ref().and_then(|read| read.parts.as_ref());
        let gate = self.reader.gate().map(|gate| (gate, parts));
        let waiting = inbox.len();
        let answer = inbox.accept(now.instant, label, letter, (via, &from), gate);
        // Otherwise an earlier copy was accepted.
        if inbox.len() > waiting {
            let counts = self.table.counts();
            counts.letter(Direction::Received, Some(via), LetterOutcome::Delivered);
        }
        if answer == Answer::Accepted {
            if let Some(letter) = seen {
                let via = Some(via);
                self.table
                    .notice(label.stream, label.sequence, &label.receiver, || {
                        News::Taken { via, letter }
                    });
            }
            let agent = registration;
            self.table.actions.push_back(Action::Deliverable { agent });
        } else {
            self.count_refusal(via, &answer);
        }
        Reaction::Now(answer)
    }

    #[cold]
    fn count_refusal(&self, via: Kind, answer: &Answer) {
        let refused = FailureReason::Refused;
        if matches!(answer, Answer::Failed { reason, .. } if *reason == refused) {
            let counts = self.table.counts();
            counts.letter(Direction::Received, Some(via), LetterOutcome::Refused);
        }
    }

    /// Checks what a letter claims: its sender, its place in the stream, and its sizes.
    ///
    /// # Errors
    /// The answer that refuses it.
    #[inline(always)]
    fn check_letter(
        &mut self,
        label: &Label,
        from: &Hop,
        letter: &Letter,
        read: Option<&ReadLetter>,
    ) -> Result<(), Answer> {
        let refused = |detail: String| Err(Answer::failed(FailureReason::Refused, detail));
        let sender = (
            label.stream.sender,
            read.and_then(|read| read.sender_name()),
        );
        let view = &*self.table.view;
        match self.principals.check_sender(sender, from, view) {
            Ok(()) => {}
            Err(PrincipalError::NotIntroduced) => return Err(Answer::Busy),
            Err(error) => return refused(error.to_string()),
        }
        if label.sequence == 0 || label.after >= label.sequence {
            return refused("the letter's sequence is not above its predecessor's".to_owned());
        }
        if self.closed && self.agents.contains_key(&label.stream.receiver) {
            let reason = FailureReason::NoSuchAgent;
            return Err(Answer::failed(reason, "the process is closing"));
        }
        if let Some(detail) = reading::too_long(letter) {
            return Err(Answer::failed(FailureReason::TooLarge, detail));
        }
        match read.and_then(|read| read.fault.clone()) {
            Some(detail) => refused(detail),
            None => Ok(()),
        }
    }

    /// Finds the receiver of a letter for an agent of another process.
    ///
    /// # Errors
    /// The answer that refuses the letter: its receiver is unknown, has left this host, or is not for this service to
    /// pass letters to.
    pub(super) fn find_receiver(
        &self,
        now: Now,
        label: &Label,
        from: &Hop,
    ) -> Result<Arc<Entry>, Answer> {
        let unknown = |why: &str| Answer::failed(FailureReason::NoSuchAgent, why);
        let registration = label.stream.receiver;
        let Some(entry) = self.table.receiver(registration, &label.receiver) else {
            return Err(
                match self.table.departed.contains(now.instant, registration) {
                    true => Answer::Moved,
                    false => unknown("the agent is not known to the gateway"),
                },
            );
        };
        if entry.role != Role::Agent {
            let why = "letters for another gateway are not passed on";
            return Err(Answer::failed(FailureReason::Refused, why));
        }
        // A gateway never relays between other hosts: letters from the network must be for its own.
        if from.is_remote() && entry.reach != Reach::Local {
            return Err(unknown("the agent is not on the gateway's host"));
        }
        Ok(entry)
    }

    fn handle_report(&mut self, now: Now, label: &Label, from: &Hop, report: Report) -> Reaction {
        if let Some(lane) = self.lane_of(label.stream, &label.receiver) {
            let letter = HandedOver {
                registration: label.stream.receiver,
                sequence: label.sequence,
                transfer: label.transfer,
            };
            self.with_lane(now, lane, |lane, table| {
                lane.reported(now.instant, from, letter, report, table);
            });
        }
        self.send_failures(now);
        Reaction::Now(Answer::Accepted)
    }

    fn handle_credit(&mut self, now: Now, label: &Label, from: &Hop) -> Reaction {
        if let Some(lane) = self.lane_of(label.stream, &label.receiver) {
            self.with_lane(now, lane, |lane, table| {
                lane.credited(now.instant, from, table);
            });
        }
        self.send_failures(now);
        Reaction::Now(Answer::Accepted)
    }

    fn handle_predecessor(&mut self, now: Now, label: &Label, from: &Hop) -> Reaction {
        let mut answer = None;
        if let Some(lane) = self.lane_ids.get(&LaneKey::Custody(label.stream)) {
            let note = PredecessorNote {
                sequence: label.sequence,
                after: label.after,
                transfer: label.transfer,
            };
            self.with_lane(now, *lane, |lane, table| {
                answer = lane.handle_predecessor_note(now.instant, from, note, table);
            });
        }
        self.send_failures(now);
        // A report that is on its way tells more than that the letter is gone.
        let is_reported = self
            .table
            .is_reporting(label.stream, label.sequence, label.transfer);
        Reaction::Now(match answer {
            Some(answer) => answer,
            None if is_reported => {
                self.table.repeat_reports(now.instant, &from.location);
                self.await_answers(now);
                Answer::Accepted
            }
            None => Answer::Returned { uncertain: true },
        })
    }

    /// Asks the gate, if there is one, about a letter that it has read.
    pub(super) fn ask_gate(
        &self,
        now: Now,
        receiver: &str,
        parts: Option<&LetterParts>,
        link: Link,
    ) -> Result<(), String> {
        match self.reader.gate() {
            Some(gate) => ask(gate, now.instant, receiver, parts, link),
            None => Ok(()),
        }
    }

    /// Takes the next letter from an agent's queue.
    pub fn take(&mut self, agent: Incarnation) -> Option<Received> {
        let inbox = self.agents.get_mut(&agent)?;
        let received = inbox.take()?;
        self.table.counts().event(Event::Read, 1);
        let receiver = Arc::clone(&inbox.name);
        for (stream, back) in inbox.credits() {
            self.table.credit(stream, Arc::clone(&receiver), back);
        }
        Some(received)
    }

    /// Number of letters in an agent's queue.
    #[must_use]
    pub fn waiting(&self, agent: Incarnation) -> usize {
        self.agents.get(&agent).map_or(0, Inbox::len)
    }
}
