//! The HTTP listener of a gateway, as the gateway reports it.

use crate::admin::routes::HttpListener;

/// The open listener.
pub(super) struct OpenListener {
    pub(super) listener: HttpListener,
    /// The key with which it encrypts.
    #[cfg(feature = "secure")]
    pub(super) security: Option<fipa_transport_net::secure::Security>,
}

impl OpenListener {
    /// The listener with the certificate that it presents now. A reload may replace the certificate.
    pub(super) fn report(&self) -> HttpListener {
        #[cfg(feature = "secure")]
        let fingerprint = self.security.as_ref().map(|it| it.own().to_string());
        #[cfg(not(feature = "secure"))]
        let fingerprint = None;
        HttpListener {
            fingerprint,
            ..self.listener.clone()
        }
    }
}
