//! A gateway in the process of the program.

use fipa::Gateway;
use fipa::blocking::{self, Wait};
use parking_lot::Mutex;

use crate::domain::{FipaDomainOptions, configured};
use crate::failure::{FipaResult, call};
use crate::raw::Place;
use crate::table::{self, FipaHandle, Object};
use fipa_bindings::{Failure, OrFail};

/// A running gateway, until the caller closes it.
struct OpenGateway(Mutex<Option<Gateway>>);

impl Object for OpenGateway {
    fn close(&self) -> Result<(), Failure> {
        if let Some(gateway) = self.0.lock().take() {
            gateway.close().wait();
        }
        Ok(())
    }
}

/// Runs the gateway of this host in the process, as `fipa up` does, with the configuration of `options` or, if that is
/// NULL, of the environment. Only in a library with the feature `gateway`. `fipa_close` ends it.
///
/// # Safety
/// `options` is NULL or as its documentation says. `gateway` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_open_gateway(
    options: *const FipaDomainOptions,
    gateway: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let gateway = unsafe { Place::of(gateway, "the handle") }?;
        // SAFETY: The caller promises it.
        let (_, config) = unsafe { configured(options) }?;
        blocking::start().or_fail()?;
        let opened = Gateway::open(&config).wait().or_fail()?;
        let open = OpenGateway(Mutex::new(Some(opened)));
        Ok(table::give(gateway, open))
    })
}
