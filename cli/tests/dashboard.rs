//! The dashboard of a gateway: its listener as browsers and attackers reach it, and its page in a real browser.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

#[path = "dashboard/actions.rs"]
mod actions;
#[path = "common/browser.rs"]
mod browser;
mod common;
#[path = "dashboard/dock.rs"]
mod dock;
#[path = "dashboard/hostile.rs"]
mod hostile;
#[path = "common/listener.rs"]
mod listener;
#[path = "dashboard/memory.rs"]
mod memory;

use std::fs;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;

use browser::Browser;
use common::Host;
use fipa_testbed::{AnyPeer, ChildGuard, until};
use listener::Shown;
use serde_json::Value;

/// Maximum number of pages that follow a gateway.
const MAX_STREAMS: usize = 16;

impl Shown {
    /// Sends a request with these headers beside `Host`. Returns the status, the headers in lower case, and the body.
    fn ask(&self, method: &str, path: &str, headers: &str, body: &str) -> (u16, String, String) {
        let (address, length) = (self.address, body.len());
        let head = format!("{method} {path} HTTP/1.1\r\nHost: {address}\r\n{headers}");
        let request = format!("{head}Content-Length: {length}\r\n\r\n{body}");
        let (status, head, body) = self.exchange(&request);
        (status, head.to_ascii_lowercase(), body)
    }

    /// The headers of a change by the page of this listener.
    fn of_page(&self) -> String {
        format!("Origin: http://{}\r\nX-Fipa: 1\r\n", self.address)
    }

    /// The header with the cookie of a new session.
    fn session(&self) -> String {
        let (status, head, _) = self.ask("POST", "/api/session", &self.of_page(), &self.token);
        assert_eq!(status, 204, "{head}");
        let cookie = head
            .lines()
            .find_map(|line| line.strip_prefix("set-cookie: "))
            .unwrap();
        for part in ["; httponly", "; samesite=strict", "; path=/"] {
            assert!(cookie.contains(part), "{cookie}");
        }
        format!("Cookie: other=1; {}\r\n", cookie.split(';').next().unwrap())
    }

    /// Follows a view.
    fn follow(&self, view: &str) -> Following {
        let mut stream = self.connect();
        let (address, bearer) = (self.address, self.bearer());
        write!(
            stream,
            "GET /api/live/{view} HTTP/1.1\r\nHost: {address}\r\n{bearer}\r\n"
        )
        .unwrap();
        let mut lines = BufReader::new(stream);
        let mut status = String::new();
        lines.read_line(&mut status).unwrap();
        Following { status, lines }
    }

    /// Opens the page in a browser.
    fn open(&self, name: &str, width: u32, height: u32) -> Option<Browser> {
        Browser::open_page(name, (width, height), (self.address, &self.token))
    }
}

/// The events of a view.
struct Following {
    status: String,
    lines: BufReader<TcpStream>,
}

impl Following {
    /// Waits for the next event of this kind.
    fn event(&mut self, kind: &str) -> Value {
        let mut is_wanted = false;
        loop {
            let mut line = String::new();
            assert_ne!(
                self.lines.read_line(&mut line).unwrap(),
                0,
                "the stream has ended"
            );
            if let Some(event) = line.strip_prefix("event: ") {
                is_wanted = event.trim_end() == kind;
            }
            if let Some(data) = line.strip_prefix("data: ").filter(|_| is_wanted) {
                return serde_json::from_str(data).unwrap();
            }
        }
    }

    /// Waits until a row has changed as wanted.
    fn change(&mut self, section: &str, key: &str, is_wanted: impl Fn(&Value) -> bool) {
        loop {
            let changes = self.event("changes");
            if is_wanted(&changes["set"][section][key]) {
                return;
            }
        }
    }
}

