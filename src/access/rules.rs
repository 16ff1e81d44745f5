//! The rules of `[access]`, which decide about letters by their sender, receiver, performative,
//! protocol, ontology and action, and the rate limit of senders.
//!
//! A deny rule takes precedence over all allow rules. If there are allow rules, a letter that
//! matches none of them is refused. A decision needs no I/O: it takes the facts of a letter and `now`. The numbers of
//! users are looked up when a rule is parsed.
//!
//! Not in this module: the proof of a sender's identity (`fipa_transport_net::secure`).

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_mts::LetterSource;
use fipa_sds::Matcher;
use fipa_transport::TokenBucket;

use crate::domain::accounts::user_number;

/// An entry of `access.allow` or `access.deny`: the sender and its receivers.
pub(crate) type Line<'a> = (&'a str, &'a [String]);

/// Maximum number of senders whose rate is stored, over all sources. Beyond it, silent senders are
/// removed. If there are none, the oldest sender of the source with the most senders is evicted, so
/// a source that invents names evicts its own senders only.
const MAX_SENDERS: usize = 8192;

/// The properties of a letter that the rules check. All except the user are claims of the sender.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LetterFacts<'a> {
    pub(crate) sender: &'a str,
    /// The user of the process on this host that handed it over, as the kernel names it; `None` if that is not known.
    pub(crate) user: Option<u32>,
    pub(crate) receiver: &'a str,
    pub(crate) performative: &'a str,
    pub(crate) protocol: Option<&'a str>,
    pub(crate) ontology: Option<&'a str>,
    /// The action of a goal for a robot.
    pub(crate) action: Option<&'a str>,
}

/// The reason why a letter is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Refusal {
    #[error("a rule denies it (access.deny)")]
    Denied,
    #[error("no rule allows it (access.allow)")]
    NotAllowed,
    #[error("its sender exceeds the limit of letters per second (access.rate)")]
    TooMany,
}

/// The error of a rule that cannot be parsed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct RuleError(String);

/// The rules, and the current rates of senders.
#[derive(Debug, Default)]
pub(crate) struct Access {
    deny: Vec<Rule>,
    allow: Vec<Rule>,
    /// The agents that may cancel goals of other clients, and read their results.
    #[cfg(feature = "actions")]
    operators: Vec<Matcher>,
    /// The agents that may record on this host and fetch its recordings.
    recorders: Vec<Matcher>,
    /// Maximum number of letters per second and sender; `None` means unlimited.
    rate: Option<f64>,
    senders: Senders,
}

/// The senders of all sources, at most [`MAX_SENDERS`].
#[derive(Debug, Default)]
struct Senders {
    sources: HashMap<LetterSource, SourceSenders>,
    /// Each source with its number of senders, ordered by that number.
    sizes: BTreeSet<(usize, LetterSource)>,
    /// Number of senders of all sources.
    len: usize,
    /// Time of the last removal of silent senders.
    swept: Option<Instant>,
}

/// The senders of one source.
#[derive(Debug, Default)]
struct SourceSenders {
    senders: HashMap<Arc<str>, Sender>,
    /// The senders in the order of their first letters.
    order: VecDeque<Arc<str>>,
}

/// The rule for one receiver of an entry.
#[derive(Debug, Clone)]
struct Rule {
    sender: Matcher,
    receiver: Matcher,
    /// The numbers of the users to which the rule applies; if empty, all.
    users: Vec<u32>,
    /// The performatives to which the rule applies; if empty, all.
    performatives: Vec<String>,
    /// The protocols to which the rule applies; if empty, all.
    protocols: Vec<String>,
    /// The ontologies to which the rule applies; if empty, all.
    ontologies: Vec<String>,
    /// The actions to which the rule applies; if empty, all letters.
    actions: Vec<String>,
}

/// The rate of one sender.
#[derive(Debug)]
struct Sender(TokenBucket);

