//! A rover on one host sends a message to an arm on another host, through the gateways of both hosts.
//!
//! Two domains of this machine represent the hosts. On real hosts, `fipa up` runs each gateway, both
//! use the domain `default`, multicast DNS replaces `discovery.static`, and keys protect the connection.
//!
//! ```console
//! $ cargo run --example two_hosts --features net
//! ```

#![allow(clippy::print_stdout, reason = "an example prints")]

use std::time::Duration;

use fipa::config::Sources;
use fipa::{Change, Config, Domain, Gateway, Performative::Inform};

#[tokio::main]
async fn main() -> fipa::Result<()> {
    let there = host("crex", &[])?;
    let crex = Gateway::open(&there).await?;
    let tcp = crex
        .locations()
        .into_iter()
        .find(|it| it.kind().name() == "tcp");
    let tcp = tcp.map(|location| format!("tcp://{}", location.address()));
    let peer = format!(
        "discovery.static={{ crex = [{tcp:?}] }}",
        tcp = tcp.unwrap_or_default()
    );
    let here = host("sherpa", &[peer])?;
    let sherpa = Gateway::open(&here).await?;

    let far = Domain::open(&there).await?;
    let arm = far.register("arm_1").await?;
    let near = Domain::open(&here).await?;
    let rover = near.register("rover").await?;

    // The gateways exchange their directories; then the rover knows the arm.
    let mut changes = near.changes();
    while near.directory().lookup("arm_1").is_none() {
        let change = tokio::time::timeout(Duration::from_millis(100), changes.next()).await;
        if let Ok(Some(Change::Joined(entry))) = change {
            println!("{} is at {}", entry.name, entry.mts.shown());
        }
    }

    let hello = rover.message(Inform).receiver("arm_1").content("hello");
    println!("{}", rover.send(hello).await?);
    println!("arm_1 received {:?}", arm.receive().await?.message().text());

    far.close().await;
    near.close().await;
    sherpa.close().await;
    crex.close().await;
    Ok(())
}

/// Returns the configuration of a host.
fn host(name: &str, set: &[String]) -> fipa::Result<Config> {
    let own = [
        format!("domain={name}-{}", std::process::id()),
        format!("mts.name={name}"),
        "discovery.mdns=false".to_owned(),
        "mts.deadline=30s".to_owned(),
    ];
    Ok(Config::load(&Sources {
        set: own.into_iter().chain(set.iter().cloned()).collect(),
        ..Sources::default()
    })?)
}