#[test]
fn a_browser_exchanges_the_token_for_a_session() {
    let host = Host::new();
    let shown = Shown::start(&host, "[::1]:0", &[]);
    let session = shown.session();
    let (status, _, body) = shown.ask("GET", "/api/fleet", &session, "");
    assert_eq!(status, 200, "{body}");
    assert!(serde_json::from_str::<Value>(&body).is_ok(), "{body}");
    // The name of the cookie alone, another secret, and a cookie of another port.
    let secret = session.trim_end().rsplit('=').next().unwrap();
    let name = format!("fipa_session_{}", shown.address.port());
    for wrong in ["", "0123456789abcdef0123456789abcdef"] {
        let header = format!("Cookie: {name}={wrong}\r\n");
        assert_eq!(
            shown.ask("GET", "/api/fleet", &header, "").0,
            401,
            "{wrong}"
        );
    }
    let header = format!("Cookie: fipa_session_1={secret}\r\n");
    assert_eq!(shown.ask("GET", "/api/fleet", &header, "").0, 401);

    let headers = session.clone() + &shown.of_page();
    assert_eq!(shown.ask("DELETE", "/api/session", &headers, "").0, 204);
    assert_eq!(shown.ask("GET", "/api/fleet", &session, "").0, 401);

    // A further session than 16 ends the oldest.
    let sessions: Vec<String> = (0..17).map(|_| shown.session()).collect();
    assert_eq!(shown.ask("GET", "/api/fleet", &sessions[0], "").0, 401);
    assert_eq!(shown.ask("GET", "/api/fleet", &sessions[1], "").0, 200);
}

#[test]
fn pages_of_other_sites_reach_nothing() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let address = shown.address;
    for headers in [
        "X-Fipa: 1\r\n".to_owned(),
        format!("Origin: http://{address}\r\n"),
        "Origin: http://evil.example\r\nX-Fipa: 1\r\n".to_owned(),
        "Origin: null\r\nX-Fipa: 1\r\n".to_owned(),
        format!("Origin: https://{address}\r\nX-Fipa: 1\r\n"),
        format!("Origin: http://{address}.evil.example\r\nX-Fipa: 1\r\n"),
        format!("Origin: http://{address}\r\nOrigin: http://{address}\r\nX-Fipa: 1\r\n"),
    ] {
        let (status, head, _) = shown.ask("POST", "/api/session", &headers, &shown.token);
        assert_eq!(status, 403, "{headers}");
        assert!(!head.contains("set-cookie"), "{head}");
    }
    let (status, head, _) = shown.ask("POST", "/api/session", &shown.of_page(), "0123456789abcdef");
    assert_eq!(status, 401);
    assert!(!head.contains("set-cookie"), "{head}");
    let long = "a".repeat(100_000);
    assert_eq!(
        shown.ask("POST", "/api/session", &shown.of_page(), &long).0,
        413
    );

    // The parts of the page are public, the values are not.
    for path in ["/", "/main.js", "/style.css"] {
        let (status, head, body) = shown.ask("GET", path, "", "");
        assert_eq!(status, 200, "{path}");
        assert!(!body.contains(&shown.token) && !body.contains(&host.domain));
        for part in [
            "default-src 'none'",
            "frame-ancestors 'none'",
            "require-trusted-types-for 'script'",
            "x-content-type-options: nosniff",
            "referrer-policy: no-referrer",
        ] {
            assert!(head.contains(part), "{path} {part} {head}");
        }
        assert!(!head.contains("unsafe-"), "{head}");
    }
    for path in [
        "/api/fleet",
        "/api/live/fleet",
        "/api/agent?name=a",
        "/metrics",
    ] {
        assert_eq!(shown.ask("GET", path, "", "").0, 401, "{path}");
    }
    for (path, status) in [
        ("/api/agent", 400),
        ("/api/conversation", 400),
        ("/api/other", 404),
        ("/../etc/passwd", 404),
    ] {
        assert_eq!(
            shown.ask("GET", path, &shown.bearer(), "").0,
            status,
            "{path}"
        );
    }
    assert_eq!(
        shown
            .ask(
                "POST",
                "/api/fleet",
                &(shown.bearer() + &shown.of_page()),
                ""
            )
            .0,
        405
    );
}

#[test]
fn a_view_is_followed_by_its_changes() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let mut fleet = shown.follow("fleet");
    let _ = fleet.event("snapshot");
    let echo = host.echo("crane");
    fleet.change("agents", "crane", |row| {
        row["here"] == true && row["ended"].is_null()
    });
    host.run(&["ping", "crane", "--count", "20", "--interval", "1ms"])
        .done();
    fleet.change("agents", "crane", |row| {
        row["received"].as_u64() >= Some(20)
    });
    let _ = echo.signal("-KILL");
    fleet.change("agents", "crane", |row| !row["ended"].is_null());

    let mut letters = shown.follow("letters");
    let snapshot = letters.event("snapshot");
    let rows = snapshot["letters"].as_object().unwrap();
    assert!(
        rows.values()
            .any(|row| row["to"] == "crane" && row["fate"]["outcome"] == "delivered")
    );
}

