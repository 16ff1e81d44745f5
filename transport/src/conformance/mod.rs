//! The rules of [`Transport`], as tests for every implementation.
//!
//! ```text
//! struct Mine { /* the state that its endpoints share */ }
//! impl fipa_transport::conformance::Fixture for Mine { /* … */ }
//! fipa_transport::conformance_tests!(Mine::new());
//! ```
//!
//! The suite does not depend on a runtime: it calls [`Transport::drive`] and sleeps briefly until a
//! condition holds, and fails after a timeout that no working transport reaches.

mod edge_cases;
mod endpoint;
mod letters;
mod trust;

use std::any::Any;
use std::sync::Arc;
use std::time::Duration;

use crate::{Location, Transport};

pub use edge_cases::*;
pub use letters::*;
pub use trust::*;

/// The transport under test.
pub trait Fixture {
    /// Creates an endpoint without calling `listen`. Endpoints of one fixture can reach each other,
    /// and represent different processes.
    fn endpoint(&self) -> Arc<dyn Transport>;

    /// A location of this transport without an endpoint.
    fn nowhere(&self) -> Location;

    /// Creates two endpoints without calling `listen`, of different services whose certificates are
    /// valid now and trusted by the other one. The certificate of the first endpoint ends after this
    /// time. `None` if peers of this transport prove nothing. There is no default: a transport with
    /// keys must follow the rules on trust.
    fn keyed_pair(&self, valid_for: Duration) -> Option<[KeyedEndpoint; 2]>;

    /// Takes the locks that other processes of this host take while they change what the endpoints
    /// share, and holds them until the result is dropped, as a stopped process does. `None` if the
    /// transport has no such locks.
    fn obstacle(&self) -> Option<Box<dyn Any>> {
        None
    }
}

/// Defines one test per rule. The argument is an expression for a new [`Fixture`].
#[macro_export]
macro_rules! conformance_tests {
    ($fixture:expr) => {
        $crate::conformance_tests!(@each $fixture;
            every_field_and_kind_arrives
            answers_come_back_as_given
            contradictions_end_a_connection
            the_sink_has_the_letter_before_it_is_confirmed
            a_late_answer_concludes_its_own_parcel
            order_is_kept
            pieces_arrive_as_one_letter
            content_of_many_sizes_arrives
            a_letter_above_the_limit_is_not_sent
            a_location_without_an_endpoint_is_unreachable
            a_letter_for_another_incarnation_is_not_delivered
            parcels_can_be_sent_back_to_the_hop
            an_abandoned_attempt_is_concluded_at_once
            an_attempt_that_is_abandoned_unsent_never_arrives
            attempts_to_a_closing_receiver_are_concluded
            attempts_of_a_closing_sender_are_concluded
            a_closed_transport_refuses_parcels
            no_call_waits_for_another_process
            the_first_parcels_arrive_in_order
            letters_of_all_lengths_arrive_in_order
            letters_leave_room_for_other_parcels
            loaned_content_arrives
            shared_content_arrives_at_all_receivers
            a_flood_is_bounded_and_every_attempt_concluded
            many_endpoints_exchange_letters_with_one
            a_sink_may_call_its_transport
            a_caller_may_hold_a_lock_that_its_sink_takes
        );
        $crate::trust_conformance_tests!($fixture);
    };
    (@each $fixture:expr; $($rule:ident)*) => {
        $(#[test]
        fn $rule() {
            $crate::conformance::$rule(&$fixture);
        })*
    };
}

/// Defines the tests of the rules on trust only, for transports to legacy peers. The argument is an
/// expression for a new [`Fixture`].
#[macro_export]
macro_rules! trust_conformance_tests {
    ($fixture:expr) => {
        $crate::conformance_tests!(@each $fixture;
            withdrawn_trust_ends_open_connections
            the_end_of_a_certificate_ends_open_connections
        );
    };
}
