//! The requests: whether they are admitted, and their answers.

use std::net::{Ipv4Addr, Ipv6Addr};
use std::sync::Arc;
use std::time::Instant;

use axum::Router;
use axum::body::Bytes;
use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::header::{
    AUTHORIZATION, CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, COOKIE, HOST, ORIGIN,
    REFERRER_POLICY, SET_COOKIE, WWW_AUTHENTICATE, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse as _, Response};
use axum::routing::{get, post};

use super::pages::Pages;
use super::sessions::{LIFETIME, Sessions};
use super::token::Token;
use super::{Source, prometheus};

/// The header that scripts of the page send with each change. A form or a link of another site cannot set it.
const PAGE_HEADER: &str = "x-fipa";

/// Maximum size of the body of a request, in bytes.
const MAX_BODY: usize = 4096;

/// The rights of each page: it runs its own scripts, asks this listener, and is in no frame.
const PAGE_RIGHTS: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; \
    manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; require-trusted-types-for 'script'";

/// The conditions of each request.
struct Admission {
    token: Token,
    sessions: Sessions,
    /// Names of this host, in lower case.
    names: Vec<String>,
    scheme: Scheme,
}

/// How clients reach the listener.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Scheme {
    Http,
    Https,
}

impl Scheme {
    /// The beginning of its URLs.
    fn prefix(self) -> &'static str {
        match self {
            Self::Http => "http://",
            Self::Https => "https://",
        }
    }
}

/// Returns the answers to all requests.
pub(super) fn routes(
    source: Arc<dyn Source>,
    token: Token,
    names: Vec<String>,
    scheme: Scheme,
    pages: Pages,
) -> Router {
    let names = names.iter().map(|name| name.to_ascii_lowercase()).collect();
    let admission = Arc::new(Admission {
        token,
        sessions: Sessions::default(),
        names,
        scheme,
    });
    let layer = || middleware::from_fn_with_state(Arc::clone(&admission), need_proof);
    let protected = Router::new()
        .route("/metrics", get(metrics))
        .route("/healthz", get(|| async { "ok\n" }))
        .route("/readyz", get(readiness))
        .with_state(source)
        .merge(pages.protected)
        .route_layer(layer());
    let sessions = Router::new()
        .route("/api/session", post(begin_session).delete(end_session))
        .layer(DefaultBodyLimit::max(MAX_BODY))
        .with_state(Arc::clone(&admission));
    Router::new()
        .merge(protected)
        .merge(sessions)
        .merge(pages.public)
        .fallback(|| async { (StatusCode::NOT_FOUND, "there is no such page\n") })
        .layer(middleware::from_fn_with_state(admission, admit))
}

/// Refuses requests under another name, and changes that a page of another site may have caused. Gives each answer the
/// headers that all of them have.
async fn admit(State(admission): State<Arc<Admission>>, request: Request, next: Next) -> Response {
    let refused = admission.check(&request);
    let mut response = match refused {
        None => next.run(request).await,
        Some(refusal) => refusal,
    };
    let headers = response.headers_mut();
    if !headers.contains_key(CACHE_CONTROL) {
        headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-store"));
    }
    let mut set = |name: HeaderName, value| headers.insert(name, HeaderValue::from_static(value));
    set(X_CONTENT_TYPE_OPTIONS, "nosniff");
    set(CONTENT_SECURITY_POLICY, PAGE_RIGHTS);
    set(REFERRER_POLICY, "no-referrer");
    set(
        HeaderName::from_static("cross-origin-opener-policy"),
        "same-origin",
    );
    set(
        HeaderName::from_static("cross-origin-resource-policy"),
        "same-origin",
    );
    response
}

/// Refuses clients that prove nothing.
async fn need_proof(
    State(admission): State<Arc<Admission>>,
    request: Request,
    next: Next,
) -> Response {
    if admission.has_proof(request.headers()) {
        return next.run(request).await;
    }
    let why = "send the token of the gateway: Authorization: Bearer TOKEN\n";
    let challenge = [(WWW_AUTHENTICATE, "Bearer")];
    (StatusCode::UNAUTHORIZED, challenge, why).into_response()
}

