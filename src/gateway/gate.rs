//! The door of the gateway: what letters claim is held against the rules of `[access]`.

use std::sync::Arc;
use std::time::Instant;

use fipa_acl::{EnvelopeView, Letter, MessageView};
use fipa_mts::Gate;
use parking_lot::Mutex;

use crate::access::{Access, Claim};

/// What lines about refused letters are told under.
const AUDIT: &str = "fipa::audit";

/// Judges every letter that comes to the gateway, from this host or from others.
pub(super) struct Door {
    access: Mutex<Access>,
    /// The gateway itself, which everybody may write to: so gateways and their clerks talk.
    own: Arc<str>,
}

impl Door {
    pub(super) fn new(access: Access, own: &str) -> Self {
        Self {
            access: Mutex::new(access),
            own: own.into(),
        }
    }

    fn judge(&self, receiver: &str, letter: &Letter, sender: &str) -> Result<(), String> {
        let message = MessageView::parse_payload(letter.payload());
        let message = message.map_err(|error| format!("its message cannot be read: {error}"))?;
        if let Some(signed) = message.sender().map(|it| it.name())
            && signed.as_str() != sender
        {
            return Err(format!(
                "its envelope is from {sender}, and its message from {signed}"
            ));
        }
        let performative = message.performative_name();
        let protocol = message.protocol();
        let protocol = protocol.as_ref().map(|text| text.as_str());
        let claim = Claim {
            sender,
            receiver,
            performative: &performative.as_str(),
            protocol: protocol.as_deref(),
        };
        let judged = self.access.lock().judge(&claim, Instant::now());
        judged.map_err(|refusal| refusal.to_string())
    }
}

impl Gate for Door {
    fn admits(&self, receiver: &str, letter: &Letter) -> Result<(), String> {
        if receiver == &*self.own {
            return Ok(());
        }
        let envelope = letter.envelope();
        let view = EnvelopeView::parse(&envelope).ok();
        let sender = view.and_then(|view| Some(view.from_name()?.to_string()));
        let judged = match &sender {
            Some(sender) => self.judge(receiver, letter, sender),
            None => Err("its envelope names no sender".to_owned()),
        };
        judged.inspect_err(|why| {
            let sender = sender.as_deref().unwrap_or_default();
            tracing::warn!(target: AUDIT, sender, receiver, "letter refused: {why}");
        })
    }
}
