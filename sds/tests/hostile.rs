//! Malicious records: other agents are still found, and the stored state is bounded.

// The exception in clippy.toml for tests does not apply to functions that they call.
#![allow(clippy::unwrap_used, clippy::print_stdout, clippy::print_stderr)]

mod common;

use std::net::{Ipv4Addr, UdpSocket};
use std::time::{Duration, Instant};

use common::mdns::{free_port, open};
use common::registration;
use fipa_sds::{Change, Directory, MdnsDirectory};
use fipa_testbed::until_some_async;
use simple_dns::rdata::{A, PTR, RData, SRV, TXT};
use simple_dns::{CLASS, CharacterString, Label, Name, Packet, PacketFlag, ResourceRecord};

const SERVICE: [&str; 3] = ["_fipa_service_directory", "_udp", "local"];

/// Number of announced records, unless `FIPA_FLOOD` sets another.
const FLOOD: u32 = 10_000;
/// Time for which a long run waits for records that may be lost.
const TIMEOUT: Duration = Duration::from_millis(100);

struct Attacker {
    socket: UdpSocket,
    port: u16,
}

impl Attacker {
    fn new(port: u16) -> Self {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let of_socket = socket2::SockRef::from(&socket);
        of_socket.set_multicast_if_v4(&Ipv4Addr::LOCALHOST).unwrap();
        of_socket.set_multicast_ttl_v4(255).unwrap();
        Self { socket, port }
    }

    fn send(&self, packet: &[u8]) {
        let group = (Ipv4Addr::new(224, 0, 0, 251), self.port);
        self.socket.send_to(packet, group).unwrap();
    }

    /// Announces a record with these strings, with all parts that a browser needs.
    fn announce(&self, label: &[u8], strings: &[&[u8]]) {
        let service = labels(&[]);
        let instance = labels(&[label]);
        let host = Name::new_unchecked("hostile.local");
        let mut txt = TXT::new();
        for string in strings {
            txt.add_char_string(CharacterString::new(string).unwrap());
        }
        let mut packet = Packet::new_reply(0);
        packet.set_flags(PacketFlag::AUTHORITATIVE_ANSWER);
        let srv = SRV {
            priority: 0,
            weight: 0,
            port: 0,
            target: host.clone(),
        };
        let address = A {
            address: u32::from(Ipv4Addr::LOCALHOST),
        };
        for (name, data) in [
            (service, RData::PTR(PTR(instance.clone()))),
            (instance.clone(), RData::SRV(srv)),
            (instance, RData::TXT(txt)),
            (host, RData::A(address)),
        ] {
            let record = ResourceRecord::new(name, CLASS::IN, 120, data);
            packet.answers.push(record);
        }
        self.send(&packet.build_bytes_vec_compressed().unwrap());
    }
}

