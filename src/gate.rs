//! The door of a process: what letters claim is held against the rules of `[access]`.
//!
//! The gateway has one for what comes from other hosts and goes there, every other process for what
//! its own agents get: nobody can be trusted to keep rules for somebody else.

use std::sync::Arc;
use std::time::Instant;

use fipa_acl::{EnvelopeView, Letter, MessageView};
use fipa_mts::{AccessGate, Link};
use fipa_sds::{Directory, Entry, HostDirectory, Role as EntryRole};
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
    /// has counted what it passes on. It is recognized by its link.
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
        link: Link,
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
        let is_stamped = view.stamps().next().is_some();
        let judge = |gateway: Option<Arc<Entry>>| match gateway {
            // The gateway has stamped what it has passed on, and counted it.
            Some(_) if is_stamped => self.access.lock().judge(&claim),
            Some(gateway) if *gateway.name == *sender => Ok(()),
            _ => {
                let mut access = self.access.lock();
                access
                    .judge(&claim)
                    .and_then(|()| access.count(link.source, sender, now))
            }
        };
        let gateway = self.gateway_on(link);
        let is_known = gateway.is_some();
        judge(gateway).or_else(|refusal| {
            // The gateway may have registered a moment ago. Looking is for what is refused only.
            match self.looked_for_gateway_on(link).filter(|_| !is_known) {
                Some(gateway) => Ok(judge(Some(gateway))?),
                None => Err(refusal.into()),
            }
        })
    }

    /// The entry of the gateway of this host, if it is at the other end of this link as far as is
    /// known. The kernel proves that the other end is a process of this user only when the link is
    /// within the host.
    fn gateway_on(&self, link: Link) -> Option<Arc<Entry>> {
        let Of::Process(host) = &self.of else {
            return None;
        };
        if !link.via.is_host_local() {
            return None;
        }
        let entry = host.known_incarnation(link.service)?;
        (entry.role == EntryRole::Gateway).then_some(entry)
    }

    /// The same, with what others have registered until now.
    fn looked_for_gateway_on(&self, link: Link) -> Option<Arc<Entry>> {
        if let Of::Process(host) = &self.of
            && link.via.is_host_local()
        {
            host.refresh();
        }
        self.gateway_on(link)
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

impl AccessGate for Door {
    fn admits(
        &self,
        now: Instant,
        receiver: &str,
        letter: &Letter,
        link: Link,
    ) -> Result<(), String> {
        if let Of::Gateway(own) = &self.of
            && receiver == &**own
        {
            return Ok(());
        }
        let envelope = letter.envelope();
        let view = EnvelopeView::parse(&envelope).ok();
        let sender = view.as_ref().and_then(EnvelopeView::from_name);
        let judged = match (&view, sender) {
            (Some(view), Some(sender)) => {
                self.judge(now, receiver, letter, view, &sender.as_str(), link)
            }
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
    use fipa_mts::Source;
    use fipa_sds::{HostConfig, Mts, Registration};
    use fipa_transport::{Incarnation, Kind};

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
        let access = rules.rules().unwrap().unwrap();
        let door = Door::new(access, Of::Process(Arc::new(open(false))));
        (door, open(true), place)
    }

    const GATEWAY: Incarnation = Incarnation::from_u64(0x6a7e);

    /// The source of the letters of a service on this host.
    fn source_by(via: Kind, service: Incarnation) -> Source {
        match via.is_host_local() {
            true => Source::Process(service),
            false => Source::at(std::net::Ipv4Addr::LOCALHOST.into()),
        }
    }

    /// A link with the gateway.
    fn gateway_by(via: Kind) -> Link {
        Link {
            via,
            service: GATEWAY,
            source: source_by(via, GATEWAY),
        }
    }

    /// A link with a process that is not the gateway.
    fn process_by(via: Kind) -> Link {
        let service = Incarnation::from_u64(0x9);
        Link {
            via,
            service,
            source: source_by(via, service),
        }
    }

    /// The gateway registers itself, and the process of this door notices.
    fn register(gateway: &HostDirectory, door: &Door) {
        let at = "shm://0000000000006a7e#0000000000006a7e".parse().unwrap();
        let registration = Registration {
            role: EntryRole::Gateway,
            ..Registration::new("mts", GATEWAY, vec![at])
        };
        gateway.register(registration).unwrap();
        if let Of::Process(host) = &door.of {
            host.refresh();
        }
    }

    #[tokio::test]
    async fn what_the_gateway_has_counted_is_not_counted_again() {
        let (door, gateway, _place) = door(&[]);
        register(&gateway, &door);
        let now = Instant::now();
        let taken = |is_stamped, link| {
            let letter = letter("rover", "rover", is_stamped);
            door.admits(now, "arm", &letter, link).is_ok()
        };
        let link = gateway_by(Kind::Unix);
        // Held up on the way, they come closer together than they were sent.
        assert!(taken(true, link) && taken(true, link) && taken(true, link));
        assert!(taken(false, link));
        assert!(!taken(false, link), "one a second");
    }

    #[tokio::test]
    async fn a_stamp_evades_the_rate_on_no_link_but_the_gateways() {
        for link in [
            process_by(Kind::Shm),
            process_by(Kind::Unix),
            // The incarnation is what the peer claims there.
            gateway_by(Kind::Tcp),
        ] {
            let (door, gateway, _place) = door(&[]);
            register(&gateway, &door);
            let now = Instant::now();
            let stamped = letter("rover", "rover", true);
            assert!(door.admits(now, "arm", &stamped, link).is_ok());
            assert!(door.admits(now, "arm", &stamped, link).is_err(), "{link:?}");
        }
    }

    #[tokio::test]
    async fn envelope_and_message_name_one_sender() {
        let (door, _gateway, _place) = door(&[]);
        let letter = letter("rover", "crex", false);
        let judged = door.admits(Instant::now(), "arm", &letter, process_by(Kind::Shm));
        let told = judged.unwrap_err();
        assert!(told.contains("rover") && told.contains("crex"), "{told}");
    }

    #[tokio::test]
    async fn the_gateway_of_the_host_is_taken_by_its_link_and_nothing_else_by_its_name() {
        let (door, gateway, _place) = door(&["mts", "rover"]);
        register(&gateway, &door);
        let taken = |sender, is_passed_on, link| {
            let letter = letter(sender, sender, is_passed_on);
            door.admits(Instant::now(), "arm", &letter, link).is_ok()
        };
        for local in [Kind::Shm, Kind::Unix] {
            assert!(taken("mts", false, gateway_by(local)));
            assert!(!taken("mts", true, gateway_by(local)), "from another host");
            assert!(!taken("rover", false, gateway_by(local)));
            assert!(!taken("mts", false, process_by(local)), "by its name");
        }
        assert!(!taken("mts", false, gateway_by(Kind::Tcp)), "unproved");
    }
}
