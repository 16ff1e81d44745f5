//! The memory that pages which never read cost.

use fipa::{AgentId, Performative};
use fipa_testbed::private_memory;

use super::*;

/// Number of letters that fill the tables of the gateway: it shows the newest 5,000.
const LETTERS: usize = 6000;

/// Bound of the growth of the gateway's own memory with all silent pages, in bytes. Measured: 5 to 19 MB, most of it the
/// drift of the allocator.
const MAX_MEMORY: u64 = 64 << 20;

/// Growth of the gateway with that many letters once its tables are full, in bytes.
const MAX_DRIFT: u64 = 4 << 20;

/// Bound of the data that the system keeps for a silent page, in bytes. Measured: 286 KB.
const MAX_KEPT: usize = 512 << 10;

/// The bytes that the system keeps for the clients of a port, which have not taken them.
fn kept_by_system(port: u16) -> Vec<usize> {
    let sockets = fs::read_to_string("/proc/net/tcp").unwrap();
    let kept = sockets.lines().skip(1).filter_map(|line| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let (_, from) = fields.get(1)?.split_once(':')?;
        let (sent, _) = fields.get(4)?.split_once(':')?;
        // Only connections, and not the listening socket.
        let is_of_port = u16::from_str_radix(from, 16) == Ok(port) && *fields.get(3)? == "01";
        is_of_port.then(|| usize::from_str_radix(sent, 16).unwrap())
    });
    kept.collect()
}

#[test]
fn pages_that_never_read_cost_bounded_memory() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let domain = runtime
        .block_on(fipa::Domain::open(&config_of(&host)))
        .unwrap();
    let rover = runtime.block_on(domain.register("rover")).unwrap();
    let crane = runtime.block_on(domain.register("crane")).unwrap();
    runtime.spawn(async move { while crane.receive().await.is_ok() {} });
    let send = |count: usize| {
        runtime.block_on(async {
            for number in 0..count {
                let to = AgentId::new("crane").unwrap();
                let message = rover.message(Performative::Inform).receiver(to);
                let message = message.conversation_id("c1").content(format!("{number}"));
                rover.send(message).await.unwrap();
            }
        });
    };
    let newest = || {
        let (_, _, body) = shown.ask("GET", "/api/letters", &shown.bearer(), "");
        let view: Value = serde_json::from_str(&body).unwrap();
        view["letters"].as_object().map_or(0, serde_json::Map::len)
    };
    // The domain is observed from the first question on.
    until("the tables are full", || {
        send(10);
        newest() >= 200
    });
    let pid = shown.gateway.pid();
    let mut before = 0;
    until("the gateway does not grow any more", || {
        send(LETTERS);
        let earlier = std::mem::replace(&mut before, private_memory(pid));
        before < earlier + MAX_DRIFT
    });

    let silent: Vec<Following> = (0..MAX_STREAMS).map(|_| shown.follow("letters")).collect();
    assert!(silent.iter().all(|it| it.status.contains(" 200 ")));
    let port = shown.address.port();
    let mut all = Vec::new();
    // Until the gateway cannot send more: what the clients have not taken stays the same.
    until("all connections are full", || {
        send(1000);
        let found = kept_by_system(port);
        let is_full = found.len() == MAX_STREAMS && found == all && !all.contains(&0);
        all = found;
        is_full
    });
    send(LETTERS);
    let grown = private_memory(pid).saturating_sub(before);
    let most = all.iter().max().copied().unwrap();
    println!(
        "{MAX_STREAMS} silent pages: {grown} bytes of the gateway, up to {most} of the system each"
    );
    assert!(grown < MAX_MEMORY, "{grown}");
    assert!(most < MAX_KEPT, "{all:?}");
    drop(silent);
}
