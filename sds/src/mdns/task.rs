//! The background task of the mDNS directory.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::ErrorChain;
use fipa_transport::{Incarnation, PeerId};
use mdns_sd::{DaemonEvent, DaemonStatus, Error, Metrics, Receiver, ServiceDaemon};

use super::alarm::Alarm;
use super::beacon::Digest;
use super::browse::{Found, ParsedPacket, label_of};
use super::listener::Listener;
use super::record;
use super::restart::{self, CacheCheck, Pauses};
use super::{MAX_SPOILT, OwnAgents, Shared};
use crate::Entry;

/// Delay before the stop command is repeated to a busy library.
const RETRY: Duration = Duration::from_millis(50);

/// Keeps the view up to date and this gateway's names unambiguous, until it is aborted.
pub(super) async fn run(shared: Arc<Shared>) {
    let mut listener = Listener::new(&shared);
    let mut pauses = Pauses::new(Instant::now());
    while let Some(monitor) = monitor(&shared) {
        let why = listen(&shared, Some(&monitor), &mut listener).await;
        // Later events of this library are ignored.
        drop(monitor);
        let pause = pauses.ended(Instant::now());
        shared.status.lock().restarts += 1;
        shared.failed(format!("restarting the mDNS library in {pause:?}: {why}"));
        tokio::select! {
            () = restart_daemon(&shared, pause) => {}
            // Receiving and beacons continue without the library.
            _ = listen(&shared, None, &mut listener) => {}
        }
        pauses.started(Instant::now());
    }
}

/// Stops the library, and starts it again after the pause.
async fn restart_daemon(shared: &Shared, pause: Duration) {
    let ended = loop {
        match shared.end_daemon() {
            // Its command queue is full.
            Err(Error::Again) => tokio::time::sleep(RETRY).await,
            Err(error) => {
                shared.failed(format!("cannot stop the mDNS library: {error}"));
                tokio::time::sleep(pause).await;
            }
            Ok(ended) => break ended,
        }
    };
    tokio::time::sleep(pause).await;
    if let Some(ended) = ended {
        // The library handles commands only between packets. Two running libraries would need twice
        // the memory, so this waits. A closed channel also means that it has ended.
        let _: Result<DaemonStatus, _> = ended.recv_async().await;
    }
    while !shared.start_daemon() {
        tokio::time::sleep(pause).await;
    }
}

/// Subscribes to the events of the library, if it is running.
fn monitor(shared: &Shared) -> Option<Receiver<DaemonEvent>> {
    match shared.ask(ServiceDaemon::monitor) {
        Ok(receiver) => receiver,
        Err(error) => {
            shared.failed(format!(
                "cannot receive events of the mDNS library: {error}"
            ));
            None
        }
    }
}

/// Processes events until the library, if there is one, must be restarted; returns the reason.
async fn listen(
    shared: &Shared,
    monitor: Option<&Receiver<DaemonEvent>>,
    listener: &mut Listener,
) -> String {
    let mut cache_check = CacheCheck::new(Instant::now());
    let mut metrics: Option<Receiver<Metrics>> = None;
    let mut alarm = Alarm::new();
    loop {
        let now = Instant::now();
        shared.show(|coalition_sync| coalition_sync.handle_timeout(now));
        let waiting = shared.coalition_sync.lock().poll_timeout();
        let announcing = shared.announce_due();
        let sending = listener.send_due(shared);
        // Without a timer of its own: each packet and each beacon leads here.
        if monitor.is_some() && metrics.is_none() && cache_check.is_due(now, restart::work) {
            // Requests the cache size; a busy library is asked again later.
            let daemon = shared.daemon.lock().clone();
            metrics = daemon.and_then(|daemon| daemon.get_metrics().ok());
            cache_check.asked(now, metrics.is_some().then(restart::work));
        }
        let due = [announcing, Some(sending), waiting];
        let due = due.into_iter().flatten().min();
        tokio::select! {
            () = shared.postponed.notified() => {}
            () = alarm.until(due) => {}
            received = listener.listen(shared) => handle(shared, listener, received),
            event = next(monitor) => match event {
                Some(DaemonEvent::NameChange(change)) => renamed(shared, &change.original),
                Some(DaemonEvent::Error(error)) => shared.failed(error.to_string()),
                Some(_) => {}
                None => return "the mDNS library has ended".to_owned(),
            },
            answer = next(metrics.as_ref()) => {
                metrics = None;
                if let Some(cached) = answer.as_ref().and_then(restart::is_too_much) {
                    return format!(
                        "the mDNS library cached {cached}, because a host floods the network; new \
                         registrations are announced with a delay; find the host that sends so \
                         many packets to UDP port {}",
                        shared.config.port
                    );
                }
            }
        }
    }
}

