//! Reactions of a browser to packets and time.

use std::net::{Ipv4Addr, Ipv6Addr};

use proptest::prelude::*;

use super::super::packet::tests::{Part, answer, asked};
use super::*;

const HOST: &str = "host.local";
/// Origin of the packets.
const FROM: Origin = Origin {
    address: IpAddr::V4(Ipv4Addr::new(192, 0, 2, 9)),
    interface: 2,
};
const OWN: Incarnation = Incarnation::from_u64(1);
const OTHER: Incarnation = Incarnation::from_u64(7);

fn seconds(seconds: f64) -> Duration {
    Duration::from_secs_f64(seconds)
}

fn announced(label: &str, text: &[u8], ttl: u32) -> Vec<u8> {
    answer(
        label,
        &[Part::Ptr, Part::Srv(HOST), Part::Txt(&[text])],
        ttl,
    )
}

/// A browser that received records with these labels from one host.
fn browser(now: Instant, labels: &[&str]) -> Browser {
    let mut browser = Browser::new(now, OWN, 0.0);
    for label in labels {
        let received = browser.handle_packet(now, FROM, &announced(label, b"TYPE=x", 120), 0.0);
        assert_eq!(names(&received), [*label]);
    }
    browser
}

fn names(received: &ParsedPacket) -> Vec<&str> {
    let found = received.found.iter();
    found.map(|found| label_of(&found.fullname)).collect()
}

/// Runs the timers until then. Returns the queries, except those for all records, and the removals,
/// each with its time in tenths of a second.
fn run_timers(browser: &mut Browser, start: Instant, until: f64) -> (Vec<(u64, String)>, Vec<u64>) {
    let (mut questions, mut gone) = (Vec::new(), Vec::new());
    let mut last = None;
    while let now = browser.poll_timeout()
        && now < start + seconds(until)
    {
        assert_ne!(last.replace(now), Some(now), "the timeout did not advance");
        let due = browser.handle_timeout(now, 0.0);
        let at = (now - start).as_millis() as u64 / 100;
        for (label, kind) in asked(&due.packets) {
            if !label.is_empty() {
                let kind = if kind == QTYPE::TYPE(TYPE::SRV) {
                    "SRV"
                } else {
                    "TXT"
                };
                questions.push((at, format!("{label} {kind}")));
            }
        }
        gone.extend(due.gone.iter().map(|_| at));
    }
    (questions, gone)
}

#[test]
fn an_announced_record_is_reported_once_with_all_its_strings() {
    let (mut browser, now) = (Browser::new(Instant::now(), OWN, 0.0), Instant::now());
    let strings: [&[u8]; 5] = [
        b"LOCATOR=tcp://a",
        b"TYPE=\xff",
        b"locator=:1;",
        b"flag",
        b"=",
    ];
    let parts = [Part::Txt(&strings), Part::Srv(HOST), Part::Ptr];
    let received = browser.handle_packet(now, FROM, &answer("Arm.left", &parts, 120), 0.0);
    let [found] = &received.found[..] else {
        panic!("{received:?}");
    };
    assert_eq!(*found.fullname, *format!("Arm.left.{SERVICE_TYPE}"));
    let expected: [(&str, &[u8]); 4] = [
        ("LOCATOR", b"tcp://a"),
        ("TYPE", b"\xff"),
        ("locator", b":1;"),
        ("flag", b""),
    ];
    let expected = expected.map(|(key, value)| (key.to_owned(), value.to_vec()));
    assert_eq!(found.properties, expected);
    // An identical record is not reported again; a changed one is.
    let again = browser.handle_packet(now, FROM, &answer("Arm.left", &parts, 120), 0.0);
    assert_eq!(again, ParsedPacket::default());
    let other = answer("Arm.left", &[Part::Txt(&[b"TYPE=x"])], 120);
    assert_eq!(
        names(&browser.handle_packet(now, FROM, &other, 0.0)),
        ["Arm.left"]
    );
    // A record that was not introduced is ignored.
    let stranger = answer("leg", &[Part::Srv(HOST), Part::Txt(&strings)], 120);
    assert_eq!(
        browser.handle_packet(now, FROM, &stranger, 0.0),
        ParsedPacket::default()
    );
    assert_eq!(browser.records.len(), 1);
}

