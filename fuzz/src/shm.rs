//! Descriptors in shared memory: headers of requests with payloads of any length, and answers.
//! Every range that an accepted header announces is within the payload.

use fipa_transport_shm::fuzzing::{HEADER_LEN, ack, header};

/// Reads a header and its payload from the bytes, or an answer.
pub fn play(bytes: &[u8]) {
    let Some((kind, bytes)) = bytes.split_first() else {
        return;
    };
    if kind % 4 == 0 {
        let _ = ack(bytes, 7);
        return;
    }
    let Some((head, payload)) = bytes.split_first_chunk::<HEADER_LEN>() else {
        return;
    };
    let mut head = *head;
    // A valid version, so that the parser reads the fields behind it.
    if kind % 4 != 1 {
        head[..4].copy_from_slice(&fipa_transport_shm::fuzzing::VERSION.to_le_bytes());
        head[4] %= 16;
        head[5..8].fill(0);
    }
    let elsewhere = &payload[..payload.len() / 2];
    header(&head, payload, elsewhere);
}