/// Returns the next value, or `None` when the channel is closed. Without a channel it never
/// returns.
async fn next<T>(of: Option<&Receiver<T>>) -> Option<T> {
    match of {
        Some(receiver) => receiver.recv_async().await.ok(),
        None => std::future::pending().await,
    }
}

fn handle(shared: &Shared, listener: &mut Listener, received: ParsedPacket) {
    for one in received.found {
        if let Some(gateway) = found(shared, &one) {
            listener.browser.belongs(&one.fullname, gateway);
        }
    }
    if received.refused > 0 {
        shared.status.lock().refused += received.refused;
        let error = "refused records of other hosts: too many on the network";
        shared.set_last_error(error.to_owned());
    }
}

/// Decodes and stores a record. Returns the gateway that announces it, if it is valid.
fn found(shared: &Shared, found: &Found) -> Option<Incarnation> {
    let Found {
        fullname,
        properties,
        from,
        interfaces,
    } = found;
    let label = label_of(fullname);
    let entry = match record::decode(label, properties, SystemTime::now()) {
        Ok(entry) => Arc::new(Entry {
            locations: record::on_interfaces(entry.locations, interfaces),
            peer: PeerId::of_ip(*from),
            ..entry
        }),
        Err(error) => {
            shared.status.lock().refused += 1;
            tracing::debug!(record = label, error = %ErrorChain(&error), "record not used");
            // An earlier version of the record may have been valid and stored.
            shared.put(fullname, None);
            return None;
        }
    };
    if entry.mts.incarnation == shared.config.mts.incarnation {
        own_found(shared, fullname, &entry, Digest::of(properties));
    } else {
        shared.put(fullname, Some(Arc::clone(&entry)));
        give_way(shared, fullname, &entry);
    }
    Some(entry.mts.incarnation)
}

/// Handles one of this gateway's own records. A different label means that the library renamed it
/// and the notification was lost. A different content of a record whose locations changed is
/// outdated.
fn own_found(shared: &Shared, fullname: &str, entry: &Entry, digest: Digest) {
    let original = {
        let mut own = shared.own.lock();
        let current = own.agents.get(&entry.name).map(|one| one.digest);
        if current.is_some_and(|current| current != digest) {
            // The task sends it before it waits again.
            own.relocations.handle_outdated(Instant::now(), &entry.name);
        }
        let announced = own.agents.get(&entry.name);
        let announced = announced.filter(|one| one.entry.incarnation == entry.incarnation);
        // Other differences come from caches that still have abandoned labels.
        announced
            .filter(|one| is_renamed(&fullname.to_lowercase(), &one.fullname))
            .map(|one| Arc::clone(&one.fullname))
    };
    if let Some(original) = original {
        renamed(shared, &original);
    }
}

/// Whether the full name is the original with ` (2)` or a similar suffix after its label.
fn is_renamed(fullname: &str, original: &str) -> bool {
    let label = label_of(original);
    label_of(fullname)
        .strip_prefix(label)
        .and_then(|rest| {
            rest.strip_prefix(" (")?
                .strip_suffix(')')?
                .parse::<u32>()
                .ok()
        })
        .is_some()
}

/// Handles a conflict over the label of an own record. The conflicting record may be of the same name
/// or of another one. Announces the record under the next label.
fn renamed(shared: &Shared, original: &str) {
    let original = original.to_lowercase();
    let mut own = shared.own.lock();
    let announced = own.agents.values().find(|one| *one.fullname == *original);
    let Some(announced) = announced else {
        return;
    };
    let (entry, attempt) = (Arc::clone(&announced.entry), announced.attempt + 1);
    if own.spoilt.len() >= MAX_SPOILT {
        // A dropped label causes another conflict, which is handled the same way.
        own.spoilt.clear();
    }
    own.spoilt.insert(original.into());
    let withdrawn = shared.withdraw(&mut own, &entry.name);
    let announced = withdrawn.and_then(|()| shared.announce(&mut own, &entry, attempt));
    if let Err(error) = announced {
        let name = &entry.name;
        shared.failed(format!(
            "cannot announce {name:?} by another label: {error}"
        ));
    }
}

