//! An agent answers each message with the same content, in a task of its own.
//!
//! ```console
//! $ cargo run --example echo
//! ```

#![allow(clippy::print_stdout, reason = "an example prints")]

use std::time::Duration;

use fipa::Performative::{Inform, QueryRef};
use fipa::{Agent, Domain, SenderTasks};

#[tokio::main]
async fn main() -> fipa::Result<()> {
    let domain = Domain::from_environment().await?;
    let echo = domain.register("echo").await?;
    let answering = tokio::spawn(answer_all(echo.clone()));

    let rover = domain.register("rover").await?;
    for word in ["one", "two", "three"] {
        let question = rover
            .message(QueryRef)
            .receiver("echo")
            .reply_with(rover.unique_id())
            .content(word);
        rover.send(question).await?;
        match rover.receive_within(Duration::from_secs(60)).await? {
            Some(answer) => println!("{word}: {:?}", answer.message().text()),
            None => println!("{word}: no answer"),
        }
    }

    // The end of the registration ends the task, too.
    echo.deregister()?;
    let answered = answering.await.unwrap_or(0);
    println!("echo answered {answered} messages");
    domain.close().await;
    Ok(())
}

/// Answers until the agent is deregistered, and returns the number of answers.
async fn answer_all(echo: Agent) -> usize {
    // An agent that takes no answers must not delay the answers to others.
    let mut tasks = SenderTasks::default();
    let mut answered = 0;
    while let Ok(letter) = echo.receive().await {
        let question = letter.message();
        let answer = echo.reply(question, Inform).content(question.text());
        let sending = echo.send(answer);
        let send = async move {
            if let Err(error) = sending.await {
                println!("cannot answer: {error}");
            }
        };
        answered += usize::from(tasks.run(&letter, send).await);
    }
    tasks.finish().await;
    answered
}