impl Access {
    /// Parses these entries, each a sender and its receivers, and the patterns of operators and recorders. `rate` is the
    /// maximum number of letters per second and sender; 0 means unlimited. Returns `None` if there is
    /// nothing to check.
    pub(crate) fn new<'a>(
        deny: impl IntoIterator<Item = Line<'a>>,
        allow: impl IntoIterator<Item = Line<'a>>,
        operators: &[String],
        recorders: &[String],
        rate: usize,
    ) -> Result<Option<Self>, RuleError> {
        let (deny, allow) = (rules(deny)?, rules(allow)?);
        let (operators, recorders) = (matchers(operators)?, matchers(recorders)?);
        let names_agents = !operators.is_empty() || !recorders.is_empty();
        if deny.is_empty() && allow.is_empty() && !names_agents && rate == 0 {
            return Ok(None);
        }
        Ok(Some(Self {
            deny,
            allow,
            #[cfg(feature = "actions")]
            operators,
            recorders,
            rate: (rate > 0).then_some(rate as f64),
            senders: Senders::default(),
        }))
    }

    /// Whether a rule names an action.
    #[cfg(feature = "actions")]
    pub(crate) fn names_actions(&self) -> bool {
        let mut rules = self.deny.iter().chain(&self.allow);
        rules.any(|rule| !rule.actions.is_empty())
    }

    /// Whether the agent with this name is an operator.
    #[cfg(feature = "actions")]
    pub(crate) fn is_operator(&self, agent: &str) -> bool {
        self.operators.iter().any(|it| it.matches(agent))
    }

    /// Whether the agent with this name may record on this host and fetch its recordings.
    pub(crate) fn is_recorder(&self, agent: &str) -> bool {
        self.recorders.iter().any(|it| it.matches(agent))
    }

    /// Checks a letter against the rules.
    pub(crate) fn judge(&self, facts: &LetterFacts<'_>) -> Result<(), Refusal> {
        if self.deny.iter().any(|rule| rule.names(facts)) {
            return Err(Refusal::Denied);
        }
        if !self.allow.is_empty() && !self.allow.iter().any(|rule| rule.names(facts)) {
            return Err(Refusal::NotAllowed);
        }
        Ok(())
    }

    /// Counts a letter that the rules allow. Fails when the sender exceeds its rate by this source.
    pub(crate) fn count(
        &mut self,
        source: LetterSource,
        sender: &str,
        now: Instant,
    ) -> Result<(), Refusal> {
        let Some(rate) = self.rate else {
            return Ok(());
        };
        if let Some(known) = self.senders.get_mut(source, sender) {
            return known.take(rate, now);
        }
        self.senders
            .insert(source, sender, rate, now)
            .take(rate, now)
    }
}

impl Senders {
    /// Returns the rate of this sender by this source, if it is stored.
    fn get_mut(&mut self, source: LetterSource, sender: &str) -> Option<&mut Sender> {
        self.sources.get_mut(&source)?.senders.get_mut(sender)
    }

    /// Stores a new sender of this source, and makes room for it if necessary.
    fn insert(
        &mut self,
        source: LetterSource,
        sender: &str,
        rate: f64,
        now: Instant,
    ) -> &mut Sender {
        if self.len >= MAX_SENDERS {
            self.make_room(now);
        }
        let known = self.sources.entry(source).or_default();
        let sender: Arc<str> = sender.into();
        known.order.push_back(Arc::clone(&sender));
        let size = known.order.len();
        self.sizes.remove(&(size - 1, source));
        self.sizes.insert((size, source));
        self.len += 1;
        known
            .senders
            .entry(sender)
            .or_insert_with(|| Sender(TokenBucket::new(rate, now)))
    }

    /// Removes the senders without a letter in the last second, at most once per second. The bucket
    /// of such a sender is as full as that of a new one. If this makes no room, evicts the oldest
    /// sender of the source with the most senders.
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

