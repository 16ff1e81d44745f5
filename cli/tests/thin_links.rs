//! Small letters beside large ones, and images of a camera, on a link of 10 Mbit/s.
//!
//! The hosts are network namespaces; see `fipa-testbed`. A packet filter drops what exceeds the rate.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stdout, reason = "the test prints its progress")]

mod hosts;

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

use fipa_testbed::{ChildGuard, Family, Network, directory, enter, isolated, until};
use hosts::PORT;
use serde_json::Value;

/// Length of a large letter: it takes more than ten seconds, and the commands that send small ones take less.
const LARGE: usize = 12 << 20;

/// Defines a test, and the ignored test that it runs in namespaces.
macro_rules! on_a_thin_link {
    ($name:ident, $inside:ident, $test:ident, $family:expr) => {
        #[test]
        fn $name() {
            isolated(stringify!($inside), &["nft"]);
        }

        #[test]
        #[ignore = "is run by the other test in namespaces of its own"]
        fn $inside() {
            enter();
            $test($family);
        }
    };
}

on_a_thin_link!(
    small_letters_arrive_before_large_ones_over_ipv4,
    inside_small_letters_arrive_before_large_ones_over_ipv4,
    small_letters_arrive_before_large_ones,
    Family::V4
);

on_a_thin_link!(
    small_letters_arrive_before_large_ones_over_ipv6,
    inside_small_letters_arrive_before_large_ones_over_ipv6,
    small_letters_arrive_before_large_ones,
    Family::UniqueLocal
);

on_a_thin_link!(
    a_camera_sends_the_newest_image_over_ipv4,
    inside_a_camera_sends_the_newest_image_over_ipv4,
    a_camera_sends_the_newest_image,
    Family::V4
);

on_a_thin_link!(
    a_camera_sends_the_newest_image_over_ipv6,
    inside_a_camera_sends_the_newest_image_over_ipv6,
    a_camera_sends_the_newest_image,
    Family::UniqueLocal
);

/// Makes the links thin. Returns the hosts.
fn thin_network(family: Family) -> Network {
    let network = Network::of(family, 2);
    for host in network.hosts() {
        hosts::filter(
            host,
            "limit rate over 1250 kbytes/second burst 32 kbytes drop",
        );
    }
    network
}

/// The settings of a gateway that uses this transport.
fn settings(at: usize, transport: &str, has_keys: bool) -> Vec<String> {
    vec![
        format!("domain=host{at}"),
        format!("mts.name=gateway{at}"),
        format!("mts.transports=shm,{transport}"),
        format!("transport.{transport}.listen=*:{PORT}"),
        match has_keys {
            true => format!("security.keys={}", hosts::keys(at).dir().display()),
            false => "security.insecure=true".to_owned(),
        },
    ]
}

/// A command of a host.
fn fipa(network: &Network, at: usize, words: &[&str]) -> Command {
    let mut command = network.host(at).command(env!("CARGO_BIN_EXE_fipa"));
    command.args(["--set", &format!("domain=host{at}")]);
    command.args(words).stdin(Stdio::null());
    command
}

