//! Performatives in the form that the machines use: numbers for the 22 standard ones, and sets.

use std::num::NonZeroU8;

use fipa_acl::{Pattern, PatternError, Performative};

use crate::protocol::spelling::one_edit_apart;

/// The bits of all standard performatives.
const STANDARD: u32 = (1 << 22) - 1;

/// A performative in a form that is fast to compare.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Act<'a> {
    /// One of the 22 of FIPA00037: its index in [`Performative::STANDARD`].
    Standard(u8),
    /// A user-defined one: its name.
    Other(&'a str),
}

pub(crate) const CANCEL: Act<'static> = Act::Standard(2);
pub(crate) const FAILURE: Act<'static> = Act::Standard(6);
pub(crate) const INFORM: Act<'static> = Act::Standard(7);
pub(crate) const NOT_UNDERSTOOD: Act<'static> = Act::Standard(10);

impl<'a> Act<'a> {
    pub(crate) fn of(performative: &'a Performative) -> Self {
        use Performative as P;
        Self::Standard(match performative {
            P::AcceptProposal => 0,
            P::Agree => 1,
            P::Cancel => 2,
            P::Cfp => 3,
            P::Confirm => 4,
            P::Disconfirm => 5,
            P::Failure => 6,
            P::Inform => 7,
            P::InformIf => 8,
            P::InformRef => 9,
            P::NotUnderstood => 10,
            P::Propagate => 11,
            P::Propose => 12,
            P::Proxy => 13,
            P::QueryIf => 14,
            P::QueryRef => 15,
            P::Refuse => 16,
            P::RejectProposal => 17,
            P::Request => 18,
            P::RequestWhen => 19,
            P::RequestWhenever => 20,
            P::Subscribe => 21,
            P::Other(user) => return Self::Other(user.as_str()),
        })
    }

    pub(crate) fn named(name: &'a str) -> Self {
        let mut standard = (0..).zip(&Performative::STANDARD);
        match standard.find(|(_, act)| act.as_str().eq_ignore_ascii_case(name)) {
            Some((number, _)) => Self::Standard(number),
            None => Self::Other(name),
        }
    }

    pub(crate) fn name(self) -> &'a str {
        match self {
            Self::Standard(number) => standard_name(number),
            Self::Other(name) => name,
        }
    }
}

/// A performative in one byte: its index in [`Performative::STANDARD`] plus 1, and 255 for all user-defined ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(transparent)]
pub(crate) struct ActNumber(NonZeroU8);

impl ActNumber {
    #[inline]
    pub(crate) fn of(act: Act<'_>) -> Self {
        let next = match act {
            Act::Standard(number) => NonZeroU8::new(number.wrapping_add(1)),
            Act::Other(_) => None,
        };
        Self(next.unwrap_or(NonZeroU8::MAX))
    }

    /// `None` for a byte that is no number. A host from which an agent moves might send one.
    pub(crate) fn from_byte(byte: u8) -> Option<Self> {
        let is_number = usize::from(byte) <= Performative::STANDARD.len() || byte == u8::MAX;
        NonZeroU8::new(byte).filter(|_| is_number).map(Self)
    }

    pub(crate) fn byte(self) -> u8 {
        self.0.get()
    }

    /// The performative, if it is a standard one.
    pub(crate) fn standard(self) -> Option<Act<'static>> {
        let index = self.byte() - 1;
        (usize::from(index) < Performative::STANDARD.len()).then_some(Act::Standard(index))
    }
}

/// Returns the standard performative from which a user-defined one differs by one edit: an inserted, a
/// deleted, a replaced or two swapped characters. It is probably a typing error.
#[must_use]
pub fn near_standard(name: &str) -> Option<&'static str> {
    /// Longer names are no misspelled standard ones.
    const MAX: usize = 32;
    if !is_word(name) || name.len() > MAX || matches!(Act::named(name), Act::Standard(_)) {
        return None;
    }
    let name = name.to_ascii_lowercase();
    let mut standard = (0..22).map(standard_name);
    standard.find(|known| one_edit_apart(known, &name))
}

