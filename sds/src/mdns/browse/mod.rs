//! Browses for records of this service type: finds records, keeps them while they are valid, and
//! queries for those that may be outdated.
//!
//! This module implements the browsing half of DNS-SD. The mDNS library only announces and answers,
//! for three reasons. Of several strings with one key the library keeps the first (RFC 6763 clause
//! 6.4), but fipa_services splits long values that way. It searches all its records for every
//! packet. And it queries for every record again within the record's two minutes, which is not
//! necessary among gateways: each sends a digest of its announcements every two seconds
//! ([`super::beacon`]), and while the digest matches the stored records, [all of them are
//! valid](Browser::confirm).
//!
//! A PTR record introduces a record; it is known when its SRV and TXT records have arrived. These
//! two keep it valid. Its address records do not matter, because the TXT record lists the
//! locations.
//!
//! This module has no I/O and no clock: packets and the time go in, packets and changes come out.

mod full_query;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::{Incarnation, scoped_quota_address};
use simple_dns::rdata::RData;
use simple_dns::{CLASS, Name, Packet, PacketFlag, QTYPE, TYPE};

use self::full_query::FullQuery;
use super::beacon::Digest;
use super::packet::{self, KNOWN};
use super::record::{self, Properties};
use super::{MdnsDirectory, SERVICE_TYPE};

/// Maximum number of records that are introduced but not yet known. Each is queried for a few
/// times.
const MAX_UNKNOWN: usize = 4096;
/// Maximum share of one source address in the tables: a quarter, so that one source cannot fill
/// them. The last quarter is only for sources with a small share, so that a few others cannot fill them either.
const MAX_SHARE: usize = MdnsDirectory::MAX_RECORDS / 4;
const MAX_SHARE_BYTES: usize = MdnsDirectory::MAX_BYTES / 4;
const SMALL_SHARE: usize = MAX_SHARE / 40;
const SMALL_SHARE_BYTES: usize = MAX_SHARE_BYTES / 40;
const MAX_SHARE_UNKNOWN: usize = MAX_UNKNOWN / 4;
/// Delays of the queries for missing parts of a record, each after the previous query. A host that
/// has just sent a record must not repeat it within a second (RFC 6762 clause 6).
const MISSING: &[Duration] = &[
    Duration::from_millis(20),
    Duration::from_millis(1200),
    Duration::from_secs(3),
    Duration::from_secs(9),
];
/// Time for which a record may stay introduced without being known: the sum of `MISSING`, and time
/// for the last answer.
const INTRODUCED: Duration = Duration::from_secs(15);
/// Delays of the queries for a record suspected, and the time it has to be confirmed.
const DOUBTED: &[Duration] = &[Duration::ZERO, Duration::from_millis(1100)];
const TIMEOUT: Duration = Duration::from_secs(2);
/// Time for which a record stays known after its goodbye, so that the goodbye can be revoked (RFC
/// 6762 clause 10.1).
const GOODBYE: Duration = Duration::from_secs(1);
/// Maximum jitter of the first delay, so that hosts do not query simultaneously.
const JITTER: Duration = Duration::from_millis(100);

/// Fractions of a record's TTL at which it is queried for again. The first is earlier than RFC 6762
/// clause 5.2 recommends, because batched queries take fewer packets; the others are the
/// recommended ones.
const RENEWED: [f64; 4] = [0.55, 0.80, 0.90, 0.95];
/// Maximum jitter of the first fraction, so that one host queries and the others receive the
/// answer.
const RENEWED_JITTER: f64 = 0.12;
/// A record that is due within this fraction (1/24) of its TTL is queried for together with others.
const ALONG: u32 = 24;
/// Upper bound of a TTL.
const MAX_LIFETIME: Duration = Duration::from_secs(4500);
/// Minimum time between two scans of all records: a constant, and an amount per record.
const GRAIN: Duration = Duration::from_millis(20);
const GRAIN_EACH: Duration = Duration::from_micros(10);

/// Maximum number of known answers that take extra packets in a query for all records.
const MAX_KNOWN: usize = 50 * KNOWN;

/// Maximum number of interfaces of a record that are remembered.
const MAX_INTERFACES: usize = 4;

/// The origin of a packet.
#[derive(Debug, Clone, Copy)]
pub(super) struct Origin {
    pub(super) address: IpAddr,
    /// The number of the interface on which it was received.
    pub(super) interface: u32,
}

