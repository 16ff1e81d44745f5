use std::time::Duration;

use fipa_acl::{Letter, Payload};
use fipa_transport::{Arriving, Body, FailureReason, Incarnation, LoanedContent, Stream};
use proptest::prelude::*;

use super::reader::{APART_FROM, CHUNK, FIRST_STEP};
use super::*;
use crate::stream::budget::{ByteBudget, ContentBuffer};

fn letter_parcel(head: Vec<u8>, content: Vec<u8>) -> Parcel {
    let payload = Payload {
        head: head.into(),
        content: content.into(),
        tail: Bytes::from_static(b"\x01"),
    };
    Parcel {
        receiver: "arm@crex".into(),
        stream: Stream::between(Incarnation::from_u64(1), Incarnation::from_u64(2)),
        sequence: 1,
        after: 1,
        remaining: Duration::from_secs(1),
        transfer: 0,
        body: Body::Letter(Letter::new(Bytes::from_static(b"envelope"), payload)),
    }
}

/// Puts bytes into the reader in pieces of at most these sizes, over and over.
fn read(reader: &mut FrameReader, bytes: &[u8], sizes: &[usize]) -> Result<Vec<Frame>, FrameError> {
    read_into(reader, bytes, sizes, |_| None)
}

/// Like [`read`], with memory for contents.
fn read_into(
    reader: &mut FrameReader,
    mut bytes: &[u8],
    sizes: &[usize],
    mut memory: impl FnMut(&Arriving<'_>) -> Option<ContentBuffer>,
) -> Result<Vec<Frame>, FrameError> {
    let mut frames = Vec::new();
    let mut sizes = sizes.iter().cycle();
    while !bytes.is_empty() {
        let mut space = reader.space();
        let room = room(&space);
        assert!(room > 0, "a full buffer would read as end of stream");
        let step = (*sizes.next().unwrap()).max(1).min(bytes.len()).min(room);
        match &mut space {
            Space::Buffer(buffer) => buffer.put_slice(&bytes[..step]),
            Space::Content(content) => content[..step].copy_from_slice(&bytes[..step]),
        }
        reader.put(step);
        bytes = &bytes[step..];
        while let Some(frame) = reader.next(&mut memory)? {
            frames.push(frame);
        }
        // Bytes that wait for more are in their final memory, or the start of a header.
        assert!(reader.chunk.len() < HEADER_LEN, "{reader:?}");
    }
    Ok(frames)
}

fn room(space: &Space<'_>) -> usize {
    match space {
        Space::Buffer(buffer) => buffer.remaining_mut(),
        Space::Content(content) => content.len(),
    }
}

/// Memory of the sink.
struct Memory(Vec<u8>);

impl LoanedContent for Memory {
    fn content_mut(&mut self) -> &mut [u8] {
        &mut self.0
    }

    fn freeze(self: Box<Self>) -> Bytes {
        self.0.into()
    }
}

fn place(len: usize) -> Option<ContentBuffer> {
    let loan = ByteBudget::default().lend(len, len)?;
    Some(ContentBuffer::new(Box::new(Memory(vec![0; len])), loan))
}

fn content(frame: &Frame) -> &Bytes {
    let Frame::Parcel { parcel, .. } = frame else {
        panic!("{frame:?}")
    };
    let Body::Letter(letter) = &parcel.body else {
        panic!("{parcel:?}")
    };
    &letter.payload().content
}

fn reader(max_letter: usize) -> FrameReader {
    FrameReader::new(max_letter, BytesMut::new())
}

fn header(version: u8, kind: u8, body_len: u64) -> Vec<u8> {
    FrameHeader {
        magic: MAGIC,
        version,
        kind,
        flags: U16::ZERO,
        id: U64::new(1),
        body_len: U64::new(body_len),
    }
    .as_bytes()
    .to_vec()
}

#[test]
fn the_header_has_24_bytes_and_begins_like_no_envelope() {
    assert_eq!(HEADER_LEN, 24);
    assert!(![0xfe, 0xfd, b'<'].contains(&MAGIC[0]));
}

#[test]
fn a_written_letter_is_not_copied_and_a_read_one_lies_in_one_piece() {
    let sent = letter_parcel(vec![1; 10], vec![2; 100_000]);
    let Body::Letter(letter) = &sent.body else {
        panic!()
    };
    let pieces = parcel(9, &sent).unwrap();
    assert!(
        pieces
            .iter()
            .any(|piece| piece.as_ptr() == letter.payload().content.as_ptr())
    );
    let frames = read(&mut reader(1 << 20), &pieces.concat(), &[5000]).unwrap();
    let [Frame::Parcel { id: 9, parcel }] = &frames[..] else {
        panic!("{frames:?}")
    };
    let Body::Letter(read) = &parcel.body else {
        panic!()
    };
    assert_eq!(read.to_bytes(), letter.to_bytes());
    let (head, content) = (&read.payload().head, &read.payload().content);
    assert_eq!(head.as_ptr_range().end, content.as_ptr());
}

#[test]
fn an_announced_length_allocates_no_memory() {
    let mut reader = reader(4 << 30);
    let announced = 4 << 30;
    assert_eq!(
        read(&mut reader, &header(VERSION, PARCEL, announced), &[24]),
        Ok(vec![])
    );
    assert!(room(&reader.space()) <= FIRST_STEP);
    for filled in 0..100 {
        let step = vec![0; 64 * 1024];
        assert_eq!(read(&mut reader, &step, &[usize::MAX]), Ok(vec![]));
        let body = reader.body.as_ref().unwrap();
        let arrived = (filled + 1) * step.len();
        assert_eq!(body.bytes.len(), arrived);
        assert!(body.bytes.capacity() <= 4 * arrived.max(FIRST_STEP));
    }
}

#[test]
fn large_content_is_read_only_into_the_offered_memory() {
    let large = parcel(9, &letter_parcel(vec![1; 300], vec![2; 100_000])).unwrap();
    let small = parcel(9, &letter_parcel(vec![1; 300], vec![2; 1000])).unwrap();
    let (large, small) = (large.concat(), small.concat());
    let mut reader = reader(1 << 20);
    let mut places = Vec::new();
    let mut memory = |arriving: &Arriving<'_>| {
        let Arriving {
            receiver,
            front,
            len,
            tail,
            ..
        } = *arriving;
        assert_eq!((receiver, front, tail), ("arm@crex", 8 + 8 + 300, 1));
        let memory = Memory(vec![0; len]);
        places.push(memory.0.as_ptr());
        let loan = ByteBudget::default().lend(len, len)?;
        Some(ContentBuffer::new(Box::new(memory), loan))
    };
    let run = [&large[..], &large, &large].concat();
    let first = read_into(&mut reader, &run, &[usize::MAX], &mut memory).unwrap();
    let Placed { contents, moved } = reader.take_placed();
    assert_eq!(contents, 3);
    // Only bytes of the first letter that came with its front are moved.
    assert!(moved > 0 && moved < CHUNK as u64, "{moved}");
    // Answers between letters, and letters one by one.
    let run = [&answer(1, &Answer::Busy)[..], &large, &ping(), &large].concat();
    let second = read_into(&mut reader, &run, &[7, usize::MAX], &mut memory).unwrap();
    let placed = reader.take_placed();
    assert_eq!((placed.contents, placed.moved), (2, 0));
    let run = [small, large].concat();
    let third = read_into(&mut reader, &run, &[usize::MAX], &mut memory).unwrap();
    let found = [
        &first[0], &first[1], &first[2], &second[1], &second[3], &third[1],
    ];
    assert_eq!(found.map(|frame| content(frame).as_ptr()), places[..]);
    assert!(
        found
            .iter()
            .all(|frame| *content(frame) == [2; 100_000][..])
    );
    assert_eq!(content(&third[0]), &[2; 1000][..]);
}

