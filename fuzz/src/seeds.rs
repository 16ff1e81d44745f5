//! Generated and random seeds for targets without recorded ones.

use std::fs;
use std::path::PathBuf;
use std::time::SystemTime;

use fipa_sds::{Entry, MtsId, Reach, Role, Source};
use fipa_transport::Incarnation;
use fipa_transport_net::fuzzing::parcel_body as written;

use crate::input::Input;

/// Writes the seeds of a target into the directory that `FIPA_FUZZ_SEEDS` names.
pub fn write(target: &str) {
    let Some(directory) = std::env::var_os("FIPA_FUZZ_SEEDS").map(PathBuf::from) else {
        return;
    };
    fs::create_dir_all(&directory).expect("a directory for seeds");
    for (number, seed) in of(target).iter().enumerate() {
        fs::write(directory.join(number.to_string()), seed).expect("a seed");
    }
}

/// Returns the seeds of a target.
#[must_use]
pub fn of(target: &str) -> Vec<Vec<u8>> {
    match target {
        "mdns" => {
            let mut seeds = drawn(8, 200);
            for role in [Role::Agent, Role::Gateway] {
                for packet in fipa_sds::fuzzing::announced(&entry(role)) {
                    let len = u16::try_from(packet.len()).unwrap_or(u16::MAX);
                    seeds.push([&[0][..], &len.to_le_bytes(), &packet].concat());
                }
            }
            seeds
        }
        "delivery" => {
            let mut seeds = crate::delivery::seeds();
            seeds.extend(drawn(48, 400));
            seeds
        }
        "http" => crate::http::seeds(),
        "gateway_state" => vec![GATEWAY_STATE.to_vec()],
        "presence" => {
            let mut seeds = drawn(24, 200);
            let texts: [&[u8]; 2] = [
                br#"{"version":1,"ask":[{"id":"0000000000000001","mts":"0000000000000002"}]}"#,
                br#"{"version":1,"here":["0000000000000001"],"gone":[],"unsupported":[]}"#,
            ];
            seeds.extend(texts.map(<[u8]>::to_vec));
            seeds
        }
        "texts" => texts(),
        "config" => config(),
        "host" => vec![HOST.to_vec(), HOST[..120].to_vec()],
        "shm" => {
            let parcels = drawn(16, 300);
            let parcels = parcels.iter().map(|bytes| {
                let parcel = written(&crate::framed::parcel(&mut Input(bytes)));
                let mut seed = vec![1];
                seed.extend(fipa_transport_shm::fuzzing::VERSION.to_le_bytes());
                seed.extend([0; 4]);
                seed.extend(7_u64.to_le_bytes());
                seed.extend([0; 40]);
                seed.extend(parcel.iter().take(4000));
                seed
            });
            parcels.chain(drawn(4, 180)).collect()
        }
        _ => drawn(48, 400),
    }
}

/// The file of a gateway with each kind of item.
const GATEWAY_STATE: &[u8] = include_bytes!("../../src/gateway/state/example.txt");

/// An entries file in the format that a process writes.
const HOST: &[u8] = br#"{"format":"fipa-directory","version":1,"mts":{"name":"arm-mts","incarnation":"00000000000000ab"},"entries":[{"name":"arm_left","type":"gripper","incarnation":"00000000000000cd","locations":["shm://00000000000000ab#00000000000000ab"],"description":"left","registered":1795172400000,"role":"agent"},{"name":"rover","incarnation":"00000000000000ce","locations":["tcp://192.0.2.7:7788#00000000000000ac"],"registered":1795172400000,"role":"agent","remote":{"name":"rover-mts","incarnation":"00000000000000ac"},"source":"mdns"}]}"#;

fn entry(role: Role) -> Entry {
    let gateway = Incarnation::from_u64(9);
    Entry {
        name: "arm_left".into(),
        agent_type: "gripper".into(),
        incarnation: gateway,
        locations: vec!["tcp://192.0.2.7:7788".parse().expect("a location")],
        mts: MtsId::new("arm-mts", gateway),
        description: "left".into(),
        registered: SystemTime::UNIX_EPOCH,
        source: Source::Mdns,
        reach: Reach::Remote { gateway },
        peer: fipa_transport::PeerId::THIS_HOST,
        role,
    }
}

fn texts() -> Vec<Vec<u8>> {
    let texts: [(u8, &[&str]); 5] = [
        (
            1,
            &["urn:fipa:mts:crex-mts\nurn:fipa:agent:arm%5F1\nurn:fipa:agent:rover_*"],
        ),
        (
            3,
            &[
                "tcp://10.0.0.2:7788#00000000000000ab",
                "udp://[fe80::1%25eth0]:7788",
                "shm://00000000000000ab#00000000000000ab",
                "unix://0123#4567",
                "tcp://host.example:7788;sig=letters",
                "http://host:8080/acc",
            ],
        ),
        (4, &["arm_left", "arm_.*", "a b", "arm@host"]),
        (
            5,
            &["arm_.*\narm_left", "(?i)ARM|rover[0-9]{1,3}\nrover7", "a?b"],
        ),
        (6, &["(?x) a # comment\na", "((((a))))*\naaaa"]),
    ];
    let seeds = texts.iter().flat_map(|(kind, texts)| {
        let texts = texts.iter();
        texts.map(|text| [&[*kind][..], text.as_bytes()].concat())
    });
    seeds.collect()
}

fn config() -> Vec<Vec<u8>> {
    let default = fipa::fuzzing::config("", &[]).expect("defaults").render();
    let texts = [
        default.as_str(),
        "domain = \"a\"\n[mts]\ntransports = [\"tcp\"]\n[access]\nrate = 3\n[access.allow]\n\"rover_.*\" = [\"arm performative=inform\"]\n",
        "[discovery]\nstatic = { crex-mts = [\"tcp://10.0.0.2:7788\"] }\n[routes]\n\"camera_.*\" = [\"shm\"]\n\0mts.deadline=9s\0transport.shm.capacity=1GiB",
        "[security]\nkeys = \"/etc/fipa\"\n[transport.quic]\nlisten = [\"0.0.0.0:7788\"]\n",
    ];
    texts.iter().map(|text| text.as_bytes().to_vec()).collect()
}

/// Returns inputs of pseudorandom bytes. They are the same in each run. Each input has 16 to
/// `most + 15` bytes.
fn drawn(count: u64, most: usize) -> Vec<Vec<u8>> {
    // SplitMix64.
    let mut state = 0_u64;
    let mut draw = move || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    };
    let mut input = move |_| {
        let len = draw() as usize % most + 16;
        (0..len).map(|_| draw() as u8).collect()
    };
    (0..count).map(&mut input).collect()
}
