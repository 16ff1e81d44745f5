//! Topics: publishing and subscribing.

use std::time::Duration;

use fipa::Performative;
use fipa::blocking::Wait;
use fipa::protocol::Keep;
use fipa::topics::{Publisher, Topic, TopicLoan};

use crate::agent::OwnAgent;
use crate::conversation::copied;
use crate::failure::{FipaResult, call};
use crate::item::{Event, FipaEvent, OperationHandle, script};
use crate::letter::{FipaMessage, Letter};
use crate::loaned::Loaned;
use crate::message::Draft;
use crate::raw::{Extensible, FipaBytes, FipaText, Place, Readable, limit, structure};
use crate::table::{self, FipaHandle, Object};
use fipa_bindings::{Failure, OrFail};

/// Time for the answer to a subscription, if the caller sets none.
const TIMEOUT: Duration = Duration::from_secs(30);

/// A topic. A field that is zero is not set.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct FipaTopic {
    /// sizeof(struct fipa_topic).
    pub size: usize,
    /// The name.
    pub name: FipaText,
    /// The media type of the contents, such as `image/jpeg`, for users.
    pub media_type: FipaText,
    /// Notifications per second. The topic is then a stream: subscribers get the newest notification unless they ask
    /// for others.
    pub rate: f64,
    /// Number of the newest contents that a new subscriber gets at once, at most 64.
    pub latched: usize,
}

// SAFETY: It begins with a `usize`.
unsafe impl Extensible for FipaTopic {}
// SAFETY: Its fields are pointers and numbers.
unsafe impl Readable for FipaTopic {}

/// A publisher. Calls share it with the loans that were not published yet.
struct OpenPublisher(Publisher);

/// A loan of a publisher.
type OpenTopicLoan = Loaned<OpenPublisher, TopicLoan>;

impl Object for OpenPublisher {}

/// Publishes a topic: accepts the subscriptions whose content is its name (FIPA00035). `fipa_close` ends it.
///
/// # Safety
/// `topic` is NULL or as its documentation says. `publisher` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_publisher(
    agent: FipaHandle,
    topic: *const FipaTopic,
    publisher: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let publisher = unsafe { Place::of(publisher, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let topic = unsafe { structure(topic, "the topic") }?;
        // SAFETY: The caller promises it.
        let mut described = Topic::new(unsafe { topic.name.required("the name of the topic") }?);
        // SAFETY: The caller promises it.
        let media_type = unsafe { topic.media_type.read("the media_type") }?;
        if let Some(media_type) = media_type.filter(|media_type| !media_type.is_empty()) {
            described = described.media_type(media_type);
        }
        if topic.rate != 0.0 {
            if !topic.rate.is_finite() || topic.rate < 0.0 {
                return Err(Failure::invalid(
                    "the rate of a topic is not a positive number",
                ));
            }
            described = described.rate(topic.rate);
        }
        described = described.latched(topic.latched);
        let opened = async { own.agent.publisher(described) }.wait().or_fail()?;
        Ok(table::give(publisher, OpenPublisher(opened)))
    })
}

/// Notifies all subscribers. Waits only for a subscriber that asks for all notifications and is slow, at most 5 s.
/// `subscribers` may be NULL, or gets their number.
///
/// # Safety
/// The content must be readable. `subscribers` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_publish(
    publisher: FipaHandle,
    content: FipaBytes,
    subscribers: *mut usize,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let subscribers = unsafe { Place::optional(subscribers, "the number of subscribers") }?;
        let publisher = table::get::<OpenPublisher>(publisher)?;
        // SAFETY: The caller promises it.
        let content = unsafe { copied(content) }?;
        let publication = publisher.0.publish(content).wait();
        if let Some(subscribers) = subscribers {
            subscribers.put(publication.subscribers());
        }
        Ok(FipaResult::Ok)
    })
}

/// Loans memory of `len` bytes for a notification, which subscribers on this host read in place. The memory is valid
/// until the loan is published or closed.
///
/// # Safety
/// `loan` and `content` are NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_loan_notification(
    publisher: FipaHandle,
    len: usize,
    loan: *mut FipaHandle,
    content: *mut *mut u8,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let loan = unsafe { Place::of(loan, "the handle") }?;
        // SAFETY: The caller promises it.
        let content = unsafe { Place::of(content, "the content") }?;
        let publisher = table::get::<OpenPublisher>(publisher)?;
        let mut loaned = publisher.0.loan(len).or_fail()?;
        let memory = loaned.content_mut().as_mut_ptr();
        let open = OpenTopicLoan::new(publisher, loaned);
        content.put(memory);
        Ok(table::give(loan, open))
    })
}

/// Notifies all subscribers with a loan, as `fipa_publish`. Its handle is closed.
///
/// # Safety
/// `subscribers` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_publish_loan(
    loan: FipaHandle,
    subscribers: *mut usize,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let subscribers = unsafe { Place::optional(subscribers, "the number of subscribers") }?;
        let (publisher, taken) = OpenTopicLoan::take(loan)?;
        let publication = publisher.0.publish_loan(taken).wait();
        if let Some(subscribers) = subscribers {
            subscribers.put(publication.subscribers());
        }
        Ok(FipaResult::Ok)
    })
}

/// Subscribes to a topic: `message` has the publishing agent as its receiver and the name of the topic as its content.
/// `keep` is empty, or says which notifications are wanted: `all`, or `latest N`. Each is an item of the kind
/// `FIPA_EVENT_NOTIFICATION`. `FIPA_EVENT_INTERRUPTED` says that the publisher or its host is lost and the subscription
/// goes on when it returns, and `FIPA_EVENT_ENDED` that the subscription has ended. Closing the operation cancels the
/// subscription.
///
/// # Safety
/// `message` is NULL or as its documentation says. The text must be readable. `operation` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_subscribe(
    agent: FipaHandle,
    message: *const FipaMessage,
    keep: FipaText,
    timeout_ms: i64,
    tag: u64,
    operation: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let operation = unsafe { Place::of(operation, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let draft = unsafe { Draft::read(message) }?;
        let act = draft.performative(Some(Performative::Subscribe))?;
        let message = draft.with_content(own.agent.message(act))?;
        // SAFETY: The caller promises it.
        let keep = match unsafe { keep.read("the keep") }?.filter(|keep| !keep.is_empty()) {
            Some(keep) => keep
                .parse()
                .map_err(|error| Failure::invalid(format!("{error}")))?,
            None => Keep::Auto,
        };
        let timeout = limit(timeout_ms).unwrap_or(TIMEOUT);
        let agent = own.agent.clone();
        let events = script(async move |emitter| {
            let subscribed = agent.subscribe_keeping(keep, message, timeout).await;
            let mut subscription = subscribed.or_fail()?;
            loop {
                emitter
                    .emit(match subscription.next().await {
                        Ok(notification) => {
                            let missed = notification.missed();
                            let letter = Letter::from(notification);
                            Event::with(FipaEvent::Notification, letter).number(missed)
                        }
                        Err(error) if subscription.goes_on() => {
                            Event::of(FipaEvent::Interrupted).result(Err(Failure::of(error)))
                        }
                        Err(error) => return Err(Failure::of(error)),
                    })
                    .await;
            }
        });
        let began = OperationHandle::of(own.items.follow(tag, events));
        Ok(table::give(operation, began))
    })
}
