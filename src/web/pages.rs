//! Pages of a program at the gateway's listener.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use axum::Router;

/// Pages that a program shows at the HTTP listener of its gateway (`http.listen`), beside those of the gateway.
///
/// The listener has checked `Host` of each request. Its answers have a `Content-Security-Policy` with which a page uses
/// nothing but this listener. Paths of the gateway itself (`/metrics`, `/healthz`, `/readyz`, `/api/session`) must not be
/// among them.
#[derive(Debug, Default)]
pub struct Pages {
    /// Answers without the token: must show nothing about this host.
    pub public: Router,
    /// Answers to clients that have sent the token or have a session. Answers to GET change nothing. Other requests
    /// come from a page of this listener: they have its `Origin` and the header `X-Fipa`.
    pub protected: Router,
}

/// Keeps a connection open, for an answer without an end. An extension of each request.
///
/// Other connections end after 10 seconds.
#[derive(Debug, Clone, Default)]
pub struct KeepOpen(Arc<AtomicBool>);

impl KeepOpen {
    /// Keeps the connection of this request open, until the client closes it or takes nothing from it for 30 seconds.
    pub fn keep(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    pub(super) fn is_kept(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}