/// A record that is new or has changed.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Found {
    pub(super) fullname: Arc<str>,
    pub(super) properties: Properties,
    /// The address that introduced it.
    pub(super) from: IpAddr,
    /// The interfaces on which it was received, the latest first.
    pub(super) interfaces: Vec<u32>,
}

/// The records on the network.
#[derive(Debug)]
pub(super) struct Browser {
    /// This host's own gateway; its records are looped back and need no renewal.
    own: Incarnation,
    /// By label with its original spelling, which queries must repeat.
    records: HashMap<String, Record>,
    /// Number of records that are not yet known.
    unknown: usize,
    /// Total bytes of their TXT records.
    bytes: usize,
    /// Share of each [source](scoped_quota_address) in these.
    shares: HashMap<IpAddr, Share>,
    /// Time at which the beacon of a gateway last matched its stored records.
    confirmed: HashMap<Incarnation, Instant>,
    full_query: FullQuery,
    /// Jitter of the next renewals, from 0 to 1.
    share: f64,
    /// Time of the last scan of all records, and of the next.
    looked: Option<Instant>,
    next: Option<Instant>,
}

/// The records that one source introduced.
#[derive(Debug, Clone, Copy, Default)]
struct Share {
    records: usize,
    /// Number of these that are not yet known.
    unknown: usize,
    bytes: usize,
}

#[derive(Debug)]
struct Record {
    fullname: Arc<str>,
    /// The [source](scoped_quota_address) that introduced it.
    from: IpAddr,
    /// The gateway that announces it, if it is not a legacy peer's record.
    gateway: Incarnation,
    /// TTL of its SRV record, and the host in it.
    place: Option<Lifetime>,
    host: String,
    /// TTL of its TXT record, its digest and its length in bytes.
    text: Option<Lifetime>,
    digest: Digest,
    len: usize,
    /// Properties that have not been reported yet.
    news: Option<Properties>,
    /// The interfaces on which it was received, the latest first.
    interfaces: Vec<u32>,
    /// Whether both its SRV and TXT record have arrived.
    known: bool,
    /// Expiry if nothing more arrives: the record is not known yet, is suspected, or had a goodbye.
    ends: Option<Instant>,
    questions: Option<Questions>,
}

/// Queries for both parts of a record.
#[derive(Debug)]
struct Questions {
    pauses: &'static [Duration],
    asked: usize,
    due: Instant,
}

/// Lifetime of a DNS record.
#[derive(Debug, Clone, Copy)]
struct Lifetime {
    received: Instant,
    ttl: Duration,
    /// Number of renewal queries since then.
    asked: usize,
}

/// Result of introducing a record.
enum Introduced {
    New,
    Already,
    Refused,
}

/// Content of a packet.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct ParsedPacket {
    pub(super) found: Vec<Found>,
    /// Number of records that were refused for lack of space.
    pub(super) refused: u64,
}

/// Actions that are due.
#[derive(Debug, Default)]
pub(super) struct Due {
    /// Packets to send.
    pub(super) packets: Vec<Vec<u8>>,
    /// Full names of records that were removed.
    pub(super) gone: Vec<Arc<str>>,
}

impl Browser {
    /// Starts without records and with a query for all. `chance`, from 0 to 1, scales the jitter.
    pub(super) fn new(now: Instant, own: Incarnation, chance: f64) -> Self {
        Self {
            own,
            records: HashMap::new(),
            unknown: 0,
            bytes: 0,
            shares: HashMap::new(),
            confirmed: HashMap::new(),
            full_query: FullQuery::new(now, chance),
            share: 0.0,
            looked: None,
            next: None,
        }
    }

    /// Restarts the queries for all records, because a new interface has not been queried yet.
    pub(super) fn start_again(&mut self, now: Instant, chance: f64) {
        self.full_query = FullQuery::new(now, chance);
    }