fn labels<'a>(first: &[&'a [u8]]) -> Name<'a> {
    let mut labels: Vec<Label<'a>> = first.iter().map(|one| Label::new_unchecked(*one)).collect();
    labels.extend(SERVICE.map(|label| Label::new_unchecked(label.as_bytes())));
    Name::new_with_labels(&labels)
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_records_do_not_affect_other_agents() {
    let port = free_port();
    let (victim, honest) = (open(port, "victim"), open(port, "honest"));
    honest.register(registration("before")).unwrap();
    until_some_async("found before the attack", || victim.lookup("before")).await;
    let attacker = Attacker::new(port);
    let long = [b'x'; 250];
    let endless: Vec<&[u8]> = (0..30).map(|_| &long[..]).collect();
    attacker.announce(b"endless", &endless);
    attacker.announce(
        b"binary",
        &[
            b"TYPE=\xff\xfe\x00",
            b"\x00=\x01",
            b"",
            b"=",
            b"LOCATOR=\xc3\x28;",
        ],
    );
    attacker.announce(b"newline\n", &[b"TYPE=x"]);
    attacker.announce(b"liar", &[b"fipa-version=1", b"fipa-name=", b"fipa-id=0"]);
    attacker.announce(b"future", &[b"fipa-version=99"]);
    // Names that point to themselves and to each other, and false lengths.
    for packet in [
        &b"\0\0\x84\0\0\0\0\x01\0\0\0\0\xc0\x0c\0\x10\0\x01\0\0\0\x78\0\0"[..],
        b"\0\0\x84\0\0\0\0\x02\0\0\0\0\xc0\x0e\xc0\x0c\0\x10\0\x01\0\0\0\x78\0\0",
        b"\0\0\x84\0\0\0\xff\xff\xff\xff\xff\xff\x01a\0",
        b"\0\0\x84\0\0\0\0\x01\0\0\0\0\x01a\0\0\x10\0\x01\0\0\0\x78\xff\xff",
        b"",
        b"\0",
        &[0xff; 9000],
    ] {
        attacker.send(packet);
    }
    // Beacons of a gateway that claims a million agents, of an unknown gateway, and of the victim
    // itself.
    for label in ["00000000000000aa", "0000000000000000", "absent"] {
        let mut packet = Packet::new_reply(0);
        let txt = TXT::new().with_string("agents=1000000").unwrap();
        let txt = txt.with_string("digest=0123456789abcdef").unwrap();
        let name = format!("{label}._fipa_gateway._udp.local");
        let name = Name::new_unchecked(&name);
        packet
            .answers
            .push(ResourceRecord::new(name, CLASS::IN, 10, RData::TXT(txt)));
        attacker.send(&packet.build_bytes_vec_compressed().unwrap());
    }
    honest.register(registration("arm")).unwrap();
    until_some_async("the honest agent", || victim.lookup("arm")).await;
    until_some_async("the liar and the future are refused", || {
        (victim.status().refused >= 2).then_some(())
    })
    .await;
    let names: Vec<String> = victim
        .entries()
        .iter()
        .map(|entry| entry.name.to_string())
        .collect();
    assert!(
        !names.iter().any(|name| name == "liar" || name == "future"),
        "{names:?}"
    );
    for entry in victim.entries().iter() {
        assert_eq!(entry.check(), Ok(()));
    }
}