#[test]
fn the_description_of_the_interface_is_what_the_gateway_answers() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let (_, _, text) = shown.ask("GET", "/api/openapi.json", "", "");
    let description: Value = serde_json::from_str(&text).unwrap();
    let _crane = host.start(&["publish", "crane", "charge", "80"]);
    let mut letters = shown.follow("letters");
    let _ = letters.event("snapshot");
    let _owner = host.start(&["own", "bay"]);
    say(&host, "cfp", "c1", "crane");
    let answer = |path: &str| {
        let (status, _, body) = shown.ask("GET", path, &shown.bearer(), "");
        assert_eq!(status, 200, "{path}");
        serde_json::from_str::<Value>(&body).unwrap()
    };
    let (status, head, svg) = shown.ask(
        "GET",
        "/api/protocol.svg?name=fipa-request&state=agreed",
        &shown.bearer(),
        "",
    );
    assert_eq!(status, 200, "{svg}");
    assert!(
        head.contains("image/svg+xml") && svg.contains("agreed"),
        "{svg}"
    );
    let _robot = actions::Robot::start(&host, "crex", &[]);
    let _driving = actions::drive(&host, "crex");
    for (path, description_of_path) in description["paths"].as_object().unwrap() {
        let Some(get) = description_of_path.get("get") else {
            continue;
        };
        let given = match get["parameters"][0]["name"].as_str() {
            Some("name") => "?name=crane",
            Some("id") => "?id=c1",
            Some("at") => "?at=9999999999",
            _ => "",
        };
        // Other tests ask for what is no JSON.
        let Some(schema) = get.pointer("/responses/200/content/application~1json/schema") else {
            continue;
        };
        // Each section has a row as soon as the domain has been looked at.
        let mut view = Value::Null;
        until(path, || {
            view = answer(&format!("{path}{given}"));
            let sections = schema["properties"].as_object().unwrap();
            // There is no other host, all letters are delivered, and nothing is cancelled.
            let may_be_empty = |section: &str| matches!(section, "hosts" | "reasons" | "cancelled");
            let has_rows = |section: &str| {
                may_be_empty(section) || view[section].as_object().is_some_and(|it| !it.is_empty())
            };
            sections.keys().all(|section| has_rows(section))
        });
        let sections: Vec<&String> = view.as_object().unwrap().keys().collect();
        let described: Vec<&String> = schema["properties"].as_object().unwrap().keys().collect();
        assert_eq!(sections, described, "{path}");
        for (section, rows) in view.as_object().unwrap() {
            let section = &schema["properties"][section];
            let reference = section
                .pointer("/additionalProperties/$ref")
                .or(section.pointer("/properties/totals/$ref"));
            let reference = reference
                .unwrap()
                .as_str()
                .unwrap()
                .strip_prefix('#')
                .unwrap();
            let properties = description.pointer(reference).unwrap()["properties"]
                .as_object()
                .unwrap();
            for row in rows.as_object().unwrap().values() {
                for key in row.as_object().unwrap().keys() {
                    assert!(properties.contains_key(key), "{path}: {key} in {row}");
                }
            }
        }
    }
}

#[test]
fn pages_that_never_read_take_bounded_places() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let silent: Vec<Following> = (0..MAX_STREAMS).map(|_| shown.follow("letters")).collect();
    assert!(silent.iter().all(|it| it.status.contains(" 200 ")));
    assert!(shown.follow("fleet").status.contains(" 503 "));
    // Values are still answered.
    assert_eq!(shown.ask("GET", "/api/fleet", &shown.bearer(), "").0, 200);
    drop(silent);
    until("a place is free", || {
        shown.follow("fleet").status.contains(" 200 ")
    });
}

#[test]
fn the_gateway_ends_while_pages_follow_it() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let mut fleet = shown.follow("fleet");
    let _ = fleet.event("snapshot");
    let (code, log) = shown.gateway.signal("-INT");
    assert_eq!(code, Some(0), "{log}");
    let mut rest = String::new();
    // The stream ends, or the connection does.
    let _ = fleet.lines.read_to_string(&mut rest);
    assert_eq!(host.left_behind(), Vec::<std::path::PathBuf>::new());
}