    /// Handles a packet from this origin. `chance`, from 0 to 1, scales the jitter.
    pub(super) fn handle_packet(
        &mut self,
        now: Instant,
        from: Origin,
        packet: &[u8],
        chance: f64,
    ) -> ParsedPacket {
        let mut received = ParsedPacket::default();
        let ours = packet::may_name_our_type(packet);
        let Some(packet) = ours.then(|| packet::parse(packet)).flatten() else {
            return received;
        };
        if !packet.has_flags(PacketFlag::RESPONSE) {
            self.handle_question(now, &packet);
            return received;
        }
        let all = packet.answers.iter().chain(&packet.additional_records);
        let all = all.filter(|record| record.class == CLASS::IN);
        let (goodbyes, there): (Vec<_>, Vec<_>) = all.partition(|record| record.ttl == 0);
        let mut new = Vec::new();
        let source = scoped_quota_address(from.address, from.interface);
        for record in &there {
            if let Some(label) = introduced(&record.name, &record.rdata) {
                match self.introduce(now, source, label, chance) {
                    Introduced::New => new.push(label),
                    Introduced::Refused => received.refused += 1,
                    Introduced::Already => {}
                }
            }
        }
        for record in &there {
            let label = packet::label_of(&record.name);
            let Some(known) = label.and_then(|label| self.records.get_mut(label)) else {
                continue;
            };
            let lifetime = Lifetime::new(now, record.ttl);
            match &record.rdata {
                RData::SRV(srv) => {
                    known.host = srv.target.to_string();
                    known.place = Some(lifetime);
                }
                RData::TXT(txt) => {
                    let properties = packet::properties(txt);
                    let digest = Digest::of(&properties);
                    let is_elsewhere = !known.interfaces.contains(&from.interface);
                    if is_elsewhere {
                        known.interfaces.insert(0, from.interface);
                        known.interfaces.truncate(MAX_INTERFACES);
                    }
                    if known.text.is_none() || known.digest != digest || is_elsewhere {
                        let len = record::len_of(&properties);
                        let others = self.bytes - known.len;
                        let share = self.shares.entry(known.from).or_default();
                        let others_of_share = share.bytes - known.len;
                        let most = match others_of_share + len <= SMALL_SHARE_BYTES {
                            true => MdnsDirectory::MAX_BYTES,
                            false => MdnsDirectory::MAX_BYTES - MAX_SHARE_BYTES,
                        };
                        if others + len > most || others_of_share + len > MAX_SHARE_BYTES {
                            received.refused += 1;
                            continue;
                        }
                        (self.bytes, share.bytes) = (others + len, others_of_share + len);
                        (known.digest, known.len) = (digest, len);
                        known.news = Some(properties);
                    }
                    known.text = Some(lifetime);
                }
                _ => continue,
            }
            if known.place.is_none() || known.text.is_none() {
                continue;
            }
            if !known.known {
                self.unknown -= 1;
                self.shares.entry(known.from).or_default().unknown -= 1;
            }
            known.known = true;
            known.is_there();
            if let Some(news) = known.news.take() {
                received.found.push(Found {
                    fullname: Arc::clone(&known.fullname),
                    properties: news,
                    from: known.from,
                    interfaces: known.interfaces.clone(),
                });
            }
            if let Some(due) = known.due(self.share, self.own) {
                self.wake(due);
            }
        }
        // A new record that is complete in one packet does not count as unknown.
        for label in new {
            let share = self.shares.get(&source).copied().unwrap_or_default();
            let are_too_many = self.unknown > MAX_UNKNOWN || share.unknown > MAX_SHARE_UNKNOWN;
            if are_too_many && self.records.get(label).is_some_and(|it| !it.known) {
                self.remove(label);
                received.refused += 1;
            }
        }
        for record in &goodbyes {
            if let Some(label) = introduced(&record.name, &record.rdata) {
                self.handle_goodbye(now, label, &goodbyes);
            }
        }
        received
    }

    /// Handles the introduction of a record.
    fn introduce(&mut self, now: Instant, from: IpAddr, label: &str, chance: f64) -> Introduced {
        if let Some(known) = self.records.get_mut(label) {
            if known.known {
                known.is_there();
            }
            return Introduced::Already;
        }
        let share = self.shares.get(&from).copied().unwrap_or_default();
        let most = match share.records < SMALL_SHARE {
            true => MdnsDirectory::MAX_RECORDS,
            false => MdnsDirectory::MAX_RECORDS - MAX_SHARE,
        };
        if self.records.len() >= most || share.records >= MAX_SHARE {
            return Introduced::Refused;
        }
        let jitter = JITTER.mul_f64(chance.clamp(0.0, 1.0));
        let questions = Questions::new(now + jitter, MISSING);
        let due = questions.due;
        let record = Record {
            fullname: format!("{label}.{SERVICE_TYPE}").into(),
            from,
            gateway: Incarnation::UNKNOWN,
            place: None,
            host: String::new(),
            text: None,
            digest: Digest::default(),
            len: 0,
            news: None,
            interfaces: Vec::new(),
            known: false,
            ends: Some(now + INTRODUCED),
            questions: Some(questions),
        };
        self.records.insert(label.to_owned(), record);
        let share = self.shares.entry(from).or_default();
        (share.records, share.unknown) = (share.records + 1, share.unknown + 1);
        self.unknown += 1;
        self.wake(due);
        Introduced::New
    }

