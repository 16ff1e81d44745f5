//! Stands for `checks.rs`, `demultiplexer.rs` and `lock_slot.rs` in a build without the feature `protocols`: nothing is checked, no call leads a conversation, and there are no locks.

use fipa_acl::Message;
use fipa_mts::core::Received;
use fipa_sds::Directory;
use fipa_transport::counts::SharedCounts;
use fipa_transport::log_limit;

use crate::agent::AgentCore;
use crate::agent::endpoint::Endpoint;
use crate::agent::incoming::Incoming;
use crate::config::{self, Check};
use crate::error::{OpenError, ReceiveError, SendError};

/// Does nothing.
#[derive(Default)]
pub(crate) struct Nothing;

pub(crate) type Rules = Nothing;
pub(crate) type Checks = Nothing;
pub(crate) type Origin = Nothing;
pub(crate) type Demultiplexer = Nothing;
pub(crate) type LockSlot = Nothing;
pub(crate) type Neighbors = Nothing;

/// There is none, because nothing is checked.
pub(crate) enum Unsettled {}

pub(crate) fn is_for_locks(_incoming: &Incoming) -> bool {
    false
}

impl Nothing {
    pub(crate) fn load(config: &config::Monitor) -> Result<Self, OpenError> {
        if config.check != Check::Off {
            log_limit::warn!(
                "monitor.check has no effect: this program was built without the feature `protocols`"
            );
        }
        Ok(Self)
    }

    pub(crate) fn checks(
        &self,
        _agent: &str,
        _ids: String,
        _directory: &dyn Directory,
        _counts: SharedCounts,
    ) -> Self {
        Self
    }

    pub(crate) fn check_outgoing(
        &self,
        _message: &Message,
        _directory: &dyn Directory,
    ) -> Result<Option<Unsettled>, SendError> {
        Ok(None)
    }

    pub(crate) fn arrived(
        &self,
        incoming: Incoming,
        _origin: Origin,
        _directory: &dyn Directory,
        _answer: impl FnOnce(&Message, String) -> Option<Message>,
    ) -> Incoming {
        incoming
    }

    pub(crate) fn of(_received: &Received) -> Self {
        Self
    }

    pub(crate) async fn next_other(&self, endpoint: &Endpoint) -> Result<Incoming, ReceiveError> {
        loop {
            endpoint.until_letter().await?;
            if let Some(incoming) = self.other_now(endpoint)? {
                return Ok(incoming);
            }
        }
    }

    pub(crate) fn other_now(&self, endpoint: &Endpoint) -> Result<Option<Incoming>, ReceiveError> {
        while let Some(received) = endpoint.letter_now()? {
            if let Some(incoming) = endpoint.decode(received) {
                return Ok(Some(incoming));
            }
        }
        Ok(None)
    }

    pub(crate) fn drain(&self) -> Vec<Incoming> {
        Vec::new()
    }

    pub(crate) fn close(&self, _agent: &AgentCore) {}
}

impl Unsettled {
    pub(crate) fn settle<'a>(self, _undelivered: impl Iterator<Item = &'a str>) {
        match self {}
    }
}
