//! The actions that the core asks its runtime to perform.

use std::sync::Arc;

use fipa_transport::{
    Answer, AttemptId, Incarnation, Kind, Location, Outcome, Parcel, Ticket, TransportError,
    TransportErrorKind,
};

use super::ids::SubmissionId;
use super::watch_event::Notice;

/// An action that the runtime performs for the delivery core.
#[derive(Debug)]
pub enum Action {
    /// Pass this parcel to the transport of the location's kind. An immediate refusal by the
    /// transport is reported like any other conclusion.
    Dispatch {
        /// Identifies the attempt in its conclusion.
        attempt: AttemptId,
        /// The receiver's location.
        location: Location,
        /// The parcel.
        parcel: Parcel,
    },
    /// Make the transport [abandon](fipa_transport::Transport::abandon) this attempt. Its end is
    /// reported at once with [`Core::handle_conclusion`](super::Core::handle_conclusion).
    Abandon {
        /// The attempt.
        attempt: AttemptId,
        /// The location to which it was dispatched.
        location: Location,
        /// The error of the conclusion.
        error: TransportError,
    },
    /// Pass the transport the answer to an arrival that was deferred.
    Answer {
        /// The transport.
        kind: Kind,
        /// The arrival.
        ticket: Ticket,
        /// The answer.
        answer: Answer,
    },
    /// One receiver's outcome of a letter sent here.
    Outcome {
        /// The submission.
        submission: SubmissionId,
        /// The receiver.
        receiver: Arc<str>,
        /// The outcome.
        outcome: Outcome,
    },
    /// An agent of another host that is not in the directory has sent a letter. Letters to it can
    /// be sent to this location, from which its letter came or which a legacy peer states as its
    /// own. The letter waits for the [refresh](Self::Refresh) that follows: the contacts are published to the
    /// processes of this host before it.
    ContactSeen {
        /// Its name in the letter.
        name: String,
        /// Its incarnation; unknown for an agent of a legacy peer.
        agent: Incarnation,
        /// Location of its message transport service.
        location: Location,
        /// The host name in the address that it states, which was replaced by the address of its connection.
        host: Option<String>,
    },
    /// An agent of another host that is in the directory as a contact has sent another letter.
    ContactSeenAgain {
        /// Its name.
        name: Arc<str>,
    },
    /// An agent of a legacy peer has taken a letter.
    Taken {
        /// Its name.
        name: Arc<str>,
        /// The location that took the letter.
        location: Location,
    },
    /// An attempt at this location, of a known incarnation, failed: the service may have ended
    /// without a goodbye. Reported by gateways only.
    Suspect {
        /// The location.
        location: Location,
        /// Kind of the failure.
        fault: TransportErrorKind,
    },
    /// Refresh the directory, without the core locked, and report the end with
    /// [`Core::handle_refreshed`](super::Core::handle_refreshed) and this number.
    Refresh {
        /// Later refreshes have greater numbers.
        number: u64,
    },
    /// The number of outcomes of a letter for which [`Core::submit`](super::Core::submit) has returned
    /// none.
    Resolved {
        /// The submission.
        submission: SubmissionId,
        /// Number of outcomes, of which some may have been reported already.
        outcomes: usize,
    },
    /// A letter was added to this agent's queue.
    Deliverable {
        /// The agent.
        agent: Incarnation,
    },
    /// Notify the watcher before performing later actions; only while the core is watched.
    Notice(Box<Notice>),
}
