//! Messages that are split around their content.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use bytes::Bytes;
use fipa_acl::{
    BuildError, Dialect, EncodeError, Message, MessageBuilder, Payload, Performative, Problem,
    Representation, explain,
};

fn message() -> Message {
    Message::builder(Performative::Inform)
        .content("four")
        .language("plain")
        .user_defined("k", "v")
        .build()
        .unwrap()
}

fn problem(payload: &Payload) -> Problem {
    Message::decode(payload).unwrap_err().problem().clone()
}

#[test]
fn the_content_is_shared_in_both_directions() {
    let message = message();
    let payload = message.to_payload();
    let sent = message.content().unwrap().as_ptr();
    assert_eq!(payload.content.as_ptr(), sent);
    let received = Message::decode(&payload).unwrap();
    assert_eq!(received, message);
    assert_eq!(received.content().unwrap().as_ptr(), sent);
}

#[test]
fn empty_content_is_present() {
    let message = Message::builder(Performative::Inform)
        .content("")
        .build()
        .unwrap();
    let payload = message.to_payload();
    assert!(payload.is_split());
    assert_eq!(
        Message::decode(&payload).unwrap().content(),
        Some(&Bytes::new())
    );
}

#[test]
fn parameters_behind_the_content_are_read() {
    let mut payload = message().to_payload();
    payload.tail = Bytes::from_static(b"\x0d\x10c1\0\x00\x10X-l\0\x10w\0\x01");
    let read = Message::decode(&payload).unwrap();
    assert_eq!(read.conversation_id(), Some("c1"));
    let pair = |name: &str, value: &str| (name.to_owned(), value.to_owned());
    assert_eq!(read.user_defined(), [pair("k", "v"), pair("l", "w")]);
    assert_eq!(read.content().unwrap(), "four");
}

#[test]
fn pieces_that_do_not_match_are_refused() {
    let whole = message().to_payload();
    let longer = Payload {
        content: Bytes::from_static(b"fours"),
        ..whole.clone()
    };
    assert!(matches!(problem(&longer), Problem::Split(_)));
    let shorter = Payload {
        content: Bytes::from_static(b"fou"),
        ..whole.clone()
    };
    assert!(matches!(problem(&shorter), Problem::Split(_)));

    let no_tail = Payload {
        tail: Bytes::new(),
        ..whole.clone()
    };
    assert!(matches!(problem(&no_tail), Problem::Truncated(_)));
    let long_tail = Payload {
        tail: Bytes::from_static(b"\x01\x01"),
        ..whole.clone()
    };
    assert_eq!(problem(&long_tail), Problem::Trailing(1));
    let more = Payload {
        tail: Bytes::from_static(b"\x04\x16\x01x\x01"),
        ..whole.clone()
    };
    assert!(matches!(problem(&more), Problem::Split(_)));

    let complete = Payload {
        head: whole.to_bytes(),
        ..whole.clone()
    };
    assert!(matches!(problem(&complete), Problem::Split(_)));
    let headless = Payload {
        head: whole.head.slice(..3),
        ..whole.clone()
    };
    assert!(matches!(problem(&headless), Problem::Truncated(_)));
    // The head must end with the length.
    let mut beyond = whole.head.to_vec();
    beyond.extend_from_slice(b"\x02\x02");
    let beyond = Payload {
        head: beyond.into(),
        ..whole
    };
    assert!(Message::decode(&beyond).is_err());
}

#[test]
fn errors_name_other_encodings_and_code_tables() {
    let of = |bytes: &'static [u8]| problem(&Payload::from(Bytes::from_static(bytes)));
    assert_eq!(of(b"\xfb\x10\x08\x01"), Problem::CodeTable);
    assert_eq!(of(b"\xfa\x10\x08\x05\x11\x00\x01"), Problem::CodeTable);
    for text in [&b"(inform)"[..], b"<fipa-message/>"] {
        let error = explain(text).error.unwrap();
        let unsupported = matches!(error.problem(), Problem::UnsupportedRepresentation(_));
        assert!(
            unsupported,
            "{error}: only the bit-efficient one is explained"
        );
    }
    assert_eq!(of(b"hello"), Problem::UnknownRepresentation);
    assert_eq!(of(b"\xfa\x10\x08\x01\n"), Problem::Trailing(1));
}

/// FIPA00069 has lengths of 32 bits. The content is never accessed, so its memory is only reserved.
#[test]
fn content_of_the_maximum_length_is_encoded_and_decoded() {
    let longest = u32::MAX as usize;
    let date = "20000508T042651481".parse().unwrap();
    let letter = message().to_letter_around(longest, date).unwrap();
    let Payload { head, tail, .. } = letter.into_payload();
    assert!(head.ends_with(b"\x04\x19\xff\xff\xff\xff"));
    assert_eq!(&tail[..], b"\x01");
    let too_long = message().to_letter_around(longest + 1, date);
    assert_eq!(too_long, Err(EncodeError::ContentTooLong(longest + 1)));

    // The kernel reserves more memory than is available, but not much more.
    let memory = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let free = memory.lines().find_map(|line| {
        let kilobytes = line.strip_prefix("MemAvailable:")?.strip_suffix("kB")?;
        kilobytes.trim().parse::<u64>().ok()
    });
    if free.is_none_or(|kilobytes| kilobytes < 5 << 20) {
        println!("skipped: less than 5 GiB of memory are available");
        assert_ne!(std::env::var("CI").as_deref(), Ok("true"));
        return;
    }
    let sent = MessageBuilder::from(message())
        .content(Bytes::from(vec![0; longest]))
        .build()
        .unwrap();
    let payload = sent.to_payload();
    assert_eq!(payload.len(), head.len() + longest + 1);
    for dialect in [Dialect::Standard, Dialect::FipaServices] {
        let len = sent.encoded_len(Representation::String, dialect).unwrap();
        assert!(len > longest);
    }
    let read = Message::decode(&payload).unwrap();
    let content = read.content().unwrap();
    assert_eq!(content.len(), longest);
    assert_eq!(content.as_ptr(), payload.content.as_ptr());
    let beyond = MessageBuilder::from(message()).content(Bytes::from(vec![0; longest + 1]));
    assert_eq!(beyond.build(), Err(BuildError::ContentTooLong(longest + 1)));
}
