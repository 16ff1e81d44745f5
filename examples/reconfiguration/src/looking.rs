//! The camera of the merged robot: that of its last item.

use std::sync::Arc;
use std::time::Duration;

use fipa::protocol::{DialogueError, Reply, Server};
use fipa::{Agent, Performative};
use tokio::sync::Mutex;

use crate::hardware::Sight;
use crate::part::Failed;
use crate::report::{Claim, Reporter};
use crate::words::{self, IMAGES};

/// The items in front of a robot, the first one at its own interface.
pub(crate) type Stack = Arc<Mutex<Vec<String>>>;

/// Maximum wait for the answer of an item.
const TIMEOUT: Duration = Duration::from_secs(10);

/// Offers to look.
pub(crate) fn offer(
    agent: &Agent,
    stack: &Stack,
    reporter: &Reporter,
) -> Result<Server, DialogueError> {
    let looking = (agent.clone(), Arc::clone(stack), reporter.clone());
    agent.serve("fipa-request", move |_| {
        let (agent, stack, reporter) = looking.clone();
        async move {
            let looked = look(agent, stack, reporter).await;
            looked.map_err(|error| error.to_string())
        }
    })
}

async fn look(agent: Agent, stack: Stack, reporter: Reporter) -> Result<Reply, Failed> {
    let Some(of) = stack.lock().await.last().cloned() else {
        return Ok(Reply::Refuse("no item is docked".into()));
    };
    let subscribe = agent.message(Performative::Subscribe).receiver(of.as_str());
    let mut images = agent.subscribe(subscribe.content(IMAGES), TIMEOUT).await?;
    let image = images.next().await?;
    images.cancel(TIMEOUT).await?;
    let image = words::bytes(image.message());
    let marker = Sight::find(image).map(|sight| sight.marker.to_string());
    let bytes = image.len();
    reporter.claim(Claim::Image { of, bytes, marker });
    Ok(Reply::Inform(words::say(&bytes).into()))
}
