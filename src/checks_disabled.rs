//! The types of `checks.rs` in a build without the feature `protocols`: they check nothing.

use fipa_acl::Message;

use crate::config::{self, Check};
use crate::error::{OpenError, SendError};
use crate::incoming::Incoming;

pub(crate) struct Rules;

impl Rules {
    pub(crate) fn load(config: &config::Monitor) -> Result<Self, OpenError> {
        if config.check != Check::Off {
            tracing::warn!(
                "monitor.check has no effect: this program was built without the feature `protocols`"
            );
        }
        Ok(Self)
    }

    pub(crate) fn checks(&self, _agent: &str) -> Checks {
        Checks
    }
}

pub(crate) struct Checks;

impl Checks {
    pub(crate) fn leaving(&self, _message: &Message) -> Result<(), SendError> {
        Ok(())
    }

    pub(crate) fn arrived(
        &self,
        incoming: Incoming,
        _answer: impl FnOnce(&Message, String) -> Option<Message>,
    ) -> Incoming {
        incoming
    }
}
