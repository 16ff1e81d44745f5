//! The task that listens to the network.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use mdns_sd::{
    DaemonEvent, DaemonStatus, Error, Metrics, Receiver, ResolvedService, ServiceDaemon,
    ServiceEvent,
};

use super::anew::{self, Pauses, Unconfirmed};
use super::ear::Ear;
use super::record::Properties;
use super::{MAX_SPOILT, MdnsDirectory, SERVICE_TYPE, Shared, Withdrawal, record};
use crate::Entry;

/// For how long what was known is believed after events were lost: the daemon tells at once what
/// it still knows.
const BELIEF: Duration = Duration::from_secs(10);
/// How long a daemon that is busy has until it is told again that it is to end.
const RETRY: Duration = Duration::from_millis(50);

/// What the daemon tells.
struct Events {
    found: Receiver<ServiceEvent>,
    monitor: Receiver<DaemonEvent>,
}

/// Why there are no more events.
enum Ended {
    /// The daemon has dropped the listener, or is gone.
    Lost,
    /// The daemon keeps too much: that.
    TooMuch(String),
}

/// Keeps the view up to date and our names unambiguous, for ever.
pub(super) async fn run(shared: Arc<Shared>) {
    let mut unconfirmed = Unconfirmed::default();
    let mut ear = Ear::new();
    let mut pauses = Pauses::new(Instant::now());
    while let Some(monitor) = subscribe(&shared, ServiceDaemon::monitor)
        && let Some(found) = subscribe(&shared, |daemon| daemon.browse(SERVICE_TYPE))
    {
        let events = Events { found, monitor };
        let ended = listen(&shared, Some(&events), &mut unconfirmed, &mut ear).await;
        // What it says from now on counts no more.
        drop(events);
        match ended {
            // It drops a listener who has fallen behind; then all is asked for again.
            Ended::Lost => {
                shared.failed("events were lost; asking the network again".to_owned());
                unconfirmed.add(shared.table.origins(), Instant::now() + BELIEF);
                tokio::time::sleep(Duration::from_secs(1)).await;
            }
            Ended::TooMuch(kept) => {
                let pause = pauses.ended(Instant::now());
                shared.status.lock().restarts += 1;
                shared.failed(format!(
                    "the mDNS library kept {kept}, so somebody floods the network: it starts anew \
                     in {pause:?}, and agents that are announced meanwhile are found a little \
                     later. See who sends so much to UDP port {}",
                    shared.config.port
                ));
                unconfirmed.add(shared.table.origins(), Instant::now() + anew::KEPT);
                tokio::select! {
                    () = start_anew(&shared, pause) => {}
                    // Beacons are said, and heard, without a daemon.
                    _ = listen(&shared, None, &mut unconfirmed, &mut ear) => {}
                }
                pauses.started(Instant::now());
            }
        }
    }
}

/// Ends the daemon, and starts another one when the pause is over.
async fn start_anew(shared: &Shared, pause: Duration) {
    let ended = loop {
        match shared.end_daemon() {
            // Too busy to listen.
            Err(Error::Again) => tokio::time::sleep(RETRY).await,
            Err(error) => {
                shared.failed(format!("cannot end the mDNS library: {error}"));
                tokio::time::sleep(pause).await;
            }
            Ok(ended) => break ended,
        }
    };
    tokio::time::sleep(pause).await;
    if let Some(ended) = ended {
        // While it reads it does not listen. Two of them would keep twice as much. That it has
        // gone without a word is as good.
        let _: Result<DaemonStatus, _> = ended.recv_async().await;
    }
    while !shared.start_daemon() {
        tokio::time::sleep(pause).await;
    }
}

fn subscribe<T>(
    shared: &Shared,
    what: impl Fn(&ServiceDaemon) -> Result<Receiver<T>, Error>,
) -> Option<Receiver<T>> {
    match shared.ask(what) {
        Ok(receiver) => receiver,
        Err(error) => {
            shared.failed(format!("cannot listen: {error}"));
            None
        }
    }
}

