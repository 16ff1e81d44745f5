//! Requests over HTTP that a server must not take.

/// Returns malformed and ambiguous requests by their names. `method`, `path` and `fields`, each with its line break, are
/// those of a request that the server would take with a body. Ambiguous requests have `hidden` behind them, which is a
/// whole request: a server that differs from a proxy in front of it about the length of the first one would take it.
#[must_use]
pub fn hostile_requests(
    method: &str,
    path: &str,
    fields: &str,
    hidden: &str,
) -> Vec<(String, Vec<u8>)> {
    let head = format!("{method} {path} HTTP/1.1\r\n{fields}");
    let mut all = vec![
        (
            "a handshake of TLS".to_owned(),
            b"\x16\x03\x01\x02\0\x01\0\x01\xfc\x03\x03\r\n\r\n".to_vec(),
        ),
        (
            "the preface of HTTP/2".to_owned(),
            b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec(),
        ),
        ("bytes".to_owned(), (0..=255).cycle().take(10_000).collect()),
    ];
    let mut add = |name: String, text: String| all.push((name, text.into_bytes()));
    let line = |line: &str| format!("{line}\r\n{fields}Content-Length: 0\r\n\r\n");
    for wrong in [
        format!("{method} {path} HTTP/3.7"),
        format!("{method} {path}"),
        format!("{method} {path} HTTP/1.1 {path}"),
        format!("{method} {path}\0 HTTP/1.1"),
        format!("{method}\t{path}\tHTTP/1.1"),
        format!("{path} {method} HTTP/1.1"),
        "HTTP/1.1 200 OK".to_owned(),
    ] {
        add(format!("the line {wrong:?}"), line(&wrong));
    }
    for wrong in [
        "X",
        "X : 1",
        "X\0: 1",
        "X: 1\0",
        ": 1",
        "X\u{7f}: 1",
        "X Y: 1",
    ] {
        let text = format!("{head}{wrong}\r\nContent-Length: 0\r\n\r\n");
        add(format!("the field {wrong:?}"), text);
    }
    for length in [
        "+5",
        "-1",
        "0x5",
        "5 5",
        "",
        "5,6",
        "five",
        "18446744073709551616",
    ] {
        let text = format!("{head}Content-Length: {length}\r\n\r\n12345{hidden}");
        add(format!("the length {length:?}"), text);
    }
    let two = format!("{head}Content-Length: 0\r\nContent-Length: 5\r\n\r\n{hidden}");
    add("two lengths".to_owned(), two);
    for coding in [
        "chunked",
        "identity, chunked",
        "chunked, identity",
        "\tchunked",
        "gzip",
        "xchunked",
    ] {
        let length = hidden.len() + 5;
        let text = format!(
            "{head}Content-Length: {length}\r\nTransfer-Encoding: {coding}\r\n\r\n0\r\n\r\n{hidden}"
        );
        add(format!("a length and the coding {coding:?}"), text);
    }
    for chunk in ["zz", "fffffffffffffffff", "-1", "0x0", "5 5", ""] {
        let text = format!("{head}Transfer-Encoding: chunked\r\n\r\n{chunk}\r\n12345\r\n{hidden}");
        add(format!("a chunk of the length {chunk:?}"), text);
    }
    let shorter = format!("{head}Content-Length: 1000\r\n\r\n12345");
    add("a body that ends too early".to_owned(), shorter);
    let long = "a".repeat(1 << 20);
    add(
        "a long line".to_owned(),
        line(&format!("{method} {path}{long} HTTP/1.1")),
    );
    add(
        "a long field".to_owned(),
        format!("{head}X: {long}\r\n\r\n"),
    );
    add(
        "many fields".to_owned(),
        format!(
            "{head}{}Content-Length: 0\r\n\r\n",
            "a: b\r\n".repeat(100_000)
        ),
    );
    all
}
