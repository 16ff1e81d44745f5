//! Random walks through configurations that are too large to be explored.

use fastrand::Rng;
use stateright::Model;

use crate::protocol::{Action, Protocol};

/// One step of this many is a fault, while the run may have another.
const FAULT_IN: usize = 6;
/// Longest walk. A fair run without faults ends after a few hundred steps.
const MAX_STEPS: usize = 20_000;

/// Walks until every letter has an outcome and nothing is left in transit: a letter that has
/// failed must not be taken afterwards. Returns the number of steps.
///
/// # Errors
///
/// Returns the broken property and the steps that led there.
pub(crate) fn walk(model: &Protocol, seed: u64) -> Result<usize, (&'static str, Vec<Action>)> {
    let mut rng = Rng::with_seed(seed);
    let properties = model.properties();
    let mut state = model.init_states().remove(0);
    let mut path = Vec::new();
    let mut actions = Vec::new();
    loop {
        if path.len() >= MAX_STEPS {
            return Err(("a run ends", path));
        }
        model.actions(&state, &mut actions);
        let wanted = rng.usize(..FAULT_IN) == 0;
        if actions.iter().any(|action| action.is_fault() == wanted) {
            actions.retain(|action| action.is_fault() == wanted);
        }
        let Some(action) = rng.choice(actions.drain(..)) else {
            break;
        };
        path.push(action);
        if let Some(next) = model.next_state(&state, action) {
            state = next;
        }
        let broken = properties
            .iter()
            .find(|property| !(property.condition)(model, &state));
        if let Some(property) = broken {
            return Err((property.name, path));
        }
    }
    if !Protocol::is_done(&state) {
        return Err(("every letter gets an outcome", path));
    }
    Ok(path.len())
}
