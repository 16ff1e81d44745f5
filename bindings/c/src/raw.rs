//! Texts, bytes and structures of the caller.

use std::mem::MaybeUninit;
use std::ptr::NonNull;
use std::time::Duration;
use std::{ptr, slice};

use fipa_bindings::Failure;

/// Time limit of a conversation for which the caller sets none: a year.
pub(crate) const LONG: Duration = Duration::from_secs(365 * 24 * 60 * 60);

/// Maximum number of elements of a list from the caller, far above what a message may have.
const MAX_LIST: usize = 65_536;

/// A text in UTF-8. It need not end with NUL. A NULL pointer is no text, and an empty text of a message's parameter
/// is none, too.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct FipaText {
    /// The first byte.
    pub data: *const u8,
    /// Number of bytes.
    pub len: usize,
}

/// Bytes. A NULL pointer means none.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct FipaBytes {
    /// The first byte.
    pub data: *const u8,
    /// Number of bytes.
    pub len: usize,
}

impl FipaText {
    pub(crate) const NONE: Self = Self {
        data: ptr::null(),
        len: 0,
    };

    pub(crate) fn of(text: &str) -> Self {
        Self {
            data: text.as_ptr(),
            len: text.len(),
        }
    }

    pub(crate) fn of_option(text: Option<&str>) -> Self {
        text.map_or(Self::NONE, Self::of)
    }

    /// Reads the text; `None` if there is none. `what` names it in errors.
    ///
    /// # Safety
    /// The bytes must be readable, and must not change, for the lifetime `'a` that the caller of this function chooses.
    pub(crate) unsafe fn read<'a>(self, what: &str) -> Result<Option<&'a str>, Failure> {
        // SAFETY: The caller promises it.
        let Some(bytes) = (unsafe { list(self.data, self.len, usize::MAX, what) })? else {
            return Ok(None);
        };
        match str::from_utf8(bytes) {
            Ok(text) => Ok(Some(text)),
            Err(error) => Err(Failure::invalid(format!("{what} is not UTF-8: {error}"))),
        }
    }

    /// Reads a text that must be there.
    ///
    /// # Safety
    /// As for [`read`](Self::read).
    pub(crate) unsafe fn required<'a>(self, what: &str) -> Result<&'a str, Failure> {
        // SAFETY: The caller promises it.
        let text = unsafe { self.read(what) }?;
        text.filter(|text| !text.is_empty())
            .ok_or_else(|| Failure::invalid(format!("{what} is missing")))
    }
}

impl FipaBytes {
    pub(crate) const NONE: Self = Self {
        data: ptr::null(),
        len: 0,
    };

    pub(crate) fn of(bytes: &[u8]) -> Self {
        Self {
            data: bytes.as_ptr(),
            len: bytes.len(),
        }
    }

    /// Reads the bytes; `None` if there are none.
    ///
    /// # Safety
    /// As for [`FipaText::read`].
    pub(crate) unsafe fn read<'a>(self, what: &str) -> Result<Option<&'a [u8]>, Failure> {
        // SAFETY: The caller promises it.
        unsafe { list(self.data, self.len, usize::MAX, what) }
    }
}

/// Reads a list; `None` if the pointer is NULL and the length is 0.
///
/// # Safety
/// Unless the pointer is NULL, `len` elements must be readable there, and must not change, for the lifetime `'a` that
/// the caller of this function chooses.
unsafe fn list<'a, T>(
    data: *const T,
    len: usize,
    most: usize,
    what: &str,
) -> Result<Option<&'a [T]>, Failure> {
    if data.is_null() {
        return match len {
            0 => Ok(None),
            _ => Err(Failure::invalid(format!(
                "{what} is NULL with a length of {len}"
            ))),
        };
    }
    let bytes = len.checked_mul(size_of::<T>());
    if len > most || bytes.is_none_or(|bytes| isize::try_from(bytes).is_err()) {
        return Err(Failure::invalid(format!(
            "{what} cannot have a length of {len}"
        )));
    }
    if !data.is_aligned() {
        return Err(Failure::invalid(format!("{what} is not aligned")));
    }
    // SAFETY: The pointer is not NULL and aligned, the length fits, and the caller promises the rest.
    Ok(Some(unsafe { slice::from_raw_parts(data, len) }))
}

/// Reads a list of structures or numbers.
///
/// # Safety
/// As for [`FipaText::read`].
pub(crate) unsafe fn elements<'a, T>(
    data: *const T,
    len: usize,
    what: &str,
) -> Result<&'a [T], Failure> {
    // SAFETY: The caller promises it.
    Ok(unsafe { list(data, len, MAX_LIST, what) }?.unwrap_or_default())
}

/// Reads a list of texts, none of them empty.
///
/// # Safety
/// As for [`FipaText::read`], for the list and for each text in it.
pub(crate) unsafe fn texts<'a>(
    data: *const FipaText,
    len: usize,
    what: &str,
) -> Result<Vec<&'a str>, Failure> {
    // SAFETY: The caller promises it.
    let all = unsafe { elements(data, len, what) }?;
    // SAFETY: The caller promises it.
    all.iter()
        .map(|text| unsafe { text.required(what) })
        .collect()
}