    /// Removes the senders without a letter in the last second.
    fn sweep(&mut self, now: Instant) {
        self.sources.retain(|_, known| {
            let is_recent = |it: &Sender| !is_over(it.0.asked(), now);
            known.senders.retain(|_, it| is_recent(it));
            let SourceSenders { senders, order } = known;
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
    /// Takes a token for one letter.
    fn take(&mut self, rate: f64, now: Instant) -> Result<(), Refusal> {
        match self.0.take(1.0, rate, now) {
            true => Ok(()),
            false => Err(Refusal::TooMany),
        }
    }
}

/// Whether at least one second has passed since then.
fn is_over(since: Instant, now: Instant) -> bool {
    now.saturating_duration_since(since) >= Duration::from_secs(1)
}

impl Rule {
    /// Parses `RECEIVER [user=NAME,…] [performative=NAME,…] [protocol=NAME,…] [ontology=NAME,…] [action=NAME,…]`.
    fn parse(sender: &str, receiver: &str) -> Result<Self, RuleError> {
        let mut words = receiver.split_whitespace();
        let name = words.next().unwrap_or_default();
        if name.is_empty() || sender.is_empty() {
            return Err(RuleError("has a rule without a name".to_owned()));
        }
        let mut rule = Self {
            sender: matcher(sender)?,
            receiver: matcher(name)?,
            users: Vec::new(),
            performatives: Vec::new(),
            protocols: Vec::new(),
            ontologies: Vec::new(),
            actions: Vec::new(),
        };
        for word in words {
            let (list, names) = match word.split_once('=') {
                Some(("user", names)) => {
                    for name in names.split(',') {
                        rule.users.push(user_number(name).ok_or_else(|| {
                            RuleError(format!(
                                "names the user {name:?}, which /etc/passwd does not list"
                            ))
                        })?);
                    }
                    continue;
                }
                Some(("performative", names)) => (&mut rule.performatives, names),
                Some(("protocol", names)) => (&mut rule.protocols, names),
                Some(("ontology", names)) => (&mut rule.ontologies, names),
                Some(("action", names)) if cfg!(feature = "actions") => (&mut rule.actions, names),
                Some(("action", _)) => {
                    let problem = "names an action, which needs the feature `actions`";
                    return Err(RuleError(problem.to_owned()));
                }
                _ => return Err(RuleError(format!("has {word:?} behind a receiver"))),
            };
            list.extend(names.split(',').map(str::to_owned));
            if list.iter().any(String::is_empty) {
                return Err(RuleError(format!("has an empty name in {word:?}")));
            }
        }
        Ok(rule)
    }

    /// Whether the rule applies to this letter.
    fn names(&self, facts: &LetterFacts<'_>) -> bool {
        let among = |names: &[String], name: Option<&str>| {
            names.is_empty()
                || name.is_some_and(|name| names.iter().any(|it| it.eq_ignore_ascii_case(name)))
        };
        self.sender.matches(facts.sender)
            && self.receiver.matches(facts.receiver)
            && (self.users.is_empty() || facts.user.is_some_and(|user| self.users.contains(&user)))
            && among(&self.performatives, Some(facts.performative))
            && among(&self.protocols, facts.protocol)
            && among(&self.ontologies, facts.ontology)
            && (self.actions.is_empty()
                || facts
                    .action
                    .is_some_and(|action| self.actions.iter().any(|it| it == action)))
    }
}

fn matcher(text: &str) -> Result<Matcher, RuleError> {
    Matcher::parse(text).map_err(|error| {
        let error = error.to_string();
        let last = error.lines().last().unwrap_or_default().trim();
        RuleError(format!(
            "has {text:?}, which is not a valid pattern: {last}"
        ))
    })
}

fn matchers(patterns: &[String]) -> Result<Vec<Matcher>, RuleError> {
    patterns.iter().map(|it| matcher(it)).collect()
}

/// Returns the error of a pattern of operators or recorders, if it has one.
pub(crate) fn fault_of_agents(pattern: &str) -> Option<RuleError> {
    match pattern.is_empty() {
        true => Some(RuleError("has an empty name".to_owned())),
        false => matcher(pattern).err(),
    }
}

/// Returns the first error of an entry, if it has one.
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
        Access::new(lines(&deny), lines(&allow), &[], &[], rate)
            .unwrap()
            .unwrap()
    }

    #[cfg(feature = "actions")]
    #[test]
    fn operators_are_those_that_a_pattern_names() {
        let patterns = ["boss".to_owned(), "desk_[0-9]+".to_owned()];
        let access = Access::new([], [], &patterns, &[], 0).unwrap().unwrap();
        for (agent, is_operator) in [
            ("boss", true),
            ("desk_7", true),
            ("boss_2", false),
            ("desk_", false),
            ("", false),
        ] {
            assert_eq!(access.is_operator(agent), is_operator, "{agent}");
        }
        assert_eq!(access.judge(&facts("rover", "arm")), Ok(()));
        assert!(Access::new([], [], &[], &[], 0).unwrap().is_none());
        for wrong in ["", "arm_("] {
            assert!(fault_of_agents(wrong).is_some(), "{wrong:?}");
        }
        assert!(!Access::default().is_operator("boss"));
    }

    #[test]
    fn recorders_are_no_operators() {
        let access = Access::new([], [], &[], &["station_.*".to_owned()], 0);
        let access = access.unwrap().unwrap();
        assert!(access.is_recorder("station_1") && !access.is_recorder("rover"));
        #[cfg(feature = "actions")]
        assert!(!access.is_operator("station_1"));
        assert!(!Access::default().is_recorder("station_1"));
    }

    fn facts<'a>(sender: &'a str, receiver: &'a str) -> LetterFacts<'a> {
        LetterFacts {
            sender,
            user: None,
            receiver,
            performative: "inform",
            protocol: None,
            ontology: None,
            action: None,
        }
    }

    #[test]
    fn what_is_denied_does_not_pass_whatever_is_allowed() {
        let access = access(&[("rover_2", &["arm"])], &[("rover_.*", &["arm"])], 0);
        assert_eq!(access.judge(&facts("rover_1", "arm")), Ok(()));
        let denied = access.judge(&facts("rover_2", "arm"));
        assert_eq!(denied, Err(Refusal::Denied));
        for (sender, receiver) in [("rover_1", "arm_2"), ("crex", "arm")] {
            let refused = access.judge(&facts(sender, receiver));
            assert_eq!(refused, Err(Refusal::NotAllowed));
        }
    }

    /// Letters with such a name are refused before, but a rule for all senders has no exception.
    #[test]
    fn a_rule_for_all_senders_includes_names_with_line_breaks() {
        let access = access(&[(".*", &["brake"])], &[(".*", &[".*"])], 0);
        for sender in ["rov\n_1", "\n", "rov\r\n_1", "rov\u{2028}_1"] {
            let judged = access.judge(&facts(sender, "brake"));
            assert_eq!(judged, Err(Refusal::Denied), "{sender:?}");
        }
        let receivers = ["brake".to_owned()];
        let refused = fault(("(?-s).*", &receivers)).map(|error| error.to_string());
        assert!(refused.is_some_and(|why| why.contains("turns off the flag `s`")));
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
            let facts = LetterFacts {
                performative,
                protocol,
                ..facts("rover", "arm")
            };
            assert_eq!(access.judge(&facts).is_ok(), passes, "{facts:?}");
        }
    }

