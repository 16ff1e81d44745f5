//! Who there is on the network: the records of our type, found, kept as long as they are good, and
//! asked for when they might not be any more.
//!
//! This is the part of DNS-SD that browses. The mDNS library could do it, too, and only announces
//! and answers for us, for three reasons. Of several strings with one key it keeps the first (RFC
//! 6763 clause 6.4), but fipa_services splits long values so. It looks through all that it knows
//! whenever a packet comes. And it asks for every record again before the record's two minutes are
//! over, which is not needed among gateways: each says every two seconds what it announces
//! ([`super::beacon`]), and as long as that is what is held of it, [all of it is
//! good](Browser::confirm).
//!
//! A record is introduced by a PTR record, and known from when its SRV and its TXT record have been
//! heard. These keep it alive; whether it has an address is no matter, locations stand in its text.
//!
//! No input or output, and no clock: packets and the time go in, packets and news come out.

mod everything;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::Incarnation;
use simple_dns::rdata::RData;
use simple_dns::{CLASS, Name, Packet, PacketFlag, QTYPE, TYPE};

use self::everything::Everything;
use super::beacon::Digest;
use super::packet::{self, KNOWN};
use super::record::Properties;
use super::{MdnsDirectory, SERVICE_TYPE};

/// Most records that are introduced and not known yet. Each is asked for a few times.
const MAX_UNKNOWN: usize = 4096;
/// Of all that is kept, the share of one source address: a quarter. One source cannot fill the tables.
const MAX_SHARE: usize = MdnsDirectory::MAX_RECORDS / 4;
const MAX_SHARE_BYTES: usize = MdnsDirectory::MAX_BYTES / 4;
const MAX_SHARE_UNKNOWN: usize = MAX_UNKNOWN / 4;
/// When what is missing of a record is asked for, each after the one before: who has just said it
/// must not repeat it within a second (RFC 6762 clause 6).
const MISSING: &[Duration] = &[
    Duration::from_millis(20),
    Duration::from_millis(1200),
    Duration::from_secs(3),
    Duration::from_secs(9),
];
/// For how long a record is introduced without being known: that, and time for the last answer.
const INTRODUCED: Duration = Duration::from_secs(15);
/// When a record that is in doubt is asked for, likewise, and how long it has to answer.
const DOUBTED: &[Duration] = &[Duration::ZERO, Duration::from_millis(1100)];
const PATIENCE: Duration = Duration::from_secs(2);
/// For how long a record is still known after its goodbye, so that it can be taken back (RFC 6762
/// clause 10.1).
const GOODBYE: Duration = Duration::from_secs(1);
/// Up to how much is added to the first pause, so that not all ask at the same moment.
const JITTER: Duration = Duration::from_millis(100);

/// At which part of its life a record is asked for again. The first comes earlier than others ask
/// (RFC 6762 clause 5.2), because what is asked for together takes fewer packets; the others are
/// theirs.
const RENEWED: [f64; 4] = [0.55, 0.80, 0.90, 0.95];
/// Up to how much is added to the first, so that one host asks and the others hear the answer.
const RENEWED_JITTER: f64 = 0.12;
/// What becomes due within that part of its life is asked for along with others.
const ALONG: u32 = 24;
/// A record is not believed in for longer than that, whatever it says.
const MAX_LIFE: Duration = Duration::from_secs(4500);
/// The shortest time between two looks at all records: that, and so much for each.
const GRAIN: Duration = Duration::from_millis(20);
const GRAIN_EACH: Duration = Duration::from_micros(10);

/// Most known answers to a question for everything that take packets of their own.
const MAX_KNOWN: usize = 50 * KNOWN;

/// The records on the network.
#[derive(Debug)]
pub(super) struct Browser {
    /// Our gateway, whose records come back to us, and are no news.
    own: Incarnation,
    /// By label, as it is spelt: others are asked and answer by that.
    records: HashMap<String, Record>,
    /// How many of them are not known yet.
    unknown: usize,
    /// How many bytes the others say.
    bytes: usize,
    /// What of that each source address has introduced.
    shares: HashMap<IpAddr, Share>,
    /// When the beacons of a gateway last said what is held of it.
    confirmed: HashMap<Incarnation, Instant>,
    everything: Everything,
    /// The jitter of the next renewals, from 0 to 1.
    share: f64,
    /// When all records were looked at, and when they are to be looked at next.
    looked: Option<Instant>,
    next: Option<Instant>,
}

