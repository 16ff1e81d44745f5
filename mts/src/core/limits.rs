//! Limits of the work that a gateway does because of legacy peers' letters: failure messages, and
//! agents that become known by a letter.
//!
//! A legacy peer may send letters at any rate, under any name. Three rates bound the work: per
//! sender, per address, and in total.

use std::net::IpAddr;
use std::time::{Duration, Instant};

use fipa_transport::{TokenBucket, log_limit, quota_address};

use crate::Map;

/// Maximum number of failure messages per second to one sender.
const PER_SENDER: f64 = 20.0;
/// Maximum number of failure messages per second to all senders of one address.
const PER_ADDRESS: f64 = 100.0;
/// Maximum number of failure messages per second to all senders.
const IN_ALL: f64 = 400.0;
/// Maximum number of addresses with a byte credit.
const MAX_CREDIT_ADDRESSES: usize = 4096;
/// Time for which a credit is kept when another address needs the space. Longer than the deadline
/// of most letters.
const CREDIT_MEMORY: Duration = Duration::from_secs(60);
/// Minimum credit of a letter, in bytes. A failure message about a letter of 119 bytes has 300 to
/// 700, and the headers of the letter's own connection have 270.
const MIN_CREDIT: u64 = 1024;
/// Maximum credit of an address, in bytes.
const MAX_CREDIT: u64 = 1 << 20;

/// The address from which a letter came, if known, and the name of its sender.
type Sender = (Option<IpAddr>, String);

/// A rate of actions, and the number that may follow each other at once.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rate {
    per_second: f64,
    burst: f64,
}

impl Rate {
    /// A rate whose burst is the number of one second.
    pub(super) const fn of(per_second: f64) -> Self {
        Self::with_burst(per_second, per_second)
    }

    pub(super) const fn with_burst(per_second: f64, burst: f64) -> Self {
        Self { per_second, burst }
    }

    fn full(self, now: Instant) -> TokenBucket {
        TokenBucket::new(self.burst, now)
    }

    fn take(self, bucket: &mut TokenBucket, now: Instant) -> bool {
        bucket.take_of(1.0, self.per_second, self.burst, now)
    }

    /// A full token bucket from which one token was taken.
    fn less_one(self, now: Instant) -> TokenBucket {
        let mut bucket = self.full(now);
        self.take(&mut bucket, now);
        bucket
    }

    /// Time after which a token bucket is full again, so that it can be dropped.
    fn memory(self) -> Duration {
        Duration::from_secs_f64(self.burst / self.per_second)
    }
}

/// Limits actions for senders: per sender, per address, and in total. A request that exceeds one
/// rate does not use up the others.
#[derive(Debug)]
pub(super) struct SenderLimit {
    per_sender: Rate,
    per_address: Rate,
    in_all: Rate,
    /// Time after which the token buckets of a sender and of an address are full again.
    memory: Duration,
    /// Maximum number of senders, and of addresses. Only granted requests create entries: within `memory`, at most
    /// a burst and the rate of `in_all`.
    max_entries: usize,
    all: Option<TokenBucket>,
    addresses: Map<IpAddr, TokenBucket>,
    senders: Map<Sender, TokenBucket>,
}

impl SenderLimit {
    pub(super) fn new(per_sender: Rate, per_address: Rate, in_all: Rate) -> Self {
        let memory = per_sender.memory().max(per_address.memory());
        let granted = in_all.burst + in_all.per_second * memory.as_secs_f64();
        Self {
            memory,
            max_entries: (granted as usize).max(1024),
            per_sender,
            per_address,
            in_all,
            all: None,
            addresses: Map::default(),
            senders: Map::default(),
        }
    }

    /// Takes a token; returns whether the action is allowed.
    pub(super) fn take(&mut self, now: Instant, from: Option<IpAddr>, sender: &str) -> bool {
        if self.senders.len().max(self.addresses.len()) >= self.max_entries {
            let memory = self.memory;
            let is_recent = |it: &TokenBucket| now.saturating_duration_since(it.asked()) < memory;
            self.senders.retain(|_, allowance| is_recent(allowance));
            self.addresses.retain(|_, allowance| is_recent(allowance));
            if self.senders.len().max(self.addresses.len()) >= self.max_entries {
                return false;
            }
        }
        let address = from.map(quota_address);
        let sender = (address, sender.to_owned());
        // The narrowest first, because a refused request must not use up the wider rates. If the
        // widest refuses, nothing is stored.
        if let Some(known) = self.senders.get_mut(&sender)
            && !self.per_sender.take(known, now)
        {
            return false;
        }
        if let Some(known) = address.and_then(|address| self.addresses.get_mut(&address))
            && !self.per_address.take(known, now)
        {
            return false;
        }
        let in_all = self.in_all;
        if !in_all.take(self.all.get_or_insert_with(|| in_all.full(now)), now) {
            return false;
        }
        let less_one = |rate: Rate| move || rate.less_one(now);
        self.senders
            .entry(sender)
            .or_insert_with(less_one(self.per_sender));
        if let Some(address) = address {
            self.addresses
                .entry(address)
                .or_insert_with(less_one(self.per_address));
        }
        true
    }
}

/// Bytes received from one address, minus those of the failure messages about them.
#[derive(Debug, Clone, Copy)]
struct ByteCredit {
    bytes: u64,
    last: Instant,
}

/// Limits failure messages, and logs those that are omitted. Without I/O except for the log.
#[derive(Debug)]
pub(super) struct FailureLimit {
    limit: SenderLimit,
    /// Credit of legacy peers' addresses: failure messages about letters from one address never
    /// have more bytes than these letters are credited for.
    credits: Map<IpAddr, ByteCredit>,
}

