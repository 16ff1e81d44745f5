//! Limits of what a gateway does because of legacy peers' letters: failure messages, and agents that
//! become known by a letter.
//!
//! A legacy peer may send letters as fast as it likes, under any name. Three rates bound what is done
//! about them: for one sender, for one address, and for all.

use std::net::IpAddr;
use std::time::{Duration, Instant};

use fipa_transport::Allowance;

use crate::Map;

/// Failure messages a second to one sender.
const PER_SENDER: f64 = 20.0;
/// Failure messages a second to all senders of one address.
const PER_ADDRESS: f64 = 100.0;
/// Failure messages a second to all senders.
const IN_ALL: f64 = 400.0;
/// How long an allowance is remembered. After that it is a full one again, so nothing is lost.
const MEMORY: Duration = Duration::from_secs(1);
/// Addresses whose bytes are remembered, at most.
const MAX_PAID: usize = 4096;
/// How long they are remembered when another address needs the room. Longer than the deadline of most
/// letters.
const PAID_MEMORY: Duration = Duration::from_secs(60);
/// Bytes that a letter counts as, at least. A failure message about a letter of 119 bytes has 300 to 700, and
/// the headers of the letter's own connection have 270.
const MIN_PAID: u64 = 1024;
/// Bytes that an address may have in store, at most.
const MAX_CREDIT: u64 = 1 << 20;
/// How often it is logged that failure messages were left out.
const LOG_EVERY: Duration = Duration::from_secs(1);

/// The address that a letter came from, if that is known, and the name of its sender.
type Sender = (Option<IpAddr>, String);

/// Limits what is done for senders: for one, for those of one address, and for all. What exceeds one
/// rate takes nothing from others.
#[derive(Debug)]
pub(super) struct SenderLimit {
    per_sender: f64,
    per_address: f64,
    in_all: f64,
    all: Option<Allowance>,
    addresses: Map<IpAddr, Allowance>,
    senders: Map<Sender, Allowance>,
}

impl SenderLimit {
    /// Senders that are remembered, at most, and addresses. Only what is allowed makes entries: twice
    /// `in_all` within the memory.
    const MAX_ENTRIES: usize = 1024;

    /// So much a second, each.
    pub(super) fn new(per_sender: f64, per_address: f64, in_all: f64) -> Self {
        Self {
            per_sender,
            per_address,
            in_all,
            all: None,
            addresses: Map::default(),
            senders: Map::default(),
        }
    }

    /// Whether it is allowed once more.
    pub(super) fn take(&mut self, now: Instant, from: Option<IpAddr>, sender: &str) -> bool {
        if self.senders.len().max(self.addresses.len()) >= Self::MAX_ENTRIES {
            let is_recent = |it: &Allowance| now.saturating_duration_since(it.asked()) < MEMORY;
            self.senders.retain(|_, allowance| is_recent(allowance));
            self.addresses.retain(|_, allowance| is_recent(allowance));
            if self.senders.len().max(self.addresses.len()) >= Self::MAX_ENTRIES {
                return false;
            }
        }
        let address = from.map(host);
        let sender = (address, sender.to_owned());
        // The narrowest first: what it refuses takes nothing from the others. Refused by the
        // widest, nothing is remembered.
        if let Some(known) = self.senders.get_mut(&sender)
            && !known.take(1.0, self.per_sender, now)
        {
            return false;
        }
        if let Some(known) = address.and_then(|address| self.addresses.get_mut(&address))
            && !known.take(1.0, self.per_address, now)
        {
            return false;
        }
        let in_all = self.in_all;
        let all = self.all.get_or_insert_with(|| Allowance::new(in_all, now));
        if !all.take(1.0, in_all, now) {
            return false;
        }
        let per_sender = || less_one(self.per_sender, now);
        self.senders.entry(sender).or_insert_with(per_sender);
        if let Some(address) = address {
            let per_address = || less_one(self.per_address, now);
            self.addresses.entry(address).or_insert_with(per_address);
        }
        true
    }
}

/// Bytes that came from one address, less those of the failure messages about them.
#[derive(Debug, Clone, Copy)]
struct Paid {
    bytes: u64,
    last: Instant,
}

