//! Any bytes are a parcel or are refused. A decoded parcel is the same after a round trip.

#![no_main]

use bytes::Bytes;
use fipa_transport::Body;
use fipa_transport::wire::{HEADER_LEN, ParcelHeader};
use libfuzzer_sys::fuzz_target;
use zerocopy::FromBytes;

fuzz_target!(|bytes: &[u8]| {
    let Ok((header, body)) = ParcelHeader::read_from_prefix(bytes) else {
        assert!(bytes.len() < HEADER_LEN);
        return;
    };
    let Ok(parcel) = header.parcel(Bytes::copy_from_slice(body)) else {
        return;
    };
    let (again, pieces) = ParcelHeader::of(&parcel).expect("a decoded parcel can be encoded");
    let read = again
        .parcel(pieces.concat().into())
        .expect("an encoded parcel can be decoded");
    match (&read.body, &parcel.body) {
        (Body::Letter(one), Body::Letter(other)) => assert_eq!(one.to_bytes(), other.to_bytes()),
        (one, other) => assert_eq!(one, other),
    }
});
