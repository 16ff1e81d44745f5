//! The hello of a connection that this side opens.

use std::net::SocketAddr;

use super::packet::{self, Cookie, NO_COOKIE};
use crate::datagrams::dialing::Greeting;
use crate::hello::Hello;

/// The handshake of a connection that this side opens.
pub(crate) type Dialing = crate::datagrams::dialing::Dialing<OwnHello>;

/// The hello of this service, with its number of the connection.
#[derive(Debug)]
pub(crate) struct OwnHello {
    pub(crate) id: u64,
    pub(crate) hello: Hello,
}

impl Greeting for OwnHello {
    type Cookie = Cookie;

    fn datagram(&self, _to: SocketAddr, cookie: Option<Cookie>) -> Vec<u8> {
        packet::hello(self.id, &cookie.unwrap_or(NO_COOKIE), &self.hello)
    }
}