/// Handles what happens until the daemon's events end, if there is a daemon. What was known before
/// and has not been found again after a while is gone.
async fn listen(
    shared: &Shared,
    events: Option<&Events>,
    unconfirmed: &mut Unconfirmed,
    ear: &mut Ear,
) -> Ended {
    let mut look = events.map(|_| Instant::now() + anew::INTERVAL);
    let mut metrics: Option<Receiver<Metrics>> = None;
    loop {
        let now = Instant::now();
        shared.show(|together| together.handle_timeout(now));
        for fullname in unconfirmed.handle_timeout(now) {
            ear.forget(&fullname);
            removed(shared, &fullname);
        }
        if look.is_some_and(|look| look <= now) {
            look = None;
            // Whether it keeps too much. A daemon that is busy is asked again.
            let daemon = shared.daemon.lock().clone();
            metrics = daemon.and_then(|daemon| daemon.get_metrics().ok());
            if metrics.is_none() {
                look = Some(now + anew::INTERVAL);
            }
        }
        let waiting = shared.together.lock().poll_timeout();
        let announcing = shared.announce_due();
        let due = [announcing, ear.speak(shared), waiting, look];
        let due = due.into_iter().chain([unconfirmed.poll_timeout()]);
        let due = due.flatten().min();
        tokio::select! {
            () = shared.postponed.notified() => {}
            () = until(due), if due.is_some() => {}
            whole = ear.listen(shared) => {
                for (fullname, properties) in whole {
                    peer_read(shared, ear, &fullname, properties);
                }
            }
            event = next(events.map(|events| &events.found)) => match event {
                Some(ServiceEvent::ServiceResolved(service)) => {
                    unconfirmed.forget(service.get_fullname());
                    ear.known(service.get_fullname());
                    resolved(shared, ear, &service);
                }
                Some(ServiceEvent::ServiceRemoved(_, fullname)) => {
                    unconfirmed.forget(&fullname);
                    ear.forget(&fullname);
                    removed(shared, &fullname);
                }
                Some(ServiceEvent::SearchStopped(_)) | None => return Ended::Lost,
                Some(_) => {}
            },
            event = next(events.map(|events| &events.monitor)) => match event {
                Some(DaemonEvent::NameChange(change)) => renamed(shared, &change.original),
                Some(DaemonEvent::Error(error)) => shared.failed(error.to_string()),
                Some(_) => {}
                None => return Ended::Lost,
            },
            answer = next(metrics.as_ref()) => {
                metrics = None;
                look = Some(Instant::now() + anew::INTERVAL);
                if let Some(kept) = answer.as_ref().and_then(anew::is_too_much) {
                    return Ended::TooMuch(kept);
                }
            }
        }
    }
}

/// The next that is told; none when there will not be any more. Without a teller it never comes.
async fn next<T>(of: Option<&Receiver<T>>) -> Option<T> {
    match of {
        Some(receiver) => receiver.recv_async().await.ok(),
        None => std::future::pending().await,
    }
}

async fn until(due: Option<Instant>) {
    if let Some(due) = due {
        tokio::time::sleep_until(due.into()).await;
    }
}

fn resolved(shared: &Shared, ear: &mut Ear, service: &ResolvedService) {
    let fullname: Arc<str> = service.get_fullname().into();
    let properties = service.get_properties().iter();
    let told: Properties = properties
        .map(|property| {
            let value = property.val().unwrap_or_default();
            (property.key().to_owned(), value.to_vec())
        })
        .collect();
    if record::is_ours(&told) {
        return found(shared, &fullname, &told, true);
    }
    if !shared.has_room(&fullname) {
        return;
    }
    match ear.whole(&fullname, &told) {
        Some(whole) => found(shared, &fullname, &whole, true),
        None => {
            found(shared, &fullname, &told, false);
            // Until the answer comes, that is all.
            ear.told(fullname, told);
        }
    }
}

/// The whole of a peer's record has been read.
fn peer_read(shared: &Shared, ear: &mut Ear, fullname: &Arc<str>, whole: Properties) {
    if let Some(whole) = ear.read(fullname, whole) {
        found(shared, fullname, whole, true);
    }
}

/// What is known of a record now.
fn found(shared: &Shared, fullname: &Arc<str>, properties: &Properties, whole: bool) {
    let borrowed: Vec<(&str, &[u8])> = properties
        .iter()
        .map(|(key, value)| (key.as_str(), value.as_slice()))
        .collect();
    let label = label_of(fullname);
    let entry = match record::decode(&label, &borrowed, whole, SystemTime::now()) {
        Ok(entry) => Arc::new(entry),
        Err(error) => {
            shared.status.lock().refused += 1;
            tracing::debug!(record = label, %error, "record not used");
            // It may have been right before.
            return removed(shared, fullname);
        }
    };
    if entry.mts.incarnation == shared.config.mts.incarnation {
        return own_found(shared, fullname, &entry);
    }
    if shared.has_room(fullname) {
        shared.put(fullname, Some(Arc::clone(&entry)));
        contested(shared, &entry);
    }
}

