//! The bounds of both agents.

use std::time::Duration;

/// Maximum length of the content of a request, in bytes. A longer content is not parsed.
pub const CONTENT: usize = 16 << 10;
/// Maximum length of the content of a subscription, in bytes. It is stored, and part of each
/// notification.
pub const SUBSCRIPTION_CONTENT: usize = 4 << 10;
/// Maximum length of the parameters that the messages of a subscription repeat (conversation
/// identifier, protocol and others, and the identifier of the sender), in bytes together.
pub const SUBSCRIPTION_PARAMETERS: usize = 4 << 10;
/// Maximum length of the text in a stored description, in bytes.
pub const DESCRIPTION_BYTES: usize = 8 << 10;
/// Maximum number of strings, services, properties and parts of their values in a stored description.
pub const DESCRIPTION_PARTS: usize = 128;
/// Maximum number of such parts in the template of a search or a subscription.
pub const TEMPLATE_PARTS: usize = 32;
/// Maximum number of comparisons of one search. A search that needs more fails.
pub const COMPARISONS: usize = 1_000_000;
/// Maximum number of descriptions in an answer.
pub const RESULTS: usize = 1000;
/// Length of an answer, in bytes, from which on no further description is added.
pub const RESULT_BYTES: usize = 256 << 10;
/// Maximum number of remembered search identifiers, and maximum length of one in bytes.
pub const SEARCH_IDS: (usize, usize) = (1024, 255);

/// Maximum number of descriptions in the DF.
pub const DESCRIPTIONS: usize = 4096;
/// Maximum number of descriptions in the DF of agents of other hosts.
pub const FOREIGN_DESCRIPTIONS: usize = 2048;
/// Maximum number of descriptions in the DF of agents of one platform of another host.
pub const DESCRIPTIONS_OF_PLATFORM: usize = 256;

/// Maximum length of the text of a description that travels to the directory facilitators of other
/// hosts, in bytes. A longer one stays in the DF of its host.
pub const REMOTE_BYTES: usize = 4 << 10;
/// Maximum number of parts (see [`DESCRIPTION_PARTS`]) of a description that travels.
pub const REMOTE_PARTS: usize = 64;
/// Maximum number of descriptions from the directory facilitators of other hosts.
pub const REMOTE_DESCRIPTIONS: usize = 2048;
/// Maximum number of new descriptions that one call of
/// [`Df::handle_remote`](crate::Df::handle_remote) takes from one host. So no host fills the
/// notifications to a subscriber.
pub const REMOTE_CHANGES: usize = 32;
/// Minimum time between two such calls.
pub const REMOTE_PAUSE: Duration = Duration::from_millis(250);

/// Maximum number of subscriptions to the DF.
pub const SUBSCRIPTIONS: usize = 512;
/// Maximum number of subscriptions of agents of other hosts.
pub const FOREIGN_SUBSCRIPTIONS: usize = 256;
/// Maximum number of subscriptions of agents of one platform of another host. A further one ends the
/// oldest.
pub const SUBSCRIPTIONS_OF_PLATFORM: usize = 64;
/// Maximum number of subscriptions of one agent.
pub const SUBSCRIPTIONS_OF_AGENT: usize = 16;
/// Maximum number of changed descriptions that wait for one subscriber. A subscription with more ends.
pub const CHANGES: usize = DESCRIPTIONS + REMOTE_DESCRIPTIONS;
/// Length of a notification, in bytes, from which on further changes wait for the next one.
pub const NOTIFICATION_BYTES: usize = 64 << 10;
/// Minimum time between two notifications of one subscription.
pub const NOTIFICATION_PAUSE: Duration = Duration::from_millis(500);

/// Maximum number of agents of other hosts in the AMS.
pub const FOREIGN_AGENTS: usize = 1024;
/// Maximum number of agents of one platform of another host in the AMS.
pub const FOREIGN_AGENTS_OF_PLATFORM: usize = 128;

/// Longest lease of a description of an agent of another host, and the lease of a description that asks
/// for none. A description of an agent of this host without a lease stays as long as the agent is
/// registered.
pub const LEASE: Duration = Duration::from_secs(3600);

/// Maximum length of text from a request that a reason repeats, in characters.
pub(crate) const REPEATED: usize = 120;
