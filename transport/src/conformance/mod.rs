//! The rules of [`Transport`], as tests that every implementation runs.
//!
//! ```text
//! struct Mine { /* what endpoints need to reach each other */ }
//! impl fipa_transport::conformance::Fixture for Mine { /* … */ }
//! fipa_transport::conformance_tests!(Mine::new());
//! ```
//!
//! The suite knows nothing of runtimes: it waits by calling [`Transport::drive`] and sleeping a
//! little until a condition holds, and gives up after a time that no working transport needs.

mod ends;
mod letters;
mod party;

use std::sync::Arc;

use crate::{Location, Transport};

pub use ends::*;
pub use letters::*;

/// What an implementation brings to the suite.
pub trait Fixture {
    /// A new endpoint on which `listen` was not called yet. Endpoints of one fixture can reach
    /// each other, and stand for different processes.
    fn endpoint(&self) -> Arc<dyn Transport>;

    /// A location of this transport at which nobody is.
    fn nowhere(&self) -> Location;
}

/// Makes one test per rule. The argument is an expression for a new [`Fixture`].
#[macro_export]
macro_rules! conformance_tests {
    ($fixture:expr) => {
        $crate::conformance_tests!(@each $fixture;
            every_field_and_kind_arrives
            answers_come_back_as_given
            the_letter_is_the_sinks_before_it_is_confirmed
            a_late_answer_reaches_its_own_parcel
            order_is_kept
            pieces_arrive_as_one_letter
            content_of_many_sizes_arrives
            what_is_too_large_is_not_sent
            nobody_is_nowhere
            another_incarnation_is_somebody_else
            a_hop_can_be_answered
            an_abandoned_attempt_is_concluded_at_once
            an_attempt_that_is_abandoned_unsent_never_arrives
            a_closing_receiver_leaves_no_attempt_open
            a_closing_sender_leaves_no_attempt_open
            a_closed_transport_takes_nothing
            loaned_content_arrives
            content_for_many_arrives_everywhere
            a_flood_is_bounded_and_every_attempt_concluded
            many_talk_to_one_and_one_to_many
            a_sink_may_use_its_transport
            a_caller_may_hold_a_lock_that_its_sink_wants
        );
    };
    (@each $fixture:expr; $($rule:ident)*) => {
        $(#[test]
        fn $rule() {
            $crate::conformance::$rule(&$fixture);
        })*
    };
}
