//! The error of the listener.

use super::token::TokenError;

/// The error if the listener cannot be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WebError {
    /// The address cannot be used.
    #[error("cannot listen at {address} (key http.listen)")]
    Listen {
        /// The address.
        address: String,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// Other hosts reach the address, and the gateway has no key to encrypt with.
    #[error("there is no key to encrypt with at {address} (key http.listen)")]
    NoKey {
        /// The address.
        address: String,
    },
    /// The token cannot be used.
    #[error(transparent)]
    Token(#[from] TokenError),
}
