//! Who may send what to whom: the rules of `[access]`, and how often.
//!
//! A rule that denies comes before all that allow; when there are rules that allow, what none of
//! them names is refused. Sans-I/O: what a letter claims and `now` go in, a judgement comes out.
//!
//! What must not live here: whether a sender is who it says (`fipa_transport_net::secure`).

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_mts::Source;
use fipa_sds::Matcher;
use fipa_transport::TokenBucket;

/// A line of `access.allow` or `access.deny`: the sender and its receivers.
pub(crate) type Line<'a> = (&'a str, &'a [String]);

/// Senders whose rate is remembered, of all sources. When there are more, the source with the most
/// senders loses the one that it brought first: a source that invents names makes this process forget
/// its own senders only.
const MAX_SENDERS: usize = 8192;

/// What a letter says of itself.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Claim<'a> {
    pub(crate) sender: &'a str,
    pub(crate) receiver: &'a str,
    pub(crate) performative: &'a str,
    pub(crate) protocol: Option<&'a str>,
}

/// Why a letter does not pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Refusal {
    #[error("a rule denies it (access.deny)")]
    Denied,
    #[error("no rule allows it (access.allow)")]
    NotAllowed,
    #[error("its sender sends more letters a second than it may (access.rate)")]
    TooMany {
        /// Whether it is worth a line of the audit: one a second for each sender.
        told: bool,
    },
}

/// A rule that cannot be understood; the text says what to write.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub(crate) struct RuleError(String);

/// The rules, and what senders have sent lately.
#[derive(Debug)]
pub(crate) struct Access {
    deny: Vec<Rule>,
    allow: Vec<Rule>,
    /// Letters a second; none: any number.
    rate: Option<f64>,
    senders: Senders,
}

/// The senders of each source, bounded.
#[derive(Debug, Default)]
struct Senders {
    sources: HashMap<Source, OfSource>,
    /// The number of senders of each source.
    sizes: BTreeSet<(usize, Source)>,
    /// All senders.
    len: usize,
    /// When silent senders were last looked for.
    swept: Option<Instant>,
}

/// The senders of one source.
#[derive(Debug, Default)]
struct OfSource {
    senders: HashMap<Arc<str>, Sender>,
    /// In the order in which they were first heard.
    order: VecDeque<Arc<str>>,
}

/// One receiver of one line.
#[derive(Debug, Clone)]
struct Rule {
    sender: Matcher,
    receiver: Matcher,
    /// Any, when there are none.
    performatives: Vec<String>,
    protocols: Vec<String>,
}

/// What a sender may still send.
#[derive(Debug)]
struct Sender {
    allowance: TokenBucket,
    /// When it was last told that it sent too much.
    told: Option<Instant>,
}

impl Access {
    /// The rules of these lines, each a sender and its receivers, and the letters per second of one
    /// sender (0: unlimited). `None` if there is nothing to check.
    pub(crate) fn new<'a>(
        deny: impl IntoIterator<Item = Line<'a>>,
        allow: impl IntoIterator<Item = Line<'a>>,
        rate: usize,
    ) -> Result<Option<Self>, RuleError> {
        let (deny, allow) = (rules(deny)?, rules(allow)?);
        if deny.is_empty() && allow.is_empty() && rate == 0 {
            return Ok(None);
        }
        Ok(Some(Self {
            deny,
            allow,
            rate: (rate > 0).then_some(rate as f64),
            senders: Senders::default(),
        }))
    }

    /// What the rules say of a letter.
    pub(crate) fn judge(&self, claim: &Claim<'_>) -> Result<(), Refusal> {
        if self.deny.iter().any(|rule| rule.names(claim)) {
            return Err(Refusal::Denied);
        }
        if !self.allow.is_empty() && !self.allow.iter().any(|rule| rule.names(claim)) {
            return Err(Refusal::NotAllowed);
        }
        Ok(())
    }

    /// Counts a letter that may pass by the rules, if its sender may send one more by this source.
    pub(crate) fn count(
        &mut self,
        source: Source,
        sender: &str,
        now: Instant,
    ) -> Result<(), Refusal> {
        let Some(rate) = self.rate else {
            return Ok(());
        };
        self.senders.of(source, sender, rate, now).take(rate, now)
    }
}

impl Senders {
    /// What this sender may still send by this source.
    fn of(&mut self, source: Source, sender: &str, rate: f64, now: Instant) -> &mut Sender {
        let known = self.sources.get(&source);
        if !known.is_some_and(|known| known.senders.contains_key(sender)) {
            if self.len >= MAX_SENDERS {
                self.make_room(now);
            }
            let known = self.sources.entry(source).or_default();
            known.order.push_back(sender.into());
            let before = known.order.len() - 1;
            self.sizes.remove(&(before, source));
            self.sizes.insert((before + 1, source));
            self.len += 1;
        }
        let known = self.sources.entry(source).or_default();
        let fresh = || Sender {
            allowance: TokenBucket::new(rate, now),
            told: None,
        };
        known.senders.entry(sender.into()).or_insert_with(fresh)
    }