#[test]
fn content_behind_the_longest_front_is_read_into_the_offered_memory() {
    for front in [CHUNK, 100_000, Letter::MAX_AROUND] {
        let whole = parcel(9, &letter_parcel(vec![1; front], vec![2; 100_000])).unwrap();
        let mut places = Vec::new();
        let memory = |arriving: &Arriving<'_>| {
            let memory = Memory(vec![0; arriving.len]);
            places.push(memory.0.as_ptr());
            let loan = ByteBudget::default().lend(arriving.len, arriving.len)?;
            Some(ContentBuffer::new(Box::new(memory), loan))
        };
        let run = [&whole.concat()[..], &ping()].concat();
        let read = read_into(&mut reader(8 << 20), &run, &[usize::MAX, 7, 999], memory).unwrap();
        assert_eq!(read.len(), 2);
        assert_eq!([content(&read[0]).as_ptr()], places[..]);
        assert_eq!(*content(&read[0]), [2; 100_000][..]);
    }
}

#[test]
fn inconsistent_lengths_get_no_memory() {
    let whole = parcel(9, &letter_parcel(vec![1; 10], vec![2; 100_000])).unwrap();
    let mut bytes = whole.concat();
    // The announced body is one byte longer than its parts.
    let len = u64::from_le_bytes(bytes[16..24].try_into().unwrap()) + 1;
    bytes[16..24].copy_from_slice(&len.to_le_bytes());
    bytes.push(0);
    let refused = read_into(&mut reader(1 << 20), &bytes, &[usize::MAX], |_| {
        panic!("memory for a malformed parcel")
    });
    assert!(matches!(
        refused,
        Err(FrameError::Parcel(WireError::BodyLength { .. }))
    ));
    // Nor does content below the minimum length.
    let short = parcel(
        9,
        &letter_parcel(vec![1; APART_FROM as usize], vec![2; 100]),
    )
    .unwrap();
    let read = read_into(&mut reader(1 << 20), &short.concat(), &[usize::MAX], |_| {
        panic!("memory for small content")
    });
    assert_eq!(read.unwrap().len(), 1);
}