/// Begins the session of a browser that sends the token.
async fn begin_session(
    State(admission): State<Arc<Admission>>,
    headers: HeaderMap,
    token: Bytes,
) -> Response {
    if !admission.token.is(token.trim_ascii()) {
        return (
            StatusCode::UNAUTHORIZED,
            "this is not the token of the gateway\n",
        )
            .into_response();
    }
    let begun = admission.sessions.begin(Instant::now());
    let cookie = begun.map(|secret| admission.cookie(&headers, &secret, LIFETIME.as_secs()));
    match cookie {
        Ok(cookie) => ([(SET_COOKIE, cookie)], StatusCode::NO_CONTENT).into_response(),
        Err(error) => (
            StatusCode::SERVICE_UNAVAILABLE,
            format!("no random bytes: {error}\n"),
        )
            .into_response(),
    }
}

/// Ends the session of a browser.
async fn end_session(State(admission): State<Arc<Admission>>, headers: HeaderMap) -> Response {
    for secret in session_secrets(&headers) {
        admission.sessions.end(secret);
    }
    let cookie = admission.cookie(&headers, "", 0);
    ([(SET_COOKIE, cookie)], StatusCode::NO_CONTENT).into_response()
}

fn cookie_name(headers: &HeaderMap) -> String {
    let host = headers.get(HOST).and_then(|host| host.to_str().ok());
    let authority = host.and_then(|host| host.parse::<Authority>().ok());
    let port = authority.and_then(|authority| authority.port_u16());
    format!("fipa_session_{}", port.unwrap_or(0))
}

/// The secrets of sessions that a request has.
fn session_secrets(headers: &HeaderMap) -> impl Iterator<Item = &[u8]> {
    let name = cookie_name(headers);
    let cookies = headers.get_all(COOKIE).iter();
    let pairs = cookies.flat_map(|cookies| cookies.as_bytes().split(|byte| *byte == b';'));
    pairs.filter_map(move |pair| {
        let value = pair.trim_ascii().strip_prefix(name.as_bytes())?;
        value.strip_prefix(b"=")
    })
}

impl Admission {
    /// Returns the answer to a request that is not admitted.
    fn check(&self, request: &Request) -> Option<Response> {
        let headers = request.headers();
        // A request line with a whole URI names the host, too.
        let target = request.uri().authority().map(Authority::as_str);
        let is_own_target = target.is_none_or(|target| self.is_own(target));
        let host = only(headers, HOST).filter(|host| is_own_target && self.is_own(host));
        let Some(host) = host else {
            let why = "this name is not in http.names of the gateway's configuration\n";
            return Some((StatusCode::MISDIRECTED_REQUEST, why).into_response());
        };
        if matches!(*request.method(), Method::GET | Method::HEAD) {
            return None;
        }
        let origin =
            only(headers, ORIGIN).and_then(|origin| origin.strip_prefix(self.scheme.prefix()));
        let is_of_page = origin.is_some_and(|origin| origin.eq_ignore_ascii_case(host));
        if is_of_page && headers.contains_key(PAGE_HEADER) {
            return None;
        }
        let why = "only the page of this listener changes something\n";
        Some((StatusCode::FORBIDDEN, why).into_response())
    }

    /// Returns the cookie of a session. Its name has the port, because a browser sends cookies to all ports of a host:
    /// two gateways on one host have different ones.
    fn cookie(&self, headers: &HeaderMap, secret: &str, seconds: u64) -> String {
        let name = cookie_name(headers);
        let secure = match self.scheme {
            Scheme::Https => "; Secure",
            Scheme::Http => "",
        };
        format!("{name}={secret}; Path=/; Max-Age={seconds}; HttpOnly; SameSite=Strict{secure}")
    }

    /// Whether a request has the token, or belongs to a session.
    fn has_proof(&self, headers: &HeaderMap) -> bool {
        let given = headers.get(AUTHORIZATION).map(HeaderValue::as_bytes);
        let given = given.and_then(|value| value.split_at_checked(b"Bearer ".len()));
        let given = given.filter(|(scheme, _)| scheme.eq_ignore_ascii_case(b"Bearer "));
        let now = Instant::now();
        given.is_some_and(|(_, token)| self.token.is(token))
            || session_secrets(headers).any(|secret| self.sessions.has(now, secret))
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

/// The value of a header that a request has exactly once.
fn only(headers: &HeaderMap, name: HeaderName) -> Option<&str> {
    let mut values = headers.get_all(name).iter();
    let value = values.next()?.to_str().ok()?;
    values.next().is_none().then_some(value)
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
            sessions: Sessions::default(),
            scheme: Scheme::Http,
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
