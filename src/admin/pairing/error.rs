//! The errors of a pairing.

use std::io;
use std::time::Duration;

use crate::admin::keys::KeysError;

/// The error of a pairing. This host trusts no further certificate then.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PairingError {
    /// The keys of this host cannot be read, or the certificate of the other host cannot be trusted.
    #[error(transparent)]
    Keys(#[from] KeysError),
    /// The system has no random numbers.
    #[error("the system has no random numbers")]
    Random(#[source] getrandom::Error),
    /// The port cannot be opened.
    #[error("cannot listen on the port {port}")]
    Listen {
        /// The port; 0 is one that the system chooses.
        port: u16,
        /// The error of the operating system.
        source: io::Error,
    },
    /// There is no host with this address.
    #[error("cannot find the host {address:?}")]
    Address {
        /// The address, as it was given.
        address: String,
        /// The error of the text, or of the look-up of the name.
        source: io::Error,
    },
    /// The other host cannot be reached.
    #[error("cannot connect to {address:?}")]
    Connect {
        /// The address, as it was given.
        address: String,
        /// The error of the operating system, for the last address of the host.
        source: io::Error,
    },
    /// No host with the code came within this time.
    #[error("no host with the code came within {}", humantime::format_duration(*.0))]
    Expired(Duration),
    /// The program at the other end is no pairing of this version.
    #[error("the other end does not pair, or runs another version")]
    NotPairing,
    /// The other host has another code, or a host in between tried to guess it.
    #[error("the code does not match")]
    WrongCode,
    /// A message after the code was confirmed is not from the other host.
    #[error("a message was changed on its way")]
    Altered,
    /// A certificate is longer than a certificate may be. Holds its length in bytes.
    #[error("a certificate of {0} bytes is too long")]
    TooLong(usize),
    /// The other host did not answer within this time.
    #[error("the other host did not answer within {}", humantime::format_duration(*.0))]
    Silent(Duration),
    /// The other host ended the pairing, or the connection broke.
    #[error("the other host ended the pairing")]
    Ended(#[source] io::Error),
}
