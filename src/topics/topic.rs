//! The description of a topic by its publisher.

use std::time::Duration;

use crate::protocol::keep::MAX_KEPT;

/// A topic of a publisher: its name, which is the content of a `subscribe`, and what is known about its values.
///
/// ```
/// use fipa::topics::Topic;
///
/// let camera = Topic::new("camera").rate(30.0).latched(1);
/// assert_eq!(camera.name(), "camera");
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Topic {
    name: String,
    /// The media type of the contents, if it is known.
    pub(super) media_type: Option<String>,
    /// The content language of the notifications.
    pub(super) language: Option<String>,
    /// The ontology of the notifications.
    pub(super) ontology: Option<String>,
    /// Notifications per second, if they are known.
    pub(super) rate: Option<f64>,
    /// Number of contents that are kept for new subscribers.
    pub(super) latched: usize,
    /// Time for which a publication waits for a slow subscriber.
    pub(super) wait: Duration,
}

/// Time for which a publisher waits for a slow subscriber by default.
const WAIT: Duration = Duration::from_secs(5);

impl Topic {
    /// Creates a topic of which nothing but the name is known.
    pub fn new(name: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            media_type: None,
            language: None,
            ontology: None,
            rate: None,
            latched: 0,
            wait: WAIT,
        }
    }

    /// Sets the media type of the contents, for example `image/jpeg`. It is shown to users; subscribers get no other
    /// contents for it.
    #[must_use]
    pub fn media_type(mut self, media_type: impl Into<String>) -> Self {
        self.media_type = Some(media_type.into());
        self
    }

    /// Sets the content language, which each notification carries (`:language`), for example `json`.
    #[must_use]
    pub fn language(mut self, language: impl Into<String>) -> Self {
        self.language = Some(language.into());
        self
    }

    /// Sets the ontology, which each notification carries (`:ontology`), for example the name of the type of its content.
    #[must_use]
    pub fn ontology(mut self, ontology: impl Into<String>) -> Self {
        self.ontology = Some(ontology.into());
        self
    }

    /// Sets the number of notifications per second. The topic is then a stream: subscribers get the newest
    /// notification unless they ask for others ([`Keep::Auto`](crate::protocol::Keep::Auto)).
    #[must_use]
    pub fn rate(mut self, hertz: f64) -> Self {
        self.rate = Some(hertz);
        self
    }

    /// Keeps the newest `n` contents, at most 64, for new subscribers, which get them at once. 0 by default.
    #[must_use]
    pub fn latched(mut self, n: usize) -> Self {
        self.latched = n.min(MAX_KEPT as usize);
        self
    }

    /// Sets the time for which one call of [`Publisher::publish`](super::Publisher::publish) waits at most for a
    /// subscriber that asks for [all](crate::protocol::Keep::All) notifications and has 64 that wait. 5 s by default.
    #[must_use]
    pub fn wait_for_slow(mut self, wait: Duration) -> Self {
        self.wait = wait;
        self
    }

    /// Returns the name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }
}

impl From<&str> for Topic {
    fn from(name: &str) -> Self {
        Self::new(name)
    }
}

impl From<String> for Topic {
    fn from(name: String) -> Self {
        Self::new(name)
    }
}