#[test]
fn the_command_prints_the_link() {
    let host = Host::new();
    let (_, error) = host.run(&["dashboard"]).failed_text();
    assert!(error.contains("no gateway is running"), "{error}");
    let bare = host.start(&["up", "--json"]);
    let (_, error) = host.run(&["dashboard"]).failed_text();
    assert!(error.contains("http.listen"), "{error}");
    let _ = bare.signal("-INT");
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let link = format!("http://{}/#token={}", shown.address, shown.token);
    assert_eq!(host.run(&["dashboard"]).done(), format!("{link}\n"));
    let found = host.run(&["dashboard", "--json"]).done_json();
    assert_eq!(found["link"], link.as_str());
    assert_eq!(found["fingerprint"], Value::Null);
}

/// The rows that the page shows, as lines of text.
fn rows(browser: &Browser) -> Vec<String> {
    let rows =
        browser.value("[...document.querySelectorAll('tbody tr')].map((row) => row.innerText)");
    let rows = rows.as_array().unwrap().iter();
    rows.map(|row| row.as_str().unwrap().replace(['\n', '\t'], " "))
        .collect()
}

#[test]
fn the_page_shows_the_agents_that_run_and_those_that_have_ended() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let Some(browser) = shown.open(
        "the_page_shows_the_agents_that_run_and_those_that_have_ended",
        1280,
        800,
    ) else {
        return;
    };
    // The secret is not in the address any more.
    let address = browser.value("location.href");
    assert!(
        !address.as_str().unwrap().contains(&shown.token),
        "{address}"
    );
    assert_eq!(browser.value("document.cookie"), "");

    let crane = host.echo("crane");
    let _depot = host.echo("depot");
    let hostile = "<img/src=x/onerror=document.title='hacked'>";
    let _hostile = host.echo(hostile);
    for name in ["crane", "depot", hostile] {
        until(name, || {
            rows(&browser).iter().any(|row| row.starts_with(name))
        });
    }
    // Text stays text.
    assert_eq!(browser.value("document.querySelectorAll('img').length"), 0);
    until("a chart", || {
        browser.value("document.querySelectorAll('figure canvas').length") == 1
    });
    assert_ne!(browser.value("document.title"), "hacked");

    let _ = crane.signal("-KILL");
    until("the end of crane", || {
        rows(&browser)
            .iter()
            .any(|row| row.starts_with("crane ended"))
    });
    let alerts = browser.value("document.querySelector('.alerts').innerText");
    let alerts = alerts.as_str().unwrap();
    assert!(alerts.starts_with("crane on this host ended"), "{alerts}");
    assert!(
        rows(&browser)
            .iter()
            .any(|row| row.starts_with("depot") && !row.contains("ended"))
    );
    browser.assert_no_messages();

    // Markup from a script is impossible.
    let refused = "(() => { try { document.body.innerHTML = 'x'; return 'set'; } catch { return 'refused'; } })()";
    assert_eq!(browser.value(refused), "refused");
}

/// Sends a letter of a conversation from `rover`.
fn say(host: &Host, performative: &str, conversation: &str, to: &str) {
    let letter = [
        "send",
        "--from",
        "rover",
        "--to",
        to,
        "--performative",
        performative,
        "--protocol",
        "fipa-contract-net",
        "--conversation-id",
        conversation,
    ];
    host.run(&letter).done();
}

#[test]
fn a_violated_conversation_is_first_and_drawn_with_its_violation() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let name = "a_violated_conversation_is_first_and_drawn_with_its_violation";
    let Some(browser) = shown.open(name, 390, 844) else {
        return;
    };
    let _arm = host.ordered_agent("arm", &[]);
    browser.value("location.hash = '#/conversations'");
    browser.wait_for("no conversation");
    let (wrong, right) = ("<b>wrong</b>/1", "right");
    say(&host, "agree", wrong, "arm");
    say(&host, "cfp", right, "arm");
    until("both conversations", || rows(&browser).len() == 2);
    let found = rows(&browser);
    assert!(
        found[0].starts_with(wrong) && found[0].contains("1 violation"),
        "{found:?}"
    );
    assert!(
        found[1].starts_with(right) && !found[1].contains("violation"),
        "{found:?}"
    );
    browser.value("document.querySelector('tbody a').click()");
    browser.wait_for("fipa-contract-net");
    until("the arrow", || {
        browser.value("document.querySelectorAll('svg g.wrong').length") == 1
    });
    let drawn = browser.value("document.querySelector('svg').textContent");
    let drawn = drawn.as_str().unwrap();
    assert!(
        drawn.contains("rover") && drawn.contains("arm") && drawn.contains("agree"),
        "{drawn}"
    );
    // The state machine of the protocol, which the browser has loaded.
    until("the state machine", || {
        browser.value("document.querySelector('.machine img').naturalWidth > 100") == true
    });
    // The page fits a telephone: what is wider scrolls in its own box.
    assert_eq!(browser.value("document.documentElement.scrollWidth"), 390);
    browser.assert_no_messages();
}

