//! How much room the disk has.

use std::fs::File;
use std::path::{Path, PathBuf};

/// What is held back for closing files when the disk is full, bytes: the index of the largest.
const BALLAST_BYTES: u64 = 16 << 20;

/// Room on the disk that is held by a file of our own, which goes when something must be written in spite of a
/// full disk.
#[derive(Debug)]
pub(super) struct Ballast {
    path: PathBuf,
}

impl Ballast {
    pub fn new(folder: &Path) -> Self {
        Self { path: folder.join("ballast") }
    }

    /// Takes the room; an error says that the disk is full, or does not let us.
    pub fn take(&self) -> std::io::Result<()> {
        let file = File::options().create(true).append(true).open(&self.path)?;
        if file.metadata()?.len() >= BALLAST_BYTES {
            return Ok(());
        }
        let taken = allocate(&file);
        if taken.is_err() {
            drop(file);
            self.release();
        }
        taken
    }

    /// Gives the room back.
    pub fn release(&self) {
        // What is not there holds nothing.
        let _ = std::fs::remove_file(&self.path);
    }
}

#[cfg(target_os = "linux")]
fn allocate(file: &File) -> std::io::Result<()> {
    use std::os::fd::AsRawFd as _;
    let bytes = libc::off_t::try_from(BALLAST_BYTES).unwrap_or(libc::off_t::MAX);
    // SAFETY: the descriptor is open as long as the file is borrowed.
    match unsafe { libc::posix_fallocate(file.as_raw_fd(), 0, bytes) } {
        0 => file.sync_all(),
        error => Err(std::io::Error::from_raw_os_error(error)),
    }
}

#[cfg(not(target_os = "linux"))]
fn allocate(mut file: &File) -> std::io::Result<()> {
    use std::io::Write as _;
    let zeros = vec![0; BALLAST_BYTES as usize];
    file.write_all(&zeros)?;
    file.sync_all()
}

/// When to pause, and when to go on.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reserve {
    bytes: u64,
}

impl Reserve {
    pub fn of_megabytes(megabytes: f64) -> Self {
        Self { bytes: (megabytes * 1e6) as u64 }
    }

    /// Whether a recording that runs must pause.
    pub fn is_touched(&self, free_bytes: u64) -> bool {
        free_bytes < self.bytes
    }

    /// Whether one that is paused may go on: with so much more that it does not pause again at once.
    pub fn is_restored(&self, free_bytes: u64) -> bool {
        free_bytes >= self.bytes + self.bytes / 10 + 2 * BALLAST_BYTES
    }
}

/// Space that is left where `path` is; `None` if the system does not tell.
#[cfg(unix)]
pub(in crate::site) fn disk_free_bytes(path: &Path) -> Option<u64> {
    use std::os::unix::ffi::OsStrExt as _;
    let path = std::ffi::CString::new(path.as_os_str().as_bytes()).ok()?;
    let mut answer = std::mem::MaybeUninit::<libc::statvfs>::uninit();
    // SAFETY: the path ends with NUL and outlives the call; the answer is read only if it was written.
    let answer = unsafe {
        if libc::statvfs(path.as_ptr(), answer.as_mut_ptr()) != 0 {
            return None;
        }
        answer.assume_init()
    };
    #[allow(clippy::unnecessary_cast, reason = "the types differ between systems")]
    Some(answer.f_bavail as u64 * answer.f_frsize as u64)
}

#[cfg(not(unix))]
pub(in crate::site) fn disk_free_bytes(_path: &Path) -> Option<u64> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_paused_goes_on_only_with_room_to_spare() {
        let reserve = Reserve::of_megabytes(100.0);
        assert!(reserve.is_touched(99_999_999) && !reserve.is_touched(100_000_000));
        assert!(!reserve.is_restored(110_000_000) && reserve.is_restored(150_000_000));
        let none = Reserve::of_megabytes(0.0);
        assert!(!none.is_touched(0) && !none.is_restored(BALLAST_BYTES));
    }
}