/// Takes another label for an own record if another gateway announces one by the same label, because two
/// records of one label replace each other in the caches of other hosts. Of two gateways, the one with
/// the greater incarnation does so. A record that is not announced yet waits for its turn, so the pace
/// of announcements bounds how often forged records cause this.
fn give_way(shared: &Shared, fullname: &str, theirs: &Entry) {
    if theirs.mts.incarnation > shared.config.mts.incarnation {
        return;
    }
    let original = fullname.to_lowercase();
    let is_announced = |own: &OwnAgents| {
        let mut all = own.agents.values();
        all.any(|one| *one.fullname == *original && one.last_registration.is_some())
    };
    if is_announced(&shared.own.lock()) {
        renamed(shared, &original);
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::super::SERVICE_TYPE;
    use super::super::beacon::BeaconContent;
    use super::super::browse::Origin;
    use super::super::packet::tests::{Part, answer};
    use super::super::restart::tests::directory;
    use super::*;
    use crate::{Directory, MtsId, Registration, Source};

    #[tokio::test]
    async fn records_of_a_gateway_stay_valid_while_its_beacons_match() {
        let directory = directory();
        let shared = &directory.shared;
        let gateway = MtsId::new("theirs", Incarnation::random());
        let at = "tcp://127.0.0.1:7788#00000000000000aa".parse().unwrap();
        let arm = Registration::new("arm", Incarnation::random(), vec![at]);
        let properties = record::encode(&arm.into_entry(&gateway, Source::Mdns).unwrap());
        let strings = properties
            .iter()
            .map(|(key, value)| [key.as_bytes(), b"=", value].concat());
        let strings: Vec<Vec<u8>> = strings.collect();
        let strings: Vec<&[u8]> = strings.iter().map(Vec::as_slice).collect();
        let parts = [Part::Ptr, Part::Srv("theirs.local"), Part::Txt(&strings)];

        let (mut listener, now) = (Listener::new(shared), Instant::now());
        let at = |seconds| now + Duration::from_secs(seconds);
        let received = listener.browser.handle_packet(
            now,
            Origin {
                address: Ipv4Addr::LOCALHOST.into(),
                interface: 1,
            },
            &answer("arm", &parts, 120),
            0.0,
        );
        handle(shared, &mut listener, received);
        assert!(directory.lookup("arm").is_some());
        let mut all = Digest::default();
        all.add(Digest::of(&properties));
        let coalitions = Digest::default();
        let beacon = BeaconContent { all, coalitions };
        listener.handle_beacon(at(100), shared, gateway.incarnation, beacon);
        assert_eq!(listener.browser.handle_timeout(at(150), 0.0).gone.len(), 0);
        assert_eq!(listener.browser.handle_timeout(at(221), 0.0).gone.len(), 1);
    }

    #[tokio::test]
    async fn forged_records_of_own_labels_hold_back_no_other_announcement() {
        let directory = directory();
        let shared = &directory.shared;
        let at = "tcp://127.0.0.1:7788#00000000000000aa".parse().unwrap();
        let arm = Registration::new("arm", Incarnation::random(), vec![at]);
        directory.register(arm.clone()).unwrap();
        let gateway = MtsId::new("theirs", Incarnation::from_u64(1));
        let theirs = arm.into_entry(&gateway, Source::Mdns).unwrap();
        let label = || Arc::clone(&shared.own.lock().agents["arm"].fullname);
        let first = label();
        give_way(shared, "another label", &theirs);
        assert_eq!(label(), first);
        // The forger knows each label.
        for _ in 0..1000 {
            give_way(shared, &label(), &theirs);
        }
        assert_ne!(label(), first);
        let now = Instant::now();
        let turn = shared.own.lock().pace.turn(now, 0.0);
        assert!(
            turn.is_none_or(|turn| turn < now + Duration::from_secs(1)),
            "{turn:?}"
        );
    }

    #[test]
    fn renamed_records_are_recognized() {
        let full = |label: &str| format!("{label}.{SERVICE_TYPE}");
        assert_eq!(label_of(&full("arm?left")), "arm?left");
        assert_eq!(label_of(&full("arm.left")), "arm.left");
        assert_eq!(label_of("x"), "x");
        assert!(is_renamed(&full("arm (2)"), &full("arm")));
        for other in ["arm", "arm (x)", "arm~01 (2)", "arm 2"] {
            assert!(!is_renamed(&full(other), &full("arm")), "{other}");
        }
    }
}