    /// Keeps only the interfaces that are in use.
    pub(super) fn retain_interfaces(&mut self, in_use: impl Fn(u32) -> bool) {
        for record in self.records.values_mut() {
            record.interfaces.retain(|interface| in_use(*interface));
        }
    }

    fn remove(&mut self, label: &str) {
        if let Some(gone) = self.records.remove(label) {
            self.unknown -= usize::from(!gone.known);
            self.bytes -= gone.len;
            forget(&mut self.shares, &gone);
        }
    }

    /// Handles a goodbye, unless it comes from another host than the one of the stored record.
    fn handle_goodbye(
        &mut self,
        now: Instant,
        label: &str,
        goodbyes: &[&simple_dns::ResourceRecord<'_>],
    ) {
        let Some(known) = self.records.get_mut(label) else {
            return;
        };
        let of_another = goodbyes.iter().any(|record| match &record.rdata {
            RData::SRV(srv) => {
                let same = packet::label_of(&record.name) == Some(label);
                same && known.place.is_some() && srv.target.to_string() != known.host
            }
            _ => false,
        });
        if !of_another {
            known.ends_at(now + GOODBYE);
            self.wake(now + GOODBYE);
        }
    }

    /// Handles another host's query. If it is the one that this host would send, the multicast
    /// answers serve this host as well (RFC 6762 clause 7.3).
    fn handle_question(&mut self, now: Instant, packet: &Packet<'_>) {
        let mut questions = packet.questions.iter();
        let for_all = questions.any(|one| {
            !one.unicast_response
                && one.qtype == QTYPE::TYPE(TYPE::PTR)
                && packet::is_service(&one.qname)
        });
        let more_to_come = packet.has_flags(PacketFlag::TRUNCATION);
        let is_known = |label: &str| {
            let known = self.records.get(label);
            known.is_some_and(|record| record.known)
        };
        let mut known_answers = packet.answers.iter();
        let all_known = known_answers
            .all(|answer| introduced(&answer.name, &answer.rdata).is_some_and(is_known));
        if for_all && !more_to_come && all_known {
            self.full_query.asked_by_others(now, self.records.len());
        }
    }

    /// Records that this gateway announces the record with this full name.
    pub(super) fn belongs(&mut self, fullname: &str, gateway: Incarnation) {
        if let Some(known) = self.records.get_mut(label_of(fullname)) {
            known.gateway = gateway;
        }
    }

    /// Reports the record with this label when it arrives next, even if it is the stored one.
    pub(super) fn report_again(&mut self, label: &str) {
        if let Some(known) = self.records.get_mut(label) {
            known.digest = Digest::default();
        }
    }

    /// Records that the gateway's beacon matches its stored records, so that all of them are valid.
    pub(super) fn confirm(&mut self, now: Instant, gateway: Incarnation) {
        // The next scan of the records applies it.
        self.confirmed.insert(gateway, now);
    }

    /// Removes these records of a gateway that has ended, unless they are announced again.
    pub(super) fn end(&mut self, now: Instant, fullnames: &[Arc<str>]) {
        for fullname in fullnames {
            if let Some(known) = self.records.get_mut(label_of(fullname)) {
                known.ends_at(now);
                self.wake(now);
            }
        }
    }

    /// Queries for these records; a record that is not confirmed in time is removed.
    pub(super) fn suspect(&mut self, now: Instant, fullnames: &[Arc<str>]) {
        for fullname in fullnames {
            let Some(known) = self.records.get_mut(label_of(fullname)) else {
                continue;
            };
            if known.known {
                known.ends_at(now + TIMEOUT);
                known.questions = Some(Questions::new(now, DOUBTED));
                self.wake(now);
            }
        }
    }

    /// Queries for all unknown records at once, unless such a query was sent just now.
    pub(super) fn ask_for_missing(&mut self, now: Instant) -> Vec<Vec<u8>> {
        if !self.full_query.may_be_asked(now) {
            return Vec::new();
        }
        self.full_query.last = Some(now);
        self.question_for_all()
    }

    fn question_for_all(&self) -> Vec<Vec<u8>> {
        let known = self.records.iter();
        let known = known.filter(|(_, record)| record.known && record.ends.is_none());
        let (ours, peers): (Vec<_>, Vec<_>) =
            known.partition(|(_, record)| record.gateway.is_known());
        let mut labels: Vec<&str> = peers.iter().map(|(label, _)| label.as_str()).collect();
        labels.truncate(MAX_KNOWN);
        // The mDNS library honors known answers in the first packet of a query only, so more of
        // them are useless.
        let room = KNOWN.saturating_sub(labels.len());
        labels.extend(ours.iter().take(room).map(|(label, _)| label.as_str()));
        packet::question_for_all(&labels)
    }

    /// Returns the queries that are due, and the records that were removed. `chance`, from 0 to 1,
    /// scales the jitter.
    pub(super) fn handle_timeout(&mut self, now: Instant, chance: f64) -> Due {
        let mut due = Due::default();
        if self.full_query.next <= now {
            due.packets = self.question_for_all();
            self.full_query.asked(now, self.records.len(), chance);
        }
        if self.next.is_none_or(|next| now < next) {
            return due;
        }
        self.looked = Some(now);
        self.next = None;
        self.confirmed.retain(|_, at| now < *at + MAX_LIFETIME);
        let (mut all, mut places, mut texts) = (Vec::new(), Vec::new(), Vec::new());
        let mut next: Option<Instant> = None;
        self.records.retain(|label, record| {
            if let Some(at) = self.confirmed.get(&record.gateway) {
                record.confirm(*at);
            }
            if record.end().is_some_and(|end| end <= now) {
                self.unknown -= usize::from(!record.known);
                self.bytes -= record.len;
                forget(&mut self.shares, record);
                if record.known {
                    due.gone.push(Arc::clone(&record.fullname));
                }
                return false;
            }
            if record.ask(now) {
                all.push(label.clone());
            }
            if record.is_renewed(self.own) {
                for (lifetime, labels) in [
                    (&mut record.place, &mut places),
                    (&mut record.text, &mut texts),
                ] {
                    if let Some(lifetime) = lifetime
                        && lifetime.renew(now, self.share)
                    {
                        labels.push(label.clone());
                    }
                }
            }
            let then = record.due(self.share, self.own);
            next = next.into_iter().chain(then).min();
            true
        });
        if let Some(next) = next {
            self.wake(next);
        }
        if !places.is_empty() {
            self.share = chance.clamp(0.0, 1.0);
        }
        for (labels, kinds) in [
            (&all, &[TYPE::SRV, TYPE::TXT][..]),
            (&places, &[TYPE::SRV]),
            (&texts, &[TYPE::TXT]),
        ] {
            due.packets.extend(packet::questions(labels, kinds));
        }
        due
    }

    /// Asserts that the counters match the records and are within bounds.
    #[cfg(feature = "fuzzing")]
    pub(super) fn check(&self) {
        let records = || self.records.values();
        assert_eq!(self.unknown, records().filter(|it| !it.known).count());
        assert_eq!(self.bytes, records().map(|it| it.len).sum::<usize>());
        for (from, share) in &self.shares {
            let of = || records().filter(|it| it.from == *from);
            assert_eq!(share.records, of().count());
            assert_eq!(share.unknown, of().filter(|it| !it.known).count());
            assert_eq!(share.bytes, of().map(|it| it.len).sum::<usize>());
            assert!(share.records <= MAX_SHARE && share.bytes <= MAX_SHARE_BYTES);
        }
        assert!(self.shares.len() <= self.records.len());
        assert!(self.records.len() <= MdnsDirectory::MAX_RECORDS);
        assert!(self.bytes <= MdnsDirectory::MAX_BYTES);
    }

    /// Time of the next action.
    pub(super) fn poll_timeout(&self) -> Instant {
        let next = self.next.unwrap_or(self.full_query.next);
        next.min(self.full_query.next)
    }

    fn wake(&mut self, at: Instant) {
        let known = u32::try_from(self.records.len()).unwrap_or(u32::MAX);
        let grain = GRAIN + GRAIN_EACH.saturating_mul(known);
        let at = self.looked.map_or(at, |looked| at.max(looked + grain));
        self.next = Some(self.next.map_or(at, |next| next.min(at)));
    }
}

impl Record {
    /// The beacon of its gateway matched at that time.
    fn confirm(&mut self, at: Instant) {
        for lifetime in [&mut self.place, &mut self.text].into_iter().flatten() {
            if at > lifetime.received {
                (lifetime.received, lifetime.asked) = (at, 0);
            }
        }
    }