/// The records that one source address has introduced.
#[derive(Debug, Clone, Copy, Default)]
struct Share {
    records: usize,
    /// How many of them are not known yet.
    unknown: usize,
    bytes: usize,
}

#[derive(Debug)]
struct Record {
    fullname: Arc<str>,
    /// The address that introduced it.
    from: IpAddr,
    /// Who announces it, if that is one of our gateways.
    gateway: Incarnation,
    /// Its SRV record, and the host that says.
    place: Option<Life>,
    host: String,
    /// Its TXT record, in short, and how long it is.
    text: Option<Life>,
    digest: Digest,
    len: usize,
    /// What it says and has not been told.
    news: Option<Properties>,
    /// Whether both have been heard.
    known: bool,
    /// When it is gone if it is not heard of again: it is not known yet, in doubt, or has said
    /// goodbye.
    ends: Option<Instant>,
    questions: Option<Questions>,
}

/// Questions for all of a record.
#[derive(Debug)]
struct Questions {
    pauses: &'static [Duration],
    asked: usize,
    due: Instant,
}

/// How long a DNS record is good.
#[derive(Debug, Clone, Copy)]
struct Life {
    heard: Instant,
    ttl: Duration,
    /// How often it has been asked for since.
    asked: usize,
}

/// What became of a record that was introduced.
enum Introduced {
    New,
    Already,
    Refused,
}

/// What a packet said.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Heard {
    /// Full names of records that are new or have changed, and all that they say.
    pub(super) found: Vec<(Arc<str>, Properties)>,
    /// How many found no room.
    pub(super) refused: u64,
}

/// What there is to be done.
#[derive(Debug, Default)]
pub(super) struct Due {
    /// Packets to be sent.
    pub(super) packets: Vec<Vec<u8>>,
    /// Full names of records that are gone.
    pub(super) gone: Vec<Arc<str>>,
}

impl Browser {
    /// Knows nothing, and asks for everything. `chance`, from 0 to 1, says how much jitter there is.
    pub(super) fn new(now: Instant, own: Incarnation, chance: f64) -> Self {
        Self {
            own,
            records: HashMap::new(),
            unknown: 0,
            bytes: 0,
            shares: HashMap::new(),
            confirmed: HashMap::new(),
            everything: Everything::new(now, chance),
            share: 0.0,
            looked: None,
            next: None,
        }
    }

    /// There is an interface on which nobody has been asked: everything is asked for, as in the
    /// beginning.
    pub(super) fn start_again(&mut self, now: Instant, chance: f64) {
        self.everything = Everything::new(now, chance);
    }