/// Limits failure messages, and counts those that are left out. Sans-I/O, but for the log.
#[derive(Debug)]
pub(super) struct FailureLimit {
    limit: SenderLimit,
    /// What legacy peers have sent: failure messages about letters from one address never have more
    /// bytes than these letters count as.
    paid: Map<IpAddr, Paid>,
    left_out: u64,
    /// When it is logged how many were left out.
    log_at: Option<Instant>,
}

impl Default for FailureLimit {
    fn default() -> Self {
        Self {
            limit: SenderLimit::new(PER_SENDER, PER_ADDRESS, IN_ALL),
            paid: Map::default(),
            left_out: 0,
            log_at: None,
        }
    }
}

impl FailureLimit {
    /// Whether one more failure message may leave for this sender. If not, it is counted.
    pub(super) fn allows(&mut self, now: Instant, from: Option<IpAddr>, sender: &str) -> bool {
        let allowed = self.limit.take(now, from, sender);
        if !allowed {
            self.leave_out(now);
        }
        allowed
    }

    /// A letter of so many bytes came from a legacy peer at this address. It counts as
    /// [`MIN_PAID`] at least.
    pub(super) fn came(&mut self, now: Instant, from: IpAddr, bytes: usize) {
        let (from, bytes) = (host(from), (bytes as u64).max(MIN_PAID));
        if self.paid.len() >= MAX_PAID && !self.paid.contains_key(&from) {
            let is_recent = |it: &Paid| now.saturating_duration_since(it.last) < PAID_MEMORY;
            self.paid.retain(|_, paid| is_recent(paid));
            if self.paid.len() >= MAX_PAID {
                // Its failure messages are left out.
                return;
            }
        }
        let none = Paid {
            bytes: 0,
            last: now,
        };
        let paid = self.paid.entry(from).or_insert(none);
        paid.bytes = paid.bytes.saturating_add(bytes).min(MAX_CREDIT);
        paid.last = now;
    }

    /// Whether letters from this address had as many bytes as the letter that failed, less those of
    /// failure messages. If not, the message is counted.
    pub(super) fn may_pay(&mut self, now: Instant, from: Option<IpAddr>, bytes: usize) -> bool {
        let Some(from) = from else { return true };
        let paid = self.paid.get(&host(from)).map_or(0, |paid| paid.bytes);
        // No more is ever in store.
        let may = paid >= (bytes as u64).min(MAX_CREDIT);
        if !may {
            self.leave_out(now);
        }
        may
    }

    /// Whether letters from this address had as many bytes as a failure message about one of them, and
    /// takes these bytes away. If not, the message is counted. Without an address nothing is limited:
    /// the sender is an agent of another gateway.
    pub(super) fn has_paid(&mut self, now: Instant, from: Option<IpAddr>, bytes: usize) -> bool {
        let Some(from) = from else { return true };
        let paid = self.paid.get_mut(&host(from));
        let left = paid
            .as_ref()
            .and_then(|it| it.bytes.checked_sub(bytes as u64));
        match (paid, left) {
            (Some(paid), Some(left)) => {
                paid.bytes = left;
                true
            }
            _ => {
                self.leave_out(now);
                false
            }
        }
    }

    /// Counts a failure message that does not leave.
    pub(super) fn leave_out(&mut self, now: Instant) {
        self.left_out = self.left_out.saturating_add(1);
        self.log_at.get_or_insert(now + LOG_EVERY);
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due.
    pub(super) fn due(&self) -> Option<Instant> {
        self.log_at
    }

    /// Logs how many were left out, when it is time to.
    pub(super) fn handle_timeout(&mut self, now: Instant) {
        if self.log_at.is_some_and(|at| at <= now) {
            self.log_at = None;
            let count = std::mem::take(&mut self.left_out);
            tracing::warn!(
                count,
                "left out failure messages: more than {PER_SENDER} a second to one sender, \
                 {PER_ADDRESS} to one address or {IN_ALL} in all, more bytes than came from one address, or \
                 the sender does not take them"
            );
        }
    }
}

/// The address that stands for a host: of IPv6 the first 64 bits, unless it is link-local.
fn host(address: IpAddr) -> IpAddr {
    match address {
        IpAddr::V6(v6) if !v6.is_unicast_link_local() => {
            IpAddr::V6((v6.to_bits() & !u128::from(u64::MAX)).into())
        }
        other => other,
    }
}

/// A full allowance of which one was taken.
fn less_one(per_second: f64, now: Instant) -> Allowance {
    let mut allowance = Allowance::new(per_second, now);
    allowance.take(1.0, per_second, now);
    allowance
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, Ipv6Addr};

