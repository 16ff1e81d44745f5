//! A process's membership in a domain.

use std::sync::Arc;

use fipa_acl::{Dialect, Message, Performative, Representation};
use fipa_sds::{Directory, Query};

use crate::checks::Rules;
use crate::error::OpenError;
use crate::owner::Owner;
use crate::routes::{self, Report};
use crate::service::{Role, Service};
use crate::{AgentId, Config};

/// This process's membership in a domain: processes of one domain on one host see each other.
///
/// Cheap to clone; ends when [`close`](Self::close) is called or the last clone and the last
/// agent are dropped.
///
/// A child process that is forked without exec cannot use its parent's membership: calls fail with
/// [`Forked`](crate::Forked), and dropping releases nothing. The child can open a domain of its own,
/// on a runtime of its own. Until it ends or calls exec, it keeps its parent's locks, so that other
/// processes notice the parent's end only afterwards.
#[derive(Clone)]
pub struct Domain {
    pub(crate) inner: Arc<Inner>,
}

pub(crate) struct Inner {
    pub(crate) service: Service,
    pub(crate) owner: Owner,
    pub(crate) deadline: std::time::Duration,
    pub(crate) rules: Rules,
}

impl Drop for Inner {
    fn drop(&mut self) {
        // In a forked child everything stays the parent's.
        if self.owner.is_this() {
            self.service.abort();
        }
    }
}

/// What an agent says about itself when registering.
#[derive(Debug, Clone, Default)]
pub struct RegisterOptions {
    /// What kind of agent it is, for searches; may be empty.
    pub agent_type: String,
    /// Free text; may be empty.
    pub description: String,
}

impl Domain {
    /// Joins the domain that the configuration names. Must be called within a tokio runtime,
    /// which then does the work in the background.
    ///
    /// # Errors
    /// When the configuration, the domain's directory or every transport cannot be used.
    pub async fn open(config: &Config) -> Result<Self, OpenError> {
        let rules = Rules::load(&config.monitor)?;
        let host = gethostname::gethostname();
        let name = format!("{}-{}", host.to_string_lossy(), std::process::id());
        let service = Service::start(
            config,
            Role {
                name: name.into(),
                gateway: false,
                // Another way than shared memory between processes of this host; never further.
                contacts: None,
                // What stays on this host needs no proof.
                #[cfg(feature = "secure")]
                security: None,
                view: &|host, _| Ok(host),
            },
        )?;
        let deadline = config.mts.deadline;
        Ok(Self {
            inner: Arc::new(Inner {
                service,
                owner: Owner::this(),
                deadline,
                rules,
            }),
        })
    }

    /// Who is there: the agents of this host and, when a gateway is running, those it knows of.
    #[must_use]
    pub fn directory(&self) -> &dyn Directory {
        &*self.inner.service.host
    }

    /// Which way letters from this process to the agents that match would go now, and what has
    /// happened on each of its ways. For agents of other hosts that is the way to the gateway; see
    /// [`routes::of_gateway`](crate::routes::of_gateway) for how it goes on from there.
    #[must_use]
    pub fn routes(&self, to: &Query) -> Report {
        let entries = routes::agents(self.directory(), to);
        self.inner.service.report(&entries)
    }

    /// Leaves the domain: gives letters under way a moment to arrive, then ends. All agents of
    /// this process are deregistered.
    pub async fn close(self) {
        if !self.inner.owner.is_this() {
            return;
        }
        self.inner.service.close().await;
    }
}

/// Logs that legacy peers cannot be told this name, if so: their encodings write names as words.
pub(crate) fn warn_of_name(id: &AgentId) {
    let fails = |dialect| {
        let message = Message::builder(Performative::Inform)
            .sender(id.clone())
            .build()
            .ok()?;
        message.encode(Representation::String, dialect).err()
    };
    if let Some(error) = fails(Dialect::Standard).or_else(|| fails(Dialect::Jade)) {
        tracing::warn!(
            "agents of legacy peers (string encoding, JADE) can neither get letters from {:?} nor name it \
             ({error}); use a name without blanks and parentheses where there are such peers",
            id.name()
        );
    }
}
