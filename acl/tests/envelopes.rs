//! Envelopes of peers that deviate from the standard, and envelopes that cannot be encoded.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use bytes::Bytes;
use fipa_acl::{
    AclRepresentation, AgentId, Dialect, EncodeError, Envelope, EnvelopeParams, EnvelopeTemplate,
    EnvelopeView, Letter, Message, Performative, Problem, Received, Representation, Time,
};

const DATE: &[u8] = b"\x20\x31\x11\x16\x19\x15\x37\x62\x59\x20";

fn date() -> Time {
    "20000508T042651481".parse().unwrap()
}

fn agent(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

fn base() -> EnvelopeParams {
    EnvelopeParams {
        acl_representation: Some(AclRepresentation::BitEfficient),
        date: Some(date()),
        ..EnvelopeParams::default()
    }
}

fn stamp(by: &str) -> EnvelopeParams {
    EnvelopeParams {
        received: Some(Received::new(by, date())),
        ..EnvelopeParams::default()
    }
}

/// A base envelope with these encoded parameters and a wrong length.
fn encoded_base(parameters: &[u8]) -> Vec<u8> {
    [b"\xfe\x00\x10\x10", DATE, parameters, b"\x01"].concat()
}

fn encoded_extension(stamp: &[u8], parameters: &[u8]) -> Vec<u8> {
    [b"\xfd\x00\x01", stamp, DATE, b"\x01", parameters, b"\x01"].concat()
}

#[test]
fn the_code_in_front_of_a_stamp_of_jade_is_accepted() {
    let bytes = [encoded_extension(b"\x0ajade\0", b""), encoded_base(b"")].concat();
    let (envelope, _) = Envelope::decode(&bytes).unwrap();
    assert_eq!(envelope.extensions, [stamp("jade")]);
    // A stamp that begins with that byte is the same after a round trip.
    let envelope = Envelope {
        base: base(),
        extensions: vec![stamp("\njade")],
    };
    let bytes = envelope.encode_standard().unwrap();
    assert_eq!(Envelope::decode(&bytes).unwrap().0, envelope);
}

/// Returns an XML envelope with this declaration, whose receiver has this name.
fn xml(declaration: &str, name: &[u8]) -> Vec<u8> {
    let start = format!("{declaration}<envelope><params index=\"1\"><to><agent-identifier><name>");
    let end =
        "</name></agent-identifier></to><date>20261120T112644275+0000</date></params></envelope>";
    [start.as_bytes(), name, end.as_bytes()].concat()
}

#[test]
fn a_date_with_a_numeric_zone_is_read() {
    let bytes = xml("", b"rover");
    let expected = Some("20261120T112644275Z".parse().unwrap());
    assert_eq!(Envelope::decode(&bytes).unwrap().0.base.date, expected);
    let view = EnvelopeView::parse(&bytes).unwrap();
    assert_eq!(view.len(), bytes.len());
}

#[test]
fn the_declared_encoding_of_an_xml_envelope_is_honored() {
    const LATIN: &str = "<?xml version=\"1.0\" encoding=\"ISO-8859-1\"?>";
    const UTF_8: &str = "<?xml version=\"1.0\" encoding=\"UTF-8\"?>";
    const WINDOWS: &str = "<?xml version=\"1.0\" encoding=\"windows-1252\"?>";
    const NONE: &str = "<?xml version=\"1.0\"?>";
    for (declaration, name, expected) in [
        (LATIN, &b"\xf6dd"[..], Some("ödd")),
        (LATIN, "ödd".as_bytes(), Some("Ã¶dd")),
        (UTF_8, "ödd".as_bytes(), Some("ödd")),
        (NONE, "ödd".as_bytes(), Some("ödd")),
        (NONE, b"&#xF6;dd", Some("ödd")),
        (WINDOWS, b"&#xF6;dd", Some("ödd")),
        // XML 1.0 clause 4.3.3 has these as errors.
        (NONE, b"\xf6dd", None),
        (UTF_8, b"\xf6dd", None),
        (WINDOWS, b"\xf6dd", None),
        (WINDOWS, "ödd".as_bytes(), None),
    ] {
        let envelope = xml(declaration, name);
        let payload = b"p\xf6";
        let bytes = [&envelope[..], payload].concat();
        let read = Envelope::decode(&bytes).ok();
        let expected = expected.map(|name| (name, envelope.len()));
        let found = read.as_ref().map(|(it, len)| (it.base.to[0].name(), *len));
        assert_eq!(found, expected, "{declaration} {name:?}");
        if expected.is_some() {
            let (_, letter) = Letter::decode(bytes.into()).unwrap();
            assert_eq!(letter.payload().to_bytes(), &payload[..]);
            assert_eq!(letter.parse_envelope().ok(), read.map(|(it, _)| it));
        }
    }
}

#[test]
fn an_envelope_that_jade_wrote_with_an_umlaut_is_refused() {
    // It is in ISO-8859-1 and does not declare that.
    let bytes = include_bytes!("vectors/jade_umlaut.envelope.xml");
    let refused = Envelope::decode(bytes).unwrap_err();
    assert!(
        matches!(refused.problem(), Problem::NotUtf8(_)),
        "{refused}"
    );
}

/// JADE takes each byte of an envelope for a character, but resolves references.
#[test]
fn an_xml_envelope_for_jade_is_ascii() {
    let stamp = Received::new("mts@日本", date());
    let envelope = Envelope {
        base: EnvelopeParams {
            to: vec![agent("ödd & 日本 😀")],
            comments: Some("é".into()),
            received: Some(stamp),
            ..base()
        },
        extensions: Vec::new(),
    };
    for dialect in [Dialect::Standard, Dialect::FipaServices, Dialect::Jade] {
        let bytes = envelope.encode(Representation::Xml, dialect).unwrap();
        assert_eq!(bytes.is_ascii(), dialect == Dialect::Jade, "{dialect}");
        assert_eq!(Envelope::decode(&bytes).unwrap().0, envelope, "{dialect}");
    }
    let bytes = envelope.encode(Representation::Xml, Dialect::Jade).unwrap();
    let name = b"<name>&#xF6;dd &amp; &#x65E5;&#x672C; &#x1F600;</name>";
    assert!(memchr::memmem::find(&bytes, name).is_some(), "{bytes:?}");
}

#[test]
fn an_address_is_not_taken_for_the_end_of_its_list() {
    let envelope = Envelope {
        base: EnvelopeParams {
            to: vec![agent("bob").with_address("\x01\x01").unwrap()],
            ..base()
        },
        extensions: Vec::new(),
    };
    let bytes = envelope.encode_standard().unwrap();
    assert_eq!(Envelope::decode(&bytes).unwrap().0, envelope);
}

#[test]
fn user_defined_parameters_of_jade_are_read() {
    let parameters = b"\x00X-k v w\0\x03\x02a\0\x04X-p\0q\0\x01\x00X-l\0m\0";
    let (envelope, _) = Envelope::decode(&encoded_base(parameters)).unwrap();
    let pair = |name: &str, value: &str| (name.to_owned(), value.to_owned());
    assert_eq!(
        envelope.base.user_defined,
        [pair("k", "v w"), pair("l", "m")]
    );
    assert_eq!(envelope.base.from.unwrap().user_defined(), [pair("p", "q")]);
}

#[test]
fn a_representation_of_jade_without_a_code_is_read() {
    let parameters = b"\x04fipa.acl.rep.string.std\0";
    let (envelope, _) = Envelope::decode(&encoded_base(parameters)).unwrap();
    assert_eq!(
        envelope.base.acl_representation,
        Some(AclRepresentation::String)
    );
}

#[test]
fn the_payload_length_may_have_the_code_of_a_number() {
    for parameters in [
        &b"\x06\x12\x56\x00"[..],
        b"\x06\x13\x56\x00",
        b"\x06\x56\x00",
    ] {
        let (envelope, _) = Envelope::decode(&encoded_base(parameters)).unwrap();
        assert_eq!(envelope.base.payload_length, Some(45));
    }
    for wrong in [
        &b"\x06\x00"[..],
        b"\x06\xe2\x00",
        b"\x06\xaa\xaa\xaa\xaa\xaa\xaa\xaa\xaa\xaa\xaa\x00",
    ] {
        let error = Envelope::decode(&encoded_base(wrong)).unwrap_err();
        assert_eq!(error.problem(), &Problem::Number);
    }
}

#[test]
fn extensions_are_ordered_as_their_writer_orders_them() {
    let intended = |name: &str| [b"\x09\x02", name.as_bytes(), b"\0\x01\x01"].concat();
    let counted = |by: &str, to: &str| {
        let by = format!("#{}\"{by}\0", by.len());
        encoded_extension(by.as_bytes(), &intended(to))
    };
    let bare = |by: &str, to: &str| {
        let by = format!("{by}\0");
        encoded_extension(by.as_bytes(), &intended(to))
    };
    let order = |parts: &[Vec<u8>]| {
        let bytes = [parts.concat(), encoded_base(&intended("base"))].concat();
        let (envelope, len) = Envelope::decode(&bytes).unwrap();
        let view = EnvelopeView::parse(&bytes).unwrap();
        assert_eq!(view.len(), len);
        let newest = view.receivers().map(|name| name.to_string());
        let effective = envelope.effective().intended_receivers;
        assert_eq!(newest.collect::<Vec<_>>(), [effective[0].name()]);
        let stamps = envelope.extensions.iter().flat_map(|part| &part.received);
        stamps
            .map(|received| received.by.clone())
            .collect::<Vec<_>>()
    };
    assert_eq!(order(&[bare("new", "a"), bare("old", "b")]), ["old", "new"]);
    assert_eq!(
        order(&[counted("old", "a"), counted("new", "b")]),
        ["old", "new"]
    );
    let through_both = [
        bare("last", "a"),
        bare("third", "b"),
        counted("first", "c"),
        counted("second", "d"),
    ];
    assert_eq!(order(&through_both), ["first", "second", "third", "last"]);
    assert_eq!(order(&[]), [""; 0]);
}

#[test]
fn the_last_value_in_one_part_counts() {
    let parameters = b"\x03\x02a\0\x01\x03\x02b\0\x01\x09\x02c\0\x01\x01\x09\x01";
    let bytes = encoded_base(parameters);
    let (envelope, _) = Envelope::decode(&bytes).unwrap();
    assert_eq!(envelope.base.from, Some(agent("b")));
    assert_eq!(envelope.base.intended_receivers, [agent("c")]);
    let view = EnvelopeView::parse(&bytes).unwrap();
    assert_eq!(view.from_name().unwrap(), "b");
    assert_eq!(view.receivers().count(), 1);
}

#[test]
fn long_envelopes_have_a_length_of_four_bytes() {
    for receivers in [6_000, 6_600, 20_000] {
        let envelope = Envelope {
            base: EnvelopeParams {
                to: (0..receivers)
                    .map(|n| agent(&format!("agent{n}")))
                    .collect(),
                ..base()
            },
            extensions: vec![stamp("mts")],
        };
        let bytes = envelope.encode_standard().unwrap();
        let (read, len) = Envelope::decode(&bytes).unwrap();
        assert_eq!((&read, len), (&envelope, bytes.len()));
        let base = &bytes[Envelope::encode_extension(&stamp("mts")).unwrap().len()..];
        let announced = match base {
            [0xfe, 0, 0, a, b, c, d, ..] => u32::from_be_bytes([*a, *b, *c, *d]) as usize,
            [0xfe, a, b, ..] => usize::from(u16::from_be_bytes([*a, *b])),
            _ => panic!("no base envelope"),
        };
        assert_eq!(announced, base.len());
    }
}

#[test]
fn bytes_that_are_no_envelope_are_refused() {
    let problem = |bytes: &[u8]| Envelope::decode(bytes).unwrap_err().problem().clone();
    assert!(matches!(problem(b"<?xml?>"), Problem::Truncated(_)));
    assert!(matches!(
        problem(b"hello"),
        Problem::Unexpected { found: b'h', .. }
    ));
    assert!(matches!(problem(b""), Problem::Truncated(_)));
    let extension = encoded_extension(b"mts\0", b"");
    assert!(matches!(problem(&extension), Problem::Truncated(_)));
    let followed = [&extension[..], b"\xfa\x10\x08\x01"].concat();
    assert!(matches!(
        problem(&followed),
        Problem::Unexpected { found: 0xfa, .. }
    ));
    assert!(matches!(
        problem(&extension.repeat(2000)),
        Problem::TooDeep(_)
    ));
    assert!(matches!(
        problem(&encoded_base(b"\x08")),
        Problem::Unexpected { .. }
    ));
    let nested = [&b"\x03"[..], &b"\x02a\0\x03".repeat(50_000)].concat();
    assert_eq!(
        problem(&encoded_base(&nested)),
        Problem::TooDeep("resolvers")
    );
}

#[test]
fn bytes_behind_the_envelope_are_the_payload() {
    let bytes = [&encoded_base(b"")[..], b"rest"].concat();
    let letter = Letter::split(Bytes::from(bytes)).unwrap();
    assert_eq!(letter.payload().to_bytes(), "rest");
    let with_rest = Letter::new(letter.to_bytes(), Bytes::new());
    let error = with_rest.parse_envelope().unwrap_err();
    assert_eq!(error.problem(), &Problem::Trailing(4));
}

#[test]
fn envelopes_with_missing_or_invalid_parameters_are_refused() {
    let written = |params: EnvelopeParams| {
        Envelope {
            base: params,
            extensions: vec![],
        }
        .encode_standard()
    };
    let missing = |parameter, of| Err(EncodeError::Missing { parameter, of });
    let of = "a base envelope";
    assert_eq!(
        written(EnvelopeParams {
            date: None,
            ..base()
        }),
        missing("date", of)
    );
    let no_representation = EnvelopeParams {
        acl_representation: None,
        ..base()
    };
    assert_eq!(
        written(no_representation),
        missing("acl-representation", of)
    );
    let comments = |text: &str| EnvelopeParams {
        comments: Some(text.into()),
        ..base()
    };
    assert_eq!(written(comments("a\0b")), Err(EncodeError::Nul("comments")));
    assert_eq!(written(comments("")), Err(EncodeError::Empty("comments")));
    let user_defined = vec![("a b".to_owned(), String::new())];
    let named = EnvelopeParams {
        user_defined,
        ..base()
    };
    assert_eq!(
        written(named),
        Err(EncodeError::UserDefinedName("a b".into()))
    );

    let extension = Envelope::encode_extension;
    let of = "an extension envelope";
    assert_eq!(
        extension(&EnvelopeParams::default()),
        missing("received", of)
    );
    let dated = EnvelopeParams {
        date: Some(date()),
        ..stamp("mts")
    };
    let parameter = "date";
    assert_eq!(
        extension(&dated),
        Err(EncodeError::NoPlace { parameter, of })
    );
    assert_eq!(
        extension(&stamp("")),
        Err(EncodeError::Empty("received-by"))
    );
}

#[test]
fn a_letter_of_a_message_has_the_envelope_that_encode_standard_writes() {
    let plain = agent("rover");
    let reachable = agent("arm_1").with_address("tcp://10.0.0.2:7788").unwrap();
    let many: Vec<AgentId> = (0..3000)
        .map(|n| agent(&format!("arm_{n}_of_many")))
        .collect();
    for (to, from) in [
        (vec![plain.clone()], Some(reachable.clone())),
        (vec![reachable, plain.clone()], None),
        (Vec::new(), Some(plain.clone())),
        (many, Some(plain)),
    ] {
        for content in [None, Some(Bytes::from_static(b"lift"))] {
            let mut message = Message::builder(Performative::Inform).receivers(to.clone());
            if let Some(from) = &from {
                message = message.sender(from.clone());
            }
            if let Some(content) = &content {
                message = message.content(content.clone());
            }
            let message = message.build().unwrap();
            let payload = message.to_payload();
            let whole = Envelope {
                base: EnvelopeParams {
                    to: to.clone(),
                    from: from.clone(),
                    payload_length: Some(payload.len() as u64),
                    intended_receivers: to.clone(),
                    ..base()
                },
                extensions: Vec::new(),
            };
            let letter = message.to_letter(date()).unwrap();
            assert_eq!(letter.envelope(), whole.encode_standard().unwrap());
            assert_eq!(*letter.payload(), payload);
            if let Some(content) = content {
                let around = message.to_letter_around(content.len(), date()).unwrap();
                assert_eq!(around.with_content(content), letter);
            }
        }
    }
}

#[test]
fn a_template_gives_the_letters_that_messages_give_alone() {
    let date = |text: &str| -> Time { text.parse().unwrap() };
    let reachable = agent("arm_1").with_address("tcp://10.0.0.2:7788").unwrap();
    let many: Vec<AgentId> = (0..3000).map(|n| agent(&format!("arm_{n}"))).collect();
    let mut template = EnvelopeTemplate::default();
    for (from, to, content, at) in [
        (Some("rover"), vec![agent("arm_1")], 0, "20000508T042651481"),
        // Another date, and another length of as many digits.
        (
            Some("rover"),
            vec![agent("arm_1")],
            9,
            "20261124T235959999Z",
        ),
        (
            Some("rover"),
            vec![agent("arm_1")],
            8,
            "20261125T000000000Z",
        ),
        // More digits, and fewer.
        (
            Some("rover"),
            vec![agent("arm_1")],
            70_000,
            "20261125T000000000Z",
        ),
        (
            Some("rover"),
            vec![agent("arm_1")],
            1,
            "20261125T000000001Z",
        ),
        // Another receiver, another address of it, and another sender.
        (
            Some("rover"),
            vec![reachable.clone()],
            1,
            "20261125T000000001Z",
        ),
        (
            Some("drone"),
            vec![reachable.clone()],
            1,
            "20261125T000000001Z",
        ),
        (None, vec![reachable], 1, "20261125T000000001Z"),
        (None, Vec::new(), 1, "20261125T000000001Z"),
        // Too long to be kept, twice.
        (Some("rover"), many.clone(), 1, "20261125T000000001Z"),
        (Some("rover"), many, 2, "20261125T000000002Z"),
    ] {
        let mut message = Message::builder(Performative::Inform).receivers(to);
        if let Some(from) = from {
            message = message.sender(agent(from));
        }
        let bare = message.clone().build().unwrap();
        let message = message.content(vec![7; content]).build().unwrap();
        for message in [bare, message] {
            let alone = message.to_letter(date(at)).unwrap();
            assert_eq!(template.to_letter(&message, date(at)).unwrap(), alone);
            let around = message.to_letter_around(content, date(at)).unwrap();
            let copied = template.to_letter_around(&message, content, date(at));
            assert_eq!(copied.unwrap(), around);
        }
    }
}