    #[test]
    fn a_rule_can_be_about_some_users_only() {
        let access = access(&[], &[(".*", &["arm user=root,1001"])], 0);
        for (user, passes) in [
            (Some(0), true),
            (Some(1001), true),
            (Some(1002), false),
            (None, false),
        ] {
            let facts = LetterFacts {
                user,
                ..facts("rover", "arm")
            };
            assert_eq!(access.judge(&facts).is_ok(), passes, "{facts:?}");
        }
        let receivers = ["arm user=no-such-user".to_owned()];
        let why = fault(("rover", &receivers)).unwrap().to_string();
        assert!(why.contains("which /etc/passwd does not list"), "{why}");
    }

    #[test]
    fn a_rule_can_be_about_some_ontologies_only() {
        let access = access(&[], &[(".*", &["arm ontology=fipa-robot-actions"])], 0);
        for (ontology, passes) in [
            (Some("fipa-robot-actions"), true),
            (Some("other"), false),
            (None, false),
        ] {
            let facts = LetterFacts {
                ontology,
                ..facts("rover", "arm")
            };
            assert_eq!(access.judge(&facts).is_ok(), passes, "{facts:?}");
        }
    }

    #[cfg(feature = "actions")]
    #[test]
    fn a_rule_can_be_about_some_actions_only() {
        let deny = ["arm action=lift,drop"];
        let access = access(&[(".*", &deny)], &[], 0);
        assert!(access.names_actions());
        for (action, passes) in [
            (Some("lift"), false),
            (Some("drop"), false),
            (Some("wave"), true),
            (None, true),
        ] {
            let facts = LetterFacts {
                action,
                ..facts("rover", "arm")
            };
            assert_eq!(access.judge(&facts).is_ok(), passes, "{facts:?}");
        }
    }

    const ROVER: LetterSource = LetterSource::Certificate([1; 32]);
    const CREX: LetterSource = LetterSource::Certificate([2; 32]);
    const TOO_MANY: Result<(), Refusal> = Err(Refusal::TooMany);

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
        // The rate of the first sender is still stored, and other senders of its source may send.
        assert_eq!(access.count(ROVER, "rover", now), TOO_MANY);
        assert_eq!(access.count(ROVER, "arm", now), Ok(()));
        // Many sources with one sender each evict the senders of a source with two or more.
        for number in 0..MAX_SENDERS as u64 {
            let source = LetterSource::Process(fipa_transport::Incarnation::from_u64(number + 1));
            assert_eq!(access.count(source, "agent", now), Ok(()));
        }
        let of = |source| access.senders.sources.get(&source).map(|it| it.order.len());
        assert!(of(CREX).is_none_or(|age| age <= 1), "{:?}", of(CREX));
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
        assert_eq!(access.count(CREX, "rover", now), TOO_MANY);
        assert_eq!(access.count(ROVER, "rover", now), Ok(()));
    }

    #[test]
    fn a_sender_beyond_its_rate_is_refused_without_effect_on_others() {
        let mut access = access(&[], &[], 2);
        let begun = Instant::now();
        let at = |ms| begun + Duration::from_millis(ms);
        let said: Vec<_> = [0, 0, 0, 100, 600, 700, 1100, 1100]
            .map(|ms| access.count(ROVER, "rover", at(ms)))
            .into();
        let passes = Ok(());
        let all = [
            passes, passes, TOO_MANY, TOO_MANY, passes, TOO_MANY, passes, TOO_MANY,
        ];
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
            let judged = access.judge(&facts(&sender, &receiver));
            prop_assert_eq!(judged.is_err(), denied);
        }
    }
}
