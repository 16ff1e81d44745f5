//! The conformance suite of all transports.

mod common;

use std::any::Any;
use std::sync::Arc;
use std::time::Duration;

use common::TestDomain;
use fipa_transport::conformance::{Fixture, KeyedEndpoint};
use fipa_transport::{Incarnation, Location, Transport};

struct Shm(TestDomain);

impl Fixture for Shm {
    fn endpoint(&self) -> Arc<dyn Transport> {
        let mut config = self.0.config();
        config.answers_late = true;
        Arc::new(self.0.endpoint_with(config))
    }

    fn nowhere(&self) -> Location {
        common::location_of(Incarnation::random())
    }

    fn keyed_pair(&self, _: Duration) -> Option<[KeyedEndpoint; 2]> {
        None
    }

    fn obstacle(&self) -> Option<Box<dyn Any>> {
        Some(Box::new(self.0.locked()))
    }
}

fipa_transport::conformance_tests!(Shm(TestDomain::new()));
