//! What went wrong on the way to another process's mailbox, as the sender is told.

use fipa_transport::wire::WireError;
use fipa_transport::{WayError, WayFault};
use iceoryx2::port::LoanError;
use iceoryx2::port::client::RequestSendError;
use iceoryx2::service::builder::request_response::RequestResponseOpenError;
use iceoryx2::service::port_factory::client::ClientCreateError;

const MAILBOX_TAKEN: &str = ": too many processes have it open (max_clients of the other process)";

pub(crate) fn too_large() -> WayError {
    WayError::new(WayFault::TooLarge, "")
}

pub(crate) fn retired() -> WayError {
    WayError::new(WayFault::Congested, "the connection is being renewed")
}

pub(crate) fn window_full(window: usize) -> WayError {
    WayError::new(
        WayFault::Congested,
        format_args!("{window} letters to this process are without an answer"),
    )
}

pub(crate) fn wire_error(error: WireError) -> WayError {
    let fault = match error {
        WireError::BodyLength { .. } => WayFault::TooLarge,
        _ => WayFault::Refused,
    };
    WayError::new(fault, error)
}

pub(crate) fn open_error(error: RequestResponseOpenError) -> WayError {
    use RequestResponseOpenError as E;
    let fault = match error {
        E::DoesNotExist | E::IsMarkedForDestruction => WayFault::Unreachable,
        E::ExceedsMaxNumberOfNodes => WayFault::Congested,
        E::IncompatibleRequestOrResponseType
        | E::IncompatibleAttributes
        | E::IncompatibleMessagingPattern => WayFault::Incompatible,
        _ => WayFault::Unreachable,
    };
    let hint = match error {
        E::ExceedsMaxNumberOfNodes => MAILBOX_TAKEN,
        _ => "",
    };
    WayError::new(
        fault,
        format_args!("the mailbox cannot be opened ({error:?}){hint}"),
    )
}

pub(crate) fn create_error(error: ClientCreateError) -> WayError {
    let hint = match error {
        ClientCreateError::ExceedsMaxSupportedClients => MAILBOX_TAKEN,
        _ => ": often the limit of open files is too low, or shared memory is full",
    };
    WayError::new(
        WayFault::Congested,
        format_args!("the mailbox cannot be connected to ({error:?}){hint}"),
    )
}

pub(crate) fn loan_error(error: LoanError) -> WayError {
    let hint = match error {
        LoanError::ExceedsMaxLoans => "too many letters are with this process",
        _ => "no shared memory could be had: enlarge /dev/shm, or raise the limit of open files",
    };
    WayError::new(WayFault::Congested, format_args!("{hint} ({error:?})"))
}

pub(crate) fn send_error(error: RequestSendError) -> WayError {
    let hint = match error {
        RequestSendError::ExceedsMaxActiveRequests => {
            "too many letters to this process are without an answer"
        }
        _ => "the mailbox does not take it",
    };
    WayError::new(WayFault::Congested, format_args!("{hint} ({error:?})"))
}