#[test]
fn missing_parts_are_queried_a_few_times() {
    let (mut browser, start) = (browser(Instant::now(), &[]), Instant::now());
    for label in ["arm", "leg"] {
        browser.handle_packet(start, FROM, &answer(label, &[Part::Ptr], 4500), 0.0);
    }
    let (questions, _) = run_timers(&mut browser, start, 0.5);
    assert_eq!(questions.len(), 4, "{questions:?}");
    let half = answer("arm", &[Part::Srv(HOST)], 120);
    assert_eq!(
        browser.handle_packet(start, FROM, &half, 0.0),
        ParsedPacket::default()
    );
    let half = answer("arm", &[Part::Txt(&[b"TYPE=x"])], 120);
    assert_eq!(
        names(&browser.handle_packet(start, FROM, &half, 0.0)),
        ["arm"]
    );
    let (questions, gone) = run_timers(&mut browser, start, 30.0);
    let times: Vec<u64> = questions.iter().map(|(at, _)| *at).collect();
    assert_eq!(times, [12, 12, 42, 42, 132, 132]);
    assert!(questions.iter().all(|(_, what)| what.starts_with("leg")));
    // A record that was never known is not reported as removed.
    assert_eq!(gone, [0; 0]);
    assert_eq!((browser.records.len(), browser.unknown), (1, 0));
}

#[test]
fn an_expiring_record_is_queried_and_finally_removed() {
    let start = Instant::now();
    let mut browser = browser(start, &["arm", "leg"]);
    let (questions, gone) = run_timers(&mut browser, start, 80.0);
    let expected = ["arm SRV", "arm TXT", "leg SRV", "leg TXT"];
    let mut asked: Vec<&str> = questions.iter().map(|(_, what)| what.as_str()).collect();
    asked.sort_unstable();
    assert_eq!((asked, gone), (expected.to_vec(), vec![]));
    for part in [Part::Srv(HOST), Part::Txt(&[b"TYPE=x"])] {
        let now = start + seconds(80.0);
        browser.handle_packet(now, FROM, &answer("arm", &[part], 120), 0.0);
    }
    let (questions, gone) = run_timers(&mut browser, start, 130.0);
    let of_leg = questions.iter().filter(|(_, what)| what == "leg SRV");
    let times: Vec<u64> = of_leg.map(|(at, _)| *at).collect();
    assert_eq!((times, gone), (vec![960, 1080, 1140], vec![1200]));
    assert!(browser.records.contains_key("arm"));
}

#[test]
fn renewals_are_batched_and_jittered() {
    let start = Instant::now();
    let mut first = browser(start, &[]);
    for number in 0..30 {
        let now = start + seconds(f64::from(number) * 0.1);
        let label = format!("agent {number}");
        first.handle_packet(now, FROM, &announced(&label, b"TYPE=x", 120), 0.0);
    }
    let (questions, _) = run_timers(&mut first, start, 75.0);
    let times: std::collections::HashSet<u64> = questions.iter().map(|(at, _)| *at).collect();
    assert_eq!((questions.len(), times.len()), (60, 1), "{questions:?}");
    // Maximum jitter delays the query, but still before other implementations renew.
    let lifetime = Lifetime::new(start, 120);
    assert_eq!(lifetime.due(0.0), start + seconds(66.0));
    assert!(lifetime.due(1.0) > start + seconds(80.0));
    assert!(lifetime.due(1.0) < start + seconds(120.0 * 0.75));
}

