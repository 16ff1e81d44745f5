//! The door of a process: what letters claim is held against the rules of `[access]`.
//!
//! The gateway has one for what comes from other hosts and goes there, every other process for what
//! its own agents get: nobody can be trusted to keep rules for somebody else.

use std::sync::Arc;
use std::time::Instant;

use fipa_acl::{EnvelopeView, Letter, MessageView};
use fipa_mts::Gate;
use fipa_sds::{Directory, HostDirectory, Role as EntryRole};
use parking_lot::Mutex;

use crate::access::{Access, Claim, Refusal};

/// What lines about refused letters are told under.
const AUDIT: &str = "fipa::audit";

/// Judges every letter that comes.
pub(crate) struct Door {
    access: Mutex<Access>,
    of: Of,
}

/// Whose door it is.
pub(crate) enum Of {
    /// The gateway's, with its name. Everybody may write to it: so gateways and their clerks talk.
    Gateway(Arc<str>),
    /// A process's on this host. The gateway there may write to everybody, as it answers only, and
    /// has counted what it passes on.
    Process(Arc<HostDirectory>),
}

impl Door {
    pub(crate) fn new(access: Access, of: Of) -> Self {
        Self {
            access: Mutex::new(access),
            of,
        }
    }

    fn judge(
        &self,
        now: Instant,
        receiver: &str,
        letter: &Letter,
        view: &EnvelopeView<'_>,
        sender: &str,
    ) -> Result<(), Refused> {
        let message = MessageView::parse_payload(letter.payload());
        let message = message
            .map_err(|error| Refused::Other(format!("its message cannot be read: {error}")))?;
        if let Some(signed) = message.sender().map(|it| it.name())
            && signed.as_str() != sender
        {
            let what = format!("its envelope is from {sender}, and its message from {signed}");
            return Err(Refused::Other(what));
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
        // A gateway has stamped what it has passed on, and counted it.
        let is_counted = matches!(self.of, Of::Process(_)) && view.stamps().next().is_some();
        let judged = {
            let mut access = self.access.lock();
            let judged = access.judge(&claim);
            match is_counted {
                true => judged,
                false => judged.and_then(|()| access.count(sender, now)),
            }
        };
        // Asked only now: hardly any letter is the gateway's own.
        judged.or_else(|refusal| match self.is_gateway(sender) {
            true => Ok(()),
            false => Err(refusal.into()),
        })
    }

    /// Whether this is the name of the gateway of this host, which writes to a process of it.
    fn is_gateway(&self, sender: &str) -> bool {
        let Of::Process(host) = &self.of else {
            return false;
        };
        let entry = host.lookup(sender);
        entry.is_some_and(|entry| entry.role == EntryRole::Gateway)
    }
}

/// Why a letter does not pass.
#[derive(Debug, thiserror::Error)]
enum Refused {
    #[error(transparent)]
    ByRule(#[from] Refusal),
    #[error("{0}")]
    Other(String),
}

impl Gate for Door {
    fn admits(&self, now: Instant, receiver: &str, letter: &Letter) -> Result<(), String> {
        if let Of::Gateway(own) = &self.of
            && receiver == &**own
        {
            return Ok(());
        }
        let envelope = letter.envelope();
        let view = EnvelopeView::parse(&envelope).ok();
        let sender = view.as_ref().and_then(EnvelopeView::from_name);
        let judged = match (&view, sender) {
            (Some(view), Some(sender)) => self.judge(now, receiver, letter, view, &sender.as_str()),
            _ => Err(Refused::Other("its envelope names no sender".to_owned())),
        };
        judged.map_err(|why| {
            // Whoever sends too much would fill the log, too.
            if !matches!(why, Refused::ByRule(Refusal::TooMany { told: false })) {
                let sender = sender.map(|name| name.to_string()).unwrap_or_default();
                tracing::warn!(target: AUDIT, sender, receiver, "letter refused: {why}");
            }
            why.to_string()
        })
    }
}