    /// A packet has been heard from this address. `chance`, from 0 to 1, says how much jitter there is.
    pub(super) fn handle_packet(
        &mut self,
        now: Instant,
        from: IpAddr,
        packet: &[u8],
        chance: f64,
    ) -> Heard {
        let mut heard = Heard::default();
        let ours = packet::may_name_our_type(packet);
        let Some(packet) = ours.then(|| packet::parse(packet)).flatten() else {
            return heard;
        };
        if !packet.has_flags(PacketFlag::RESPONSE) {
            self.handle_question(now, &packet);
            return heard;
        }
        let all = packet.answers.iter().chain(&packet.additional_records);
        let all = all.filter(|record| record.class == CLASS::IN);
        let (goodbyes, there): (Vec<_>, Vec<_>) = all.partition(|record| record.ttl == 0);
        let mut new = Vec::new();
        for record in &there {
            if let Some(label) = introduced(&record.name, &record.rdata) {
                match self.introduce(now, from, label, chance) {
                    Introduced::New => new.push(label),
                    Introduced::Refused => heard.refused += 1,
                    Introduced::Already => {}
                }
            }
        }
        for record in &there {
            let label = packet::label_of(&record.name);
            let Some(known) = label.and_then(|label| self.records.get_mut(label)) else {
                continue;
            };
            let life = Life::new(now, record.ttl);
            match &record.rdata {
                RData::SRV(srv) => {
                    known.host = srv.target.to_string();
                    known.place = Some(life);
                }
                RData::TXT(txt) => {
                    let said = packet::properties(txt);
                    let digest = Digest::of(&said);
                    if known.text.is_none() || known.digest != digest {
                        let len = len_of(&said);
                        let others = self.bytes - known.len;
                        let share = self.shares.entry(known.from).or_default();
                        let others_of_share = share.bytes - known.len;
                        if others + len > MdnsDirectory::MAX_BYTES
                            || others_of_share + len > MAX_SHARE_BYTES
                        {
                            heard.refused += 1;
                            continue;
                        }
                        (self.bytes, share.bytes) = (others + len, others_of_share + len);
                        (known.digest, known.len) = (digest, len);
                        known.news = Some(said);
                    }
                    known.text = Some(life);
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
                heard.found.push((Arc::clone(&known.fullname), news));
            }
            if let Some(due) = known.due(self.share, self.own) {
                self.wake(due);
            }
        }
        // What comes with all that it says is not waited for.
        for label in new {
            let share = self.shares.get(&from).copied().unwrap_or_default();
            let are_too_many = self.unknown > MAX_UNKNOWN || share.unknown > MAX_SHARE_UNKNOWN;
            if are_too_many && self.records.get(label).is_some_and(|it| !it.known) {
                self.remove(label);
                heard.refused += 1;
            }
        }
        for record in &goodbyes {
            if let Some(label) = introduced(&record.name, &record.rdata) {
                self.handle_goodbye(now, label, &goodbyes);
            }
        }
        heard
    }

    /// There is such a record.
    fn introduce(&mut self, now: Instant, from: IpAddr, label: &str, chance: f64) -> Introduced {
        if let Some(known) = self.records.get_mut(label) {
            if known.known {
                known.is_there();
            }
            return Introduced::Already;
        }
        let share = self.shares.get(&from).copied().unwrap_or_default();
        if self.records.len() >= MdnsDirectory::MAX_RECORDS || share.records >= MAX_SHARE {
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

    fn remove(&mut self, label: &str) {
        if let Some(gone) = self.records.remove(label) {
            self.unknown -= usize::from(!gone.known);
            self.bytes -= gone.len;
            forget(&mut self.shares, &gone);
        }
    }

    /// Its owner takes leave of it, unless that is another one than the one we know.
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

    /// Somebody asks. If it is what we would ask, the answers are for us as well (RFC 6762 clause
    /// 7.3).
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
            self.everything.asked_by_others(now, self.records.len());
        }
    }

    /// The record with this full name is announced by that gateway.
    pub(super) fn belongs(&mut self, fullname: &str, gateway: Incarnation) {
        if let Some(known) = self.records.get_mut(label_of(fullname)) {
            known.gateway = gateway;
        }
    }

    /// The gateway has said that it announces what is held of it: so all of that is good.
    pub(super) fn confirm(&mut self, now: Instant, gateway: Incarnation) {
        // When its records are looked at next, this is seen.
        self.confirmed.insert(gateway, now);
    }

    /// These records are of a gateway that has ended. They are gone, unless that is said again.
    pub(super) fn end(&mut self, now: Instant, fullnames: &[Arc<str>]) {
        for fullname in fullnames {
            if let Some(known) = self.records.get_mut(label_of(fullname)) {
                known.ends_at(now);
                self.wake(now);
            }
        }
    }

    /// Asks whether these records are still there. Who does not answer is gone.
    pub(super) fn doubt(&mut self, now: Instant, fullnames: &[Arc<str>]) {
        for fullname in fullnames {
            let Some(known) = self.records.get_mut(label_of(fullname)) else {
                continue;
            };
            if known.known {
                known.ends_at(now + PATIENCE);
                known.questions = Some(Questions::new(now, DOUBTED));
                self.wake(now);
            }
        }
    }

    /// Asks at once for what is not known, unless somebody just has.
    pub(super) fn ask_for_missing(&mut self, now: Instant) -> Vec<Vec<u8>> {
        if !self.everything.may_be_asked(now) {
            return Vec::new();
        }
        self.everything.last = Some(now);
        self.question_for_all()
    }

    fn question_for_all(&self) -> Vec<Vec<u8>> {
        let known = self.records.iter();
        let known = known.filter(|(_, record)| record.known && record.ends.is_none());
        let (ours, peers): (Vec<_>, Vec<_>) =
            known.partition(|(_, record)| record.gateway.is_known());
        let mut labels: Vec<&str> = peers.iter().map(|(label, _)| label.as_str()).collect();
        labels.truncate(MAX_KNOWN);
        // The library regards what stands in the first packet of a question only, so more would
        // be in vain.
        let room = KNOWN.saturating_sub(labels.len());
        labels.extend(ours.iter().take(room).map(|(label, _)| label.as_str()));
        packet::question_for_all(&labels)
    }

    /// What is to be asked now, and who is gone. `chance`, from 0 to 1, says how much jitter there
    /// is.
    pub(super) fn handle_timeout(&mut self, now: Instant, chance: f64) -> Due {
        let mut due = Due::default();
        if self.everything.next <= now {
            due.packets = self.question_for_all();
            self.everything.asked(now, self.records.len(), chance);
        }
        if self.next.is_none_or(|next| now < next) {
            return due;
        }
        self.looked = Some(now);
        self.next = None;
        self.confirmed.retain(|_, at| now < *at + MAX_LIFE);
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
                for (life, labels) in [
                    (&mut record.place, &mut places),
                    (&mut record.text, &mut texts),
                ] {
                    if let Some(life) = life
                        && life.renew(now, self.share)
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

    /// What is counted is what is kept, within the bounds.
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

    /// When there is something to be done next.
    pub(super) fn poll_timeout(&self) -> Instant {
        let next = self.next.unwrap_or(self.everything.next);
        next.min(self.everything.next)
    }

    fn wake(&mut self, at: Instant) {
        let known = u32::try_from(self.records.len()).unwrap_or(u32::MAX);
        let grain = GRAIN + GRAIN_EACH.saturating_mul(known);
        let at = self.looked.map_or(at, |looked| at.max(looked + grain));
        self.next = Some(self.next.map_or(at, |next| next.min(at)));
    }
}

impl Record {
    /// Its gateway announced it then.
    fn confirm(&mut self, at: Instant) {
        for life in [&mut self.place, &mut self.text].into_iter().flatten() {
            if at > life.heard {
                (life.heard, life.asked) = (at, 0);
            }
        }
    }

    /// Somebody has said so.
    fn is_there(&mut self) {
        (self.ends, self.questions) = (None, None);
    }

    fn ends_at(&mut self, end: Instant) {
        self.ends = Some(self.ends.map_or(end, |ends| ends.min(end)));
    }

    /// Whether all of it is to be asked for now.
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

    /// Whether it is asked for before it ends.
    fn is_renewed(&self, own: Incarnation) -> bool {
        self.known && self.gateway != own
    }

    /// When it is gone if nothing is heard of it.
    fn end(&self) -> Option<Instant> {
        let lives = [self.place, self.text].into_iter().flatten();
        lives.map(Life::end).chain(self.ends).min()
    }

    /// When it is to be looked at.
    fn due(&self, share: f64, own: Incarnation) -> Option<Instant> {
        let lives = [self.place, self.text].into_iter().flatten();
        let renewed = lives
            .filter(|_| self.is_renewed(own))
            .map(|life| life.due(share));
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

impl Life {
    fn new(heard: Instant, ttl: u32) -> Self {
        let ttl = Duration::from_secs(ttl.into()).min(MAX_LIFE);
        Self {
            heard,
            ttl,
            asked: 0,
        }
    }

    fn end(self) -> Instant {
        self.heard + self.ttl
    }

    /// When it is asked for next, or ends.
    fn due(self, share: f64) -> Instant {
        let jitter = if self.asked == 0 {
            RENEWED_JITTER * share
        } else {
            0.0
        };
        let part = RENEWED.get(self.asked).map_or(1.0, |part| part + jitter);
        self.heard + self.ttl.mul_f64(part)
    }

    /// Whether it is to be asked for now, or along with what is.
    fn renew(&mut self, now: Instant, share: f64) -> bool {
        let due = self.asked < RENEWED.len() && self.due(share) <= now + self.ttl / ALONG;
        self.asked += usize::from(due);
        due
    }
}

/// Takes a record that is gone out of the share of its source.
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

fn len_of(said: &Properties) -> usize {
    said.iter()
        .map(|(key, value)| key.len() + value.len() + 2)
        .sum()
}
