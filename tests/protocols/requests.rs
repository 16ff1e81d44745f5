//! Requests whose answers are repeated, superfluous or cross a cancel.

use super::*;

/// Sends this answer to a message, without the checks of a call.
async fn answer(arm: &Agent, first: &Message, act: Performative, content: &str) {
    let answer = arm.reply(first, act).content(content.to_owned());
    let sent = arm.send(answer.build().unwrap()).await.unwrap();
    assert!(sent.all_succeeded(), "{sent}");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_first_answer_that_ends_a_request_stays() {
    use Performative::{Failure, NotUnderstood, Refuse};
    let (rover, arm) = pair(&[]).await;
    for act in [Refuse, Failure, NotUnderstood] {
        let lift = to(&rover, Performative::Request, &arm, "lift");
        let mut request = rover.request(lift, TIMEOUT).await.unwrap();
        let first = next_message(&arm).await.unwrap().into_message();
        answer(&arm, &first, act.clone(), "busy").await;
        let agreed = request.agreed().await.map(|_| ());
        let again = request.agreed().await.map(|_| ());
        let result = request.result().await.map(|_| ());
        for ended in [agreed, again, result] {
            let message = match ended {
                Err(DialogueError::Refused(message)) if act == Refuse => message,
                Err(DialogueError::Failed(message)) if act == Failure => message,
                Err(DialogueError::NotUnderstood(message)) if act == NotUnderstood => message,
                other => panic!("{act}: {other:?}"),
            };
            assert_eq!(text(&message), "busy");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn superfluous_messages_do_not_end_a_request() {
    let (rover, arm) = pair(&[]).await;
    let lift = to(&rover, Performative::Request, &arm, "lift");
    let mut request = rover.request(lift, TIMEOUT).await.unwrap();
    let first = next_message(&arm).await.unwrap().into_message();
    for act in [
        Performative::Agree,
        Performative::Agree,
        Performative::Propose,
    ] {
        answer(&arm, &first, act, "").await;
    }
    answer(&arm, &first, Performative::Inform, "lifted").await;
    assert_eq!(text(&request.result().await.unwrap()), "lifted");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cancel_that_is_refused_loses_no_result() {
    let (rover, arm) = pair(&[]).await;
    let lift = to(&rover, Performative::Request, &arm, "lift");
    let mut request = rover.request(lift, TIMEOUT).await.unwrap();
    let first = next_message(&arm).await.unwrap().into_message();
    let refuses = async {
        let cancel = next_message(&arm).await.unwrap().into_message();
        assert_eq!(*cancel.performative(), Performative::Cancel);
        // The agreement was sent before the cancel arrived.
        answer(&arm, &first, Performative::Agree, "").await;
        answer(&arm, &cancel, Performative::Failure, "too late").await;
        answer(&arm, &first, Performative::Inform, "lifted").await;
    };
    let (cancelled, ()) = tokio::join!(request.cancel(TIMEOUT), refuses);
    assert!(!cancelled.unwrap());
    assert!(request.agreed().await.unwrap());
    assert_eq!(text(&request.result().await.unwrap()), "lifted");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_result_that_crosses_a_cancel_is_not_lost() {
    let (rover, arm) = pair(&[]).await;
    for (act, content) in [
        (Performative::Inform, "lifted"),
        (Performative::Failure, "broken"),
    ] {
        let lift = to(&rover, Performative::Request, &arm, "lift");
        let mut request = rover.request(lift, TIMEOUT).await.unwrap();
        let first = next_message(&arm).await.unwrap().into_message();
        let crosses = async {
            let cancel = next_message(&arm).await.unwrap().into_message();
            assert_eq!(*cancel.performative(), Performative::Cancel);
            answer(&arm, &first, act.clone(), content).await;
        };
        let (cancelled, ()) = tokio::join!(request.cancel(TIMEOUT), crosses);
        assert!(!cancelled.unwrap());
        // A second cancel of an ended request sends nothing.
        assert!(!request.cancel(TIMEOUT).await.unwrap());
        assert!(arm.try_receive().unwrap().is_none());
        let message = match request.result().await {
            Ok(message) => message,
            Err(DialogueError::Failed(message)) => *message,
            other => panic!("{other:?}"),
        };
        assert_eq!((message.performative(), text(&message)), (&act, content));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_confirmed_cancel_ends_a_request_although_its_wait_was_given_up() {
    let (rover, arm) = pair(&[]).await;
    let lift = to(&rover, Performative::Request, &arm, "lift");
    let mut request = rover.request(lift, TIMEOUT).await.unwrap();
    let first = next_message(&arm).await.unwrap().into_message();
    answer(&arm, &first, Performative::Agree, "").await;
    let timed_out = request.cancel(Duration::from_secs(5)).await;
    assert!(
        matches!(timed_out, Err(DialogueError::TimedOut)),
        "{timed_out:?}"
    );
    let cancel = next_message(&arm).await.unwrap().into_message();
    answer(&arm, &cancel, Performative::Inform, "").await;
    let result = request.result().await;
    assert!(
        matches!(result, Err(DialogueError::Cancelled(_))),
        "{result:?}"
    );
}