#[test]
fn locks_have_their_holders_and_lost_hosts_stay_in_sight() {
    let (host, other) = (Host::new(), Host::new());
    let far = other.start(&["up", "--json", "--set", "mts.name=far"]);
    let peer = format!(
        "discovery.static={{ far = [\"tcp://{}\"] }}",
        far.tcp_address()
    );
    let shown = Shown::start(&host, "127.0.0.1:0", &[&peer, "mts.name=near"]);
    let name = "locks_have_their_holders_and_lost_hosts_stay_in_sight";
    let Some(browser) = shown.open(name, 1280, 800) else {
        return;
    };
    let _lidar = other.echo("lidar");
    browser.wait_for("lidar");
    browser.wait_for("connected for");
    let _ = far.signal("-KILL");
    browser.wait_for("LOST");
    until("the end of lidar", || {
        rows(&browser)
            .iter()
            .any(|row| row.starts_with("lidar ended"))
    });

    browser.value("location.hash = '#/locks'");
    browser.wait_for("no resource");
    let _owner = host.start(&["own", "bay"]);
    until("the resource", || {
        rows(&browser).iter().any(|row| row.starts_with("bay free"))
    });
    // Ends with its input, and so with this test.
    let mut holder = host.command(&["lock", "bay", "--", "cat"]);
    let _holder = ChildGuard::start(holder.stdin(Stdio::piped()).stdout(Stdio::null()));
    until("the holder", || {
        rows(&browser)
            .iter()
            .any(|row| row.starts_with("bay fipa-lock-"))
    });
    browser.assert_no_messages();
}

/// The SHA-256 of the certificate that a listener presents.
fn presented(address: SocketAddr) -> String {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = rustls::ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(AnyPeer))
        .with_no_client_auth();
    let name = "localhost".try_into().unwrap();
    let mut connection = rustls::ClientConnection::new(Arc::new(config), name).unwrap();
    let mut stream = TcpStream::connect(("localhost", address.port())).unwrap();
    connection.complete_io(&mut stream).unwrap();
    let certificate = &connection.peer_certificates().unwrap()[0];
    let digest = ring::digest::digest(&ring::digest::SHA256, certificate);
    digest
        .as_ref()
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

#[test]
fn other_hosts_reach_the_page_with_the_key_of_the_gateway_only() {
    let host = Host::new();
    let keys = host.path("keys");
    let keys_dir = keys.to_str().unwrap();
    host.run(&["keys", "init", "--dir", keys_dir]).done();
    let keys = format!("security.keys={keys_dir}");
    for listen in ["0.0.0.0:0", "[::]:0"] {
        let shown = Shown::start(&host, listen, &[&keys]);
        // Without TLS, there is no answer.
        let mut stream = shown.connect();
        let _ = write!(stream, "GET / HTTP/1.1\r\nHost: localhost\r\n\r\n");
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        assert!(!answer.starts_with(b"HTTP"), "{answer:?}");

        let link = host
            .run(&["dashboard", "--set", &keys, "--json"])
            .done_json();
        let own = host
            .run(&["keys", "list", "--dir", keys_dir, "--json"])
            .done_json();
        let fingerprint = own["own"]["fingerprint"].as_str().unwrap();
        assert_eq!(link["fingerprint"], fingerprint);
        let text = host.run(&["dashboard", "--set", &keys]).done();
        assert_eq!(presented(shown.address), fingerprint);
        let link = link["link"].as_str().unwrap();
        let expected = format!("{link}\nfingerprint of the certificate (SHA-256): {fingerprint}\n");
        assert_eq!(text, expected);
        assert!(link.starts_with("https://"), "{link}");
        let name = "other_hosts_reach_the_page_with_the_key_of_the_gateway_only";
        let Some(browser) = Browser::open(name, 1280, 800) else {
            return;
        };
        browser.go_to(link);
        browser.wait_for("this host");
        let cookie = browser.cookie();
        assert_eq!(
            (&cookie["secure"], &cookie["httpOnly"], &cookie["sameSite"]),
            (&true.into(), &true.into(), &"Strict".into())
        );
        browser.assert_no_messages();
        let _ = shown.gateway.signal("-INT");
    }
}

