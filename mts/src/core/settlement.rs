//! The end of a letter in a lane, and the report of it to its sender or to the services that handed it over.

use std::sync::Arc;
use std::time::Instant;

use fipa_transport::counts::{Direction, Event};
use fipa_transport::{Answer, Body, Outcome, Parcel, Report, Stream};

use super::News;
use super::action::Action;
use super::lane::OpenLetter;
use super::lane_table::LaneTable;
use super::letter_log::{LetterId, letter_debug};
use super::notes::{Note, note_parcel};
use super::origin::{Origin, Settlement, Upstream};

impl LaneTable {
    /// Reports the end of a letter to its sender, or to the services that handed it over.
    pub(crate) fn settle(
        &mut self,
        now: Instant,
        open_letter: Box<OpenLetter>,
        stream: Stream,
        receiver: Arc<str>,
        settlement: Settlement,
    ) {
        let OpenLetter {
            origin,
            sequence,
            deadline,
            since,
            ..
        } = *open_letter;
        if let Settlement::Outcome(outcome) = &settlement {
            let counts = self.counts();
            match origin {
                Origin::Local { .. } => {
                    counts.settled(Direction::Sent, outcome);
                    counts.took(outcome.via(), now.saturating_duration_since(since));
                }
                Origin::Forwarded { .. } | Origin::LegacyPeer { .. } => {
                    counts.settled(Direction::Forwarded, outcome);
                }
                Origin::FailureMessage => counts.event(Event::FailureMessage, 1),
            }
            letter_debug!(LetterId::new(stream, sequence), %receiver, %outcome, "settled");
            self.notice(stream, sequence, &receiver, || News::Settled {
                outcome: outcome.clone(),
                sender: !matches!(origin, Origin::Forwarded { .. }),
            });
        }
        match (origin, settlement) {
            (Origin::Local { submission }, Settlement::Outcome(outcome)) => {
                self.actions.push_back(Action::Outcome {
                    submission,
                    receiver,
                    outcome,
                });
            }
            (Origin::Forwarded { upstreams }, settlement) => {
                let (brief, report) = answer_and_report(settlement);
                for upstream in upstreams {
                    let letter = (stream, sequence);
                    self.report_to(upstream, letter, &receiver, (&brief, &report), deadline);
                }
            }
            // Only custodians return letters; a failed failure message is not reported.
            (Origin::Local { .. } | Origin::LegacyPeer { .. } | Origin::FailureMessage, _) => {}
        }
    }

    fn report_to(
        &mut self,
        upstream: Upstream,
        (stream, sequence): (Stream, u64),
        receiver: &Arc<str>,
        (brief, report): (&Option<Answer>, &Report),
        deadline: Instant,
    ) {
        let Upstream {
            back,
            remote,
            transfer,
            unanswered,
        } = upstream;
        if let Some((kind, ticket)) = unanswered {
            let answer = match brief {
                // The transport within another host is of no interest there.
                Some(Answer::Delivered { .. }) if remote => Answer::Accepted,
                Some(brief) => brief.clone(),
                None => Answer::Custody,
            };
            self.actions.push_back(Action::Answer {
                kind,
                ticket,
                answer,
            });
            if brief.is_some() {
                return;
            }
        }
        let body = Body::Report(report.clone());
        let parcel = Parcel {
            transfer,
            ..note_parcel(stream, Arc::clone(receiver), sequence, body)
        };
        self.note(Note::until(deadline, back, parcel));
    }
}

/// The answer to services that handed a letter over, if an answer can express the end, and the
/// report otherwise.
fn answer_and_report(settlement: Settlement) -> (Option<Answer>, Report) {
    match settlement {
        Settlement::Outcome(outcome) => {
            let brief = match &outcome {
                Outcome::Delivered { via, attempts } if attempts.is_empty() => {
                    Some(Answer::Delivered { via: *via })
                }
                Outcome::Failed { reason, attempts } if attempts.is_empty() => {
                    Some(Answer::failed(*reason, ""))
                }
                _ => None,
            };
            (brief, Report::Settled(outcome))
        }
        Settlement::Returned { uncertain } => (
            Some(Answer::Returned { uncertain }),
            Report::Returned { uncertain },
        ),
        Settlement::Moved => (Some(Answer::Moved), Report::Moved),
    }
}