#[test]
fn matching_beacons_keep_records_valid() {
    let start = Instant::now();
    let mut browser = browser(start, &["arm", "peer"]);
    browser.belongs(&format!("arm.{SERVICE_TYPE}"), OTHER);
    for second in 1..600 {
        let now = start + Duration::from_secs(second);
        browser.confirm(now, OTHER);
        let (questions, _) = run_timers(&mut browser, start, second as f64 + 1.0);
        assert!(questions.iter().all(|(_, what)| what.starts_with("peer")));
    }
    assert_eq!(browser.records.len(), 1, "the peer has no beacons");
    // The beacons stop, and no query is answered.
    let (questions, gone) = run_timers(&mut browser, start, 800.0);
    assert_eq!((questions[0].0, gone), (5990 + 660, vec![5990 + 1200]));
}

#[test]
fn own_records_are_not_queried() {
    let start = Instant::now();
    let mut browser = browser(start, &["own"]);
    browser.belongs(&format!("own.{SERVICE_TYPE}"), OWN);
    let (questions, gone) = run_timers(&mut browser, start, 200.0);
    assert_eq!((questions, gone), (vec![], vec![1200]));
}

#[test]
fn a_goodbye_takes_effect_after_a_second_unless_it_is_revoked() {
    let start = Instant::now();
    let mut browser = browser(start, &["arm", "leg", "eye"]);
    for label in ["arm", "leg"] {
        browser.handle_packet(start, FROM, &announced(label, b"TYPE=x", 0), 0.0);
    }
    // A goodbye from another host with the same label.
    let parts = [Part::Ptr, Part::Srv("other.local"), Part::Txt(&[b"TYPE=y"])];
    browser.handle_packet(start, FROM, &answer("eye", &parts, 0), 0.0);
    let back = start + seconds(0.5);
    let received = browser.handle_packet(back, FROM, &announced("leg", b"TYPE=x", 120), 0.0);
    assert_eq!(received, ParsedPacket::default());
    let (_, gone) = run_timers(&mut browser, start, 5.0);
    assert_eq!(gone, [10]);
    assert!(browser.records.contains_key("leg") && browser.records.contains_key("eye"));
}

#[test]
fn a_doubted_record_is_confirmed_or_removed() {
    let start = Instant::now();
    let mut browser = browser(start, &["arm", "leg"]);
    let suspected = ["arm", "leg"].map(|label| format!("{label}.{SERVICE_TYPE}").into());
    browser.suspect(start, &suspected);
    let (questions, _) = run_timers(&mut browser, start, 0.5);
    assert_eq!(questions.len(), 4, "{questions:?}");
    let now = start + seconds(0.5);
    browser.handle_packet(now, FROM, &answer("leg", &[Part::Srv(HOST)], 120), 0.0);
    let (questions, gone) = run_timers(&mut browser, start, 5.0);
    let mut again = questions.iter().map(|(at, what)| (*at, what.as_str()));
    assert_eq!(again.next(), Some((11, "arm SRV")));
    assert!(again.all(|(_, what)| what.starts_with("arm")));
    assert_eq!(gone, [20]);
    // A beacon is not an answer.
    browser.belongs(&suspected[1], OTHER);
    browser.suspect(now, &suspected);
    browser.confirm(now + seconds(0.1), OTHER);
    let (_, gone) = run_timers(&mut browser, start, 5.0);
    assert_eq!(gone, [25]);
}

