//! What is heard on the network beside what the mDNS library tells, and what is asked there beside
//! what it asks: whole records of old peers ([`super::whole`]), what would
//! expire ([`super::refresh`]), and beacons ([`super::beacon`]).

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use simple_dns::TYPE;

use super::Shared;
use super::beacon::{self, Beacons, Repair};
use super::record::Properties;
use super::refresh::Refresh;
use super::task::label_of;
use super::whole::{self, QUESTIONS, Reader, Sockets};

/// Up to how much is added to the time between two beacons, so that not all speak at once.
const JITTER: Duration = Duration::from_millis(500);
/// Least time between two beacons, however fast coalitions change.
const BREATH: Duration = Duration::from_millis(200);

pub(super) struct Ear {
    sockets: Sockets,
    reader: Reader,
    /// What the daemon has told of an old peer's record, and what the whole of it was then.
    known: HashMap<Arc<str>, (Properties, Option<Properties>)>,
    beacons: Beacons,
    refresh: Refresh,
    next_beacon: Instant,
    /// When one may be said that cannot wait until then.
    next_urgent: Instant,
}

impl Ear {
    pub(super) fn new() -> Self {
        Self {
            sockets: Sockets::new(),
            reader: Reader::default(),
            known: HashMap::new(),
            beacons: Beacons::default(),
            refresh: Refresh::default(),
            next_beacon: Instant::now(),
            next_urgent: Instant::now(),
        }
    }

    /// What is known of the whole record of which the daemon tells this. It is asked for again
    /// in any case: that part of it is the same says nothing about the rest.
    pub(super) fn whole(&mut self, fullname: &Arc<str>, told: &Properties) -> Option<Properties> {
        let label = label_of(fullname);
        self.reader
            .want(Instant::now(), fullname, &label, fastrand::f64());
        let (before, whole) = self.known.get(fullname)?;
        whole.clone().filter(|_| before == told)
    }

    /// The daemon knows this record.
    pub(super) fn known(&mut self, fullname: &str) {
        self.refresh.put(Instant::now(), &label_of(fullname));
    }

    /// That is all that is known of an old peer's record so far.
    pub(super) fn told(&mut self, fullname: Arc<str>, told: Properties) {
        self.known.insert(fullname, (told, None));
    }

    /// The whole of an old peer's record has come, if it is still there.
    pub(super) fn read(&mut self, fullname: &Arc<str>, whole: Properties) -> Option<&Properties> {
        let (_, known) = self.known.get_mut(fullname)?;
        Some(known.insert(whole))
    }

    pub(super) fn forget(&mut self, fullname: &str) {
        let label = label_of(fullname);
        self.reader.forget(&label);
        self.refresh.forget(&label);
        self.known.remove(fullname);
    }

    /// Says and asks what is due, and says when there is more.
    pub(super) fn speak(&mut self, shared: &Shared) -> Option<Instant> {
        let now = Instant::now();
        if shared.coalitions_changed.swap(false, Ordering::Relaxed) {
            // Others wait for it.
            self.next_beacon = self.next_beacon.min(self.next_urgent.max(now));
        }
        if now >= self.next_beacon {
            self.next_beacon = now + beacon::INTERVAL + JITTER.mul_f64(fastrand::f64());
            self.next_urgent = now + BREATH;
            // Interfaces come and go.
            if let Err(error) = self.sockets.refresh(&shared.config) {
                shared.failed(format!("cannot open a multicast socket: {error}"));
            }
            let beacon = beacon::packet(shared.config.mts.incarnation, shared.announced());
            self.send(beacon);
            for silent in self.beacons.silent(now) {
                self.repair(shared, silent);
            }
        }
        let questions = self.reader.handle_timeout(now);
        self.send(questions);
        let doubtful = shared.held.lock().due(now);
        for fullname in &doubtful {
            shared.verify(fullname);
        }
        // The daemon asks for the addresses; what the record says may be another thing, too.
        let labels: Vec<Vec<u8>> = doubtful
            .iter()
            .map(|fullname| label_of(fullname).into_bytes())
            .collect();
        let packets = labels.chunks(QUESTIONS);
        self.send(packets.filter_map(|labels| whole::question(labels, TYPE::TXT)));
        let questions = self.refresh.handle_timeout(now, fastrand::f64());
        self.send(questions);
        let later = shared.held.lock().poll_timeout(now);
        let due = [
            Some(self.next_beacon),
            self.reader.poll_timeout(),
            self.refresh.poll_timeout(),
            later,
        ];
        due.into_iter().flatten().min()
    }

    fn send(&self, packets: impl IntoIterator<Item = Vec<u8>>) {
        for packet in packets {
            self.sockets.send(&packet);
        }
    }

    /// Hears one packet: the whole records in it that were asked for.
    pub(super) async fn listen(&mut self, shared: &Shared) -> Vec<(Arc<str>, Properties)> {
        let packet = self.sockets.receive().await;
        let whole = self.reader.handle_packet(packet);
        self.refresh.handle_packet(Instant::now(), packet);
        if let Some((gateway, said)) = beacon::read(packet)
            && gateway != shared.config.mts.incarnation
        {
            let now = Instant::now();
            shared.show(|together| together.said(now, gateway, said.coalitions));
            let held = shared.held.lock().of(gateway);
            if let Some(repair) = self.beacons.handle(now, gateway, said.all, held) {
                self.repair(shared, repair);
            }
        }
        whole
    }

    fn repair(&self, shared: &Shared, repair: Repair) {
        tracing::debug!(?repair, "what is held of others is not what they have");
        match repair {
            Repair::Missing => {
                let origins = shared.table.origins();
                let labels: Vec<String> = origins.iter().map(|one| label_of(one)).collect();
                self.send(beacon::question(labels.iter().map(String::as_str)));
            }
            Repair::Surplus(gateway) => shared.held.lock().verify_all(gateway),
            Repair::Silent(gateway) => {
                shared.held.lock().doubt(Instant::now(), gateway);
            }
        }
    }
}