impl Shared {
    /// Whether one more record can be kept, or it is known already.
    fn has_room(&self, fullname: &Arc<str>) -> bool {
        let has = self.table.len() < MdnsDirectory::MAX_RECORDS || self.table.has_origin(fullname);
        if !has {
            let mut status = self.status.lock();
            status.refused += 1;
            status.last_error = Some("too many records on the network".to_owned());
        }
        has
    }
}

fn removed(shared: &Shared, fullname: &str) {
    shared.put(&fullname.into(), None);
}

/// One of our own records has come back, perhaps by another name than we have given it: then the
/// daemon has renamed it, and its telling so was lost.
fn own_found(shared: &Shared, fullname: &str, entry: &Entry) {
    let original = {
        let own = shared.own.lock();
        let announced = own.agents.get(&entry.name);
        let announced = announced.filter(|one| one.entry.incarnation == entry.incarnation);
        // The rest is what the network still remembers of labels we have given up.
        announced
            .filter(|one| is_renamed(&fullname.to_lowercase(), &one.fullname))
            .map(|one| Arc::clone(&one.fullname))
    };
    if let Some(original) = original {
        renamed(shared, &original);
    }
}

/// Whether the one full name is the other with ` (2)` or the like behind its label.
fn is_renamed(fullname: &str, original: &str) -> bool {
    let label = label_of(original);
    label_of(fullname)
        .strip_prefix(&label)
        .and_then(|rest| {
            rest.strip_prefix(" (")?
                .strip_suffix(')')?
                .parse::<u32>()
                .ok()
        })
        .is_some()
}

/// The label of one of our records was taken, and the daemon has chosen another one. Whose name
/// it is, is not known yet: it may be another name with the same label. We choose our own label;
/// if the name is the same, both will see that and the later gives way.
fn renamed(shared: &Shared, original: &str) {
    let original = original.to_lowercase();
    let mut own = shared.own.lock();
    let announced = own.agents.values().find(|one| *one.fullname == *original);
    let Some(announced) = announced else {
        return;
    };
    let (entry, attempt) = (Arc::clone(&announced.entry), announced.attempt + 1);
    if own.spoilt.len() >= MAX_SPOILT {
        // What is forgotten is noticed again, just a little later.
        own.spoilt.clear();
    }
    own.spoilt.insert(original.into());
    let withdrawn = shared.take_back(&mut own, &entry.name);
    let announced = withdrawn.and_then(|()| shared.announce(&mut own, &entry, attempt));
    if let Err(error) = announced {
        let name = &entry.name;
        shared.failed(format!(
            "cannot announce {name:?} by another label: {error}"
        ));
    }
}

/// If we announce the same name, the later registration is withdrawn: by us when it is ours.
fn contested(shared: &Shared, theirs: &Arc<Entry>) {
    let mut own = shared.own.lock();
    let Some(ours) = own.agents.get(&theirs.name) else {
        return;
    };
    let age = |entry: &Entry| (entry.registered, entry.incarnation);
    if age(&ours.entry) < age(theirs) {
        return;
    }
    let withdrawn = Arc::clone(&ours.entry);
    if let Err(error) = shared.take_back(&mut own, &withdrawn.name) {
        let name = &withdrawn.name;
        shared.failed(format!("cannot withdraw {name:?}: {error}"));
    }
    drop(own);
    let name = &withdrawn.name;
    tracing::warn!(%name, holder = %theirs.mts.name, "an earlier registration has the name");
    // That nobody listens is up to the owner.
    let _ = shared.withdrawals.send(Withdrawal {
        withdrawn,
        holder: Arc::clone(theirs),
    });
}

/// The first label of a full name, as it was given.
pub(super) fn label_of(fullname: &str) -> String {
    let label = fullname
        .len()
        .checked_sub(SERVICE_TYPE.len() + 1)
        .and_then(|len| fullname.get(..len))
        .unwrap_or(fullname);
    label.replace("\\.", ".").replace("\\\\", "\\")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn renamed_records_are_recognised() {
        let full = |label: &str| format!("{label}.{SERVICE_TYPE}");
        assert_eq!(label_of(&full("arm?left")), "arm?left");
        assert_eq!(label_of(&full(r"arm\.left")), "arm.left");
        assert_eq!(label_of("x"), "x");
        assert!(is_renamed(&full("arm (2)"), &full("arm")));
        for other in ["arm", "arm (x)", "arm~01 (2)", "arm 2"] {
            assert!(!is_renamed(&full(other), &full("arm")), "{other}");
        }
    }
}