/// An image takes the time of 25. A viewer gets whole images with gaps, and at most one image is under way beside the
/// newest one.
fn a_camera_sends_the_newest_image(family: Family) {
    let network = thin_network(family);
    let image = directory().join("image");
    std::fs::write(&image, vec![b'i'; 1_000_000]).unwrap();
    let image = image.display().to_string();
    let _gateways = [0, 1].map(|at| {
        let settings = settings(at, "tcp", false);
        ChildGuard::until_ready(&mut hosts::gateway(network.host(at), &settings)).0
    });
    let publish = ["publish", "camera", "image", "--content-file", &image];
    let publish = [&publish[..], &["--rate", "30"]].concat();
    let _camera = ChildGuard::until_ready(&mut fipa(&network, 0, &publish)).0;
    until("the camera is found", || {
        let agents = fipa(&network, 1, &["agents"]).output().unwrap().stdout;
        String::from_utf8_lossy(&agents).contains("camera")
    });
    let subscribe = ["subscribe", "camera", "image", "--json", "--count", "4"];
    let mut viewer = run(fipa(&network, 1, &subscribe));
    let mut lines = BufReader::new(viewer.stdout.take().unwrap()).lines();
    let mut next = || serde_json::from_str::<Value>(&lines.next().unwrap().unwrap()).unwrap();
    assert_eq!(next()["subscribed"], "camera");
    for number in 0..4 {
        let seen = next();
        let content = seen["notification"]["content"].as_str().unwrap();
        assert_eq!(content.len(), 1_000_000);
        // The first ones may be the latched image and its successor.
        if number > 1 {
            assert!(seen["missed"].as_u64().unwrap() > 0, "{}", seen["missed"]);
        }
        let topics = fipa(&network, 0, &["topics", "camera", "--json"]).output();
        let topics: Value = serde_json::from_slice(&topics.unwrap().stdout).unwrap();
        let subscribers = &topics[0]["topics"][0]["first_subscribers"];
        for subscriber in subscribers.as_array().unwrap() {
            assert!(subscriber["waiting"].as_u64().unwrap() <= 2, "{subscriber}");
        }
    }
    assert!(viewer.wait().unwrap().success());
}

/// Two hosts send each other a large letter. Before these have arrived, new letters of other agents and their
/// replies arrive in both directions.
fn small_letters_arrive_before_large_ones(family: Family) {
    let network = thin_network(family);
    hosts::make_keys(2);
    let map = directory().join("map");
    std::fs::write(&map, vec![7; LARGE]).unwrap();
    let fipa = |at: usize, words: &[&str]| fipa(&network, at, words);
    for (transport, has_keys) in [("tcp", false), ("tcp", true), ("quic", true)] {
        println!("{family:?}: {transport}, keys: {has_keys}");
        let _gateways = [0, 1].map(|at| {
            let settings = settings(at, transport, has_keys);
            ChildGuard::until_ready(&mut hosts::gateway(network.host(at), &settings)).0
        });
        let _agents = [0, 1].map(|at| {
            let names = [format!("echo{at}"), format!("map{at}")];
            let echo = ChildGuard::until_ready(&mut fipa(at, &["echo", &names[0]])).0;
            (
                echo,
                ChildGuard::until_ready(&mut fipa(at, &["listen", &names[1]])).0,
            )
        });
        for (at, other) in [(0, 1), (1, 0)] {
            until("the other host is found", || {
                let agents = fipa(at, &["agents"]).output().unwrap().stdout;
                String::from_utf8_lossy(&agents).contains(&format!("map{other}"))
            });
        }
        let mut large = [(0, "map1"), (1, "map0")].map(|(at, to)| {
            let file = map.display().to_string();
            let words = [
                "send",
                "--to",
                to,
                "--content-file",
                &file,
                "--deadline",
                "5m",
            ];
            run(fipa(at, &words))
        });
        for _ in 0..2 {
            let small = [(0, "echo1"), (1, "echo0")].map(|(at, to)| {
                let words = ["send", "--to", to, "--content", "stop", "--wait"];
                run(fipa(at, &words))
            });
            for sent in small {
                let sent = sent.wait_with_output().unwrap();
                let errors = String::from_utf8_lossy(&sent.stderr);
                assert!(sent.status.success(), "{errors}");
            }
        }
        for sender in &mut large {
            assert_eq!(
                sender.try_wait().unwrap(),
                None,
                "a large letter came first"
            );
        }
        for sender in large {
            let ended = sender.wait_with_output().unwrap();
            let errors = String::from_utf8_lossy(&ended.stderr);
            assert!(ended.status.success(), "{errors}");
        }
    }
}

fn run(mut command: Command) -> Child {
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command.spawn().unwrap()
}
