//! Multicast DNS packets from several sources, and the passing of time.
//!
//! * The counters per source match the stored records and are within the limits.
//! * Found entries are within their limits and can be announced and read again.
//! * Only found records are reported as gone.

use std::net::IpAddr;
use std::time::{Duration, Instant, SystemTime};

use fipa_sds::fuzzing::{Listener, announced};
use fipa_sds::{Entry, Members, MtsId, Reach, Role, Source};
use fipa_transport::Incarnation;

use crate::input::Input;

/// Runs a host with the packets that the bytes encode: raw packets, and announcements with changed
/// bytes.
pub fn play(bytes: &[u8]) {
    let mut input = Input(bytes);
    let mut now = Instant::now();
    let mut listener = Listener::new(now);
    while !input.is_empty() {
        let how = input.byte();
        let from = IpAddr::from([192, 0, 2, how % 3]);
        match how >> 4 {
            0..=7 => {
                let packet = input.long_bytes();
                listener.arrive(now, from, packet);
            }
            8..=12 => {
                let entry = entry(&mut input);
                for mut packet in announced(&entry) {
                    // Changes some bytes of the packet.
                    for _ in 0..input.below(4) {
                        let at = usize::from(u16::from_le_bytes([input.byte(), input.byte()]));
                        let at = at % packet.len();
                        packet[at] = input.byte();
                    }
                    listener.arrive(now, from, &packet);
                }
            }
            _ => {
                let time = input.time().min(Duration::from_secs(7200));
                listener.pass(&mut now, time);
            }
        }
    }
    listener.pass(&mut now, Duration::from_secs(600));
}

fn text(input: &mut Input<'_>) -> String {
    String::from_utf8_lossy(input.bytes(40)).into_owned()
}

fn entry(input: &mut Input<'_>) -> Entry {
    let gateway = Incarnation::from_u64(input.number());
    let role = match input.below(4) {
        0 => Role::Gateway,
        1 => match Members::new([text(input), text(input)], None) {
            Ok(members) => Role::Coalition(members),
            Err(_) => Role::Agent,
        },
        _ => Role::Agent,
    };
    let location = input.one_of(&["tcp://192.0.2.7:7788", "udp://[2001:db8::1]:7788"]);
    Entry {
        name: text(input).into(),
        agent_type: text(input),
        incarnation: Incarnation::from_u64(input.number()),
        locations: vec![location.parse().expect("a location")],
        mts: MtsId::new(text(input), gateway),
        description: text(input),
        registered: SystemTime::UNIX_EPOCH + input.time().min(Duration::from_secs(10_000)),
        source: Source::Mdns,
        reach: Reach::Remote { gateway },
        peer: fipa_transport::PeerId::THIS_HOST,
        role,
    }
}
