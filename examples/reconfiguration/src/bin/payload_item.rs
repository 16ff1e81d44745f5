//! The program of a payload item: `payload_item PART`, where PART is a JSON document.

use std::process::ExitCode;

use fipa_reconfiguration::item;
use fipa_reconfiguration::part::{Failed, Part};
use fipa_reconfiguration::report::{Claim, Reporter};

#[tokio::main(flavor = "current_thread")]
async fn main() -> ExitCode {
    let part = std::env::args().nth(1).unwrap_or_default();
    let part: Part = match serde_json::from_str(&part) {
        Ok(part) => part,
        Err(error) => return failed("payload_item", &error.into()),
    };
    match item::run(&part).await {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(&part.name, &error),
    }
}

fn failed(name: &str, error: &Failed) -> ExitCode {
    let error = error.to_string();
    Reporter::new(name).claim(Claim::Broken { error });
    ExitCode::FAILURE
}
