//! String messages: the three dialects, every accepted form, and properties of all messages.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod arbitrary;

use bytes::Bytes;
use fipa_acl::{
    AgentId, DecodeError, Dialect, EncodeError, Message, Payload, Performative, Problem,
    Representation, Zone,
};
use proptest::prelude::*;

use arbitrary::{Kinds, message, message_of, pairs};

const DIALECTS: [Dialect; 3] = [Dialect::Standard, Dialect::FipaServices, Dialect::Jade];

fn decode(text: impl AsRef<[u8]>) -> Result<Message, DecodeError> {
    Message::decode(&Payload::from(Bytes::copy_from_slice(text.as_ref())))
}

fn written(message: &Message, dialect: Dialect) -> Result<Bytes, EncodeError> {
    message.encode(Representation::String, dialect)
}

fn text(message: &Message, dialect: Dialect) -> String {
    String::from_utf8(written(message, dialect).unwrap().to_vec()).unwrap()
}

fn agent(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

#[test]
fn each_dialect_has_its_form() {
    let sender = agent("alice")
        .with_address("tcp://h:1")
        .unwrap()
        .with_resolver(agent("ams"))
        .unwrap();
    let with_role = sender.clone().with_user_defined("k", "v w").unwrap();
    let from = |sender| {
        Message::builder(Performative::Request)
            .sender(sender)
            .receiver(agent("bob"))
            .content("say \"hi\"")
            .language("fipa-sl")
            .ontology("4 711")
            .protocol("fipa-request")
            .reply_by("20240131T235959000Z".parse().unwrap())
            .user_defined("prio", "7")
            .build()
            .unwrap()
    };
    let message = from(with_role);
    assert_eq!(
        text(&message, Dialect::Standard),
        "(request :sender (agent-identifier :name alice :addresses (sequence tcp://h:1) \
         :resolvers (sequence (agent-identifier :name ams)) :X-k \"v w\") \
         :receiver (set (agent-identifier :name bob)) :reply-by 20240131T235959000Z \
         :language fipa-sl :ontology \"4 711\" :protocol fipa-request :X-prio \"7\" \
         :content #8\"say \"hi\")"
    );
    // fipa_services does not read user-defined parameters of agents.
    assert!(written(&message, Dialect::FipaServices).is_err());
    assert_eq!(
        text(&from(sender), Dialect::FipaServices),
        "(request:sender(agent-identifier:namealice:addresses(sequencetcp://h:1 )\
         :resolvers(sequence(agent-identifier:nameams))):receiver(set\
         (agent-identifier:namebob)):content#8\"say \"hi\":reply-by20240131T235959000\
         :language#7\"fipa-sl:ontology#5\"4 711:protocolfipa-request:X-prio(#1\"7))"
    );
    assert_eq!(
        text(&message, Dialect::Jade),
        "(REQUEST :sender (agent-identifier :name alice :addresses (sequence tcp://h:1) \
         :resolvers (sequence (agent-identifier :name ams)) :X-k \"v w\") \
         :receiver (set (agent-identifier :name bob)) :reply-by 20240131T235959000Z \
         :language fipa-sl :ontology \"4 711\" :protocol fipa-request :X-prio \"7\" \
         :content \"say \\\"hi\\\"\")"
    );
    for dialect in [Dialect::Standard, Dialect::Jade] {
        assert_eq!(
            decode(text(&message, dialect)).as_ref(),
            Ok(&message),
            "{dialect}"
        );
    }
}

#[test]
fn binary_content_is_base64_for_jade() {
    let message = Message::builder(Performative::Inform)
        .content(&b"\0\x01\xff"[..])
        .build()
        .unwrap();
    let text = text(&message, Dialect::Jade);
    assert_eq!(text, "(INFORM :X-JADE-Encoding Base64 :content \"AAH/\")");
    assert_eq!(decode(text), Ok(message));
    for (content, expected) in [
        ("", "(INFORM :content \"\")"),
        ("grüß \\n", "(INFORM :content \"grüß \\n\")"),
        ("a\"b", "(INFORM :content \"a\\\"b\")"),
        // JADE would not find the end of these.
        ("a\\", "(INFORM :X-JADE-Encoding Base64 :content \"YVw=\")"),
        ("\\\"", "(INFORM :X-JADE-Encoding Base64 :content \"XCI=\")"),
    ] {
        let message = Message::builder(Performative::Inform).content(content);
        let message = message.build().unwrap();
        assert_eq!(self::text(&message, Dialect::Jade), expected);
        assert_eq!(decode(expected), Ok(message));
    }
    let chunked = decode("(inform :content \"AA\r\nH/\" :X-JADE-Encoding Base64)").unwrap();
    assert_eq!(chunked.content().unwrap(), &b"\0\x01\xff"[..]);
    assert!(chunked.user_defined().is_empty());
    let wrong = decode("(inform :content \"?\" :X-JADE-Encoding Base64)").unwrap_err();
    assert_eq!((wrong.offset(), wrong.problem()), (17, &Problem::Base64));
}

#[test]
fn values_that_a_reader_misreads_are_refused() {
    let refused = |set: &dyn Fn(fipa_acl::MessageBuilder) -> fipa_acl::MessageBuilder| {
        let message = set(Message::builder(Performative::Inform)).build().unwrap();
        DIALECTS.map(|dialect| written(&message, dialect).is_err())
    };
    let sender = |agent: AgentId| refused(&move |b| b.sender(agent.clone()));
    let address = |url| sender(agent("a").with_address(url).unwrap());
    assert_eq!(refused(&|b| b), [false; 3]);
    assert_eq!(sender(agent("a b")), [true, true, false]);
    assert_eq!(sender(agent("1a")), [true, true, false]);
    assert_eq!(sender(agent("a:addresses")), [false, true, false]);
    assert_eq!(address("a b"), [true; 3]);
    assert_eq!(address("\"a\""), [true, true, false]);
    let resolved = agent("a").with_resolver(agent("b")).unwrap();
    assert_eq!(sender(resolved.clone()), [false; 3]);
    let twice = agent("c").with_resolver(resolved).unwrap();
    assert_eq!(sender(twice), [false, true, false]);
    assert_eq!(refused(&|b| b.protocol("@a")), [true, true, false]);
    assert_eq!(refused(&|b| b.protocol("a:language")), [false, true, false]);
    assert_eq!(
        refused(&|b| b.user_defined("a:b", "")),
        [false, true, false]
    );
    let announced = |b: fipa_acl::MessageBuilder| b.user_defined("jade-encoding", "Base64");
    assert_eq!(refused(&announced), [false; 3]);
    assert_eq!(refused(&|b| announced(b).content("AAAA")), [true; 3]);
    assert_eq!(refused(&|b| b.language("é \\")), [false, false, true]);
    for (time, expected) in [
        ("20240131T235959000", [false; 3]),
        ("20240131T235959000K", [false, true, false]),
        ("+00000000T000001000", [false, true, false]),
    ] {
        let time = time.parse().unwrap();
        assert_eq!(refused(&|b| b.reply_by(time)), expected, "{time}");
    }
    for (act, expected) in [
        ("my-act", [false, true, true]),
        ("my:language", [true, true, true]),
    ] {
        let message = Message::builder(act.parse().unwrap()).build().unwrap();
        let refused = DIALECTS.map(|dialect| written(&message, dialect).is_err());
        assert_eq!(refused, expected, "{act}");
    }
}

#[test]
fn every_form_is_read() {
    let message = decode(
        "\u{feff} ( Request\r\n:CONTENT (a \"b)\") :sender ( AGENT-identifier :X-k 7 :addresses \
         ( sequence ) :name \"a b\" ) :reply-to (set) :protocol \"fipa-request\"\t:language 12ab \
         :ontology @o :conversation-id :c :reply-by 20240131Z235959000K :X-p(#3\"a)b) :X-q (#1 2)\
         :encoding \"#1\" :language -1 ) \n",
    );
    assert!(
        message.is_err(),
        "a counted string needs its quotation mark"
    );
    let message = decode(
        "\u{feff} ( Request\r\n:CONTENT (a \"b)\") :sender ( AGENT-identifier :X-k 7 :addresses \
         ( sequence ) :name \"a b\" ) :reply-to (set) :protocol \"fipa-request\"\t:language 12ab \
         :ontology @o :conversation-id :c :reply-by 20240131Z235959000K :X-p(#3\"a)b) :X-q (1 2)\
         :encoding \"#1\" :language -1 ) \n",
    )
    .unwrap();
    assert_eq!(message.performative(), &Performative::Request);
    assert_eq!(message.content().unwrap(), "(a \"b)\")");
    let sender = message.sender().unwrap();
    assert_eq!((sender.name(), sender.addresses().len()), ("a b", 0));
    assert_eq!(sender.user_defined(), [("k".into(), "7".into())]);
    assert!(message.reply_to().is_empty());
    assert_eq!(message.protocol(), Some("fipa-request"));
    assert_eq!(message.language(), Some("-1"), "the last one counts");
    assert_eq!(message.ontology(), Some("@o"));
    assert_eq!(message.conversation_id(), Some(":c"));
    assert_eq!(message.encoding(), Some("#1"));
    assert_eq!(message.reply_by().unwrap().zone(), Zone::Letter('K'));
    let pairs = [
        ("p".to_owned(), "a)b".to_owned()),
        ("q".to_owned(), "(1 2)".to_owned()),
    ];
    assert_eq!(message.user_defined(), pairs);

    // JADE accepts a word as content.
    assert_eq!(
        decode("(inform :content word)").unwrap().content().unwrap(),
        "word"
    );
    // Only the parentheses of fipa_services are removed.
    let quoted = decode("(inform :X-p \"(#1\\\"a)\")").unwrap();
    assert_eq!(quoted.user_defined()[0].1, "(#1\"a)");
}

#[test]
fn without_white_space_keywords_end_words() {
    let message = decode(
        "(my-act:sender(agent-identifier:namea:b@c:1099/JADE:resolvers(sequence\
         (agent-identifier:namer:X-k(#1\"v)))):protocolfipa:x:conversation-id#8\":content:reply-by\
         20240131T235959000:X-p(#1\")))",
    )
    .unwrap();
    assert_eq!(message.performative().as_str(), "my-act");
    let sender = message.sender().unwrap();
    assert_eq!(sender.name(), "a:b@c:1099/JADE");
    assert_eq!(sender.resolvers()[0].user_defined()[0].1, "v");
    assert_eq!(message.protocol(), Some("fipa:x"));
    assert_eq!(message.conversation_id(), Some(":content"));
    assert!(message.reply_by().is_some());
    assert_eq!(message.user_defined()[0].1, ")");
}

/// A reader with quadratic time would not finish.
#[test]
fn a_million_bytes_without_white_space_are_read_in_linear_time() {
    let words = format!("(inform{})", ":protocolx".repeat(100_000));
    assert_eq!(decode(words).unwrap().protocol(), Some("x"));
    let strings = format!("(inform{})", ":language#1\"x".repeat(100_000));
    assert_eq!(decode(strings).unwrap().language(), Some("x"));
}

#[test]
fn errors_have_the_offset_and_the_problem() {
    for (text, offset, problem) in [
        ("(", 1, Problem::Truncated("performative")),
        ("(inform", 7, Problem::Truncated("a parameter of a message")),
        ("(inform) x", 9, Problem::Trailing(1)),
        ("(1inform)", 1, Problem::NotAWord("performative")),
        (
            "(inform :content #9\"abc)",
            17,
            Problem::Truncated("content"),
        ),
        ("(inform :content \"abc)", 17, Problem::Truncated("content")),
        (
            "(inform :reply-by 20241331T000000000)",
            18,
            Problem::DateTime,
        ),
        (
            "(inform :protocol \"a b\")",
            18,
            Problem::NotAWord("protocol"),
        ),
        ("(inform :language \"a\0\")", 18, Problem::Nul("language")),
        (
            "(inform :sender (agent-identifier))",
            17,
            Problem::Missing("name of an agent"),
        ),
        (
            "(inform :sender (agent-identifier :name \"\"))",
            17,
            Problem::Empty("name of an agent"),
        ),
    ] {
        let error = decode(text).unwrap_err();
        assert_eq!(
            (error.offset(), error.problem()),
            (offset, &problem),
            "{text}"
        );
        assert!(error.clause().starts_with("FIPA00070 "), "{error}");
    }
    for text in [
        "(inform :foo bar)",
        "(inform x)",
        "(inform :X- )",
        "(inform :receiver (agent-identifier :name a))",
        "(inform :sender (agent-identifier :foo a))",
        "(inform :sender (agent-identifier :name (a)))",
    ] {
        let error = decode(text).unwrap_err();
        assert!(
            matches!(error.problem(), Problem::Unexpected { .. }),
            "{text}: {error}"
        );
    }
}

#[test]
fn resolvers_and_expressions_nested_too_deep_are_refused() {
    let nested = |depth| {
        let open = "(agent-identifier :name a :resolvers (sequence ".repeat(depth);
        format!(
            "(inform :sender {open}(agent-identifier :name b){})",
            "))".repeat(depth)
        )
    };
    assert!(decode(nested(AgentId::MAX_DEPTH)).is_ok());
    for depth in [AgentId::MAX_DEPTH + 1, 50_000] {
        let error = decode(nested(depth)).unwrap_err();
        assert_eq!(error.problem(), &Problem::TooDeep("resolvers"));
    }
    assert!(decode(format!("(inform :content {}", "(".repeat(100_000))).is_err());
}

/// Messages with agents and protocols that every dialect of the string encoding can represent.
fn representable() -> impl Strategy<Value = Message> {
    // fipa_services reads only ASCII words.
    let word = "[a-z+~][a-z0-9.@\"-]{0,8}".boxed();
    let agent = (
        word.clone(),
        prop::collection::vec("[a-z]{2,4}://[a-z0-9:./]{1,9}", 0..3),
        prop::collection::vec("[a-z]{1,5}", 0..2),
        pairs(),
    );
    let agent = agent.prop_map(|(name, urls, resolvers, pairs)| {
        let mut agent = AgentId::new(name).unwrap();
        for url in urls {
            agent = agent.with_address(url).unwrap();
        }
        for resolver in resolvers {
            agent = agent
                .with_resolver(AgentId::new(resolver).unwrap())
                .unwrap();
        }
        for (name, value) in pairs {
            agent = agent.with_user_defined(name, value).unwrap();
        }
        agent
    });
    message_of(Kinds {
        agent: agent.boxed(),
        protocol: word,
        ..Kinds::default()
    })
}

/// fipa_services takes all times as local.
fn without_utc(message: &Message) -> String {
    format!("{message:?}").replace("zone: Utc", "zone: Unspecified")
}

fn survives(message: &Message, bytes: &Bytes, dialect: Dialect) {
    let again = Message::decode(&Payload::from(bytes.clone()));
    let again = again.unwrap_or_else(|error| panic!("{dialect}: {error}: {bytes:?}"));
    if dialect == Dialect::FipaServices {
        assert_eq!(without_utc(&again), without_utc(message), "{bytes:?}");
    } else {
        assert_eq!(&again, message, "{dialect}: {bytes:?}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(ProptestConfig::default().cases.min(192)))]

    #[test]
    fn a_message_is_the_same_after_a_round_trip_or_is_refused(message in message().boxed()) {
        for dialect in DIALECTS {
            match written(&message, dialect) {
                Ok(bytes) => survives(&message, &bytes, dialect),
                Err(error) => {
                    let unrepresentable = matches!(error, EncodeError::Unrepresentable { .. });
                    prop_assert!(unrepresentable, "{}", error);
                }
            }
        }
    }

    #[test]
    fn representable_messages_are_encoded(message in representable().boxed()) {
        let standard = written(&message, Dialect::Standard).unwrap();
        survives(&message, &standard, Dialect::Standard);
        if matches!(message.performative(), Performative::Other(_)) {
            return Ok(());
        }
        let plain_time = message.reply_by().is_none_or(|time| {
            !time.is_relative() && !matches!(time.zone(), Zone::Letter(_))
        });
        let bytes = written(&message, Dialect::FipaServices);
        let mut agents = message.sender().into_iter().chain(message.receivers());
        let plain_agents = agents.all(|agent| agent.user_defined().is_empty())
            && message.reply_to().iter().all(|agent| agent.user_defined().is_empty());
        prop_assert_eq!(bytes.is_ok(), plain_time && plain_agents);
        if let Ok(bytes) = bytes {
            survives(&message, &bytes, Dialect::FipaServices);
        }
        // JADE counts characters where the standard counts bytes.
        if standard.is_ascii() {
            let bytes = written(&message, Dialect::Jade).unwrap();
            survives(&message, &bytes, Dialect::Jade);
        }
    }

    #[test]
    fn a_truncated_message_is_refused(message in representable().boxed(), cut in any::<prop::sample::Index>()) {
        for dialect in DIALECTS {
            if let Ok(bytes) = written(&message, dialect) {
                prop_assert!(decode(&bytes[..cut.index(bytes.len())]).is_err());
            }
        }
    }

    #[test]
    fn damaged_bytes_are_read_or_refused(
        message in representable().boxed(),
        at in any::<prop::sample::Index>(),
        byte in prop_oneof![any::<u8>(), prop::sample::select(&b"():\"#\\ 0\0"[..])],
    ) {
        for dialect in DIALECTS {
            if let Ok(bytes) = written(&message, dialect) {
                let mut damaged = bytes.to_vec();
                damaged[at.index(bytes.len())] = byte;
                read_or_refused(&damaged);
            }
        }
    }

    #[test]
    fn nearly_encoded_bytes_are_read_or_refused(
        pieces in prop::collection::vec(prop::sample::select(&[
            "(", ")", " ", "\"", "\\\"", "#2\"", "#", "9", ":", "a", ":X-", "(set", "(sequence",
            "(agent-identifier", ":name", ":resolvers", ":addresses", ":content", ":protocol",
            ":sender", ":receiver", ":language", ":reply-by", "20240131T235959000", "é", "\0",
            ":X-JADE-Encoding", "Base64",
        ][..]), 0..40),
    ) {
        read_or_refused(format!("(inform{}", pieces.concat()).as_bytes());
        read_or_refused(format!("(inform{})", pieces.concat()).as_bytes());
    }

    #[test]
    fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        read_or_refused(&[b"(", &bytes[..]].concat());
    }
}

/// Checks that a decoded message is the same after a round trip in the bit-efficient encoding and in
/// every dialect that can represent it.
fn read_or_refused(bytes: &[u8]) {
    let Ok(message) = decode(bytes) else { return };
    assert_eq!(
        Message::decode(&message.to_payload()).as_ref(),
        Ok(&message)
    );
    for dialect in DIALECTS {
        if let Ok(bytes) = written(&message, dialect) {
            survives(&message, &bytes, dialect);
        }
    }
}