fn standard_name(number: u8) -> &'static str {
    static NAMES: std::sync::LazyLock<Vec<String>> = std::sync::LazyLock::new(|| {
        let names = Performative::STANDARD.iter();
        names.map(|act| act.as_str().to_owned()).collect()
    });
    NAMES.get(usize::from(number)).map_or("", String::as_str)
}

/// A set of performatives, written as a regular expression that matches whole names.
#[derive(Debug, Clone)]
pub(crate) struct Acts {
    text: String,
    /// A bit for each standard performative.
    standard: u32,
    /// The pattern for user-defined performatives.
    other: Option<Pattern>,
}

impl Acts {
    /// # Errors
    /// The text is not a regular expression.
    pub(crate) fn new(text: &str) -> Result<Self, PatternError> {
        // Most protocols list standard names. Compiling a pattern takes a thousand times as long.
        if let Some(standard) = standard_names(text) {
            return Ok(Self {
                text: text.to_owned(),
                standard,
                other: None,
            });
        }
        let pattern = Pattern::ignoring_case(text)?;
        let mut standard = 0;
        for (number, act) in Performative::STANDARD.iter().enumerate() {
            if pattern.matches(act.as_str()) {
                standard |= 1 << number;
            }
        }
        Ok(Self {
            text: text.to_owned(),
            standard,
            other: Some(pattern),
        })
    }

    #[inline]
    pub(crate) fn contains(&self, act: Act<'_>) -> bool {
        match act {
            Act::Standard(number) => self.standard & (1 << number) != 0,
            Act::Other(name) => match &self.other {
                Some(pattern) => pattern.matches(name),
                None => false,
            },
        }
    }

    /// Returns a performative that both sets contain. A user-defined one is found only if one of the
    /// texts is its name, or both texts are equal.
    pub(crate) fn common(&self, other: &Self) -> Option<String> {
        let both = self.standard & other.standard & STANDARD;
        if both != 0 {
            return Some(standard_name(both.trailing_zeros().try_into().ok()?).to_owned());
        }
        let shared = |mine: &Self, theirs: &Self| {
            let text = Act::Other(&mine.text);
            (is_word(&mine.text) && theirs.contains(text) && mine.contains(text))
                .then(|| mine.text.clone())
        };
        let same = (self.text == other.text).then(|| self.text.clone());
        same.or_else(|| shared(self, other))
            .or_else(|| shared(other, self))
    }

    /// Formats the set for people: the standard names, for example `agree, refuse`, or the text.
    pub(crate) fn shown(&self) -> String {
        if is_word(&self.text) || self.standard == 0 || self.standard == STANDARD {
            return match self.text.as_str() {
                ".*" => "any performative".to_owned(),
                text => text.to_owned(),
            };
        }
        let names = (0..22_u8).filter(|number| self.standard & (1 << number) != 0);
        let names: Vec<&str> = names.map(standard_name).collect();
        names.join(", ")
    }

    pub(crate) fn text(&self) -> &str {
        &self.text
    }
}

/// The bits of a text that consists of standard names, separated by `|`.
fn standard_names(text: &str) -> Option<u32> {
    text.split('|')
        .try_fold(0, |names, name| match Act::named(name) {
            Act::Standard(number) => Some(names | 1 << number),
            Act::Other(_) => None,
        })
}