/// A structure that begins with its size as `size_t`, so that fields can be added at its end.
///
/// # Safety
/// The type is `repr(C)` and begins with a `usize`.
pub(crate) unsafe trait Extensible: Copy {}

/// A structure that the caller writes.
///
/// # Safety
/// Each pattern of bits is a value of each field.
pub(crate) unsafe trait Readable: Extensible {}

/// Reads a structure of the caller. Fields that the caller does not know are zero.
///
/// # Safety
/// Unless the pointer is NULL, a `usize` must be readable there, and as many bytes as that says.
pub(crate) unsafe fn structure<T: Readable>(at: *const T, what: &str) -> Result<T, Failure> {
    let Some(at) = NonNull::new(at.cast_mut()) else {
        return Err(Failure::invalid(format!("{what} is NULL")));
    };
    if !at.is_aligned() {
        return Err(Failure::invalid(format!("{what} is not aligned")));
    }
    // SAFETY: The pointer is aligned, and the caller promises that the size is there.
    let size = unsafe { at.cast::<usize>().read() };
    check_size::<T>(size, what)?;
    let mut own = MaybeUninit::<T>::zeroed();
    let known = size.min(size_of::<T>());
    // SAFETY: `known` bytes are readable, as the caller promises, and `own` has room for them.
    unsafe { ptr::copy_nonoverlapping(at.as_ptr().cast::<u8>(), own.as_mut_ptr().cast(), known) };
    // SAFETY: All bytes are initialized, and `Readable` says that any are valid.
    Ok(unsafe { own.assume_init() })
}

/// Writes a structure for the caller, as far as the caller knows its fields. The size stays that of the caller.
///
/// # Safety
/// Unless the pointer is NULL, a `usize` must be readable there, and as many bytes as that says must be writable.
pub(crate) unsafe fn fill<T: Extensible>(at: *mut T, value: T, what: &str) -> Result<(), Failure> {
    // SAFETY: The caller promises it.
    let size = unsafe { fillable(at, what) }?;
    let known = size.min(size_of::<T>());
    let skipped = size_of::<usize>();
    // SAFETY: `known` bytes are writable, as the caller promises, and lie within `value`.
    unsafe {
        ptr::copy_nonoverlapping(
            ptr::from_ref(&value).cast::<u8>().wrapping_add(skipped),
            at.cast::<u8>().wrapping_add(skipped),
            known - skipped,
        );
    }
    Ok(())
}

/// Checks a structure to be written, before the call has an effect. Returns its size.
///
/// # Safety
/// Unless the pointer is NULL, a `usize` must be readable there.
pub(crate) unsafe fn fillable<T: Extensible>(at: *mut T, what: &str) -> Result<usize, Failure> {
    // SAFETY: Only the size is read, which the caller promises to be there.
    let Place(at) = unsafe { Place::of(at, what) }?;
    // SAFETY: The pointer is aligned, and the caller promises that the size is there.
    let size = unsafe { at.cast::<usize>().read() };
    check_size::<T>(size, what)?;
    Ok(size)
}

fn check_size<T>(size: usize, what: &str) -> Result<(), Failure> {
    // A size that no version of the structure has: the caller has not set it.
    if size < size_of::<usize>() || size > 4_096 {
        return Err(Failure::invalid(format!(
            "{what} has a size of {size}; set its first field to sizeof, {} bytes",
            size_of::<T>()
        )));
    }
    Ok(())
}

/// A place of the caller for a result. It is checked before the call has an effect.
pub(crate) struct Place<T>(NonNull<T>);

impl<T> Place<T> {
    /// Checks a pointer; `what` names it in errors.
    ///
    /// # Safety
    /// Unless the pointer is NULL, a `T` must be writable there until the call returns.
    pub(crate) unsafe fn of(at: *mut T, what: &str) -> Result<Self, Failure> {
        let place = NonNull::new(at).filter(|at| at.is_aligned());
        place
            .map(Self)
            .ok_or_else(|| Failure::invalid(format!("{what} is NULL or not aligned")))
    }

    /// As [`of`](Self::of), for a result that the caller need not ask for: `None` if the pointer is NULL.
    ///
    /// # Safety
    /// As for [`of`](Self::of).
    pub(crate) unsafe fn optional(at: *mut T, what: &str) -> Result<Option<Self>, Failure> {
        match at.is_null() {
            true => Ok(None),
            // SAFETY: The caller promises it.
            false => unsafe { Self::of(at, what) }.map(Some),
        }
    }

    /// Writes the result.
    pub(crate) fn put(self, value: T) {
        // SAFETY: The pointer is aligned, and the caller of `of` has promised that it is writable.
        unsafe { self.0.write(value) };
    }
}

/// Reads a time limit in milliseconds: `None` if it is negative.
pub(crate) fn limit(milliseconds: i64) -> Option<Duration> {
    u64::try_from(milliseconds).ok().map(Duration::from_millis)
}
