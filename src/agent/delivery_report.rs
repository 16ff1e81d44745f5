//! Reports of message transport services that a letter was not delivered, as far as they are proved.
//!
//! Every agent can write such a message, and choose any conversation id. A report counts only if it comes
//! from the service of this process, which was to deliver the letter, or from the service of the agent that
//! did not get it. The monitor and the calls that lead conversations rely on this.

use fipa_acl::Performative;
use fipa_mts::DeliveryFailure;
use fipa_sds::Directory;

use crate::agent::incoming::Incoming;

/// Returns the agent that did not get a letter, if the message is a proved report about it.
///
/// Letters of legacy peers prove nothing. A report that arrives like them counts for agents of legacy
/// peers only.
pub(crate) fn read(incoming: &Incoming, directory: &dyn Directory) -> Option<Box<str>> {
    if !incoming.is(&Performative::Failure) {
        return None;
    }
    let lost = DeliveryFailure::read(incoming.message())?.receiver?;
    let service = incoming.sender;
    let is_own = incoming.via.is_none();
    let entry = directory.known(&lost);
    let is_proved = match entry.filter(|entry| entry.incarnation.is_known()) {
        _ if is_own => true,
        Some(entry) => service.is_known() && entry.mts.incarnation == service,
        None if service.is_known() => {
            // The gateway of this host hands over the letters of legacy peers in its own name.
            let sender = directory.by_incarnation(service);
            sender.is_some_and(|it| it.is_own_gateway())
        }
        None => true,
    };
    is_proved.then(|| lost.into())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::SystemTime;

    use fipa_acl::{AgentId, Message};
    use fipa_mts::core::Received;
    use fipa_mts::letter_for;
    use fipa_sds::{MemoryDirectory, MtsId, Registration, Role};
    use fipa_transport::{Incarnation, Kind};

    use super::*;

    const MTS: Incarnation = Incarnation::from_u64(1);
    const ARM: Incarnation = Incarnation::from_u64(2);
    const GATEWAY: Incarnation = Incarnation::from_u64(3);
    const MALLORY: Incarnation = Incarnation::from_u64(4);

    fn directory() -> Arc<MemoryDirectory> {
        let directory = MemoryDirectory::new(MtsId::new("here", MTS));
        let agents = [("arm", ARM), ("mallory", MALLORY)];
        for (name, incarnation) in agents {
            let agent = Registration::new(name, incarnation, Vec::new());
            directory.register(agent).unwrap();
        }
        let mut gateway = Registration::new("gateway", GATEWAY, Vec::new());
        gateway.role = Role::Gateway;
        directory.register(gateway).unwrap();
        Arc::new(directory)
    }

    fn report(act: Performative, from: Incarnation, via: Option<Kind>, lost: &str) -> Incoming {
        let agent = |name| AgentId::new(name).unwrap();
        let content = format!(
            "((action (agent-identifier :name rover) (ACLMessage)) \
             (MTS-error (agent-identifier :name {lost}) (internal-error \"gone\")))"
        );
        let message = Message::builder(act).sender(agent("mts"));
        let message = message.receiver(agent("rover")).content(content);
        let letter = letter_for(&message.build().unwrap(), SystemTime::UNIX_EPOCH).unwrap();
        Incoming::new(Received {
            letter,
            sender: from,
            via,
            service: from,
            peer: fipa_transport::PeerId::THIS_HOST,
            remote: false,
        })
        .unwrap()
    }

    #[test]
    fn a_report_counts_if_the_service_knows_the_receiver() {
        let directory = directory();
        let unknown = Incarnation::UNKNOWN;
        let failure = Performative::Failure;
        for (from, via, lost, counts) in [
            (unknown, None, "arm", true),
            (unknown, None, "echo@jade", true),
            (MTS, Some(Kind::Shm), "arm", true),
            // Another service, an agent, and a legacy peer.
            (Incarnation::from_u64(9), Some(Kind::Tcp), "arm", false),
            (MALLORY, Some(Kind::Shm), "arm", false),
            (ARM, Some(Kind::Shm), "arm", false),
            (unknown, Some(Kind::Tcp), "arm", false),
            (GATEWAY, Some(Kind::Shm), "arm", false),
            // About an agent of a legacy peer.
            (GATEWAY, Some(Kind::Shm), "echo@jade", true),
            (unknown, Some(Kind::Http), "echo@jade", true),
            (MALLORY, Some(Kind::Shm), "echo@jade", false),
        ] {
            let found = read(&report(failure.clone(), from, via, lost), &*directory);
            let expected = counts.then_some(lost);
            assert_eq!(found.as_deref(), expected, "{lost} by {from:?} via {via:?}");
        }
        let inform = report(Performative::Inform, unknown, None, "arm");
        assert_eq!(read(&inform, &*directory), None);
    }
}
