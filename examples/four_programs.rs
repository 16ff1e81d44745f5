//! An application of four programs: an operator watches a battery and requests a rover, which lets the
//! arms bid for the work. Without an argument, this is the operator and starts the others.
//!
//! ```console
//! $ cargo run --example four_programs
//! ```

#![allow(clippy::print_stdout, reason = "an example prints")]

use std::process::Command;
use std::time::Duration;

use fipa::Performative::{Cfp, Request, Subscribe};
use fipa::protocol::{Reply, Task};
use fipa::{Agent, Change, Domain};

const TIMEOUT: Duration = Duration::from_secs(60);

#[tokio::main]
async fn main() -> fipa::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let domain = Domain::from_environment().await?;
    let mut changes = domain.changes();
    let end_of_operator = async {
        while let Some(change) = changes.next().await {
            if matches!(change, Change::Left(entry) if &*entry.name == "operator") {
                break;
            }
        }
    };
    tokio::select! {
        done = program(&domain, &arguments) => done?,
        () = end_of_operator => {}
    }
    domain.close().await;
    Ok(())
}

async fn program(domain: &Domain, arguments: &[&str]) -> fipa::Result<()> {
    match arguments {
        ["battery"] => battery(domain).await,
        ["rover"] => rover(domain).await,
        ["arm", name, price] => arm(domain, name, price).await,
        _ => operator(domain).await,
    }
}

async fn battery(domain: &Domain) -> fipa::Result<()> {
    let battery = domain.register("battery").await?;
    let charge = battery.publisher("charge")?;
    let mut percent = 79;
    loop {
        if charge.publish(percent.to_string()).await.subscribers() > 0 {
            percent -= 1;
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

async fn arm(domain: &Domain, name: &str, price: &str) -> fipa::Result<()> {
    let (arm, price) = (domain.register(name).await?, price.to_owned());
    let mut server = arm.serve("fipa-contract-net", move |task| bid(task, price.clone()))?;
    server.ended().await;
    Ok(())
}

async fn bid(mut task: Task, price: String) -> fipa::Result<Reply> {
    match task.propose(price, TIMEOUT).await? {
        true => Ok(Reply::Inform("carried".into())),
        false => Ok(Reply::Nothing),
    }
}

async fn rover(domain: &Domain) -> fipa::Result<()> {
    let rover = domain.register("rover").await?;
    let handle = rover.clone();
    let mut server = rover.serve("fipa-request", move |task| carry(handle.clone(), task))?;
    server.ended().await;
    Ok(())
}

async fn carry(rover: Agent, mut task: Task) -> fipa::Result<Reply> {
    task.agree("").await?;
    let call = rover.message(Cfp).content(task.message().text());
    let mut net = rover.contract_net(call, &["arm_.*"], TIMEOUT).await?;
    let mut bids = net.bids().proposals.clone();
    bids.sort_by_key(|bid| bid.parse::<u32>().unwrap_or(u32::MAX));
    let awarded = net.award(bids.get(..1).unwrap_or(&[]), "", TIMEOUT).await?;
    let Some(awarded) = awarded.into_iter().next() else {
        return Ok(Reply::Failure("no arm has proposed".into()));
    };
    awarded.result?;
    Ok(Reply::Inform(
        format!("carried by {}", awarded.agent).into(),
    ))
}

async fn operator(domain: &Domain) -> fipa::Result<()> {
    let operator = domain.register("operator").await?;
    let mut others = Vec::new();
    for program in ["battery", "rover", "arm arm_1 30", "arm arm_2 10"] {
        let this = std::env::current_exe()?;
        others.push(Command::new(this).args(program.split(' ')).spawn()?);
    }
    while domain.agents().len() < 5 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let subscribe = operator
        .message(Subscribe)
        .receiver("battery")
        .content("charge");
    let mut charge = operator.subscribe(subscribe, TIMEOUT).await?;
    println!("operator: charge {} %", charge.next().await?.text());

    let carry = operator
        .message(Request)
        .receiver("rover")
        .content("(carry crate)");
    let done = operator.request(carry, TIMEOUT).await?.result().await?;
    println!("operator: {}", done.text());
    charge.cancel(TIMEOUT).await?;
    // The others end when the operator leaves.
    operator.deregister()?;
    for mut program in others {
        program.wait()?;
    }
    Ok(())
}