impl Default for FailureLimit {
    fn default() -> Self {
        Self {
            limit: SenderLimit::new(
                Rate::of(PER_SENDER),
                Rate::of(PER_ADDRESS),
                Rate::of(IN_ALL),
            ),
            credits: Map::default(),
        }
    }
}

impl FailureLimit {
    /// Whether another failure message may be sent to this sender.
    pub(super) fn allows(&mut self, now: Instant, from: Option<IpAddr>, sender: &str) -> bool {
        self.limit.take(now, from, sender)
    }

    /// Credits the bytes of a letter from a legacy peer at this address, at least [`MIN_CREDIT`].
    pub(super) fn credit(&mut self, now: Instant, from: IpAddr, bytes: usize) {
        let (from, bytes) = (quota_address(from), (bytes as u64).max(MIN_CREDIT));
        if self.credits.len() >= MAX_CREDIT_ADDRESSES && !self.credits.contains_key(&from) {
            let is_recent =
                |it: &ByteCredit| now.saturating_duration_since(it.last) < CREDIT_MEMORY;
            self.credits.retain(|_, credit| is_recent(credit));
            if self.credits.len() >= MAX_CREDIT_ADDRESSES {
                // Failure messages to it are omitted.
                return;
            }
        }
        let none = ByteCredit {
            bytes: 0,
            last: now,
        };
        let credit = self.credits.entry(from).or_insert(none);
        credit.bytes = credit.bytes.saturating_add(bytes).min(MAX_CREDIT);
        credit.last = now;
    }

    /// Whether the credit of this address covers the bytes of the failed letter; otherwise logs
    /// the message as omitted.
    pub(super) fn covers(&self, from: Option<IpAddr>, bytes: usize) -> bool {
        let Some(from) = from else { return true };
        let credit = self
            .credits
            .get(&quota_address(from))
            .map_or(0, |credit| credit.bytes);
        // Larger letters than the maximum credit need only that.
        let may = credit >= (bytes as u64).min(MAX_CREDIT);
        if !may {
            log_omitted(Some(from));
        }
        may
    }

    /// Subtracts the bytes of a failure message from the credit of this address, if it covers them;
    /// otherwise logs the message as omitted. Without an address there is no limit: the sender is
    /// an agent of another gateway.
    pub(super) fn debit(&mut self, from: Option<IpAddr>, bytes: usize) -> bool {
        let Some(from) = from else { return true };
        let credit = self.credits.get_mut(&quota_address(from));
        let remaining = credit
            .as_ref()
            .and_then(|it| it.bytes.checked_sub(bytes as u64));
        match (credit, remaining) {
            (Some(credit), Some(remaining)) => {
                credit.bytes = remaining;
                true
            }
            _ => {
                log_omitted(Some(from));
                false
            }
        }
    }
}

/// Logs an omitted failure message to a sender at this address.
pub(super) fn log_omitted(from: Option<IpAddr>) {
    log_limit::warn!(
        of: from.map(quota_address),
        "omitted a failure message beyond a limit: {PER_SENDER} per second to one sender, \
         {PER_ADDRESS} to one address, {IN_ALL} in total, the bytes received from one address, \
         or a full queue of the sender"
    );
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, Ipv6Addr};

    use super::*;

    fn address(last: u8) -> Option<IpAddr> {
        Some(Ipv4Addr::new(192, 0, 2, last).into())
    }

    #[test]
    fn one_sender_does_not_use_up_the_rate_of_another() {
        let (mut limit, now) = (FailureLimit::default(), Instant::now());
        let allowed = (0..1000).filter(|_| limit.allows(now, address(1), "loud"));
        assert_eq!(allowed.count(), 20);
        assert!(limit.allows(now, address(1), "quiet"));
        assert!(limit.allows(now, address(2), "loud"));
        // A second later everything is allowed again.
        assert!(limit.allows(now + Duration::from_secs(1), address(1), "loud"));
    }

    #[test]
    fn one_address_with_many_names_does_not_use_up_the_rate_of_another() {
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
    fn the_number_of_entries_is_bounded() {
        let (mut limit, start) = (FailureLimit::default(), Instant::now());
        let mut allowed = 0;
        for number in 0..50_000_u32 {
            let now = start + Duration::from_micros(u64::from(number) * 200);
            let from = Some(Ipv4Addr::from(number).into());
            allowed += u32::from(limit.allows(now, from, &format!("name {number}")));
            assert!(limit.limit.senders.len() <= limit.limit.max_entries);
            assert!(limit.limit.addresses.len() <= limit.limit.max_entries);
        }
        // Ten seconds, and the initial burst.
        assert!((4000..=4400).contains(&allowed), "{allowed}");
    }

    #[test]
    fn an_address_gets_no_more_bytes_than_came_from_it() {
        let (mut limit, now) = (FailureLimit::default(), Instant::now());
        let [one, other] = [1, 2].map(|last| address(last).unwrap());
        limit.credit(now, one, 1500);
        assert!(limit.debit(Some(one), 1000));
        assert!(!limit.debit(Some(one), 600));
        assert!(!limit.debit(Some(other), 1));
        limit.credit(now, one, 200);
        assert!(limit.debit(Some(one), 600), "200 count as 1024");
        assert!(limit.debit(None, 600), "another gateway's agent");
        for number in 0..2 * MAX_CREDIT_ADDRESSES as u32 {
            limit.credit(now, Ipv4Addr::from(number).into(), 1);
        }
        assert_eq!(limit.credits.len(), MAX_CREDIT_ADDRESSES);
        limit.credit(now + CREDIT_MEMORY, other, 9);
        assert_eq!(limit.credits.len(), 1);
        assert!(limit.debit(Some(other), 9));
    }
}
