//! The Rust code of the book (docs/book), which includes the parts between the `ANCHOR` comments.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(
    clippy::print_stdout,
    reason = "the code of the book prints its results"
)]

mod support;

use std::time::Duration;

use fipa::error::SendError;
use fipa::protocol::{DialogueError, Reply, Task};
use fipa::topics::Topic;
use fipa::{Agent, AgentId, Config, Domain, Performative};

type Result<T> = std::result::Result<T, Box<dyn std::error::Error + Send + Sync>>;

/// A deadline that a passing test does not reach.
const TIMEOUT: Duration = Duration::from_secs(60);

// ANCHOR: handler
async fn lift(mut task: Task) -> std::result::Result<Reply, DialogueError> {
    if task.message().content().is_none() {
        return Ok(Reply::Refuse("lift what?".into()));
    }
    task.agree("").await?;
    // The work of the arm.
    Ok(Reply::Inform("lifted".into()))
}
// ANCHOR_END: handler

async fn two_agents(set: &[&str]) -> (Agent, Agent) {
    let (here, there) = support::two(&support::config(set)).await;
    let rover = here.register("rover").await.unwrap();
    let arm = there.register("arm_1").await.unwrap();
    (rover, arm)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_request_is_served() -> Result<()> {
    let (rover, arm) = two_agents(&[]).await;
    // ANCHOR: serve
    let server = arm.serve("fipa-request", lift)?;
    // ANCHOR_END: serve
    // ANCHOR: request
    let request = rover
        .message(Performative::Request)
        .receiver("arm_1")
        .content("crate");
    let mut request = rover.request(request, Duration::from_secs(60)).await?;
    if request.agreed().await? {
        println!("arm_1 has agreed");
    }
    let result = request.result().await?;
    // ANCHOR_END: request
    assert_eq!(&result.content().unwrap()[..], b"lifted");
    drop(server);
    Ok(())
}

async fn offer(arm: &Agent, price: u32) -> Result<()> {
    // ANCHOR: propose
    let call = arm.receive().await?;
    let mut task = arm.take_part(&call)?;
    if task
        .propose(price.to_string(), Duration::from_secs(60))
        .await?
    {
        // The work of the arm.
        task.reply(Reply::Inform("carried".into())).await?;
    }
    // ANCHOR_END: propose
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_cheapest_proposal_is_awarded() -> Result<()> {
    let config = support::config(&[]);
    let (here, there) = support::two(&config).await;
    let rover = here.register("rover").await?;
    for (name, price) in [("arm_1", 30), ("arm_2", 10)] {
        let arm = there.register(name).await?;
        tokio::spawn(async move { offer(&arm, price).await });
    }
    // ANCHOR: contract_net
    let call = rover.message(Performative::Cfp).content("carry the crate");
    let arms = [AgentId::new("arm_1")?, AgentId::new("arm_2")?];
    let mut net = rover
        .contract_net(call, &arms, Duration::from_secs(60))
        .await?;
    let price = |bid: &fipa::Message| {
        let text = String::from_utf8_lossy(bid.content()?).into_owned();
        text.parse::<u32>().ok()
    };
    let best = net
        .bids()
        .proposals
        .iter()
        .min_by_key(|bid| price(bid))
        .cloned();
    let best = best.ok_or("no arm has made a proposal")?;
    let results = net.award(&[best], "", Duration::from_secs(60)).await?;
    // ANCHOR_END: contract_net
    assert_eq!(results.len(), 1);
    assert_eq!(results[0].agent, "arm_2");
    assert!(results[0].result.is_ok());
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_subscriber_is_notified() -> Result<()> {
    let (rover, battery) = two_agents(&[]).await;
    // ANCHOR: publish
    // In the process of the battery:
    let charge = battery.publisher("charge")?;

    // In the process of the rover:
    let subscribe = rover
        .message(Performative::Subscribe)
        .receiver(battery.id().clone())
        .content("charge");
    let mut subscription = rover.subscribe(subscribe, Duration::from_secs(60)).await?;

    // In the process of the battery, at each change:
    let reached = charge.publish("87").await.delivered().await;

    // In the process of the rover:
    let notification = subscription.next().await?;
    // ANCHOR_END: publish
    assert_eq!(reached, 1);
    assert_eq!(&notification.content().unwrap()[..], b"87");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_camera_loans_its_images() -> Result<()> {
    let (rover, camera) = two_agents(&[]).await;
    // ANCHOR: camera
    let images = camera.publisher(Topic::new("image").rate(30.0))?;

    // In the process of a viewer:
    let subscribe = rover
        .message(Performative::Subscribe)
        .receiver(camera.id().clone())
        .content("image");
    let mut viewed = rover.subscribe(subscribe, Duration::from_secs(60)).await?;

    // In the process of the camera, for each image:
    let mut image = images.loan(1_000_000)?;
    image.content_mut().fill(7);
    let published = images.publish_loan(image).await;
    println!(
        "image {} for {} viewers",
        published.number(),
        published.subscribers()
    );
    // ANCHOR_END: camera
    assert_eq!(published.delivered().await, 1);
    let content = viewed.next().await?.into_message();
    assert!(content.content().unwrap().iter().all(|byte| *byte == 7));
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn loaned_content_arrives() -> Result<()> {
    let (rover, arm) = two_agents(&[]).await;
    let picture = vec![7_u8; 100_000];
    // ANCHOR: loan
    let message = rover
        .message(Performative::Inform)
        .receiver("arm_1")
        .build()?;
    let mut loan = rover.loan(message, picture.len())?;
    loan.content_mut().copy_from_slice(&picture);
    let deliveries = rover.send_loan(loan).await?;
    // ANCHOR_END: loan
    assert!(deliveries.all_succeeded(), "{deliveries}");
    let received = arm.receive().await?.into_message();
    assert_eq!(received.content().unwrap()[..], picture[..]);
    Ok(())
}

// ANCHOR: own_handler
async fn open(mut task: Task) -> std::result::Result<Reply, DialogueError> {
    task.agree("").await?;
    task.inform("open").await?;
    // The confirmation of the initiator, which ends the conversation.
    task.next(Duration::from_secs(60)).await?;
    Ok(Reply::Nothing)
}
// ANCHOR_END: own_handler

/// The configuration of the chapter, with the file of the book.
fn with_own_protocol() -> Config {
    let file = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/docs/book/src/files/door.scxml"
    );
    let protocols = format!("monitor.protocols={file}");
    support::config(&[&protocols, "monitor.check=enforce"])
}

#[tokio::test(flavor = "multi_thread")]
async fn an_own_protocol_is_followed() -> Result<()> {
    let config = with_own_protocol();
    let domain = Domain::open(&config).await?;
    let rover = domain.register("rover").await?;
    let door = domain.register("door").await?;
    let _server = door.serve("open-door", open)?;
    // ANCHOR: own_protocol
    let request = rover
        .message(Performative::Request)
        .receiver("door")
        .protocol("open-door")
        .conversation_id(rover.unique_id())
        .content("open")
        .build()?;
    rover.send(request.clone()).await?;
    let agreed = rover.receive().await?.into_message();
    let opened = rover.receive().await?.into_message();
    // ANCHOR_END: own_protocol
    assert_eq!(agreed.performative(), &Performative::Agree);
    assert_eq!(opened.performative(), &Performative::Inform);
    // ANCHOR: own_violation
    let refused = rover.send(request).await;
    // The protocol permits only a confirm of the initiator now.
    assert!(matches!(refused, Err(SendError::Violation(_))));
    // ANCHOR_END: own_violation
    let passed = rover.reply(&opened, Performative::Confirm).build()?;
    let deliveries = rover.send_within(passed, TIMEOUT).await?;
    assert!(deliveries.all_succeeded(), "{deliveries}");
    domain.close().await;
    Ok(())
}
