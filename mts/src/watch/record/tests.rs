use fipa_acl::{AgentId, Performative};
use fipa_transport::{Attempt, FailureReason, TransportError, TransportErrorKind};

use super::*;
use crate::core::SubmissionId;
use crate::letter_for;

fn agent(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

fn letter(content: &str) -> Letter {
    let message = Message::builder(Performative::Request)
        .sender(agent("rover"))
        .receiver(agent("arm_1"))
        .protocol("fipa-request")
        .conversation_id("c1")
        .content(content.to_owned())
        .build()
        .unwrap();
    letter_for(&message, UNIX_EPOCH + Duration::from_secs(1_700_000_000)).unwrap()
}

fn notice(news: News) -> Notice {
    Notice {
        stream: Stream::between(Incarnation::from_u64(7), Incarnation::from_u64(8)),
        sequence: 3,
        receiver: "arm_1".into(),
        news,
    }
}

fn all() -> Vec<News> {
    let letter = letter("lift");
    let failed = Outcome::Failed {
        reason: FailureReason::TimedOut,
        attempts: vec![Attempt {
            via: Kind::Shm,
            location: "shm://1#0000000000000001".parse().unwrap(),
            error: TransportError::new(TransportErrorKind::Broken, "gone"),
        }],
    };
    vec![
        News::Sent {
            submission: Some(SubmissionId(9)),
            letter: letter.clone(),
        },
        News::Taken {
            via: Some(Kind::Shm),
            letter: letter.clone(),
        },
        News::Passed {
            via: Kind::Tcp,
            remote: true,
            letter,
        },
        News::Settled {
            outcome: failed,
            sender: true,
        },
    ]
}

fn at() -> SystemTime {
    UNIX_EPOCH + Duration::from_nanos(1_700_000_000_123_456_789)
}

fn written(news: News, request: Wish) -> Bytes {
    let mut bytes = of(&notice(news), request, at());
    set_lost(&mut bytes, 5);
    bytes.into()
}

#[test]
fn records_survive_a_round_trip() {
    for news in all() {
        let record = Record::parse(&written(news.clone(), Wish { content: 2 })).unwrap();
        assert_eq!((record.at, record.lost), (at(), 5));
        match (record.body, news) {
            (RecordBody::Letter { id, place, letter }, news) => {
                assert_eq!((id.stream, id.sequence), (notice(news.clone()).stream, 3));
                assert_eq!(letter.receiver(), "arm_1");
                let expected = match news {
                    News::Sent { .. } => Seen::Sent(Some(9)),
                    News::Taken { .. } => Seen::Taken(Some(Kind::Shm)),
                    _ => Seen::Passed(Kind::Tcp, Origin::OtherHost),
                };
                assert_eq!(place, expected);
                let message = letter.decode_message().unwrap();
                assert_eq!(message.protocol(), Some("fipa-request"));
                assert_eq!(message.content(), None);
                assert_eq!(
                    (letter.content_len, &letter.content()[..]),
                    (Some(4), &b"li"[..])
                );
                assert_eq!(letter.envelope().get().unwrap().base.to, [agent("arm_1")]);
                assert_eq!(letter.size, self::letter("lift").len() as u64);
            }
            (
                RecordBody::Settled {
                    outcome, sender, ..
                },
                News::Settled {
                    outcome: settled, ..
                },
            ) => {
                assert_eq!((outcome, sender), (settled, true));
            }
            (body, news) => panic!("{news:?} was read as {body:?}"),
        }
    }
}

#[test]
fn content_is_not_included_unless_requested() {
    let News::Sent { submission, .. } = all().remove(0) else {
        panic!("not the first");
    };
    let secret = News::Sent {
        submission,
        letter: letter("a secret of this robot"),
    };
    let bytes = written(secret, Wish::default());
    assert!(!bytes.windows(6).any(|window| window == b"secret"));
    let RecordBody::Letter { letter, .. } = Record::parse(&bytes).unwrap().body else {
        panic!("not a letter");
    };
    assert_eq!((letter.content_len, letter.content().len()), (Some(22), 0));
}

#[test]
fn a_greeting_and_a_loss_survive_a_round_trip() {
    let bytes = hello("rover-mts", Incarnation::from_u64(3), true, at());
    let hello = RecordBody::Hello {
        name: "rover-mts".into(),
        incarnation: Incarnation::from_u64(3),
        gateway: true,
    };
    assert_eq!(Record::parse(&bytes).unwrap().body, hello);
    assert_eq!(Record::parse(&lost(at())).unwrap().body, RecordBody::Lost);
}

#[test]
fn a_letter_that_cannot_be_decoded_is_recorded() {
    let garbage = Letter::new(
        Bytes::from_static(b"\xfe\xff"),
        Bytes::from_static(b"\xfa\x10"),
    );
    let news = News::Taken {
        via: Some(Kind::Tcp),
        letter: garbage,
    };
    let record = Record::parse(&written(news, Wish::default())).unwrap();
    let RecordBody::Letter { letter, .. } = record.body else {
        panic!("not a letter");
    };
    assert_eq!(
        (
            letter.envelope().get(),
            letter.decode_message(),
            letter.size
        ),
        (None, None, 4)
    );
}

#[test]
fn long_parts_are_left_out_and_every_record_fits_a_datagram() {
    let long = "x".repeat(MAX_PART * 2);
    let message = Message::builder(Performative::Inform)
        .sender(agent("rover"))
        .receiver(agent(&long[..4000]))
        .reply_with(long.clone())
        .content(vec![7; MAX_CONTENT * 2])
        .build()
        .unwrap();
    let letter = letter_for(&message, at()).unwrap();
    let request = Wish { content: u32::MAX };
    let bytes = written(
        News::Sent {
            submission: None,
            letter,
        },
        request,
    );
    assert!(bytes.len() <= MAX_LEN);
    let RecordBody::Letter { letter, .. } = Record::parse(&bytes).unwrap().body else {
        panic!("not a letter");
    };
    assert_eq!(letter.decode_message(), None);
    assert_eq!(letter.content().len(), MAX_CONTENT);
    const { assert!(HEADER_LEN + Parcel::MAX_NAME + 2 * MAX_PART + MAX_CONTENT <= MAX_LEN) };
}

#[test]
fn corrupted_records_are_rejected_or_parsed_without_panic() {
    let mut records: Vec<Bytes> = all()
        .into_iter()
        .map(|news| written(news, Wish { content: 100 }))
        .collect();
    records.push(hello("rover-mts", Incarnation::from_u64(3), false, at()).into());
    let mut random = fastrand::Rng::with_seed(7);
    for whole in records {
        for len in 0..whole.len() {
            assert!(Record::parse(&whole.slice(..len)).is_err(), "{len}");
        }
        for _ in 0..2000 {
            let mut changed = whole.to_vec();
            for _ in 0..random.usize(1..4) {
                let place = random.usize(..changed.len());
                changed[place] = random.u8(..);
            }
            // Only a panic would be a failure.
            let _ = Record::parse(&changed);
        }
    }
}

#[test]
fn each_kind_of_error_is_reported() {
    let whole = written(all().remove(0), Wish::default()).to_vec();
    let with = |place: usize, value: u8| {
        let mut changed = whole.clone();
        changed[place] = value;
        Record::parse(&changed).unwrap_err()
    };
    assert_eq!(with(0, b'x'), RecordError::NotARecord(whole.len()));
    assert_eq!(with(4, 9), RecordError::Version(9));
    assert_eq!(with(5, 77), RecordError::Kind(77));
    assert!(matches!(with(75, 0xff), RecordError::Length { .. }));
    assert_eq!(with(HEADER_LEN, 0xff), RecordError::Part("name"));
    let mut nameless = Header::new(SENT, at());
    nameless.sequence = U64::new(1);
    let nameless = written_bytes(nameless);
    assert_eq!(Record::parse(&nameless), Err(RecordError::Part("name")));
}

fn written_bytes(header: Header) -> Bytes {
    super::written(header, [b""; 5]).into()
}

#[test]
fn a_request_survives_a_round_trip_and_other_bytes_are_rejected() {
    let request = Wish { content: 513 };
    assert_eq!(Wish::parse(&request.to_bytes()), Some(request));
    for len in 0..Wish::LEN {
        assert_eq!(Wish::parse(&request.to_bytes()[..len]), None);
    }
    assert_eq!(
        Wish::parse(&[request.to_bytes().as_slice(), b"x"].concat()),
        None
    );
    assert_eq!(Wish::parse(b"fipw\x02\x00\x00\x00\x00\x00"), None);
}
