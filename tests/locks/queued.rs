//! The owner's queue between agents of several memberships: the owner names the algorithm, and requests survive its
//! restart.

use std::time::Duration;

use fipa::Agent;
use fipa::locks::{Algorithm, LockError};
use fipa_testbed::until_async;

use super::support::{config, two};
use super::{FOREVER, agent, agent_with, kept, watched};

#[tokio::test(flavor = "multi_thread")]
async fn agents_without_an_option_use_the_algorithm_that_the_owner_names() {
    watched(async {
        for algorithm in Algorithm::ALL {
            let (here, there) = two(&config(&[])).await;
            let files = tempfile::tempdir().unwrap();
            let crane = agent_with(&here, "crane", algorithm).await;
            let bay = crane.own("bay", kept(&files, FOREVER)).await.unwrap();
            let rover = agent(&there, "rover").await;
            let lock = rover.lock("bay").await.unwrap();
            assert!(bay.admit(lock.fence().unwrap()), "{algorithm}");
            lock.release();
            until_async("the bay is free", || bay.status().holder.is_none()).await;
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_agent_that_was_told_to_use_another_algorithm_is_refused_with_both_names() {
    watched(async {
        let (here, there) = two(&config(&[])).await;
        let files = tempfile::tempdir().unwrap();
        let crane = agent(&here, "crane").await;
        let bay = crane.own("bay", kept(&files, FOREVER)).await.unwrap();
        let rover = agent_with(&there, "rover", Algorithm::SuzukiKasami).await;
        let error = rover.lock("bay").await.unwrap_err();
        assert!(
            matches!(error, LockError::OtherAlgorithm { .. }),
            "{error:?}"
        );
        let text = error.to_string();
        assert!(
            text.contains("owner_queue") && text.contains("suzuki_kasami"),
            "{text}"
        );
        assert!(bay.status().holder.is_none());
    })
    .await;
}

/// Requests a resource in a task of its own, and holds it for a moment. Returns the number of the fence.
fn take(user: &Agent) -> tokio::task::JoinHandle<(u64, u64)> {
    let user = user.clone();
    tokio::spawn(async move {
        let lock = user.lock("bay").await.unwrap();
        let position = lock.fence().unwrap().position();
        tokio::time::sleep(Duration::from_millis(20)).await;
        position
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn requests_that_wait_survive_a_restart_of_the_owner_in_their_order() {
    watched(async {
        let config = config(&[]);
        let (here, there) = two(&config).await;
        let files = tempfile::tempdir().unwrap();
        let lease = Duration::from_secs(3);
        let crane = agent(&here, "crane").await;
        let bay = crane.own("bay", kept(&files, lease)).await.unwrap();
        let first = agent(&there, "first").await;
        let lock = first.lock("bay").await.unwrap();
        // Not in the order of their names.
        let (mut users, mut requests) = (Vec::new(), Vec::new());
        for name in ["user-b", "user-c", "user-a"] {
            let user = agent(&there, name).await;
            requests.push(take(&user));
            users.push(user);
            until_async("it waits", || bay.status().waiting == requests.len()).await;
        }
        let fence = lock.fence().unwrap().clone();
        drop(bay);
        here.close().await;
        drop(crane);
        let again = fipa::Domain::open(&config).await.unwrap();
        let crane = agent(&again, "crane").await;
        let bay = crane.own("bay", kept(&files, lease)).await.unwrap();
        assert!(!bay.admit(&fence));
        let mut positions = Vec::new();
        for request in requests {
            positions.push(request.await.unwrap());
        }
        assert!(positions.is_sorted(), "{positions:?}");
        assert!(positions[0].0 > fence.epoch());
    })
    .await;
}
