//! Tests of the reports of the gateway.

use serde_json::json;

use super::*;

/// A report of a gateway with a connected peer, a lost one and one that does not answer.
pub(in crate::command::top) fn report() -> RouteReport {
    let [tcp, udp] = [
        "tcp://10.0.0.7:7788#00000000000000ab",
        "udp://10.0.0.7:7789#00000000000000ab",
    ];
    let way = |location: &str, taken: u64, failed: u64| {
        json!({
            "location": location, "standing": "ready", "in_flight": 0, "tried": taken + failed,
            "taken": taken, "turned_back": 1, "failed": failed, "last_error": null,
            "last_error_seconds": null,
        })
    };
    let report = json!({
        "mts": "sherpa-mts", "incarnation": "00000000000000cd", "locations": [], "routes": [],
        "ways": [
            way(tcp, 40, 2), way(udp, 0, 3),
            way("tcp://10.0.0.8:7788#00000000000000ef", 7, 100),
        ],
        "peers": [
            { "name": "lander", "answers": null, "failures": [], "asked_again_in": 100 },
            { "name": "crex-mts", "answers": null, "failures": [], "asked_again_in": null },
        ],
        "neighbors": [{
            "name": "crex-mts", "incarnation": "00000000000000ab", "locations": [tcp, udp],
            "connections": 1, "seconds": 60,
            "security": { "encrypted": true, "certificate": null },
        }],
        "lost": [
            { "name": "bert-mts", "seconds": 5, "certificate": null },
            { "name": "crex-mts", "seconds": 90, "certificate": null },
        ],
    });
    serde_json::from_value(report).unwrap()
}

#[test]
fn hosts_are_connected_or_lost_or_do_not_answer() {
    let now = Instant::now();
    let meter = Meter::new(now, Duration::from_secs(5));
    let mut peers = Peers::default();
    assert!(peers.rows(now, &meter).is_empty());
    peers.handle_report(now, Some(report()));
    let later = now + Duration::from_secs(3);
    let rows = peers.rows(later, &meter);
    let states: Vec<(&str, &PeerState)> = rows
        .iter()
        .map(|row| (row.name.as_str(), &row.state))
        .collect();
    let seconds = Duration::from_secs;
    assert_eq!(
        states,
        [
            ("bert-mts", &PeerState::Lost(seconds(8))),
            ("crex-mts", &PeerState::Connected(seconds(63))),
            ("lander", &PeerState::Silent),
        ]
    );
    // Only the attempts at its own locations; only the transport that has carried letters.
    let crex = &rows[1];
    assert_eq!((crex.retries, crex.encrypted), (7, Some(true)));
    assert_eq!(crex.transports, [Kind::Tcp]);
}

#[test]
fn a_failed_request_keeps_the_last_report() {
    let now = Instant::now();
    let mut peers = Peers::default();
    peers.handle_report(now, Some(report()));
    peers.handle_failure("no answer".to_owned());
    assert_eq!(peers.problem(), Some("no answer"));
    let meter = Meter::new(now, Duration::from_secs(5));
    assert_eq!(peers.rows(now, &meter).len(), 3);
    peers.handle_report(now, None);
    assert_eq!(peers.problem(), None);
    assert!(peers.rows(now, &meter).is_empty());
}
