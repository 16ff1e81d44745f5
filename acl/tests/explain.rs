//! Explanations of encoded bytes.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use fipa_acl::{Explanation, Problem, explain};

/// Formats one line for each span: its offset, its length and its meaning.
fn lines_of(bytes: &[u8]) -> String {
    let explanation = explain(bytes);
    let mut out = String::new();
    let mut end = 0;
    for span in &explanation.spans {
        assert_eq!(span.offset, end, "no gaps");
        end += span.len;
        let indent = "  ".repeat(span.depth);
        writeln!(out, "{}+{} {indent}{}", span.offset, span.len, span.meaning).unwrap();
    }
    match explanation.error {
        None => assert_eq!(end, bytes.len()),
        Some(error) => {
            assert_eq!(end, error.offset());
            writeln!(out, "{error}").unwrap();
        }
    }
    out
}

#[test]
fn the_worked_examples_of_messages_are_explained() {
    let smallest = b"\xfa\x10\x08\x01";
    assert_eq!(
        lines_of(smallest),
        include_str!("explained/e0_smallest.txt")
    );
    let request = b"\xfa\x10\x13\
        \x02\x02\x10a@p\0\x01\
        \x03\x02\x10b@q\0\x01\x01\
        \x04\x14\"(x)\"\0\
        \x0c\x10fipa-request\0\
        \x0d\x10c1\0\
        \x01";
    assert_eq!(lines_of(request), include_str!("explained/e1_request.txt"));
    let inform = b"\xfa\x10\x08\
        \x02\x02\x10alice@p1\0\
        \x02\x10http://h1:7778/acc\0\x01\
        \x03\x02\x10ams@p1\0\x01\x01\
        \x01\
        \x03\x02\x10bob@p2\0\x01\x01\
        \x04\x16\x03\x00\x01\xff\
        \x06\x24\x31\x11\x16\x19\x15\x37\x62\x59\x20\x5a\
        \x07\x10m7\0\
        \x09\x10fipa-sl\0\
        \x01";
    assert_eq!(lines_of(inform), include_str!("explained/e2_inform.txt"));
    let user_defined = b"\xfa\x10\x00\x10ping\0\
        \x05\x70seq\0\x12\x53\0\x12\xe2\xf6\0\x14\"a\"\0\x40\
        \x06\x21\x11\x11\x11\x11\x11\x11\x41\x11\x10\
        \x00\x10X-prio\0\x12\x80\
        \x01";
    assert_eq!(
        lines_of(user_defined),
        include_str!("explained/e3_user_defined.txt")
    );
}

#[test]
fn the_worked_examples_of_envelopes_are_explained() {
    let envelope = b"\xfe\x00\x8a\x12\
        \x20\x31\x11\x16\x19\x15\x37\x62\x59\x20\
        \x02\x02receiver@foo.com\0\x02http://foo.com/acc\0\x01\x01\x01\
        \x03\x02sender@bar.com\0\x02http://bar.com/acc\0\x01\x01\
        \x0ahttp://foo.com/acc\0\x20\x31\x11\x16\x19\x15\x37\x62\x59\x20\x03123456789\0\x01\
        \x01";
    assert_eq!(lines_of(envelope), include_str!("explained/envelope.txt"));
    let stamped = b"\xfd\x00\x1dhttp://q/acc\0\x24\x31\x35\x12\x42\x34\x6a\x6a\x11\x90\x5a\x01\x01\
        \xfe\x00\x38\x10\x24\x31\x35\x12\x42\x34\x6a\x6a\x11\x80\x5a\
        \x02\x02b@q\0\x02http://q/acc\0\x01\x01\x01\
        \x03\x02a@p\0\x01\
        \x06\x50\
        \x09\x02b@q\0\x01\x01\
        \x01\
        \xfa\x10\x08\x01";
    assert_eq!(lines_of(stamped), include_str!("explained/stamped.txt"));
}

#[test]
fn a_letter_of_fipa_services_is_explained() {
    let letter = recorded("tcp_letter.bin");
    assert_eq!(lines_of(&letter), include_str!("explained/tcp_letter.txt"));
}

