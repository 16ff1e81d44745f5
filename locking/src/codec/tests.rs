use proptest::prelude::*;

use super::*;
use crate::Fence;
use crate::fence::Position;

fn id(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

fn recorded(
    performative: Performative,
    protocol: &str,
    conversation: &str,
    language: &str,
    content: &str,
) -> Message {
    let mut builder = Message::builder(performative)
        .sender(id("agent2"))
        .receiver(id("agent1"))
        .protocol(protocol)
        .conversation_id(conversation)
        .content(content.to_owned());
    if !language.is_empty() {
        builder = builder.language(language);
    }
    builder.build().unwrap()
}

/// The lines of the recording: performative, protocol, conversation, language, content. Each is read,
/// and written again in the same way.
#[test]
fn recorded_messages_of_distributed_locking() {
    use Performative::{
        Agree, Confirm, Disconfirm, Inform, Propagate, QueryIf, Request as RequestAct,
    };
    let archive_1 = "22 serialization::archive 18 3 rsc 0 0 0 0 1 0 0 0 0 0 6 agent2 0 0 0 0 0";
    let archive_2 = "22 serialization::archive 18 3 rsc 0 0 0 0 3 0 0 0 0 0 6 agent1 1 6 agent2 1 \
                     6 agent3 1 0 0 1 0 6 agent3";
    let archive_3 = "22 serialization::archive 18 3 rsc 0 0 0 0 3 0 0 0 0 0 6 agent1 1 6 agent2 1 \
                     6 agent3 1 0 0 0 0";
    let basic = Algorithm::RicartAgrawala;
    let token = Algorithm::SuzukiKasami;
    for (kind, performative, protocol, conversation, language, content) in [
        (basic, QueryIf, "dlm_discover", "agent2_0", "", "rsc"),
        (basic, Inform, "dlm_discover", "agent2_0", "", "rsc"),
        (
            basic,
            RequestAct,
            "ricart_agrawala",
            "agent2_1",
            "",
            "1\nrsc",
        ),
        (basic, Agree, "ricart_agrawala", "agent2_1", "", "3\nrsc"),
        (basic, Confirm, "ricart_agrawala", "agent2_1", "", "rsc"),
        (basic, Disconfirm, "ricart_agrawala", "agent2_1", "", "rsc"),
        (basic, RequestAct, "dlm_probe", "agent1_3", "", ""),
        (basic, Confirm, "dlm_probe", "agent1_3", "", ""),
        (token, RequestAct, "suzuki_kasami", "agent2_1", "", "rsc\n1"),
        (
            token,
            Propagate,
            "suzuki_kasami",
            "agent2_1",
            BOOST_TOKEN,
            archive_1,
        ),
        (
            token,
            Propagate,
            "suzuki_kasami",
            "agent1_3",
            BOOST_TOKEN,
            archive_2,
        ),
        (
            token,
            Propagate,
            "suzuki_kasami",
            "agent3_1",
            BOOST_TOKEN,
            archive_3,
        ),
    ] {
        let message = recorded(performative, protocol, conversation, language, content);
        let read = decode(&message, kind).unwrap();
        assert_eq!(read.dialect, LockDialect::Legacy);
        let written = encode(&read, kind, &id("agent2"), &id("agent1")).unwrap();
        assert_eq!(written, message);
    }
    let message = recorded(
        Propagate,
        "suzuki_kasami",
        "agent1_3",
        BOOST_TOKEN,
        archive_2,
    );
    let Content::Lock {
        act: Act::Token(token),
        ..
    } = decode(&message, token).unwrap().content
    else {
        panic!("a token");
    };
    assert_eq!(token.last.values().copied().collect::<Vec<_>>(), [1, 1, 1]);
    assert_eq!(
        token.last.keys().map(|name| &**name).collect::<Vec<_>>(),
        ["agent1", "agent2", "agent3"]
    );
    assert_eq!(token.queue, [Arc::from("agent3")]);
    assert_eq!(token.generation, None);
}

/// The owner's queue, in the form of its messages.
#[test]
fn messages_of_the_owner_s_queue() {
    let kind = Algorithm::OwnerQueue;
    let decoded = |performative, content: &str, reply_with: Option<&str>| {
        let mut builder = Message::builder(performative)
            .protocol("owner_queue")
            .conversation_id("rover_1")
            .ontology(ONTOLOGY)
            .content(content.to_owned());
        if let Some(reply_with) = reply_with {
            builder = builder.reply_with(reply_with);
        }
        read(&builder.build().unwrap()).map(|message| (message.algorithm, message.content))
    };
    let resource = Resource::new("bay").unwrap();
    let content = |act| {
        let resource = resource.clone();
        Ok((Some(kind), Content::Lock { resource, act }))
    };
    let ask = |place| Act::Ask { asked: 7, place };
    let request = |text, asked| decoded(Performative::Request, text, asked);
    assert_eq!(request("bay", Some("7")), content(ask(None)));
    assert_eq!(request("bay\n8", Some("7")), content(ask(Some(8))));
    let place = decoded(Performative::Agree, "bay\n1", None);
    assert_eq!(place, content(Act::Place { place: 1 }));
    for wrong in ["bay\n0", "bay\n9", "bay\n-1", "bay\n", "bay\nx"] {
        let error = Err(DecodeError::Number("the place"));
        assert_eq!(request(wrong, Some("7")), error, "{wrong}");
        assert_eq!(decoded(Performative::Agree, wrong, None), error, "{wrong}");
    }
    assert_eq!(request("bay", None), Err(DecodeError::Number("reply-with")));
    assert_eq!(request("bay\n1\n2", Some("7")), Err(DecodeError::Parts(3)));
    let report = decoded(Performative::Confirm, "bay", Some("7"));
    assert_eq!(report, Err(DecodeError::Performative("confirm".into())));
}

/// An owner names the algorithm, except to agents of `distributed_locking`, which know no such parameter.
#[test]
fn an_owner_names_its_algorithm() {
    for algorithm in Algorithm::ALL.map(Some).into_iter().chain([None]) {
        let message = LockMessage {
            conversation: Conversation::parse("agent1_0"),
            dialect: LockDialect::Own,
            algorithm,
            content: Content::Lock {
                resource: Resource::new("bay").unwrap(),
                act: Act::Owned,
            },
        };
        let written = encode(&message, Algorithm::default(), &id("a"), &id("b")).unwrap();
        let named = algorithm.map(|kind| ("fipa-algorithm".to_owned(), kind.protocol().to_owned()));
        assert_eq!(written.user_defined(), named.as_slice());
        assert_eq!(read(&written), Ok(message));
    }
    let unknown = Message::builder(Performative::Inform)
        .protocol(DISCOVER)
        .conversation_id("a_1")
        .content("bay")
        .user_defined(ALGORITHM, "raffle");
    assert_eq!(read(&unknown.build().unwrap()).unwrap().algorithm, None);
}

/// A Boost archive of an older version has no version of items. With an empty map, the first agent of
/// the queue has the class.
#[test]
fn archives_of_all_versions() {
    let old = "22 serialization::archive 3 3 rsc 0 0 0 0 0 0 0 1 0 0 6 agent3";
    let (resource, token) = boost::read(old).unwrap();
    assert_eq!(token.queue, [Arc::from("agent3")]);
    assert_eq!(boost::write(3, &resource, &token), old);
    for version in [4, 5, 9, 10, 17, 19, 20] {
        let text = boost::write(version, &resource, &token);
        let (_, read) = boost::read(&text).unwrap();
        assert_eq!(read.archive, Some(version));
        assert_eq!(read.queue, token.queue);
    }
    assert!(
        boost::read(&old.replace(' ', "\n")).is_ok(),
        "newlines separate too"
    );
}

#[test]
fn bad_messages_are_errors() {
    let (basic, extended) = (Algorithm::RicartAgrawala, Algorithm::RicartAgrawalaExtended);
    let request = |protocol: &str, content: &str| {
        recorded(Performative::Request, protocol, "a_1", "", content)
    };
    let error = |message: &Message, kind| decode(message, kind).unwrap_err();
    let message = request("ricart_agrawala", "1\nrsc");
    assert_eq!(error(&message, extended), DecodeError::Protocol(extended));
    let protocol = "ricart_agrawala";
    assert_eq!(error(&request(protocol, "1"), basic), DecodeError::Parts(1));
    let message = request(protocol, "1\nrsc\n");
    assert_eq!(error(&message, basic), DecodeError::Parts(3));
    for clock in ["", "x", "-1", "2147483648"] {
        let message = request(protocol, &format!("{clock}\nrsc"));
        assert_eq!(error(&message, basic), DecodeError::Number("the clock"));
    }
    let long = request(protocol, &format!("1\n{}", "x".repeat(10_000)));
    assert_eq!(
        error(&long, basic),
        DecodeError::Name(NameError::TooLong(10_000))
    );
    let cfp = recorded(Performative::Cfp, protocol, "a_1", "", "rsc");
    assert_eq!(error(&cfp, basic), DecodeError::Performative("cfp".into()));
    let seen = |performative, content: &str| recorded(performative, FENCES, "a_1", "", content);
    let message = seen(Performative::Inform, "rsc");
    assert_eq!(error(&message, basic), DecodeError::Parts(1));
    let message = seen(Performative::Inform, "rsc\n1.1@crane#rsc");
    assert_eq!(error(&message, basic), DecodeError::Fence(FenceError::Form));
    let message = seen(Performative::Request, "rsc\n1.1.5a31c0e4d2b19f07@crane#rsc");
    assert_eq!(
        error(&message, basic),
        DecodeError::Performative("request".into())
    );
    let token = |content: &str| {
        recorded(
            Performative::Propagate,
            "suzuki_kasami",
            "a_1",
            BOOST_TOKEN,
            content,
        )
    };
    for content in [
        "",
        "22 serialization::archiv",
        "22 serialization::archive 18 3 rsc 0 0 0 0 4294967295 0",
        "22 serialization::archive 18 99999999999999999999 rsc",
        "22 serialization::archive 18 18446744073709551615 rsc",
        "22 serialization::archive 18 3 rsc 0 0 0 0 0 0 0 0 0 0 x",
        "22 serialization::archive 18 3 rsc 0 1 0 0 0 0 0 0 0 0",
    ] {
        let error = error(&token(content), Algorithm::SuzukiKasami);
        assert!(
            matches!(error, DecodeError::Token { .. }),
            "{content}: {error}"
        );
    }
}

fn name() -> impl Strategy<Value = String> {
    "[a-zA-Z0-9_@. äß]{1,12}"
}

fn act() -> impl Strategy<Value = (Algorithm, Act)> {
    let number = 0..=i32::MAX as u64;
    let position = (any::<u64>(), any::<u64>());
    let position = position.prop_map(|(epoch, number)| Position { epoch, number });
    let fence = (name(), position, any::<u64>()).prop_map(|(owner, position, run)| {
        let owner = crate::LockPeer::new(&owner, 0).unwrap();
        Fence::new(&owner, &Resource::new("bay").unwrap(), position, run)
    });
    let fence = fence.boxed();
    let agents = proptest::collection::btree_map(name().prop_map(Arc::from), number.clone(), 0..4);
    let queue = proptest::collection::vec_deque(name().prop_map(Arc::from), 0..4);
    let token = (any::<u64>(), agents, queue, proptest::option::of(1..30_u16)).prop_map(
        |(generation, last, queue, archive)| Token {
            generation: archive.is_none().then_some(generation),
            last,
            queue,
            archive,
        },
    );
    let ra = Algorithm::RicartAgrawalaExtended;
    let sk = Algorithm::SuzukiKasamiExtended;
    let queue = Algorithm::OwnerQueue;
    let kind = prop_oneof![Just(ra), Just(sk)];
    let any_kind = prop_oneof![Just(ra), Just(sk), Just(queue)];
    let place = 1..=MAX_PLACE;
    prop_oneof![
        any::<bool>().prop_map(move |claim| (ra, Act::Query { claim })),
        Just((ra, Act::Owned)),
        Just((sk, Act::Contested)),
        (any::<u64>(), proptest::option::of(place.clone()))
            .prop_map(move |(asked, place)| (queue, Act::Ask { asked, place })),
        place.prop_map(move |place| (queue, Act::Place { place })),
        number
            .clone()
            .prop_map(move |clock| (ra, Act::Request { clock })),
        number
            .clone()
            .prop_map(move |clock| (ra, Act::Agree { clock })),
        number.prop_map(move |number| (sk, Act::RequestToken { number })),
        token.prop_map(move |token| (sk, Act::Token(token))),
        (kind.clone(), any::<u64>())
            .prop_map(|(kind, asked)| (kind, Act::Confirm { asked: Some(asked) })),
        (any_kind.clone(), fence.clone(), any::<u64>())
            .prop_map(|(kind, fence, asked)| (kind, Act::Renew { fence, asked })),
        (kind.clone(), fence.clone()).prop_map(|(kind, fence)| (kind, Act::Seen { fence })),
        (any_kind.clone(), fence, any::<u64>(), any::<u64>()).prop_map(
            |(kind, fence, lease, asked)| (
                kind,
                Act::Granted {
                    fence,
                    lease,
                    asked
                }
            )
        ),
        (any_kind.clone(), 0..Refusal::ALL.len(), any::<u64>()).prop_map(
            |(kind, reason, asked)| (
                kind,
                Act::Refused {
                    reason: Refusal::ALL[reason],
                    asked
                }
            )
        ),
        any_kind.prop_map(|kind| (kind, Act::Release)),
    ]
}

proptest! {
    #[test]
    fn every_message_is_read_as_it_was_written(
        (kind, act) in act(),
        resource in name(),
        conversation in "[a-z_0-9]{1,10}",
    ) {
        let names_none = matches!(
            act,
            Act::Query { .. } | Act::Contested | Act::Seen { .. }
        );
        let message = LockMessage {
            conversation: Conversation::parse(&conversation),
            dialect: LockDialect::Own,
            algorithm: (!names_none).then_some(kind),
            content: Content::Lock { resource: Resource::new(&resource).unwrap(), act },
        };
        let written = encode(&message, kind, &id("a"), &id("b")).unwrap();
        let sent = Message::decode(&written.to_payload()).unwrap();
        prop_assert_eq!(decode(&sent, kind), Ok(message.clone()));
        prop_assert_eq!(read(&sent), Ok(message));
    }

    #[test]
    fn no_text_makes_the_readers_panic(text in ".{0,80}", performative in 0..22_usize) {
        for kind in Algorithm::ALL {
            for protocol in [kind.protocol(), DISCOVER, PROBE, FENCES] {
                let performative = Performative::STANDARD[performative].clone();
                for language in [BOOST_TOKEN, TOKEN] {
                    let message = recorded(performative.clone(), protocol, "a_1", language, &text);
                    let _ = decode(&message, kind);
                }
            }
        }
        let _ = boost::read(&text);
        let _ = boost::read(&format!("22 serialization::archive 18 {text}"));
        let _ = text.parse::<Fence>();
    }
}
