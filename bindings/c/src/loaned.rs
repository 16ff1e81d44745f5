//! Memory that the caller writes before it is sent.

use std::sync::Arc;

use parking_lot::Mutex;

use crate::table::{self, FipaHandle, Object};
use fipa_bindings::{Failure, FailureKind};

/// A loan of an object, until it is sent.
pub(crate) struct Loaned<S, L> {
    source: Arc<S>,
    loan: Mutex<Option<L>>,
}

impl<S: Object, L: Send + 'static> Object for Loaned<S, L> {}

impl<S: Object, L: Send + 'static> Loaned<S, L> {
    pub(crate) fn new(source: Arc<S>, loan: L) -> Self {
        let loan = Mutex::new(Some(loan));
        Self { source, loan }
    }

    /// Takes the loan of a handle, which it closes, with the object that has lent it.
    pub(crate) fn take(handle: FipaHandle) -> Result<(Arc<S>, L), Failure> {
        let open = table::get::<Self>(handle)?;
        let taken = open.loan.lock().take();
        let loan =
            taken.ok_or_else(|| Failure::new(FailureKind::BadHandle, "the loan was sent"))?;
        drop(table::remove(handle));
        Ok((Arc::clone(&open.source), loan))
    }
}
