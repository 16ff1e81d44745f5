//! Letters that agents of this process send: their receivers are looked up, and each copy is put into its lane.

use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::Letter;
use fipa_sds::{Entry, Resolution, Role};
use fipa_transport::counts::{Direction, Event};
use fipa_transport::{Attempt, FailureReason, Incarnation, Outcome, Stream};

use super::action::Action;
use super::ids::{SubmissionId, registration_of};
use super::lane::OpenLetter;
use super::lanes::own_lane;
use super::letter_log::{LetterId, letter_debug};
use super::origin::Origin;
use super::undelivered::{FailureTarget, Undelivered};
use super::waiting::Unresolved;
use super::{Core, MAX_DEADLINE, News, Now};

/// A letter that an agent of this process sends.
#[derive(Debug, Clone)]
pub struct Submission {
    /// The sending agent's incarnation.
    pub sender: Incarnation,
    /// The letter, the same for all receivers.
    pub letter: Letter,
    /// Names of receivers or coalitions, or patterns.
    pub receivers: Vec<Arc<str>>,
    /// Time limit of the delivery, at most [`MAX_DEADLINE`].
    pub deadline: Duration,
}

impl Core {
    /// Sends a letter. Returns the number of outcomes that follow under this ID; outcomes that are
    /// known at once are among the actions when this method returns. The number is `None` if a
    /// receiver is not in the view, or is a pattern: [`Action::Resolved`] then reports it after the
    /// directory was refreshed. Letters of one sender are resolved in the order of the calls.
    pub fn submit(&mut self, now: Now, submitted: Submission) -> (SubmissionId, Option<usize>) {
        let Submission {
            sender,
            letter,
            receivers,
            deadline,
        } = submitted;
        let letter = match &receivers[..] {
            [receiver] => match self.submit_to_name(now, sender, letter, receiver, deadline) {
                Ok(submission) => return (submission, Some(1)),
                Err(letter) => letter,
            },
            _ => letter,
        };
        let submission = SubmissionId(self.next_submission);
        self.next_submission += 1;
        if self.closed {
            for receiver in &receivers {
                let receiver = Arc::clone(receiver);
                let reason = FailureReason::Closed;
                self.undeliverable(submission, sender, receiver, letter.clone(), reason);
            }
            self.table.undelivered.clear();
            return (submission, Some(receivers.len()));
        }
        let deadline = now.instant + deadline.min(MAX_DEADLINE);
        let mut unresolved = Unresolved {
            submission,
            sender,
            letter,
            receivers,
            deadline,
        };
        if self.is_in_turn(sender) {
            match self.resolve(now, unresolved, false) {
                Ok(outcomes) => return (submission, Some(outcomes)),
                Err(back) => unresolved = back,
            }
        }
        let len = unresolved.letter.len();
        if self.waiting.has_room(sender, len, &self.table.config) {
            let number = self.table.want_refresh();
            self.waiting.push(number, unresolved);
            return (submission, None);
        }
        let outcomes = unresolved.receivers.len();
        self.fail_receivers(unresolved, FailureReason::QueueFull);
        self.send_failures(now);
        (submission, Some(outcomes))
    }