#[test]
fn queries_for_all_records_back_off_and_are_shared_between_hosts() {
    let start = Instant::now();
    let mut hosts = [0.3, 0.7].map(|chance| Browser::new(start, OWN, chance));
    let mut times = [Vec::new(), Vec::new()];
    let mut next = start;
    while next < start + Duration::from_secs(9000) {
        for asking in 0..2 {
            if hosts[asking].poll_timeout() > next {
                continue;
            }
            let packets = hosts[asking].handle_timeout(next, asking as f64).packets;
            for packet in packets {
                times[asking].push((next - start).as_secs());
                for host in &mut hosts {
                    host.handle_packet(next, FROM, &packet, 0.0);
                }
            }
        }
        next = hosts.iter().map(Browser::poll_timeout).min().unwrap();
    }
    let [first, second] = &times;
    let mut all: Vec<u64> = first.iter().chain(second).copied().collect();
    all.sort_unstable();
    assert_eq!(all[..2], [0, 0], "each host queries once at the start");
    let pauses: Vec<u64> = all.windows(2).skip(1).map(|two| two[1] - two[0]).collect();
    assert!(pauses.len() <= 9, "{all:?}");
    assert!(pauses.iter().all(|pause| *pause <= 3600 * 9 / 8), "{all:?}");
    // A host that has just received the query does not repeat it for missing records.
    let now = start + Duration::from_secs(9000);
    assert_eq!(hosts[0].ask_for_missing(now).len(), 1);
    assert_eq!(hosts[0].ask_for_missing(now + seconds(0.5)).len(), 0);
    assert_eq!(hosts[0].ask_for_missing(now + seconds(1.0)).len(), 1);
    // A query with unknown known-answers does not serve this host.
    let knows_more = &packet::question_for_all(&["stranger"])[0];
    let mut host = Browser::new(start, OWN, 0.0);
    host.handle_timeout(start + seconds(0.2), 0.0);
    let before = host.poll_timeout();
    host.handle_packet(start + seconds(1.1), FROM, knows_more, 0.0);
    assert_eq!(host.poll_timeout(), before);
    let question = &packet::question_for_all(&[])[0];
    host.handle_packet(start + seconds(1.1), FROM, question, 0.0);
    assert!(host.poll_timeout() > before);
}

#[test]
fn pauses_between_queries_grow_with_the_number_of_records() {
    let start = Instant::now();
    let labels: Vec<String> = (0..100).map(|number| format!("agent {number}")).collect();
    let labels: Vec<&str> = labels.iter().map(String::as_str).collect();
    let mut browser = browser(start, &labels);
    for label in labels {
        browser.belongs(&format!("{label}.{SERVICE_TYPE}"), OTHER);
    }
    let mut times = Vec::new();
    for second in 0..9000 {
        let now = start + seconds(f64::from(second));
        browser.confirm(now, OTHER);
        if !browser.handle_timeout(now, 0.0).packets.is_empty() {
            times.push(second);
        }
    }
    assert_eq!(times, [0, 50, 250, 1050, 4250, 7850]);
}

#[test]
fn legacy_peers_are_listed_first_as_known_answers() {
    let now = Instant::now();
    let labels: Vec<String> = (0..40).map(|number| format!("agent {number}")).collect();
    let labels: Vec<&str> = labels.iter().map(String::as_str).collect();
    let mut browser = browser(now, &labels);
    for label in &labels[2..] {
        browser.belongs(&format!("{label}.{SERVICE_TYPE}"), OTHER);
    }
    let packets = browser.ask_for_missing(now);
    let [packet] = &packets[..] else {
        panic!("{packets:?}");
    };
    let packet = packet::parse(packet).unwrap();
    assert_eq!(packet.answers.len(), KNOWN);
    let known = packet.answers.iter();
    let known: Vec<_> = known.map(|one| introduced(&one.name, &one.rdata)).collect();
    assert!(known.contains(&Some(labels[0])) && known.contains(&Some(labels[1])));
}

/// The address of one of eight hosts.
fn one_of_many(number: usize) -> Origin {
    let last = u8::try_from(number % 8).unwrap();
    Origin {
        address: Ipv4Addr::new(198, 51, 100, last).into(),
        ..FROM
    }
}