#[test]
fn a_page_asks_for_the_token_when_its_session_has_ended() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let Some(browser) = Browser::open(
        "a_page_asks_for_the_token_when_its_session_has_ended",
        1280,
        800,
    ) else {
        return;
    };
    browser.go_to(&format!("http://{}/", shown.address));
    browser.wait_for("fipa dashboard");
    let enter = |token: &str| {
        browser.value(&format!(
            "document.querySelector('input').value = '{token}'"
        ));
        browser.value("document.querySelector('form').requestSubmit()");
    };
    enter("0123456789abcdef");
    browser.wait_for("this is not the token");
    enter(&shown.token);
    browser.wait_for("this host");
}

#[test]
fn clients_send_messages_only_with_control_and_as_an_agent_of_the_host() {
    let (host, quiet) = (Host::new(), Host::new());
    let seeing = Shown::start(&quiet, "127.0.0.1:0", &[]);
    let headers = seeing.bearer() + &seeing.of_page();
    let order = r#"{"to": "crane", "performative": "inform", "content": "hello"}"#;
    assert_eq!(seeing.ask("POST", "/api/send", &headers, order).0, 403);

    let shown = Shown::start(
        &host,
        "127.0.0.1:0",
        &["http.control=true", "mts.name=rover"],
    );
    let mut crane = host.start(&["listen", "crane", "--json"]);
    let mut fleet = shown.follow("fleet");
    let _ = fleet.event("snapshot");
    fleet.change("agents", "dashboard@rover", |row| row["here"] == true);
    let headers = shown.bearer() + &shown.of_page();
    // Without the proof of the page, or of the client.
    assert_eq!(
        shown.ask("POST", "/api/send", &shown.bearer(), order).0,
        403
    );
    assert_eq!(
        shown.ask("POST", "/api/send", &shown.of_page(), order).0,
        401
    );
    for wrong in [
        "",
        "{}",
        r#"{"to": "crane", "performative": "dance now"}"#,
        r#"{"to": "crane", "performative": "inform", "sender": "other"}"#,
    ] {
        assert_eq!(
            shown.ask("POST", "/api/send", &headers, wrong).0,
            400,
            "{wrong}"
        );
    }
    let (status, _, body) = shown.ask("POST", "/api/send", &headers, order);
    assert_eq!(status, 200, "{body}");
    assert!(body.contains("delivered"), "{body}");
    let received: Value = serde_json::from_str(&crane.line()).unwrap();
    assert_eq!(
        received["message"]["sender"]["name"], "dashboard@rover",
        "{received:#}"
    );
    assert_eq!(received["message"]["content"], "hello");

    let name = "clients_send_messages_only_with_control_and_as_an_agent_of_the_host";
    let Some(browser) = shown.open(name, 390, 844) else {
        return;
    };
    browser.value("location.hash = '#/agent/crane'");
    until("the form", || {
        browser.value("document.querySelector('main details')?.hidden") == false
    });
    browser.value(
        "(() => { document.querySelector('details').open = true; \
                   document.querySelector('textarea').value = 'from the page'; \
                   document.querySelector('form').requestSubmit(); })()",
    );
    browser.wait_for("crane: delivered");
    let received: Value = serde_json::from_str(&crane.line()).unwrap();
    assert_eq!(received["message"]["content"], "from the page");
    browser.assert_no_messages();
}

#[test]
fn another_agent_with_the_name_of_the_page_ends_no_observation() {
    let host = Host::new();
    let namesake = host.echo("dashboard@base");
    let shown = Shown::start(
        &host,
        "127.0.0.1:0",
        &["http.control=true", "mts.name=base"],
    );
    let mut fleet = shown.follow("fleet");
    let _ = fleet.event("snapshot");
    fleet.change("agents", "dashboard@base", |row| {
        row["here"] == true && row["type"] != "fipa-dashboard"
    });
    // The page takes the name as soon as it is free.
    let ended = namesake.signal("-INT");
    assert_eq!(ended.0, Some(0), "{ended:?}");
    fleet.change("agents", "dashboard@base", |row| {
        row["ended"].is_null() && row["type"] == "fipa-dashboard"
    });
}

