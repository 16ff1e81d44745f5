#![doc = include_str!("../README.md")]

mod actions;
mod conversation;
mod failure;
mod json;
mod queue;
mod script;
mod sending;
mod services;

pub use crate::actions::{GoalEvent, Offered, Pursuit, action_of, invoke, offered};
pub use crate::conversation::{Command, Conversation, RequestEvent, TaskEvent, lead, request};
pub use crate::failure::{Failure, FailureKind, OrFail};
pub use crate::json::{bids, coalition, flattened};
pub use crate::queue::bell::Bell;
pub use crate::queue::{Item, Operation, Queue};
pub use crate::script::{Emitter, script};
pub use crate::sending::{Sending, all_delivered, send, send_loan};
pub use crate::services::{service_from_json, services_to_json, template_from_json};
