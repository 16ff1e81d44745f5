//! The listener under requests that no browser sends.

use std::net::Shutdown;

use fipa_testbed::hostile_requests;

use super::*;

/// Sends bytes, and nothing after them. Returns the answer as text.
fn answer(shown: &Shown, bytes: &[u8]) -> String {
    let mut stream = shown.connect();
    // The gateway closes the connection before it has read all.
    let _ = stream.write_all(bytes);
    let _ = stream.shutdown(Shutdown::Write);
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    String::from_utf8_lossy(&answer).into_owned()
}

#[test]
fn malformed_and_ambiguous_requests_are_refused_with_and_without_a_session() {
    let host = Host::new();
    let shown = Shown::start(
        &host,
        "127.0.0.1:0",
        &["http.control=true", "mts.name=base"],
    );
    let mut crane = host.start(&["listen", "crane", "--json"]);
    let own = format!("Host: {}\r\n", shown.address);
    let session = own.clone() + &shown.session() + &shown.of_page();
    let order = r#"{"to": "crane", "performative": "inform", "content": "hidden"}"#;
    let hidden = |fields: &str| {
        let length = order.len();
        format!("POST /api/send HTTP/1.1\r\n{fields}Content-Length: {length}\r\n\r\n{order}")
    };
    for fields in [&session, &own] {
        for (method, path) in [
            ("POST", "/api/send"),
            ("POST", "/api/session"),
            ("GET", "/api/x"),
        ] {
            for (name, request) in hostile_requests(method, path, fields, &hidden(&session)) {
                let found = answer(&shown, &request);
                let case = format!("{method} {path}, {name}");
                let is_refused = found.starts_with("HTTP/1.1 4") || found.is_empty();
                assert!(is_refused, "{case}: {found}");
                assert!(found.matches("HTTP/").count() <= 1, "{case}: {found}");
                assert!(!found.contains(&shown.token), "{case}");
            }
        }
    }
    // A second request on a connection is not read.
    let two = format!("GET /healthz HTTP/1.1\r\n{session}\r\n{}", hidden(&session));
    let found = answer(&shown, two.as_bytes());
    assert!(found.starts_with("HTTP/1.1 200 "), "{found}");
    assert!(found.to_ascii_lowercase().contains("connection: close"));
    assert_eq!(found.matches("HTTP/").count(), 1, "{found}");
    // No hidden order has been executed, and the gateway still executes a plain one.
    let plain = hidden(&session).replace("\"hidden\"", "\"hello!\"");
    let found = answer(&shown, plain.as_bytes());
    assert!(found.starts_with("HTTP/1.1 200 "), "{found}");
    let received: Value = serde_json::from_str(&crane.line()).unwrap();
    assert_eq!(received["message"]["content"], "hello!");
}

/// Writes these bytes again and again until the gateway closes the connection.
fn write_until_closed(stream: &mut TcpStream, bytes: &[u8], pause: Duration) -> usize {
    let mut written = 0;
    while stream.write_all(bytes).is_ok() {
        written += bytes.len();
        std::thread::sleep(pause);
    }
    written
}

#[test]
fn slow_and_endless_requests_end_and_keep_no_client_out() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let own = format!("Host: {}\r\n", shown.address);
    let proof = own.clone() + &shown.bearer() + &shown.of_page();
    // More connections than the gateway keeps, with half a head each.
    let half: Vec<TcpStream> = (0..64)
        .map(|_| {
            let mut stream = shown.connect();
            write!(stream, "GET /healthz HTTP/1.1\r\n{own}").unwrap();
            stream
        })
        .collect();
    assert_eq!(shown.ask("GET", "/healthz", &shown.bearer(), "").0, 200);
    drop(half);
    std::thread::scope(|scope| {
        let pause = Duration::from_millis(100);
        for beginning in [
            // A head whose end never comes, byte by byte.
            format!("GET /healthz HTTP/1.1\r\n{proof}X: "),
            // A body of which a byte comes now and then, with and without a proof.
            format!("POST /api/send HTTP/1.1\r\n{proof}Content-Length: 60000\r\n\r\n"),
            format!("POST /api/session HTTP/1.1\r\n{own}Content-Length: 4000\r\n\r\n"),
        ] {
            let mut slow = shown.connect();
            scope.spawn(move || {
                slow.write_all(beginning.as_bytes()).unwrap();
                write_until_closed(&mut slow, b"a", pause);
            });
        }
        // A body without an end, as fast as it goes.
        for fields in [&proof, &own] {
            let mut fast = shown.connect();
            let head =
                format!("POST /api/send HTTP/1.1\r\n{fields}Transfer-Encoding: chunked\r\n\r\n");
            fast.write_all(head.as_bytes()).unwrap();
            let chunk = format!("1000\r\n{}\r\n", "a".repeat(0x1000));
            // The buffers of the system hold the bytes that the gateway does not read.
            let written = write_until_closed(&mut fast, chunk.as_bytes(), Duration::ZERO);
            assert!(written < 64 << 20, "{written} bytes were taken");
        }
        assert_eq!(shown.ask("GET", "/healthz", &shown.bearer(), "").0, 200);
    });
    assert_eq!(shown.ask("GET", "/healthz", &shown.bearer(), "").0, 200);
}