#[test]
fn the_interfaces_of_a_record_are_reported() {
    let now = Instant::now();
    let mut browser = browser(now, &["arm"]);
    let arm = announced("arm", b"TYPE=x", 120);
    let mut interfaces_after = |interface| {
        let from = Origin { interface, ..FROM };
        let received = browser.handle_packet(now, from, &arm, 0.0);
        let mut found = received.found.into_iter();
        found.next().map(|found| found.interfaces)
    };
    assert_eq!(interfaces_after(FROM.interface), None);
    assert_eq!(interfaces_after(3), Some(vec![3, FROM.interface]));
    assert_eq!(interfaces_after(3), None);
    for interface in 4..10 {
        let known = interfaces_after(interface).unwrap();
        assert!(known[0] == interface && known.len() <= MAX_INTERFACES);
    }
    browser.retain_interfaces(|interface| interface == 9);
    let from = Origin {
        interface: 8,
        ..FROM
    };
    let received = browser.handle_packet(now, from, &arm, 0.0);
    assert_eq!(received.found[0].interfaces, [8, 9]);
}

#[test]
fn the_stored_state_is_bounded() {
    let now = Instant::now();
    let mut browser = Browser::new(now, OWN, 0.0);
    for number in 0..MAX_UNKNOWN + 10 {
        let introduced = answer(&format!("unknown {number}"), &[Part::Ptr], 120);
        let received = browser.handle_packet(now, one_of_many(number), &introduced, 1.0);
        assert_eq!(received.refused, u64::from(number >= MAX_UNKNOWN));
    }
    assert_eq!(browser.unknown, MAX_UNKNOWN);
    // Unknown records do not prevent complete ones from being stored.
    let received = browser.handle_packet(now, FROM, &announced("arm", b"TYPE=x", 10), 0.0);
    assert_eq!((names(&received), received.refused), (vec!["arm"], 0));
    run_timers(&mut browser, now, 20.0);
    assert_eq!((browser.records.len(), browser.unknown), (0, 0));

    let long = [b'x'; 255];
    let strings: Vec<&[u8]> = vec![&long; 33];
    let long = MdnsDirectory::MAX_BYTES / (33 * 257);
    for number in 0..MdnsDirectory::MAX_RECORDS + 10 {
        let strings = if number < long + 5 { &strings[..] } else { &[] };
        let parts = [Part::Ptr, Part::Srv(HOST), Part::Txt(strings)];
        let label = format!("agent {number}");
        browser.handle_packet(now, one_of_many(number), &answer(&label, &parts, 120), 0.0);
        assert!(browser.bytes <= MdnsDirectory::MAX_BYTES);
    }
    // The last quarter is for small sources.
    let most = MdnsDirectory::MAX_RECORDS - MAX_SHARE;
    assert_eq!(browser.records.len(), most);
    assert!(browser.unknown >= 5, "some records were refused");
    run_timers(&mut browser, now, 200.0);
    assert_eq!(
        (browser.records.len(), browser.unknown, browser.bytes),
        (0, 0, 0)
    );
    assert!(browser.shares.is_empty());
}

#[test]
fn several_sources_leave_room_for_small_ones() {
    let now = Instant::now();
    let long = [b'x'; 255];
    let long: Vec<&[u8]> = vec![&long; 33];
    for strings in [&long[..], &[b"TYPE=x"]] {
        let mut browser = Browser::new(now, OWN, 0.0);
        let parts = [Part::Ptr, Part::Srv(HOST), Part::Txt(strings)];
        for number in 0..MdnsDirectory::MAX_RECORDS + 1000 {
            let packet = answer(&format!("agent {number}"), &parts, 120);
            browser.handle_packet(now, one_of_many(number), &packet, 0.0);
        }
        let parts = [Part::Ptr, Part::Srv(HOST), Part::Txt(&[b"TYPE=x"])];
        for host in 0..30 {
            let from = Origin {
                address: Ipv4Addr::new(203, 0, 113, host).into(),
                ..FROM
            };
            for number in 0..100 {
                let label = format!("arm {host} {number}");
                let received = browser.handle_packet(now, from, &answer(&label, &parts, 120), 0.0);
                assert_eq!(names(&received), [label]);
            }
        }
    }
}