/// A record that is valid for two minutes, of a peer without beacons: only the record of an
/// unreachable peer is queried.
#[tokio::test(flavor = "multi_thread")]
async fn a_legacy_peer_that_vanished_is_removed_after_verification() {
    let port = free_port();
    let (directory, other) = (open(port, "directory"), open(port, "other"));
    other.register(registration("before")).unwrap();
    until_some_async("it listens", || directory.lookup("before")).await;
    let peer = Attacker::new(port);
    for label in ["used", "unused"] {
        peer.announce(label.as_bytes(), &[b"TYPE=x"]);
        until_some_async("the peer's agent", || directory.lookup(label)).await;
    }
    directory.verify("used");
    let is_gone = || directory.lookup("used").is_none().then_some(());
    until_some_async("the unanswered record is removed", is_gone).await;
    assert!(directory.lookup("unused").is_some());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flood_of_records_is_bounded_and_others_are_found() {
    let port = free_port();
    let (victim, honest) = (open(port, "victim"), open(port, "honest"));
    honest.register(registration("before")).unwrap();
    until_some_async("found before the flood", || victim.lookup("before")).await;
    let attacker = Attacker::new(port);
    let (before, started) = (memory(), Instant::now());
    let flood = std::env::var("FIPA_FLOOD").ok();
    let long = flood.is_some();
    let flood = flood.map_or(FLOOD, |flood| flood.parse().unwrap());
    let mut enough = 0;
    for number in 0..flood {
        attacker.announce(format!("agent {number}").as_bytes(), &[b"TYPE=x"]);
        // Paced, so that most packets are received. A long run waits until they are handled, or
        // lost.
        if number % 50 == 0 {
            tokio::time::sleep(Duration::from_millis(1)).await;
            let sent = Instant::now();
            while long && received_records(&victim) < enough && sent.elapsed() < TIMEOUT {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
            enough = received_records(&victim) + 40;
        }
    }
    let status = victim.status();
    let known = status.known;
    println!(
        "of {flood}: {known} kept, {} refused, {} MiB more, {:.1?}",
        status.refused,
        (memory() - before) >> 20,
        started.elapsed()
    );
    assert!(known <= MdnsDirectory::MAX_RECORDS, "{known}");
    assert!(known > 100, "the flood was not received: {known}");
    // Known agents stay known, and unicast still works.
    assert!(victim.lookup("before").is_some());
    assert!(honest.register(registration("after")).is_ok());
}

#[tokio::test(flavor = "multi_thread")]
async fn the_cache_of_the_library_is_bounded_and_no_agent_leaves() {
    let port = free_port();
    let (victim, honest) = (open(port, "victim"), open(port, "honest"));
    let entry = honest.register(registration("honest")).unwrap();
    victim.register(registration("victim")).unwrap();
    until_some_async("the honest agent", || victim.lookup("honest")).await;
    until_some_async("the victim's agent", || honest.lookup("victim")).await;
    let (mut seen_by_victim, mut seen_by_honest) = (victim.watch(), honest.watch());
    let attacker = Attacker::new(port);
    let before = memory();
    // Addresses belong to no service, so that only the limit of the library's cache applies.
    let addresses = |of: u32| {
        let mut packet = Packet::new_reply(0);
        packet.set_flags(PacketFlag::AUTHORITATIVE_ANSWER);
        for number in 0..250 {
            let address = RData::A(A {
                address: u32::from(Ipv4Addr::LOCALHOST),
            });
            let name = format!("h{of}-{number}.local");
            let name = Name::new(&name).unwrap().into_owned();
            let record = ResourceRecord::new(name, CLASS::IN, 4500, address);
            packet.answers.push(record);
        }
        packet.build_bytes_vec_compressed().unwrap()
    };
    // Until both have reached the limit; packets may be lost. `FIPA_FLOOD` sets a higher number of
    // packets.
    let flood = std::env::var("FIPA_FLOOD").map_or(0, |flood| flood.parse().unwrap());
    let mut sent = 0;
    let flooding = async {
        let restarts = |of: &MdnsDirectory| of.status().restarts;
        while restarts(&victim) == 0 || restarts(&honest) == 0 || sent * 250 < flood {
            attacker.send(&addresses(sent));
            sent += 1;
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    let watchdog = common::WATCHDOG + Duration::from_millis(u64::from(flood));
    let flooded = tokio::time::timeout(watchdog, flooding).await;
    let more = memory().saturating_sub(before) >> 20;
    let restarts = victim.status().restarts;
    println!(
        "after {} addresses: {more} MiB more, {restarts} restarts",
        sent * 250
    );
    flooded.expect("the library is restarted");
    assert!(u64::from(sent) * 250 > MdnsDirectory::MAX_CACHED);
    until_some_async("the flood is reported", || {
        let why = victim.status().last_error?;
        why.contains("floods the network").then_some(())
    })
    .await;
    // A registration while the library is stopped, and one after that, are found.
    honest.register(registration("during")).unwrap();
    until_some_async("registered during the flood", || victim.lookup("during")).await;
    victim.register(registration("after")).unwrap();
    until_some_async("registered after the flood", || honest.lookup("after")).await;
    for watch in [&mut seen_by_victim, &mut seen_by_honest] {
        while let Some(change) = watch.try_next() {
            assert!(!matches!(change, Change::Left(_)), "{change:?}");
        }
    }
    // The new library announces the earlier registrations, and can withdraw them.
    honest.deregister("honest", entry.incarnation).unwrap();
    until_some_async("left after the flood", || {
        victim.lookup("honest").is_none().then_some(())
    })
    .await;
}

/// Number of records of others that were used or refused.
fn received_records(directory: &MdnsDirectory) -> u64 {
    let status = directory.status();
    status.known as u64 + status.refused
}

/// The memory of this process, in bytes.
fn memory() -> u64 {
    let status = std::fs::read_to_string("/proc/self/statm").unwrap();
    let pages: u64 = status.split(' ').nth(1).unwrap().parse().unwrap();
    pages * 4096
}
