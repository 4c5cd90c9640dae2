//! CDR as ROS 2 writes it: XCDR version 1, little endian, aligned from the byte after the encapsulation.
//!
//! Encapsulation `00 01 00 00`; a primitive is aligned to its size; a string is its length with the closing
//! NUL (u32), its bytes and the NUL; a fixed array is its elements; a sequence is its count (u32) and its
//! elements, without padding after a count of zero. Source: OMG DDSI-RTPS 2.5, section 10, and OMG CDR 1.2.

const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// Why bytes are not the expected CDR.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CdrError {
    /// The first four bytes are not those of little-endian CDR.
    #[error("begins with {0:02x?}, must begin with 00 01 (little-endian CDR)")]
    Encapsulation(Vec<u8>),
    /// The bytes end too early.
    #[error("ends at byte {length}, but {wanted} bytes are wanted from byte {at}")]
    Truncated {
        /// Where reading stood.
        at: usize,
        /// How much was to be read.
        wanted: usize,
        /// How much there is.
        length: usize,
    },
    /// A string without its NUL, or not UTF-8.
    #[error("the string at byte {at} {reason}")]
    BadString {
        /// Where it begins.
        at: usize,
        /// What is wrong.
        reason: &'static str,
    },
    /// A value that its type does not allow.
    #[error("the value at byte {at} {reason}")]
    BadValue {
        /// Where it stands.
        at: usize,
        /// What is wrong.
        reason: &'static str,
    },
    /// More bytes than the message.
    #[error("the message ends at byte {at}, but {left} bytes follow")]
    TooLong {
        /// Where the message ends.
        at: usize,
        /// What is left.
        left: usize,
    },
}

/// Writes one message.
#[derive(Clone, Debug)]
pub struct CdrWriter {
    bytes: Vec<u8>,
}

impl CdrWriter {
    /// Begins a message of about `capacity` bytes.
    pub fn with_capacity(capacity: usize) -> Self {
        let mut bytes = Vec::with_capacity(capacity + ENCAPSULATION.len());
        bytes.extend(ENCAPSULATION);
        Self { bytes }
    }

    /// The bytes, encapsulation included.
    pub fn finish(self) -> Vec<u8> {
        self.bytes
    }

    fn align(&mut self, size: usize) {
        let body = self.bytes.len() - ENCAPSULATION.len();
        let padding = body.next_multiple_of(size) - body;
        self.bytes.extend_from_slice(&[0; 8][..padding]);
    }

    /// One byte.
    pub fn u8(&mut self, value: u8) {
        self.bytes.push(value);
    }

    /// Signed byte.
    pub fn i8(&mut self, value: i8) {
        self.bytes.extend(value.to_le_bytes());
    }

    /// Aligned to 2.
    pub fn u16(&mut self, value: u16) {
        self.align(2);
        self.bytes.extend(value.to_le_bytes());
    }

    /// Aligned to 4.
    pub fn u32(&mut self, value: u32) {
        self.align(4);
        self.bytes.extend(value.to_le_bytes());
    }

    /// Aligned to 4.
    pub fn i32(&mut self, value: i32) {
        self.align(4);
        self.bytes.extend(value.to_le_bytes());
    }

    /// Aligned to 8.
    pub fn f64(&mut self, value: f64) {
        self.align(8);
        self.bytes.extend(value.to_le_bytes());
    }

    /// A fixed array.
    pub fn f64_array(&mut self, values: &[f64]) {
        for value in values {
            self.f64(*value);
        }
    }

    /// The count of a sequence; its elements follow.
    pub fn count(&mut self, count: usize) {
        self.u32(u32::try_from(count).expect("no message of ours holds 4 billion elements"));
    }

    /// Length with NUL, bytes, NUL.
    pub fn string(&mut self, text: &str) {
        self.count(text.len() + 1);
        self.bytes.extend(text.as_bytes());
        self.bytes.push(0);
    }
}

