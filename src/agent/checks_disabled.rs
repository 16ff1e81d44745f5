//! The types of `checks.rs` in a build without the feature `protocols`: they check nothing.

use fipa_acl::Message;
use fipa_mts::core::Received;
use fipa_sds::Directory;
use fipa_transport::log_limit;

use crate::agent::incoming::Incoming;
use crate::config::{self, Check};
use crate::error::{OpenError, SendError};

pub(crate) struct Rules;

impl Rules {
    pub(crate) fn load(config: &config::Monitor) -> Result<Self, OpenError> {
        if config.check != Check::Off {
            log_limit::warn!(
                "monitor.check has no effect: this program was built without the feature `protocols`"
            );
        }
        Ok(Self)
    }

    pub(crate) fn checks(&self, _agent: &str, _ids: String, _directory: &dyn Directory) -> Checks {
        Checks
    }
}

pub(crate) struct Checks;

pub(crate) struct Origin;

/// There is none, because nothing is checked.
pub(crate) enum Unsettled {}

impl Checks {
    pub(crate) fn leaving(
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
}

impl Origin {
    pub(crate) fn of(_received: &Received) -> Self {
        Self
    }
}

impl Unsettled {
    pub(crate) fn settle<'a>(self, _undelivered: impl Iterator<Item = &'a str>) {
        match self {}
    }
}