#[test]
fn bytes_that_are_not_a_frame_are_refused_at_once() {
    let refused = |bytes: &[u8]| read(&mut reader(1 << 20), bytes, &[1]).unwrap_err();
    assert_eq!(refused(b"GET / HTTP/1.1"), FrameError::Magic(*b"G\0\0\0"));
    assert_eq!(refused(b"fipx"), FrameError::Magic(*b"fipx"));
    assert_eq!(refused(&header(1, HELLO, 0)), FrameError::Version(1));
    assert_eq!(refused(&header(VERSION, 77, 0)), FrameError::Kind(77));
    for (kind, len) in [
        (HELLO, MAX_HELLO as u64 + 1),
        (PARCEL, 79),
        (PARCEL, (1 << 20) + PARCEL_ALLOWANCE + 1),
        (PARCEL, u64::MAX),
        (ANSWER, MAX_ANSWER_LEN as u64 + 1),
        (PING, 1),
        (GOODBYE, 1),
    ] {
        let error = refused(&header(VERSION, kind, len));
        assert!(matches!(error, FrameError::Length { .. }), "{kind} {len}");
    }
    let mut parcel = header(VERSION, PARCEL, 80);
    parcel.extend([0; 80]);
    assert_eq!(refused(&parcel), FrameError::Parcel(WireError::Name));
}

fn any_frame() -> impl Strategy<Value = Vec<u8>> {
    let bytes = |max| prop::collection::vec(any::<u8>(), 1..max);
    prop_oneof![
        (any::<u64>(), bytes(300), bytes(300)).prop_map(|(id, head, content)| {
            parcel(id, &letter_parcel(head, content)).unwrap().concat()
        }),
        (any::<u64>(), bytes(10), bytes(60_000)).prop_map(|(id, head, content)| {
            parcel(id, &letter_parcel(head, content)).unwrap().concat()
        }),
        any::<u64>().prop_map(|id| answer(id, &Answer::Busy).to_vec()),
        any::<u64>()
            .prop_map(|id| { answer(id, &Answer::failed(FailureReason::Loop, "again")).to_vec() }),
        (1..u64::MAX).prop_map(|i| hello(&crate::hello::tests::sample(i)).to_vec()),
        Just(ping().to_vec()),
        Just(pong().to_vec()),
        any::<u64>().prop_map(|last| goodbye(last).to_vec()),
    ]
}

proptest! {
    /// The same frames are read for any division of a stream into pieces, as from separate streams.
    #[test]
    fn chunking_does_not_matter(
        written in prop::collection::vec(any_frame(), 1..12),
        sizes in prop::collection::vec(1_usize..40_000, 1..8),
        small in prop::collection::vec(1_usize..30, 1..8),
    ) {
        let alone: Vec<Frame> = written
            .iter()
            .map(|bytes| read(&mut reader(1 << 20), bytes, &[usize::MAX]).unwrap().remove(0))
            .collect();
        for sizes in [&sizes, &small] {
            for offered in [false, true] {
                let mut reader = reader(1 << 20);
                let memory = |arriving: &Arriving<'_>| offered.then(|| place(arriving.len))?;
                let found = read_into(&mut reader, &written.concat(), sizes, memory).unwrap();
                prop_assert_eq!(&found, &alone);
                prop_assert!(!reader.is_partial());
            }
        }
    }

    /// For no bytes the reader panics or holds more than it was given.
    #[test]
    fn arbitrary_bytes_decode_without_panic(
        mut bytes in prop::collection::vec(any::<u8>(), 0..4000),
        version in prop_oneof![9 => Just(VERSION), 1 => any::<u8>()],
        kind in 0_u8..8,
        len in prop_oneof![0_u64..3000, any::<u64>()],
        sizes in prop::collection::vec(1_usize..2000, 1..8),
    ) {
        let mut stream = header(version, kind, len);
        stream.append(&mut bytes);
        let mut reader = reader(1 << 16);
        if let Ok(frames) = read(&mut reader, &stream, &sizes) {
            prop_assert!(frames.len() <= stream.len() / HEADER_LEN);
        }
    }
}