#[test]
fn one_source_cannot_fill_the_tables() {
    let now = Instant::now();
    let mut browser = Browser::new(now, OWN, 0.0);
    let others = one_of_many(1);
    for number in 0..MAX_SHARE_UNKNOWN + 10 {
        let introduced = answer(&format!("unknown {number}"), &[Part::Ptr], 120);
        browser.handle_packet(now, FROM, &introduced, 1.0);
    }
    assert_eq!(browser.unknown, MAX_SHARE_UNKNOWN);
    browser.handle_packet(now, others, &answer("late", &[Part::Ptr], 120), 1.0);
    assert_eq!(browser.unknown, MAX_SHARE_UNKNOWN + 1);
    run_timers(&mut browser, now, 20.0);

    let long = [b'x'; 255];
    let long: Vec<&[u8]> = vec![&long; 33];
    for strings in [&long[..], &[b"TYPE=x"]] {
        let mut browser = Browser::new(now, OWN, 0.0);
        let mut refused = 0;
        let parts = [Part::Ptr, Part::Srv(HOST), Part::Txt(strings)];
        for number in 0..MdnsDirectory::MAX_RECORDS {
            let packet = answer(&format!("agent {number}"), &parts, 120);
            refused += browser.handle_packet(now, FROM, &packet, 0.0).refused;
        }
        assert!(refused > 0);
        assert!(browser.records.len() <= MAX_SHARE && browser.bytes <= MAX_SHARE_BYTES);
        let received = browser.handle_packet(now, others, &answer("arm", &parts, 120), 0.0);
        assert_eq!(names(&received), ["arm"]);
        run_timers(&mut browser, now, 200.0);
        assert!(browser.shares.is_empty());
    }
}

#[test]
fn the_addresses_of_an_ipv6_network_are_one_source() {
    let now = Instant::now();
    let known_of = |from: &dyn Fn(u16) -> Origin| {
        let mut browser = Browser::new(now, OWN, 0.0);
        for number in 0..MAX_SHARE_UNKNOWN + 10 {
            let introduced = answer(&format!("unknown {number}"), &[Part::Ptr], 120);
            let number = u16::try_from(number).unwrap();
            browser.handle_packet(now, from(number), &introduced, 1.0);
        }
        browser.unknown
    };
    let of = |network: u16, host, interface| Origin {
        address: Ipv6Addr::new(network, 0, 0, 0, 0, 0, 0, host).into(),
        interface,
    };
    assert_eq!(known_of(&|host| of(0xfd00, host, 2)), MAX_SHARE_UNKNOWN);
    assert_eq!(known_of(&|_| of(0xfe80, 1, 2)), MAX_SHARE_UNKNOWN);
    // Each neighbor has an address of its own in the network of link-local addresses, on each link.
    let all = MAX_SHARE_UNKNOWN + 10;
    assert_eq!(known_of(&|host| of(0xfe80, host, 2)), all);
    assert_eq!(known_of(&|link| of(0xfe80, 1, link.into())), all);
}

proptest! {
    #[test]
    fn arbitrary_packets_do_not_panic(
        mut packet in prop::collection::vec(any::<u8>(), 0..600),
        answers in 0..8_u8,
    ) {
        let mut browser = browser(Instant::now(), &["arm"]);
        if let Some(header) = packet.first_chunk_mut::<12>() {
            *header = [0, 0, 0x84, 0, 0, 0, 0, answers, 0, 0, 0, 0];
        }
        browser.handle_packet(Instant::now(), FROM, &packet, 0.5);
    }

    #[test]
    fn corrupted_packets_do_not_panic(at in 0_usize..160, byte: u8) {
        let mut browser = Browser::new(Instant::now(), OWN, 0.0);
        for mut packet in [announced("arm", b"TYPE=x", 120), announced("arm", b"TYPE=x", 0)] {
            if let Some(broken) = packet.get_mut(at) {
                *broken = byte;
            }
            browser.handle_packet(Instant::now(), FROM, &packet, 0.5);
            prop_assert!(browser.unknown <= browser.records.len());
        }
    }
}