    /// Sends a letter to the agent with exactly this name. One outcome follows.
    ///
    /// # Errors
    /// Returns the letter if it must be submitted to [`submit`](Self::submit), for example because the view
    /// shows no such agent.
    #[expect(
        clippy::result_large_err,
        reason = "the letter is moved in and back; a box would cost an allocation"
    )]
    pub fn submit_to_name(
        &mut self,
        now: Now,
        sender: Incarnation,
        letter: Letter,
        receiver: &str,
        deadline: Duration,
    ) -> Result<SubmissionId, Letter> {
        if self.closed || !self.is_in_turn(sender) {
            return Err(letter);
        }
        let is_agent = |entry: &Arc<Entry>| {
            entry.incarnation.is_known() && !matches!(entry.role, Role::Coalition(_))
        };
        let Some(entry) = self.table.view.named(receiver).filter(is_agent) else {
            return Err(letter);
        };
        let submission = SubmissionId(self.next_submission);
        self.next_submission += 1;
        let deadline = now.instant + deadline.min(MAX_DEADLINE);
        self.submit_one(now, (submission, sender), &entry, letter, deadline);
        self.send_failures(now);
        Ok(submission)
    }

    /// Whether no earlier letter of this sender waits to be resolved.
    fn is_in_turn(&self, sender: Incarnation) -> bool {
        self.waiting.is_empty() || !self.waiting.has_any_of(sender)
    }

    /// Resolves the receivers of a letter in the view, and sends it to them. Returns the number of
    /// outcomes, or the letter if a refresh of the directory may add receivers. After a refresh, an
    /// unknown receiver is final.
    #[expect(
        clippy::result_large_err,
        reason = "the letter is moved in and back; a box would cost an allocation"
    )]
    pub(super) fn resolve(
        &mut self,
        now: Now,
        unresolved: Unresolved,
        is_fresh: bool,
    ) -> Result<usize, Unresolved> {
        // Earlier letters to the same coalition go first.
        self.send_to_leaders(now);
        let view = Arc::clone(&self.table.view);
        let sender = unresolved.sender;
        let sender_name = self.name_of(sender);
        let own = sender_name.as_deref().unwrap_or_default();
        let mut resolved = Vec::new();
        for receiver in &unresolved.receivers {
            let resolution = fipa_sds::resolve(&*view, receiver, own);
            match resolution {
                Ok(resolution) if !is_fresh && !resolution.is_complete() => {
                    return Err(unresolved);
                }
                Ok(resolution) => resolved.push(resolution),
                // Not a valid pattern, so no name matches it.
                Err(_) => resolved.push(Resolution::None),
            }
        }
        let Unresolved {
            submission,
            letter,
            receivers,
            deadline,
            ..
        } = unresolved;
        let mut reached: Vec<Incarnation> = Vec::new();
        let mut count = 0;
        for (receiver, resolution) in receivers.into_iter().zip(resolved) {
            let entries = match resolution {
                Resolution::Exact(entry) => vec![entry],
                Resolution::Multicast(entries) => entries,
                Resolution::Coalition {
                    agents,
                    missing,
                    leaderless,
                } => {
                    count += missing.len() + leaderless.len();
                    for member in missing {
                        self.absent(submission, sender, member, letter.clone());
                    }
                    for coalition in leaderless {
                        self.wait_for_leader(Unresolved {
                            submission,
                            sender,
                            letter: letter.clone(),
                            receivers: vec![coalition],
                            deadline,
                        });
                    }
                    if agents.is_empty() {
                        continue;
                    }
                    agents
                }
                Resolution::None => Vec::new(),
            };
            if entries.is_empty() {
                count += 1;
                self.absent(submission, sender, receiver, letter.clone());
            }
            for entry in entries {
                let registration = registration_of(&entry);
                if reached.contains(&registration) {
                    continue;
                }
                reached.push(registration);
                count += 1;
                self.submit_one(now, (submission, sender), &entry, letter.clone(), deadline);
            }
        }
        self.send_failures(now);
        Ok(count)
    }

    fn name_of(&self, sender: Incarnation) -> Option<Arc<str>> {
        let inbox = self.agents.get(&sender)?;
        Some(Arc::clone(&inbox.name))
    }

    /// Keeps a letter to a coalition that has no leader at present. One outcome follows.
    fn wait_for_leader(&mut self, letter: Unresolved) {
        let len = letter.letter.len();
        match self
            .leaderless
            .has_room(letter.sender, len, &self.table.config)
        {
            true => self.leaderless.push(0, letter),
            false => self.fail_receivers(letter, FailureReason::QueueFull),
        }
    }

    /// Sends the letters to coalitions that have a leader again, in the order in which they were submitted. A letter
    /// to a coalition that no longer exists fails.
    pub(super) fn send_to_leaders(&mut self, now: Now) {
        if self.leaderless.is_empty() {
            return;
        }
        let view = Arc::clone(&self.table.view);
        let waits = |letter: &Unresolved| {
            let name = letter.receivers.first();
            name.is_some_and(|name| fipa_sds::is_leaderless(&*view, name))
        };
        for letter in self.leaderless.remove(|letter| !waits(letter)) {
            let Unresolved {
                submission,
                sender,
                letter,
                receivers,
                deadline,
            } = letter;
            let own = self.name_of(sender);
            for receiver in receivers {
                let own = own.as_deref().unwrap_or_default();
                match fipa_sds::resolve(&*view, &receiver, own) {
                    Ok(Resolution::Coalition { agents, .. }) if agents.len() == 1 => {
                        for entry in agents {
                            let letter = letter.clone();
                            self.submit_one(now, (submission, sender), &entry, letter, deadline);
                        }
                    }
                    // The coalition is dissolved, or its leader is several agents.
                    _ => self.absent(submission, sender, receiver, letter.clone()),
                }
            }
        }
        self.send_failures(now);
    }

    /// Ends the waiting letters for which this holds: those whose receivers were not resolved, and those that wait for a
    /// leader.
    pub(super) fn fail_waiting(
        &mut self,
        ends: impl Fn(&Unresolved) -> bool,
        reason: FailureReason,
    ) {
        for letter in self.waiting.remove(&ends) {
            self.table.actions.push_back(Action::Resolved {
                submission: letter.submission,
                outcomes: letter.receivers.len(),
            });
            self.fail_receivers(letter, reason);
        }
        for letter in self.leaderless.remove(&ends) {
            self.fail_receivers(letter, reason);
        }
    }

    fn fail_receivers(&mut self, letter: Unresolved, reason: FailureReason) {
        let Unresolved {
            submission,
            sender,
            letter,
            receivers,
            ..
        } = letter;
        for receiver in receivers {
            self.undeliverable(submission, sender, receiver, letter.clone(), reason);
        }
    }

    /// Handles the end of a refresh of the directory, which began after the core had emitted
    /// [`Action::Refresh`] with this number. Call [`set_view`](Self::set_view) before. A refresh
    /// covers all earlier numbers, too.
    pub fn handle_refreshed(&mut self, now: Now, number: u64) {
        while let Some(lane) = self.table.refreshed_lane(number) {
            self.with_lane(now, lane, |lane, table| {
                lane.refreshed(now.instant, number, table);
            });
        }
        while let Some(letter) = self.waiting.pop(number) {
            let submission = letter.submission;
            if let Ok(outcomes) = self.resolve(now, letter, true) {
                let resolved = Action::Resolved {
                    submission,
                    outcomes,
                };
                self.table.actions.push_back(resolved);
            }
        }
        self.send_failures(now);
    }

    /// Sends a letter to exactly this registration of an agent; the receivers in the submission are
    /// ignored. One outcome follows under this ID.
    pub fn submit_to(&mut self, now: Now, submitted: Submission, entry: &Entry) -> SubmissionId {
        let submission = SubmissionId(self.next_submission);
        self.next_submission += 1;
        let deadline = now.instant + submitted.deadline.min(MAX_DEADLINE);
        let sending = (submission, submitted.sender);
        self.submit_one(now, sending, entry, submitted.letter, deadline);
        self.send_failures(now);
        submission
    }

    fn submit_one(
        &mut self,
        now: Now,
        (submission, sender): (SubmissionId, Incarnation),
        entry: &Entry,
        letter: Letter,
        deadline: Instant,
    ) {
        let stream = Stream::between(sender, registration_of(entry));
        let name = &entry.name;
        if self.closed {
            let reason = FailureReason::Closed;
            return self.undeliverable(submission, sender, Arc::clone(name), letter, reason);
        }
        let lane = self.lane(now, own_lane(sender, entry), name);
        if !self.has_room_to_wait(now, lane, letter.len()) {
            let reason = FailureReason::QueueFull;
            return self.undeliverable(submission, sender, Arc::clone(name), letter, reason);
        }
        self.table.counts().event(Event::Submitted, 1);
        let sequence = self.sequence_of(sender);
        letter_debug!(LetterId::new(stream, sequence), receiver = %name, bytes = letter.len(), "sent");
        self.table.notice(stream, sequence, name, || News::Sent {
            submission: Some(submission),
            letter: letter.clone(),
        });
        let origin = Origin::Local { submission };
        let letter_of = (stream.receiver, sequence);
        let open_letter = OpenLetter::new(now.instant, origin, letter, letter_of, deadline);
        self.put(now, lane, open_letter);
    }

    /// Fails a letter for an agent that cannot be reached at any of its addresses. `attempts` has the reason for
    /// each of them. One outcome follows.
    pub fn fail_unreachable(
        &mut self,
        now: Now,
        (sender, letter): (Incarnation, Letter),
        receiver: Arc<str>,
        attempts: Vec<Attempt>,
    ) -> SubmissionId {
        let submission = SubmissionId(self.next_submission);
        self.next_submission += 1;
        let reason = FailureReason::NoSuchAgent;
        self.failed(submission, sender, receiver, letter, (reason, attempts));
        self.send_failures(now);
        submission
    }

    /// Fails a letter to an agent that the directory does not list.
    pub(super) fn absent(
        &mut self,
        submission: SubmissionId,
        sender: Incarnation,
        receiver: Arc<str>,
        letter: Letter,
    ) {
        let (reason, attempt) = self.table.absence(&receiver);
        let why = (reason, attempt.into_iter().collect());
        self.failed(submission, sender, receiver, letter, why);
    }

    pub(super) fn failed(
        &mut self,
        submission: SubmissionId,
        sender: Incarnation,
        receiver: Arc<str>,
        letter: Letter,
        (reason, attempts): (FailureReason, Vec<Attempt>),
    ) {
        let details: Vec<String> = attempts.iter().map(ToString::to_string).collect();
        let detail = details.join("; ");
        let outcome = Outcome::Failed { reason, attempts };
        let counts = self.table.counts();
        counts.event(Event::Submitted, 1);
        counts.settled(Direction::Sent, &outcome);
        counts.took(outcome.via(), Duration::ZERO);
        let sequence = self.sequence_of(sender);
        let stream = Stream::between(sender, Incarnation::UNKNOWN);
        self.table
            .notice(stream, sequence, &receiver, || News::Sent {
                submission: Some(submission),
                letter: letter.clone(),
            });
        self.table
            .notice(stream, sequence, &receiver, || News::Settled {
                outcome: outcome.clone(),
                sender: true,
            });
        self.table.undelivered.push_back(Undelivered {
            sender: FailureTarget::Ours(sender),
            receiver: Arc::clone(&receiver),
            letter,
            reason,
            detail,
            count: 1,
        });
        self.table.actions.push_back(Action::Outcome {
            submission,
            receiver,
            outcome,
        });
    }

    fn undeliverable(
        &mut self,
        submission: SubmissionId,
        sender: Incarnation,
        receiver: Arc<str>,
        letter: Letter,
        reason: FailureReason,
    ) {
        self.failed(submission, sender, receiver, letter, (reason, Vec::new()));
    }

    pub(super) fn sequence_of(&mut self, sender: Incarnation) -> u64 {
        let counter = match self.agents.get_mut(&sender) {
            Some(inbox) => &mut inbox.next_sequence,
            None => &mut self.next_sequence,
        };
        *counter += 1;
        *counter - 1
    }
}