    /// A packet confirmed the record.
    fn is_there(&mut self) {
        (self.ends, self.questions) = (None, None);
    }

    fn ends_at(&mut self, end: Instant) {
        self.ends = Some(self.ends.map_or(end, |ends| ends.min(end)));
    }

    /// Whether to query for both parts now.
    fn ask(&mut self, now: Instant) -> bool {
        let Some(questions) = self.questions.as_mut().filter(|it| it.due <= now) else {
            return false;
        };
        questions.asked += 1;
        match questions.pauses.get(questions.asked) {
            Some(pause) => questions.due = now + *pause,
            None => self.questions = None,
        }
        true
    }

    /// Whether to query for the record before it expires.
    fn is_renewed(&self, own: Incarnation) -> bool {
        self.known && self.gateway != own
    }

    /// Time at which the record expires without further packets.
    fn end(&self) -> Option<Instant> {
        let lifetimes = [self.place, self.text].into_iter().flatten();
        lifetimes.map(Lifetime::end).chain(self.ends).min()
    }

    /// Time of the next action for this record.
    fn due(&self, share: f64, own: Incarnation) -> Option<Instant> {
        let lifetimes = [self.place, self.text].into_iter().flatten();
        let renewed = lifetimes
            .filter(|_| self.is_renewed(own))
            .map(|lifetime| lifetime.due(share));
        let asked = self.questions.as_ref().map(|it| it.due);
        renewed.chain(asked).chain(self.end()).min()
    }
}

impl Questions {
    fn new(from: Instant, pauses: &'static [Duration]) -> Self {
        Self {
            pauses,
            asked: 0,
            due: from + pauses.first().copied().unwrap_or_default(),
        }
    }
}

impl Lifetime {
    fn new(received: Instant, ttl: u32) -> Self {
        let ttl = Duration::from_secs(ttl.into()).min(MAX_LIFETIME);
        Self {
            received,
            ttl,
            asked: 0,
        }
    }