/// Whether the pattern matches only its own text.
pub(crate) fn is_word(text: &str) -> bool {
    let literal = |c: char| c.is_alphanumeric() || matches!(c, '-' | '_' | ':' | ' ' | '@' | '/');
    text.chars().all(literal)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_numbers_of_performatives_are_known() {
        // The 22 performatives of FIPA00037, and any other.
        for byte in (1..=22).chain([255]) {
            assert_eq!(ActNumber::from_byte(byte).map(ActNumber::byte), Some(byte));
        }
        assert!(
            (23..255)
                .chain([0])
                .all(|byte| ActNumber::from_byte(byte).is_none())
        );
        assert_eq!(size_of::<[Option<ActNumber>; 2]>(), 2);
        for act in [CANCEL, INFORM] {
            assert_eq!(ActNumber::of(act).standard(), Some(act));
        }
        assert_eq!(ActNumber::of(Act::Other("ping")).standard(), None);
    }

    #[test]
    fn standard_names_are_the_sets_of_their_patterns() {
        for text in [
            "agree",
            "query-if",
            "REFUSE",
            "agree|refuse",
            "agree|agree",
            "failure|not-understood",
        ] {
            let acts = Acts::new(text).unwrap();
            assert!(acts.other.is_none(), "{text} needs a pattern");
            let pattern = Pattern::ignoring_case(text).unwrap();
            for (number, act) in (0..).zip(&Performative::STANDARD) {
                let is_in = acts.contains(Act::Standard(number));
                assert_eq!(is_in, pattern.matches(act.as_str()), "{text}: {act}");
            }
        }
        for text in [
            "agree|",
            "agree|lift",
            "(agree|refuse)",
            "agre.",
            "",
            " agree",
        ] {
            assert_eq!(standard_names(text), None, "{text}");
        }
        let some = Acts::new("agree|lift").unwrap();
        assert!(some.contains(Act::named("lift")) && some.contains(Act::named("agree")));
        assert!(!some.contains(Act::named("refuse")));
    }

    #[test]
    fn numbers_are_indexes_of_the_standard_performatives() {
        for (number, act) in (0..).zip(&Performative::STANDARD) {
            assert_eq!(Act::of(act), Act::Standard(number));
            assert_eq!(Act::named(act.as_str()), Act::Standard(number));
            assert_eq!(Act::of(act).name(), act.as_str());
        }
        for (act, name) in [
            (CANCEL, "cancel"),
            (FAILURE, "failure"),
            (INFORM, "inform"),
            (NOT_UNDERSTOOD, "not-understood"),
        ] {
            assert_eq!(act.name(), name);
        }
        assert_eq!(Act::named("INFORM"), INFORM);
        assert_eq!(Act::named("ping"), Act::Other("ping"));
    }

    #[test]
    fn sets_contain_whole_names_only() {
        let inform = Acts::new("inform").unwrap();
        assert!(inform.contains(INFORM));
        assert!(!inform.contains(Act::named("inform-if")));
        assert!(!inform.contains(Act::Other("informs")));
        let several = Acts::new("agree|refuse|my-.*").unwrap();
        assert!(several.contains(Act::named("refuse")));
        assert!(several.contains(Act::Other("my-act")));
        assert!(!several.contains(Act::Other("not-my-act")));
        assert_eq!(several.shown(), "agree, refuse");
        assert_eq!(Acts::new(".*").unwrap().shown(), "any performative");
        assert_eq!(Acts::new("my-.*").unwrap().shown(), "my-.*");
        assert!(Acts::new("(").is_err());
        assert!(Acts::new(r"(?:\w{1000}){1000}").is_err(), "too large");
    }

    #[test]
    fn words_with_a_typing_error_are_near_a_standard_performative() {
        assert_eq!(near_standard("reqest"), Some("request"));
        assert_eq!(near_standard("Inform-iff"), Some("inform-if"));
        for far in ["request", "my-act", "requ?est", "reques.", ""] {
            assert_eq!(near_standard(far), None, "{far}");
        }
    }

    #[test]
    fn common_members_are_found() {
        let set = |text| Acts::new(text).unwrap();
        assert_eq!(
            set("inform.*").common(&set("inform-if|agree")).as_deref(),
            Some("inform-if")
        );
        assert_eq!(set("agree").common(&set("refuse")), None);
        assert_eq!(set("ping").common(&set("p.*g")).as_deref(), Some("ping"));
        assert_eq!(set("ping").common(&set("pong")), None);
        assert_eq!(set("ping").common(&set("ping")).as_deref(), Some("ping"));
    }
}
