//! The requests: whether they are admitted, and their answers.

use std::net::{Ipv4Addr, Ipv6Addr};
use std::sync::Arc;

use axum::Router;
use axum::extract::{Request, State};
use axum::http::header::{
    AUTHORIZATION, CACHE_CONTROL, CONTENT_TYPE, HOST, WWW_AUTHENTICATE, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::uri::Authority;
use axum::http::{HeaderName, HeaderValue, StatusCode};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;

use super::token::Token;
use super::{Source, prometheus};

/// The conditions of each request.
struct Admission {
    token: Token,
    /// Names of this host, in lower case.
    names: Vec<String>,
}

/// Returns the answers to all requests.
pub(super) fn routes(source: Arc<dyn Source>, token: Token, names: Vec<String>) -> Router {
    let names = names.iter().map(|name| name.to_ascii_lowercase()).collect();
    let admission = Arc::new(Admission { token, names });
    Router::new()
        .route("/metrics", get(metrics))
        .route("/healthz", get(|| async { "ok\n" }))
        .route("/readyz", get(readiness))
        .fallback(|| async { (StatusCode::NOT_FOUND, "see /metrics, /healthz, /readyz\n") })
        .with_state(source)
        .layer(middleware::from_fn_with_state(admission, admit))
}

async fn admit(State(admission): State<Arc<Admission>>, request: Request, next: Next) -> Response {
    let refused = admission.check(&request);
    let mut response = match refused {
        None => next.run(request).await,
        Some(refusal) => refusal,
    };
    let headers = response.headers_mut();
    let mut set = |name: HeaderName, value| headers.insert(name, HeaderValue::from_static(value));
    set(CACHE_CONTROL, "no-store");
    set(X_CONTENT_TYPE_OPTIONS, "nosniff");
    response
}

impl Admission {
    /// Returns the answer to a request that is not admitted.
    fn check(&self, request: &Request) -> Option<Response> {
        let headers = request.headers();
        // A request line with a whole URI names the host, too.
        let target = request.uri().authority().map(Authority::as_str);
        let mut hosts = headers.get_all(HOST).iter();
        let host = hosts.next().and_then(|host| host.to_str().ok());
        let are_own = host.is_some_and(|host| self.is_own(host))
            && target.is_none_or(|target| self.is_own(target));
        if hosts.next().is_some() || !are_own {
            let why = "this name is not in http.names of the gateway's configuration\n";
            return Some((StatusCode::MISDIRECTED_REQUEST, why).into_response());
        }
        let given = headers.get(AUTHORIZATION).map(HeaderValue::as_bytes);
        let given = given.and_then(|value| value.split_at_checked(b"Bearer ".len()));
        let given = given.filter(|(scheme, _)| scheme.eq_ignore_ascii_case(b"Bearer "));
        if given.is_some_and(|(_, token)| self.token.is(token)) {
            return None;
        }
        let why = "send the token of the gateway: Authorization: Bearer TOKEN\n";
        let challenge = [(WWW_AUTHENTICATE, "Bearer")];
        Some((StatusCode::UNAUTHORIZED, challenge, why).into_response())
    }

    /// Whether `Host` names this host.
    fn is_own(&self, host: &str) -> bool {
        let Ok(authority) = host.parse::<Authority>() else {
            return false;
        };
        let name = authority.host().to_ascii_lowercase();
        let in_brackets = name.strip_prefix('[').and_then(|it| it.strip_suffix(']'));
        let is_address = match in_brackets {
            Some(address) => address.parse::<Ipv6Addr>().is_ok(),
            None => name.parse::<Ipv4Addr>().is_ok(),
        };
        !host.contains('@') && (is_address || name == "localhost" || self.names.contains(&name))
    }
}

async fn metrics(State(source): State<Arc<dyn Source>>) -> Response {
    // Reads files, and waits for their lock.
    let read = tokio::task::spawn_blocking(move || {
        let families = source.metrics()?;
        prometheus::text(&families)
    });
    let text = read.await.map_err(|error| error.to_string());
    match text.and_then(|text| text) {
        Ok(text) => ([(CONTENT_TYPE, prometheus::FORMAT)], text).into_response(),
        Err(why) => (StatusCode::SERVICE_UNAVAILABLE, format!("{why}\n")).into_response(),
    }
}

async fn readiness(State(source): State<Arc<dyn Source>>) -> Response {
    match source.readiness().await {
        Ok(()) => "ok\n".into_response(),
        Err(why) => (StatusCode::SERVICE_UNAVAILABLE, format!("{why}\n")).into_response(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_of_this_host_are_admitted() {
        let admission = Admission {
            token: Token::for_tests(),
            names: vec!["rover.example".to_owned()],
        };
        for own in [
            "127.0.0.1:9790",
            "127.0.0.1",
            "[::1]:9790",
            "localhost:1",
            "LOCALHOST",
            "Rover.Example:80",
            "10.0.0.9",
        ] {
            assert!(admission.is_own(own), "{own}");
        }
        for other in [
            "",
            "evil.example",
            "localhost.evil.example",
            "127.0.0.1.evil.example",
            "user@localhost",
            "[::1",
            "[fe80::1%25eth0]",
            "127.1",
            "localhost:x y",
        ] {
            assert!(!admission.is_own(other), "{other}");
        }
    }
}