/// Reads one message; allocates nothing by itself.
#[derive(Clone, Debug)]
pub struct CdrReader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> CdrReader<'a> {
    /// Begins after the encapsulation.
    ///
    /// # Errors
    /// [`CdrError::Encapsulation`] if it is not little-endian CDR.
    pub fn new(bytes: &'a [u8]) -> Result<Self, CdrError> {
        // The last two bytes are options; XCDR1 leaves them to the writer.
        if bytes.len() < ENCAPSULATION.len() || bytes[..2] != ENCAPSULATION[..2] {
            return Err(CdrError::Encapsulation(bytes[..bytes.len().min(4)].to_vec()));
        }
        Ok(Self { bytes, at: ENCAPSULATION.len() })
    }

    /// Where reading stands, in bytes from the encapsulation's first.
    pub fn at(&self) -> usize {
        self.at
    }

    /// The message must end here, but for padding to the next multiple of four, which some writers add.
    ///
    /// # Errors
    /// [`CdrError::TooLong`].
    pub fn finish(self) -> Result<(), CdrError> {
        let left = self.bytes.len() - self.at;
        let padding = self.at.next_multiple_of(4) - self.at;
        if left == 0 || left == padding { Ok(()) } else { Err(CdrError::TooLong { at: self.at, left }) }
    }

    fn take(&mut self, align: usize, wanted: usize) -> Result<&'a [u8], CdrError> {
        let body = self.at - ENCAPSULATION.len();
        let at = body.next_multiple_of(align) + ENCAPSULATION.len();
        let truncated = CdrError::Truncated { at, wanted, length: self.bytes.len() };
        let end = at.checked_add(wanted).ok_or_else(|| truncated.clone())?;
        let taken = self.bytes.get(at..end).ok_or(truncated)?;
        self.at = end;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], CdrError> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N, N)?);
        Ok(array)
    }

    /// One byte.
    ///
    /// # Errors
    /// [`CdrError::Truncated`], as for all numbers.
    pub fn u8(&mut self) -> Result<u8, CdrError> {
        Ok(u8::from_le_bytes(self.array()?))
    }

    /// Signed byte.
    ///
    /// # Errors
    /// [`CdrError::Truncated`].
    pub fn i8(&mut self) -> Result<i8, CdrError> {
        Ok(i8::from_le_bytes(self.array()?))
    }

    /// Aligned to 2.
    ///
    /// # Errors
    /// [`CdrError::Truncated`].
    pub fn u16(&mut self) -> Result<u16, CdrError> {
        Ok(u16::from_le_bytes(self.array()?))
    }

    /// Aligned to 4.
    ///
    /// # Errors
    /// [`CdrError::Truncated`].
    pub fn u32(&mut self) -> Result<u32, CdrError> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    /// Aligned to 4.
    ///
    /// # Errors
    /// [`CdrError::Truncated`].
    pub fn i32(&mut self) -> Result<i32, CdrError> {
        Ok(i32::from_le_bytes(self.array()?))
    }

    /// Aligned to 8.
    ///
    /// # Errors
    /// [`CdrError::Truncated`].
    pub fn f64(&mut self) -> Result<f64, CdrError> {
        Ok(f64::from_le_bytes(self.array()?))
    }

    /// A fixed array.
    ///
    /// # Errors
    /// [`CdrError::Truncated`].
    pub fn f64_array<const N: usize>(&mut self) -> Result<[f64; N], CdrError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64()?;
        }
        Ok(values)
    }

    /// The count of a sequence whose elements take `element_bytes` at least; what is left must hold them,
    /// so that room for `count` elements may be reserved without harm.
    ///
    /// # Errors
    /// [`CdrError::Truncated`].
    pub fn count(&mut self, element_bytes: usize) -> Result<usize, CdrError> {
        let count = self.u32()? as usize;
        let wanted = count.saturating_mul(element_bytes);
        if wanted > self.bytes.len() - self.at {
            return Err(CdrError::Truncated { at: self.at, wanted, length: self.bytes.len() });
        }
        Ok(count)
    }

    /// A string, borrowed. A length of zero, which some writers use for the empty string, is taken as empty.
    ///
    /// # Errors
    /// [`CdrError::Truncated`] or [`CdrError::BadString`].
    pub fn string(&mut self) -> Result<&'a str, CdrError> {
        let length = self.u32()? as usize;
        let at = self.at;
        if length == 0 {
            return Ok("");
        }
        let bytes = self.take(1, length)?;
        let Some((0, text)) = bytes.split_last() else {
            return Err(CdrError::BadString { at, reason: "does not end with NUL" });
        };
        std::str::from_utf8(text).map_err(|_| CdrError::BadString { at, reason: "is not UTF-8" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn primitives_are_aligned_from_the_byte_after_the_encapsulation() {
        let mut writer = CdrWriter::with_capacity(0);
        writer.u8(1);
        writer.u16(2);
        writer.string("ab");
        writer.f64(1.0);
        writer.i8(-1);
        writer.i32(-2);
        let bytes = writer.finish();
        let mut expected = vec![0, 1, 0, 0, 1, 0, 2, 0, 3, 0, 0, 0, b'a', b'b', 0, 0];
        expected.extend([0, 0, 0, 0]);
        expected.extend(1.0_f64.to_le_bytes());
        expected.extend([255, 0, 0, 0, 254, 255, 255, 255]);
        assert_eq!(bytes, expected);
        let mut reader = CdrReader::new(&bytes).expect("little endian");
        assert_eq!(reader.u8(), Ok(1));
        assert_eq!(reader.u16(), Ok(2));
        assert_eq!(reader.string(), Ok("ab"));
        assert_eq!(reader.f64(), Ok(1.0));
        assert_eq!(reader.i8(), Ok(-1));
        assert_eq!(reader.i32(), Ok(-2));
        assert_eq!(reader.finish(), Ok(()));
    }

    #[test]
    fn broken_bytes_say_where() {
        assert!(matches!(CdrReader::new(&[]), Err(CdrError::Encapsulation(_))));
        assert!(matches!(CdrReader::new(&[0, 0, 0, 0]), Err(CdrError::Encapsulation(_))));
        let huge = [0, 1, 0, 0, 255, 255, 255, 255, b'a', 0];
        let mut reader = CdrReader::new(&huge).expect("little endian");
        assert!(matches!(reader.clone().string(), Err(CdrError::Truncated { at: 8, .. })));
        assert!(matches!(reader.count(8), Err(CdrError::Truncated { .. })));
        let unclosed = [0, 1, 0, 0, 2, 0, 0, 0, b'a', b'b'];
        let error = CdrReader::new(&unclosed).expect("little endian").string().expect_err("no NUL");
        assert_eq!(error.to_string(), "the string at byte 8 does not end with NUL");
        let foreign = [0, 1, 0, 0, 2, 0, 0, 0, 0xff, 0];
        assert!(CdrReader::new(&foreign).expect("little endian").string().is_err());
        assert_eq!(
            CdrReader::new(&[0, 1, 0, 0, 0]).expect("little endian").finish(),
            Err(CdrError::TooLong { at: 4, left: 1 })
        );
    }
}