#[test]
fn the_deviations_of_jade_are_explained() {
    let lines = lines_of(b"\xfa\x10\x08\x04\x14hi there\0\x00\x10X-a\0\0\x01");
    assert!(
        lines.contains("3+11 content, 8 bytes, a string: 'hi there'\n"),
        "{lines}"
    );
    assert!(
        lines.contains("20+1 user-defined value: none, as JADE writes it\n"),
        "{lines}"
    );
    let date = b"\x20\x31\x11\x16\x19\x15\x37\x62\x59\x20";
    let bytes = [
        b"\xfd\x00\x14\x0ajade\0",
        &date[..],
        b"\x01\x01",
        b"\xfe\x00\x10\x10",
        date,
        b"\x00X-k v w\0\x03\x02a\0\x04X-p\0q\0\x01\x01",
    ];
    let lines = lines_of(&bytes.concat());
    for meaning in [
        "3+1   the code of a stamp, as JADE writes it\n",
        "4+5   received: by 'jade'\n",
        "user-defined parameter 'k': 'v w', in one string as JADE writes it\n",
        "    user-defined parameter 'p': 'q'\n",
    ] {
        assert!(lines.contains(meaning), "{meaning}{lines}");
    }
}

#[test]
fn every_recorded_message_and_letter_is_explained() {
    let mut explained = 0;
    for entry in fs::read_dir(vectors()).unwrap() {
        let path = entry.unwrap().path();
        if path
            .extension()
            .is_some_and(|ext| ext == "be" || ext == "bin")
        {
            let explanation = explain(&fs::read(&path).unwrap());
            assert_eq!(explanation.error, None, "{}", path.display());
            assert!(explanation.spans.len() > 3, "{}", path.display());
            explained += 1;
        }
    }
    assert!(explained >= 50, "only {explained} found");
}

#[test]
fn a_payload_that_is_not_bit_efficient_is_one_span() {
    let letter = recorded("e02_payload_string.be");
    let payload = explain(&letter).spans.pop().unwrap();
    let start = "payload: a message in the string representation: '(inform";
    assert!(payload.meaning.starts_with(start), "{payload:?}");
    // The envelope of this recording ends where its message begins.
    let mut letter = recorded("tcp_letter.bin");
    letter.truncate(242);
    assert_eq!(
        lines_of(&letter).lines().last(),
        Some("241+1 end of base envelope")
    );
    letter.extend_from_slice(b"\x80\xff");
    let payload = "242+2 payload in an unknown representation: bytes that are not UTF-8";
    assert_eq!(lines_of(&letter).lines().last(), Some(payload));
}

#[test]
fn malformed_bytes_are_explained_up_to_the_error() {
    let lines = lines_of(b"\xfa\x10\x08\x02\x02\x10a\0\x03\x05\x01");
    let end = "3+1 sender\n\
        4+4   agent identifier: name 'a'\n\
        8+1     resolvers\n\
        at byte 9: found byte 0x05, expected an agent identifier (FIPA00069 2.2 AgentIdentifier)\n";
    assert!(lines.ends_with(end), "{lines}");
    let lines = lines_of(b"\xfa\x10\x08\x0d\x10ab\xff\0\x01");
    let end = "3+4 incomplete, ended by the error\n\
        at byte 7: the conversation-id is not UTF-8 (FIPA00069 2.2 BinExpression)\n";
    assert!(lines.ends_with(end), "{lines}");
    assert!(lines_of(b"").starts_with("at byte 0: the bytes end within a message"));
    assert!(lines_of(b"(inform)").starts_with("at byte 0: the string representation"));
    assert!(
        lines_of(b"\xfb\x10\x08\x01")
            .starts_with("at byte 0: the message uses a dynamic code table")
    );

    // Behind an envelope, offsets are relative to the letter.
    let mut letter = recorded("tcp_letter.bin");
    letter.pop();
    let error = explain(&letter).error.unwrap();
    assert_eq!(error.offset(), letter.len());
    assert!(matches!(error.problem(), Problem::Truncated(_)));
}

#[test]
fn the_number_of_spans_is_bounded() {
    let bytes = [
        b"\xfa\x10\x08\x03".to_vec(),
        b"\x02\x10a\0\x01".repeat(Explanation::MAX_SPANS),
        b"\x01\x01".to_vec(),
    ];
    let bytes = bytes.concat();
    let explanation = explain(&bytes);
    assert_eq!(explanation.error, None);
    assert_eq!(explanation.spans.len(), Explanation::MAX_SPANS);
    let last = explanation.spans.last().unwrap();
    assert_eq!(last.offset + last.len, bytes.len());
    assert_eq!(last.meaning, "the remaining bytes, not explained");
}

fn recorded(name: &str) -> Vec<u8> {
    fs::read(vectors().join(name)).unwrap()
}

fn vectors() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/vectors")
}