/// The configuration of a process of this host.
fn config_of(host: &Host) -> fipa::Config {
    let mut config = fipa::Config::for_host("test");
    config.domain.clone_from(&host.domain);
    config.runtime_dir = host.path("run").to_str().unwrap().to_owned();
    config.discovery.mdns = false;
    config
}

/// Time of the soak in minutes, unless `FIPA_SOAK` has another number.
const SOAK: u64 = 10;

/// Number of agents of the soak.
const AGENTS: usize = 1000;

/// Letters in 10 ms of the soak.
const LETTERS: usize = 20;

/// The processor time of a process, in seconds.
fn processor_time(pid: u32) -> f64 {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
    let (_, fields) = stat.rsplit_once(')').unwrap();
    let fields: Vec<&str> = fields.split_whitespace().collect();
    let ticks: u64 = fields[11].parse::<u64>().unwrap() + fields[12].parse::<u64>().unwrap();
    ticks as f64 / rustix::param::clock_ticks_per_second() as f64
}

/// The memory of the page's scripts in bytes, after what is not used any more is gone.
fn heap(browser: &Browser) -> f64 {
    browser.chromium("HeapProfiler.collectGarbage");
    browser
        .value("performance.memory.usedJSHeapSize")
        .as_f64()
        .unwrap()
}

#[test]
#[ignore = "takes eleven minutes; see CONTRIBUTING"]
fn soak() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let config = config_of(&host);
    let domain = runtime.block_on(fipa::Domain::open(&config)).unwrap();
    let mut agents = Vec::new();
    for number in 0..AGENTS {
        agents.push(
            runtime
                .block_on(domain.register(&format!("agent_{number:04}")))
                .unwrap(),
        );
    }
    let agents: Arc<[fipa::Agent]> = agents.into();
    for number in 0..AGENTS {
        let agents = Arc::clone(&agents);
        runtime.spawn(async move { while agents[number].receive().await.is_ok() {} });
    }
    let sending = Arc::clone(&agents);
    runtime.spawn(async move {
        let mut random = fastrand::Rng::with_seed(44);
        let mut ticks = tokio::time::interval(Duration::from_millis(10));
        loop {
            ticks.tick().await;
            for _ in 0..LETTERS {
                let to =
                    fipa::AgentId::new(format!("agent_{:04}", random.usize(..AGENTS))).unwrap();
                let from = &sending[random.usize(..AGENTS)];
                let message = from
                    .message(fipa::Performative::Inform)
                    .receiver(to)
                    .conversation_id(format!("c{}", random.usize(..500)))
                    .content("1.0 2.0 3.0");
                // Sends at once; the outcome is of no interest.
                drop(from.send(message));
            }
        }
    });
    println!("http://{}/#token={}", shown.address, shown.token);
    let browser = shown.open("soak", 1280, 800).unwrap();
    // The browser lays out only rows in sight: the others are no text that the page shows.
    until("all agents", || {
        browser.value("document.body.textContent.includes('agent_0999')") == true
    });
    browser.value(
        "(() => { window.long = []; new PerformanceObserver((list) => \
         list.getEntries().forEach((entry) => window.long.push(entry.duration))).observe({ type: 'longtask' }); })()",
    );
    let pid = shown.gateway.pid();
    let (started, before) = (std::time::Instant::now(), processor_time(pid));
    let mut first = None;
    let minutes = std::env::var("FIPA_SOAK").map_or(SOAK, |minutes| minutes.parse().unwrap());
    for minute in 1..=minutes {
        std::thread::sleep(Duration::from_secs(60));
        let heap = heap(&browser);
        let first = *first.get_or_insert(heap);
        let long = browser.value("Math.max(0, ...window.long)");
        let load = (processor_time(pid) - before) / started.elapsed().as_secs_f64();
        println!(
            "minute {minute}: {:.0} % of a core, heap {:.1} MB ({:.2} of the first), longest task {long} ms, {}",
            100.0 * load,
            heap / 1e6,
            heap / first,
            browser.value("document.querySelector('.totals').innerText.replaceAll('\\n', ' ')"),
        );
    }
    browser.assert_no_messages();
}
