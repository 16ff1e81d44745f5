//! Domains: joining, the directory, and the routes.

use fipa::blocking::{self, Wait};
use fipa::config::Sources;
use fipa::{Config, Domain, Matcher, Query};
use fipa_bindings::{Failure, OrFail, flattened};
use futures_util::StreamExt as _;
use futures_util::stream::iter;
use std::path::PathBuf;

use crate::failure::{FipaResult, call};
use crate::item::{Event, FipaEvent, Items, OperationHandle, Text};
use crate::raw::{Extensible, FipaText, Place, Readable, fill, structure, texts};
use crate::table::{self, FipaHandle, Object};

/// How a process joins a domain. A field that is zero is not set.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct FipaDomainOptions {
    /// sizeof(struct fipa_domain_options).
    pub size: usize,
    /// The configuration file. Without it, the file that the environment selects: `$FIPA_CONFIG`, else `./fipa.toml`,
    /// else `~/.config/fipa/fipa.toml`, else `/etc/fipa/fipa.toml`, else the defaults.
    pub config: FipaText,
    /// Values that override the file, each as `key=value`, for example `domain=test`.
    pub set: *const FipaText,
    /// Number of these values.
    pub set_count: usize,
}

// SAFETY: It begins with a `usize`.
unsafe impl Extensible for FipaDomainOptions {}
// SAFETY: Its fields are pointers and numbers.
unsafe impl Readable for FipaDomainOptions {}

/// The membership of this process in a domain, and the queue of what it waits for.
pub(crate) struct Membership {
    pub(crate) domain: Domain,
    pub(crate) items: Items,
}

impl Object for Membership {
    fn close(&self) -> Result<(), Failure> {
        self.domain.clone().close().wait();
        Ok(())
    }
}

/// Joins a domain: that of the environment if `options` is NULL. `fipa_close` leaves it.
///
/// # Safety
/// `options` is NULL or as its documentation says. `domain` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_open(
    options: *const FipaDomainOptions,
    domain: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let domain = unsafe { Place::of(domain, "the handle") }?;
        // SAFETY: The caller promises it.
        let (sources, config) = unsafe { configured(options) }?;
        blocking::start().or_fail()?;
        let opened = Domain::open(&config).wait().or_fail()?;
        async { opened.follow(sources) }.wait();
        let membership = Membership {
            domain: opened,
            items: Items::new(),
        };
        Ok(table::give(domain, membership))
    })
}

/// Reads the configuration of a domain.
///
/// # Safety
/// `options` is NULL or as its documentation says.
pub(crate) unsafe fn configured(
    options: *const FipaDomainOptions,
) -> Result<(Sources, Config), Failure> {
    let mut sources = Sources::from_environment();
    if !options.is_null() {
        // SAFETY: The caller promises it.
        let options = unsafe { structure(options, "the options") }?;
        // SAFETY: The caller promises it.
        let config = unsafe { options.config.read("the config") }?;
        if let Some(config) = config.filter(|config| !config.is_empty()) {
            sources.file = Some(PathBuf::from(config));
        }
        // SAFETY: The caller promises it.
        let set = unsafe { texts(options.set, options.set_count, "a value in set") }?;
        sources.set = set.into_iter().map(str::to_owned).collect();
    }
    let config = Config::load(&sources).or_fail()?;
    Ok((sources, config))
}

/// Returns the known agents of this host and of others as a JSON array, with the text as a handle
/// (`fipa_read_text`). `pattern` and `agent_type` may be empty; each is a name or a pattern for the whole text.
///
/// Each object has `name`, `type`, `description`, `role`, `reach` (`local` or `remote`), `locations`, `mts`,
/// `incarnation`, `registered` and `source`.
///
/// # Safety
/// The texts must be readable. `agents` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_agents(
    domain: FipaHandle,
    pattern: FipaText,
    agent_type: FipaText,
    agents: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let agents = unsafe { Place::of(agents, "the handle") }?;
        let membership = table::get::<Membership>(domain)?;
        let query = Query {
            // SAFETY: The caller promises it.
            name: matcher(unsafe { pattern.read("the pattern") }?)?,
            // SAFETY: The caller promises it.
            agent_type: matcher(unsafe { agent_type.read("the agent_type") }?)?,
            ..Query::all()
        };
        let mut found = membership.domain.agents();
        found.retain(|entry| query.matches(entry));
        Ok(table::give(agents, Text::json(&found)?))
    })
}

fn matcher(text: Option<&str>) -> Result<Option<Matcher>, Failure> {
    let text = text.filter(|text| !text.is_empty());
    text.map(Matcher::parse).transpose().or_fail()
}

/// Reports the routes of letters to the agents of a pattern (empty: to all) as JSON, with the text as a handle.
///
/// # Safety
/// As for `fipa_agents`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_routes(
    domain: FipaHandle,
    pattern: FipaText,
    routes: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let routes = unsafe { Place::of(routes, "the handle") }?;
        let membership = table::get::<Membership>(domain)?;
        let query = Query {
            // SAFETY: The caller promises it.
            name: matcher(unsafe { pattern.read("the pattern") }?)?,
            ..Query::all()
        };
        let report = membership.domain.routes(&query);
        Ok(table::give(routes, Text::json(&report)?))
    })
}

/// Numbers of contents of at least 1 KiB that have arrived through shared memory.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct FipaContentCounts {
    /// sizeof(struct fipa_content_counts).
    pub size: usize,
    /// Contents that are read in shared memory of their sender.
    pub in_place: u64,
    /// Contents that were copied, because the program held too many in place.
    pub copied: u64,
}

// SAFETY: It begins with a `usize`.
unsafe impl Extensible for FipaContentCounts {}

/// Counts the contents that have arrived through shared memory since the domain was opened.
///
/// # Safety
/// `counts` is NULL, or its first field is the number of bytes that can be written there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_read_content_counts(
    domain: FipaHandle,
    counts: *mut FipaContentCounts,
) -> FipaResult {
    call(|| {
        let membership = table::get::<Membership>(domain)?;
        let found = membership.domain.content_counts();
        let found = FipaContentCounts {
            size: size_of::<FipaContentCounts>(),
            in_place: found.in_place,
            copied: found.copied,
        };
        // SAFETY: The caller promises it.
        unsafe { fill(counts, found, "the counts") }?;
        Ok(FipaResult::Ok)
    })
}

/// Follows the directory: each agent that joins, changes or leaves is an item of the kind `FIPA_EVENT_CHANGE`, with a
/// JSON text. Its `change` is `joined`, `changed` or `left`, and `agent` is as in `fipa_agents`. It is `lagged`,
/// without an agent, if the program was too slow and has missed changes. Closing the operation ends it.
///
/// # Safety
/// `operation` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_follow_agents(
    domain: FipaHandle,
    tag: u64,
    operation: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let operation = unsafe { Place::of(operation, "the handle") }?;
        let membership = table::get::<Membership>(domain)?;
        let changes = membership.domain.changes();
        let changes = changes.flat_map(|change| iter(flattened(&change)));
        let changes = changes.map(|change| Event::json(FipaEvent::Change, &change));
        let began = OperationHandle::of(membership.items.follow(tag, changes));
        Ok(table::give(operation, began))
    })
}