    fn end(self) -> Instant {
        self.received + self.ttl
    }

    /// Time of the next renewal query, or of expiry.
    fn due(self, share: f64) -> Instant {
        let jitter = if self.asked == 0 {
            RENEWED_JITTER * share
        } else {
            0.0
        };
        let part = RENEWED.get(self.asked).map_or(1.0, |part| part + jitter);
        self.received + self.ttl.mul_f64(part)
    }

    /// Whether to query now, either because it is due or together with others.
    fn renew(&mut self, now: Instant, share: f64) -> bool {
        let due = self.asked < RENEWED.len() && self.due(share) <= now + self.ttl / ALONG;
        self.asked += usize::from(due);
        due
    }
}

/// Subtracts a removed record from the share of its source.
fn forget(shares: &mut HashMap<IpAddr, Share>, gone: &Record) {
    if let Some(share) = shares.get_mut(&gone.from) {
        share.records -= 1;
        share.unknown -= usize::from(!gone.known);
        share.bytes -= gone.len;
        if share.records == 0 {
            shares.remove(&gone.from);
        }
    }
}

/// The label of the record that a PTR record introduces.
fn introduced<'a>(name: &Name<'_>, data: &'a RData<'_>) -> Option<&'a str> {
    match data {
        RData::PTR(instance) if packet::is_service(name) => packet::label_of(&instance.0),
        _ => None,
    }
}

/// The label in a full name.
pub(super) fn label_of(fullname: &str) -> &str {
    let label = fullname.strip_suffix(SERVICE_TYPE);
    label
        .and_then(|label| label.strip_suffix('.'))
        .unwrap_or(fullname)
}
