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
        let is_passed_on = matches!(self.of, Of::Process(_)) && view.stamps().next().is_some();
        let judged = {
            let mut access = self.access.lock();
            let judged = access.judge(&claim);
            match is_passed_on {
                true => judged,
                false => judged.and_then(|()| access.count(sender, now)),
            }
        };
        // Asked only now: hardly any letter is the gateway's own. Somebody else who calls himself so
        // has been passed on.
        judged.or_else(|refusal| match !is_passed_on && self.is_gateway(sender) {
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

#[cfg(test)]
mod tests {
    use fipa_acl::{
        AclRepresentation, AgentId, Envelope, EnvelopeParams, Message, Performative, Received, Time,
    };
    use fipa_sds::{HostConfig, Mts, Registration};
    use fipa_transport::Incarnation;

    use super::*;
    use crate::config;

    /// A letter to the arm from this sender, around a message that names that one as its sender; with
    /// the stamp of a gateway or without.
    fn letter(sender: &str, signed: &str, is_stamped: bool) -> Letter {
        let [arm, sender, signed] = ["arm", sender, signed].map(|name| AgentId::new(name).unwrap());
        let date: Time = "20261121T120000000Z".parse().unwrap();
        let base = EnvelopeParams {
            to: vec![arm.clone()],
            from: Some(sender),
            acl_representation: Some(AclRepresentation::BitEfficient),
            date: Some(date),
            ..EnvelopeParams::default()
        };
        let stamp = EnvelopeParams {
            received: Some(Received::new("mts", date)),
            ..EnvelopeParams::default()
        };
        let extensions = is_stamped.then_some(stamp).into_iter().collect();
        let envelope = Envelope { base, extensions };
        let message = Message::builder(Performative::Inform).sender(signed);
        let message = message.receiver(arm).build().unwrap();
        Letter::new(envelope.encode_standard().unwrap(), message.to_payload())
    }

    /// The door of a process of a host, which lets in a letter a second of each sender, but none of
    /// those who are called so; the directory of the gateway there; and their place, for as long.
    fn door(denied: &[&str]) -> (Door, HostDirectory, tempfile::TempDir) {
        let place = tempfile::tempdir().unwrap();
        let open = |gateway| {
            let directory = HostDirectory::open(HostConfig {
                dir: place.path().join("domain"),
                mts: Mts::new("mts", Incarnation::random()),
                gateway,
            });
            directory.unwrap()
        };
        let deny = denied.iter().map(|sender| config::AccessRule {
            sender: (*sender).to_owned(),
            receivers: vec![".*".to_owned()],
        });
        let rules = config::Access {
            rate: 1,
            deny: deny.collect(),
            ..config::Access::default()
        };
        let access = Access::new(&rules).unwrap().unwrap();
        let door = Door::new(access, Of::Process(Arc::new(open(false))));
        (door, open(true), place)
    }

    #[tokio::test]
    async fn what_a_gateway_has_counted_is_not_counted_again() {
        let (door, _gateway, _place) = door(&[]);
        let now = Instant::now();
        let taken = |is_stamped| {
            let letter = letter("rover", "rover", is_stamped);
            door.admits(now, "arm", &letter).is_ok()
        };
        // Held up on the way, they come closer together than they were sent.
        assert!(taken(true) && taken(true) && taken(true));
        assert!(taken(false));
        assert!(!taken(false), "one a second");
    }

    #[tokio::test]
    async fn envelope_and_message_name_one_sender() {
        let (door, _gateway, _place) = door(&[]);
        let judged = door.admits(Instant::now(), "arm", &letter("rover", "crex", false));
        let told = judged.unwrap_err();
        assert!(told.contains("rover") && told.contains("crex"), "{told}");
    }

    #[tokio::test]
    async fn the_gateway_of_the_host_is_heard_and_nobody_else_by_its_name() {
        let (door, gateway, _place) = door(&["mts", "rover"]);
        let at = "shm://1#0000000000000001".parse().unwrap();
        let registration = Registration {
            role: EntryRole::Gateway,
            ..Registration::new("mts", Incarnation::random(), vec![at])
        };
        gateway.register(registration).unwrap();
        let taken = |sender, is_passed_on| {
            let letter = letter(sender, sender, is_passed_on);
            door.admits(Instant::now(), "arm", &letter).is_ok()
        };
        assert!(taken("mts", false));
        assert!(!taken("mts", true), "from another host");
        assert!(!taken("rover", false));
    }
}
