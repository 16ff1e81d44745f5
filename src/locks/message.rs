//! Fences in messages.

use fipa_acl::{Message, MessageBuilder};
use fipa_locking::{Fence, FenceError};

/// Name of the user-defined parameter (without `X-`) with the fences of a lock, separated by blanks.
pub const FENCE: &str = "fipa-fence";

/// Maximum number of fences in a message.
const MAX_FENCES: usize = 64;

/// The error if a command is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AdmitError {
    /// The message has no fence of this owner for the resource.
    #[error("the message has no fence of {owner:?} for {resource:?}; lock it first")]
    Missing {
        /// The name of the owner.
        owner: String,
        /// The resource.
        resource: String,
    },
    /// A fence is not valid.
    #[error("the message has a fence that is not valid")]
    Fence(#[from] FenceError),
    /// The message has too many fences.
    #[error("the message has more than {MAX_FENCES} fences")]
    TooMany,
    /// The device has admitted a fence of another run of the owner. The fence is old, or the owner has
    /// started without knowing of that run; then lock the resource again.
    #[error("the fence {fence} is of another run of the owner than {highest}, which was admitted")]
    OtherRun {
        /// The fence.
        fence: Fence,
        /// The highest fence that the device has admitted.
        highest: Fence,
    },
    /// The fence is older than the present grant: its lock was lost or released.
    #[error("the fence {fence} of {resource:?} is stale; the lock was lost or released")]
    Stale {
        /// The fence.
        fence: Fence,
        /// The resource.
        resource: String,
    },
}

/// Adds fences to a message, as [`Lock::guard`](super::Lock::guard) does.
pub fn with_fences<'a>(
    message: MessageBuilder,
    fences: impl IntoIterator<Item = &'a Fence>,
) -> MessageBuilder {
    // The name of an owner may contain blanks.
    let fences = fences
        .into_iter()
        .map(|fence| fence.to_string().replace('%', "%25").replace(' ', "%20"));
    let fences: Vec<String> = fences.collect();
    match fences.is_empty() {
        true => message,
        false => message.user_defined(FENCE, fences.join(" ")),
    }
}

/// Returns the fences in a message; none if the parameter is absent. A device that is not the owner checks them with
/// [`Admission`](super::Admission).
///
/// # Errors
/// If the parameter is not valid.
pub fn fences_of(message: &Message) -> Result<Vec<Fence>, AdmitError> {
    let mut parameters = message.user_defined().iter().rev();
    let Some((_, text)) = parameters.find(|(name, _)| name.eq_ignore_ascii_case(FENCE)) else {
        return Ok(Vec::new());
    };
    let mut fences = Vec::new();
    for text in text.split(' ') {
        if fences.len() >= MAX_FENCES {
            return Err(AdmitError::TooMany);
        }
        fences.push(
            text.replace("%20", " ")
                .replace("%25", "%")
                .parse::<Fence>()?,
        );
    }
    Ok(fences)
}

#[cfg(test)]
mod tests {
    use fipa_acl::Performative;

    use super::*;

    fn fence(text: &str) -> Fence {
        text.parse().unwrap()
    }

    #[test]
    fn fences_survive_a_message() {
        let fences = [
            fence("1.2.5a31c0e4d2b19f07@crane#bay"),
            fence("3.4.5a31c0e4d2b19f07@the 100% %20 crane#bay 1"),
        ];
        let empty = || Message::builder(Performative::Request);
        let message = with_fences(empty(), fences.iter()).build().unwrap();
        let message = Message::decode(&message.to_payload()).unwrap();
        assert_eq!(fences_of(&message).unwrap(), fences);
        assert_eq!(fences_of(&empty().build().unwrap()), Ok(Vec::new()));
    }

    #[test]
    fn other_texts_are_refused() {
        let read = |text: String| {
            let message = Message::builder(Performative::Request).user_defined(FENCE, text);
            fences_of(&message.build().unwrap())
        };
        assert_eq!(
            read("1.2.5a31c0e4d2b19f07@#b".into()),
            Err(FenceError::Name(fipa_locking::NameError::Empty).into())
        );
        assert_eq!(read(String::new()), Err(FenceError::Form.into()));
        assert_eq!(
            read("1.1.5a31c0e4d2b19f07@a#b ".repeat(65)),
            Err(AdmitError::TooMany)
        );
        let long = format!("1.1.5a31c0e4d2b19f07@{}#bay", "x".repeat(10_000));
        assert!(matches!(read(long), Err(AdmitError::Fence(_))));
    }
}