    /// Forgets the senders that were silent for a second, which may send as much as new ones. If there
    /// are none, the first sender of the source with the most is forgotten.
    fn make_room(&mut self, now: Instant) {
        if self.swept.is_none_or(|swept| is_over(swept, now)) {
            self.swept = Some(now);
            self.sweep(now);
        }
        if self.len < MAX_SENDERS {
            return;
        }
        let Some((size, source)) = self.sizes.pop_last() else {
            return;
        };
        if let Some(known) = self.sources.get_mut(&source)
            && let Some(first) = known.order.pop_front()
        {
            known.senders.remove(&first);
            self.len -= 1;
        }
        if size > 1 {
            self.sizes.insert((size - 1, source));
        } else {
            self.sources.remove(&source);
        }
    }

    fn sweep(&mut self, now: Instant) {
        self.sources.retain(|_, known| {
            let is_recent = |it: &Sender| !is_over(it.allowance.asked(), now);
            known.senders.retain(|_, it| is_recent(it));
            let OfSource { senders, order } = known;
            order.retain(|sender| senders.contains_key(sender));
            !order.is_empty()
        });
        let sizes = self.sources.iter();
        self.sizes = sizes
            .map(|(source, known)| (known.order.len(), *source))
            .collect();
        self.len = self.sizes.iter().map(|(size, _)| size).sum();
    }
}

impl Sender {
    fn take(&mut self, rate: f64, now: Instant) -> Result<(), Refusal> {
        if self.allowance.take(1.0, rate, now) {
            return Ok(());
        }
        let told = self.told.is_none_or(|before| is_over(before, now));
        if told {
            self.told = Some(now);
        }
        Err(Refusal::TooMany { told })
    }
}

/// Whether a second has gone by since.
fn is_over(since: Instant, now: Instant) -> bool {
    now.saturating_duration_since(since) >= Duration::from_secs(1)
}

impl Rule {
    /// Reads `RECEIVER [performative=NAME,…] [protocol=NAME,…]`.
    fn parse(sender: &str, receiver: &str) -> Result<Self, RuleError> {
        let matcher = |text: &str| {
            Matcher::parse(text).map_err(|error| {
                let error = error.to_string();
                let last = error.lines().last().unwrap_or_default().trim();
                RuleError(format!("{text:?} cannot be matched: {last}"))
            })
        };
        let mut words = receiver.split_whitespace();
        let name = words.next().unwrap_or_default();
        if name.is_empty() || sender.is_empty() {
            return Err(RuleError("has a rule without a name".to_owned()));
        }
        let mut rule = Self {
            sender: matcher(sender)?,
            receiver: matcher(name)?,
            performatives: Vec::new(),
            protocols: Vec::new(),
        };
        for word in words {
            let (list, names) = match word.split_once('=') {
                Some(("performative", names)) => (&mut rule.performatives, names),
                Some(("protocol", names)) => (&mut rule.protocols, names),
                _ => return Err(RuleError(format!("has {word:?} behind a receiver"))),
            };
            list.extend(names.split(',').map(str::to_owned));
            if list.iter().any(String::is_empty) {
                return Err(RuleError(format!("has an empty name in {word:?}")));
            }
        }
        Ok(rule)
    }

    /// Whether the rule is about such a letter.
    fn names(&self, claim: &Claim<'_>) -> bool {
        let among = |names: &[String], name: Option<&str>| {
            names.is_empty()
                || name.is_some_and(|name| names.iter().any(|it| it.eq_ignore_ascii_case(name)))
        };
        self.sender.matches(claim.sender)
            && self.receiver.matches(claim.receiver)
            && among(&self.performatives, Some(claim.performative))
            && among(&self.protocols, claim.protocol)
    }
}

/// What is wrong with a line of rules, if anything is.
pub(crate) fn fault((sender, receivers): Line<'_>) -> Option<RuleError> {
    if receivers.is_empty() {
        return Some(RuleError("has no receivers".to_owned()));
    }
    let mut rules = receivers.iter();
    rules.find_map(|receiver| Rule::parse(sender, receiver).err())
}