    use super::*;

    fn address(last: u8) -> Option<IpAddr> {
        Some(Ipv4Addr::new(192, 0, 2, last).into())
    }

    #[test]
    fn one_sender_takes_nothing_from_another() {
        let (mut limit, now) = (FailureLimit::default(), Instant::now());
        let allowed = (0..1000).filter(|_| limit.allows(now, address(1), "loud"));
        assert_eq!(allowed.count(), 20);
        assert!(limit.allows(now, address(1), "quiet"));
        assert!(limit.allows(now, address(2), "loud"));
        assert_eq!(limit.left_out, 980);
        // A second later everything is allowed again.
        assert!(limit.allows(now + MEMORY, address(1), "loud"));
    }

    #[test]
    fn one_address_with_many_names_takes_nothing_from_another() {
        let (mut limit, now) = (FailureLimit::default(), Instant::now());
        let names = (0..1000).map(|number| format!("name {number}"));
        let allowed = names.filter(|name| limit.allows(now, address(1), name));
        assert_eq!(allowed.count(), 100);
        assert!(limit.allows(now, address(2), "quiet"));

        let mut limit = FailureLimit::default();
        let allowed = (0..1000_u128).filter(|number| {
            let v6 = Ipv6Addr::from((0x2001_0db8 << 96) | number);
            limit.allows(now, Some(v6.into()), &format!("name {number}"))
        });
        assert_eq!(allowed.count(), 100);
    }

    #[test]
    fn memory_is_bounded() {
        let (mut limit, start) = (FailureLimit::default(), Instant::now());
        let mut allowed = 0;
        for number in 0..50_000_u32 {
            let now = start + Duration::from_micros(u64::from(number) * 200);
            let from = Some(Ipv4Addr::from(number).into());
            allowed += u32::from(limit.allows(now, from, &format!("name {number}")));
            assert!(limit.limit.senders.len() <= SenderLimit::MAX_ENTRIES);
            assert!(limit.limit.addresses.len() <= SenderLimit::MAX_ENTRIES);
        }
        // Ten seconds, and what may leave at once.
        assert!((4000..=4400).contains(&allowed), "{allowed}");
    }

    #[test]
    fn an_address_gets_no_more_bytes_than_came_from_it() {
        let (mut limit, now) = (FailureLimit::default(), Instant::now());
        let [one, other] = [1, 2].map(|last| address(last).unwrap());
        limit.came(now, one, 1500);
        assert!(limit.has_paid(now, Some(one), 1000));
        assert!(!limit.has_paid(now, Some(one), 600));
        assert!(!limit.has_paid(now, Some(other), 1));
        assert_eq!(limit.left_out, 2);
        limit.came(now, one, 200);
        assert!(limit.has_paid(now, Some(one), 600), "200 count as 1024");
        assert!(limit.has_paid(now, None, 600), "another gateway's agent");
        for number in 0..2 * MAX_PAID as u32 {
            limit.came(now, Ipv4Addr::from(number).into(), 1);
        }
        assert_eq!(limit.paid.len(), MAX_PAID);
        limit.came(now + PAID_MEMORY, other, 9);
        assert_eq!(limit.paid.len(), 1);
        assert!(limit.has_paid(now + PAID_MEMORY, Some(other), 9));
    }

    #[test]
    fn what_was_left_out_is_logged_once_a_second() {
        let (mut limit, now) = (FailureLimit::default(), Instant::now());
        assert_eq!(limit.due(), None);
        limit.leave_out(now);
        limit.leave_out(now + LOG_EVERY / 2);
        assert_eq!(limit.due(), Some(now + LOG_EVERY));
        limit.handle_timeout(now + LOG_EVERY / 2);
        assert_eq!(limit.left_out, 2);
        limit.handle_timeout(now + LOG_EVERY);
        assert_eq!((limit.left_out, limit.due()), (0, None));
    }
}
