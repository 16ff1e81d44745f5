//! The communicative acts of FIPA00037.

use std::fmt;
use std::str::FromStr;

use crate::word::is_word;

macro_rules! performatives {
    ($($(#[$doc:meta])* $variant:ident = $code:literal $name:literal,)*) => {
        /// A communicative act: one of the 22 acts of FIPA00037, or a user-defined one.
        #[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
        #[allow(clippy::exhaustive_enums, reason = "the standard is final")]
        pub enum Performative {
            $($(#[$doc])* $variant,)*
            /// A user-defined act.
            Other(UserPerformative),
        }

        impl Performative {
            /// The 22 acts of the standard, in the order of their codes in FIPA00069.
            pub const STANDARD: [Self; 22] = [$(Self::$variant,)*];

            /// Name in the spelling of the standard, or the user-defined name.
            #[must_use]
            pub fn as_str(&self) -> &str {
                match self {
                    $(Self::$variant => $name,)*
                    Self::Other(user) => user.as_str(),
                }
            }

            /// Returns the name of the standard act with this code. An unassigned code has an empty
            /// name.
            pub(crate) fn name_of_code(code: u8) -> &'static str {
                match code {
                    $($code => $name,)*
                    _ => "",
                }
            }

            /// Returns the code of the standard act with this name, in any case.
            pub(crate) fn code_of_name(name: &[u8]) -> Option<u8> {
                // Few names have the same length.
                $(if name.len() == $name.len() && name.eq_ignore_ascii_case($name.as_bytes()) {
                    return Some($code);
                })*
                None
            }

            /// Returns the code of a standard act (FIPA00069 2.2 `PredefinedMsgType`).
            pub(crate) fn code(&self) -> Option<u8> {
                match self {
                    $(Self::$variant => Some($code),)*
                    Self::Other(_) => None,
                }
            }
        }
    };
}

performatives! {
    /// Accepting a proposal submitted before.
    AcceptProposal = 0x01 "accept-proposal",
    /// Agreeing to perform some action, possibly in the future.
    Agree = 0x02 "agree",
    /// Telling that a requested action is no longer wanted.
    Cancel = 0x03 "cancel",
    /// Calling for proposals to perform an action.
    Cfp = 0x04 "cfp",
    /// Telling that a proposition the receiver was unsure of is true.
    Confirm = 0x05 "confirm",
    /// Telling that a proposition the receiver believes is false.
    Disconfirm = 0x06 "disconfirm",
    /// Telling that an action was attempted and failed.
    Failure = 0x07 "failure",
    /// Telling that a proposition is true.
    Inform = 0x08 "inform",
    /// Telling whether a proposition is true.
    InformIf = 0x09 "inform-if",
    /// Telling the object that a descriptor refers to.
    InformRef = 0x0a "inform-ref",
    /// Telling that a message was not understood.
    NotUnderstood = 0x0b "not-understood",
    /// Asking to pass a message on to others.
    Propagate = 0x0c "propagate",
    /// Proposing to perform an action under conditions.
    Propose = 0x0d "propose",
    /// Asking to select agents and send them a message.
    Proxy = 0x0e "proxy",
    /// Asking whether a proposition is true.
    QueryIf = 0x0f "query-if",
    /// Asking for the object that a descriptor refers to.
    QueryRef = 0x10 "query-ref",
    /// Refusing to perform an action.
    Refuse = 0x11 "refuse",
    /// Rejecting a proposal.
    RejectProposal = 0x12 "reject-proposal",
    /// Asking to perform an action.
    Request = 0x13 "request",
    /// Asking to perform an action when a proposition becomes true.
    RequestWhen = 0x14 "request-when",
    /// Asking to perform an action each time a proposition becomes true.
    RequestWhenever = 0x15 "request-whenever",
    /// Asking for a report of every change of the object that a descriptor refers to.
    Subscribe = 0x16 "subscribe",
}

impl Performative {
    /// Returns the standard act with this code (FIPA00069 2.2 `PredefinedMsgType`).
    pub(crate) fn of_code(code: u8) -> Option<Self> {
        Self::STANDARD
            .get(usize::from(code).checked_sub(1)?)
            .cloned()
    }
}

/// Name of a user-defined performative: a FIPA00070 word that is not one of the 22 standard names.
/// Parsing a [`Performative`] makes one.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct UserPerformative(Box<str>);

impl UserPerformative {
    /// The name.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// Error of parsing a performative: the text is not a word.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "not a performative: {0:?}; give a word, which has no blanks or parentheses and does not begin \
     with a digit, '#', '-', '@' or '\"'"
)]
pub struct PerformativeError(String);

impl FromStr for Performative {
    type Err = PerformativeError;

    /// Parses a name. The case of the standard names is ignored. Any other word is a user-defined
    /// act.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match Self::code_of_name(text.as_bytes()).and_then(Self::of_code) {
            Some(act) => Ok(act),
            None if is_word(text) => Ok(Self::Other(UserPerformative(text.into()))),
            None => Err(PerformativeError(text.chars().take(60).collect())),
        }
    }
}

impl fmt::Display for Performative {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_those_of_the_standard() {
        for (index, act) in Performative::STANDARD.iter().enumerate() {
            assert_eq!(act.code().map(usize::from), Some(index + 1), "{act}");
            assert_eq!(Performative::of_code(index as u8 + 1).as_ref(), Some(act));
            assert_eq!(Performative::name_of_code(index as u8 + 1), act.as_str());
        }
        assert_eq!(Performative::of_code(0), None);
        assert_eq!(Performative::of_code(23), None);
    }

    #[test]
    fn standard_names_are_read_in_any_case_and_other_names_must_be_words() {
        assert_eq!("INFORM".parse(), Ok(Performative::Inform));
        assert_eq!("Query-Ref".parse(), Ok(Performative::QueryRef));
        let user: Performative = "my-act".parse().unwrap();
        assert_eq!((user.as_str(), user.code()), ("my-act", None));
        for wrong in ["", "my act", "1st", "(inform"] {
            assert!(wrong.parse::<Performative>().is_err(), "{wrong:?}");
        }
    }
}