fn rules<'a>(lines: impl IntoIterator<Item = Line<'a>>) -> Result<Vec<Rule>, RuleError> {
    let rules = lines.into_iter().flat_map(|(sender, receivers)| {
        let receivers = receivers.iter();
        receivers.map(move |receiver| Rule::parse(sender, receiver))
    });
    rules.collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn lines(owned: &[(String, Vec<String>)]) -> impl Iterator<Item = Line<'_>> {
        let lines = owned.iter();
        lines.map(|(sender, receivers)| (sender.as_str(), receivers.as_slice()))
    }

    fn access(deny: &[(&str, &[&str])], allow: &[(&str, &[&str])], rate: usize) -> Access {
        let owned = |lines: &[(&str, &[&str])]| -> Vec<(String, Vec<String>)> {
            let lines = lines.iter().map(|(sender, receivers)| {
                let receivers = receivers.iter().map(|it| (*it).to_owned()).collect();
                ((*sender).to_owned(), receivers)
            });
            lines.collect()
        };
        let (deny, allow) = (owned(deny), owned(allow));
        Access::new(lines(&deny), lines(&allow), rate)
            .unwrap()
            .unwrap()
    }

    fn claim<'a>(sender: &'a str, receiver: &'a str) -> Claim<'a> {
        Claim {
            sender,
            receiver,
            performative: "inform",
            protocol: None,
        }
    }

    #[test]
    fn what_is_denied_does_not_pass_whatever_is_allowed() {
        let access = access(&[("rover_2", &["arm"])], &[("rover_.*", &["arm"])], 0);
        assert_eq!(access.judge(&claim("rover_1", "arm")), Ok(()));
        let denied = access.judge(&claim("rover_2", "arm"));
        assert_eq!(denied, Err(Refusal::Denied));
        for (sender, receiver) in [("rover_1", "arm_2"), ("crex", "arm")] {
            let refused = access.judge(&claim(sender, receiver));
            assert_eq!(refused, Err(Refusal::NotAllowed));
        }
    }

    #[test]
    fn a_rule_can_be_about_some_performatives_and_protocols_only() {
        let only = ["arm performative=request,cancel protocol=fipa-request"];
        let access = access(&[], &[(".*", &only)], 0);
        for (performative, protocol, passes) in [
            ("request", Some("fipa-request"), true),
            ("CANCEL", Some("FIPA-Request"), true),
            ("inform", Some("fipa-request"), false),
            ("request", Some("fipa-query"), false),
            ("request", None, false),
        ] {
            let claim = Claim {
                performative,
                protocol,
                ..claim("rover", "arm")
            };
            assert_eq!(access.judge(&claim).is_ok(), passes, "{claim:?}");
        }
    }

    const ROVER: Source = Source::Certificate([1; 32]);
    const CREX: Source = Source::Certificate([2; 32]);
    const TOLD: Result<(), Refusal> = Err(Refusal::TooMany { told: true });

    #[test]
    fn invented_senders_displace_those_of_the_same_source_only() {
        let mut access = access(&[], &[], 2);
        let now = Instant::now();
        for _ in 0..2 {
            assert_eq!(access.count(ROVER, "rover", now), Ok(()));
        }
        for number in 0..3 * MAX_SENDERS {
            let name = format!("agent{number}");
            assert_eq!(access.count(CREX, &name, now), Ok(()));
        }
        assert_eq!(access.senders.len, MAX_SENDERS);
        // It is still remembered, and others of its host are served.
        assert_eq!(access.count(ROVER, "rover", now), TOLD);
        assert_eq!(access.count(ROVER, "arm", now), Ok(()));
        // Many sources with one name each are one more than the source with two.
        for number in 0..MAX_SENDERS as u64 {
            let source = Source::Process(fipa_transport::Incarnation::from_u64(number + 1));
            assert_eq!(access.count(source, "agent", now), Ok(()));
        }
        let of = |source| access.senders.sources.get(&source).map(|it| it.order.len());
        assert!(of(CREX).is_none_or(|left| left <= 1), "{:?}", of(CREX));
        let later = now + Duration::from_secs(1);
        assert_eq!(access.count(ROVER, "one more", later), Ok(()));
        assert_eq!(access.senders.len, 1, "the silent ones are forgotten");
        assert_eq!(access.senders.sizes.len(), 1);
    }

    #[test]
    fn a_name_that_another_source_uses_up_is_not_used_up() {
        let mut access = access(&[], &[], 1);
        let now = Instant::now();
        assert_eq!(access.count(CREX, "rover", now), Ok(()));
        assert_eq!(access.count(CREX, "rover", now), TOLD);
        assert_eq!(access.count(ROVER, "rover", now), Ok(()));
    }

    #[test]
    fn who_sends_too_much_is_told_of_once_a_second_and_others_notice_nothing() {
        let mut access = access(&[], &[], 2);
        let begun = Instant::now();
        let at = |ms| begun + Duration::from_millis(ms);
        let said: Vec<_> = [0, 0, 0, 100, 600, 700, 1100, 1100]
            .map(|ms| access.count(ROVER, "rover", at(ms)))
            .into();
        let refused = |told| Err(Refusal::TooMany { told });
        let (first, more) = (refused(true), refused(false));
        let all = [Ok(()), Ok(()), first, more, Ok(()), more, Ok(()), first];
        assert_eq!(said, all);
        assert_eq!(access.count(ROVER, "crex", at(1100)), Ok(()));
    }

    #[test]
    fn rules_that_cannot_be_understood_are_told() {
        for wrong in [
            "",
            "arm_(",
            "arm content=x",
            "arm performative=,",
            "arm request",
        ] {
            let receivers = [wrong.to_owned()];
            assert!(fault(("rover", &receivers)).is_some(), "{wrong:?}");
        }
    }

    proptest! {
        #[test]
        fn a_denied_pair_never_passes(sender in "[a-c]{1,2}", receiver in "[a-c]{1,2}") {
            let access = access(&[("a.*", &["b.*"])], &[(".*", &[".*"])], 0);
            let denied = sender.starts_with('a') && receiver.starts_with('b');
            let judged = access.judge(&claim(&sender, &receiver));
            prop_assert_eq!(judged.is_err(), denied);
        }
    }
}
