//! The promises, as invariants.

use fipa_transport::{FailureReason, Outcome};

use super::{Breach, World};

impl World {
    pub(super) fn check_deadline(&mut self, number: u64) -> Result<(), Breach> {
        let sent = &self.sent[&number];
        let (known, expected) = (sent.outcomes.len(), sent.expected);
        if known < expected && self.processes[sent.process].alive {
            return Err(format!(
                "letter {number} has {known} of {expected} outcomes after its deadline"
            ));
        }
        Ok(())
    }

    pub(super) fn check_end(&mut self) -> Result<(), Breach> {
        let mut failed = 0;
        for (number, sent) in &self.sent {
            for (receiver, outcome) in &sent.outcomes {
                let was_taken = self
                    .taken
                    .iter()
                    .any(|(life, all)| self.names[life] == *receiver && all.contains(number));
                match outcome {
                    Outcome::Delivered { .. } if !was_taken => {
                        return Err(format!("letter {number} to {receiver} is lost: {outcome}"));
                    }
                    Outcome::Failed { reason, .. }
                        if was_taken && *reason != FailureReason::Unconfirmed =>
                    {
                        return Err(format!("letter {number} was delivered, but {outcome}"));
                    }
                    // Nobody refuses anything in this world: it was overtaken. Only when a gateway
                    // dies together with its report of a failure, others go on without that letter; and
                    // one that follows its receiver is overtaken by one sent to its new life.
                    Outcome::Failed {
                        reason: FailureReason::Refused,
                        ..
                    } if self.weather.deaths + self.weather.moves == 0 => {
                        return Err(format!("letter {number} was left out: {outcome}"));
                    }
                    Outcome::Failed { reason, .. } => {
                        failed += 1;
                        if self.weather.is_calm() && *reason != FailureReason::NoSuchAgent {
                            return Err(format!("letter {number} in calm weather: {outcome}"));
                        }
                    }
                    _ => {}
                }
            }
        }
        if self.weather.is_calm() && failed != self.failures_told {
            return Err(format!("{failed} failures, {} told", self.failures_told));
        }
        for process in self.processes.iter().filter(|process| process.alive) {
            if process.core.has_open_letters() {
                return Err("letters are still open at the end".into());
            }
        }
        Ok(())
    }
}
