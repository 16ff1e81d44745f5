//! Mapping of iceoryx2 errors to transport errors.

use std::io;

use fipa_transport::wire::WireError;
use fipa_transport::{TransportError, TransportErrorKind};
use iceoryx2::port::LoanError;
use iceoryx2::port::client::RequestSendError;
use iceoryx2::service::builder::request_response::RequestResponseOpenError;
use iceoryx2::service::port_factory::client::ClientCreateError;
use rustix::io::Errno;
use rustix::process::{Resource, getrlimit};

const MAILBOX_TAKEN: &str =
    ": too many processes have it open; raise max_clients of the other process";

pub(crate) fn too_large() -> TransportError {
    TransportError::new(TransportErrorKind::TooLarge, "")
}

pub(crate) fn retired() -> TransportError {
    TransportError::new(
        TransportErrorKind::Congested,
        "the connection is being renewed",
    )
}

pub(crate) fn closed() -> TransportError {
    TransportError::new(TransportErrorKind::Closed, "")
}

pub(crate) fn opening() -> TransportError {
    TransportError::new(
        TransportErrorKind::Congested,
        "the mailbox of the other process is being opened",
    )
}

pub(crate) fn allocating() -> TransportError {
    TransportError::new(
        TransportErrorKind::Congested,
        "another process of the domain is allocating shared memory",
    )
}

pub(crate) fn window_full(unanswered: usize) -> TransportError {
    TransportError::new(
        TransportErrorKind::Congested,
        format_args!("{unanswered} parcels to this process are unanswered"),
    )
}

pub(crate) fn wire_error(error: WireError) -> TransportError {
    let fault = match error {
        WireError::BodyLength { .. } => TransportErrorKind::TooLarge,
        _ => TransportErrorKind::Refused,
    };
    TransportError::new(fault, error)
}

/// Whether a file cannot be opened because of a limit of open files, of the process or of the system.
pub(crate) fn lacks_descriptors(error: &io::Error) -> bool {
    let errno = Errno::from_io_error(error);
    matches!(errno, Some(Errno::MFILE | Errno::NFILE))
}

/// Returns the text of an error, with the limit of open files if that is the cause.
pub(crate) fn with_limit(error: &io::Error) -> String {
    if Errno::from_io_error(error) != Some(Errno::MFILE) {
        return error.to_string();
    }
    let limit = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    format!("{error}: {}", limit_text(limit))
}

/// Returns the limit of open files of this process if it has nearly reached it.
pub(crate) fn reached_limit() -> Option<u64> {
    let limit = getrlimit(Resource::Nofile).current?;
    match std::fs::read_dir("/proc/self/fd") {
        Ok(open) => (open.count() as u64 + CONNECTION >= limit).then_some(limit),
        Err(error) => lacks_descriptors(&error).then_some(limit),
    }
}

pub(crate) fn limit_text(limit: u64) -> String {
    format!(
        "this process may have {limit} open files; raise the limit (`ulimit -n`, or mts.raise_open_files)"
    )
}

/// Number of descriptors that the connection with another process needs at most.
const CONNECTION: u64 = 12;

/// Maximum number of names in [`words`].
const MAX_NAMES: usize = 4;

/// Writes an error of iceoryx2, which has no other text than the name of its variant, in words:
/// `does not exist` for `DoesNotExist`. Of nested errors, the first names are written. Other parts of the
/// `Debug` text, such as fields, are omitted.
pub(crate) fn words(error: &dyn std::fmt::Debug) -> String {
    let text = format!("{error:?}");
    let names = text
        .split(|c: char| !c.is_ascii_alphanumeric())
        .filter(|name| name.starts_with(|c: char| c.is_ascii_uppercase()))
        .take(MAX_NAMES);
    let in_words = |name: &str| {
        let mut words = String::new();
        for c in name.chars() {
            if c.is_ascii_uppercase() && !words.is_empty() {
                words.push(' ');
            }
            words.push(c.to_ascii_lowercase());
        }
        words
    };
    let all: Vec<String> = names.map(in_words).collect();
    all.join(": ")
}

pub(crate) fn open_error(error: RequestResponseOpenError) -> TransportError {
    use RequestResponseOpenError as E;
    let fault = match error {
        E::DoesNotExist | E::IsMarkedForDestruction => TransportErrorKind::Unreachable,
        E::ExceedsMaxNumberOfNodes => TransportErrorKind::Congested,
        E::IncompatibleRequestOrResponseType
        | E::IncompatibleAttributes
        | E::IncompatibleMessagingPattern => TransportErrorKind::Incompatible,
        _ => TransportErrorKind::Unreachable,
    };
    let hint = match error {
        E::ExceedsMaxNumberOfNodes => MAILBOX_TAKEN,
        _ => "",
    };
    TransportError::new(
        fault,
        format_args!("cannot open the mailbox ({}){hint}", words(&error)),
    )
}

pub(crate) fn create_error(error: ClientCreateError) -> TransportError {
    let hint = match error {
        ClientCreateError::ExceedsMaxSupportedClients => MAILBOX_TAKEN,
        _ => ": the limit of open files may be too low, or shared memory full",
    };
    TransportError::new(
        TransportErrorKind::Congested,
        format_args!("cannot connect to the mailbox ({}){hint}", words(&error)),
    )
}

pub(crate) fn loan_error(error: LoanError) -> TransportError {
    let hint = match error {
        LoanError::ExceedsMaxLoans => "too many letters to this process are unanswered",
        _ => "cannot allocate shared memory: enlarge /dev/shm, or raise the limit of open files",
    };
    TransportError::new(
        TransportErrorKind::Congested,
        format_args!("{hint} ({})", words(&error)),
    )
}

pub(crate) fn send_error(error: RequestSendError) -> TransportError {
    let hint = match error {
        RequestSendError::ExceedsMaxActiveRequests => {
            "too many letters to this process are unanswered"
        }
        _ => "the mailbox does not accept the letter",
    };
    TransportError::new(
        TransportErrorKind::Congested,
        format_args!("{hint} ({})", words(&error)),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_variant_is_written_in_words() {
        assert_eq!(
            words(&RequestResponseOpenError::DoesNotExist),
            "does not exist"
        );
        let nested = Some(ClientCreateError::ExceedsMaxSupportedClients);
        assert_eq!(words(&nested), "some: exceeds max supported clients");
    }
}
