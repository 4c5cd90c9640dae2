//! Where a result goes: beside its place until it is whole, for what stood there must not be lost to a run that fails.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};

use super::about;

/// So many symbolic links in a row are a circle.
const LINKS_MAX: usize = 40;
/// So many unfinished files of one name are left by something else than us.
const PARTS_MAX: usize = 100;

/// A file that is to be written. It takes its place with [`Target::keep`]; dropped before, it leaves nothing behind,
/// and what was there is as it was. A symbolic link is followed. What is no regular file, such as a pipe or
/// `/dev/null`, has no place to be taken, and is written into.
#[derive(Debug)]
pub struct Target {
    out: PathBuf,
    part: Option<PathBuf>,
}

impl Target {
    /// Finds out where to write, and makes the folders above and the file there.
    ///
    /// # Errors
    /// Those of the file system; there is a folder at `out`.
    pub fn of(out: &Path) -> io::Result<Self> {
        let out = match fs::metadata(out) {
            Ok(there) if there.is_dir() => {
                return Err(about(out, io::ErrorKind::IsADirectory.into()));
            }
            Ok(there) if !there.is_file() || is_link_of_the_system(out) => {
                return Ok(Self { out: out.to_owned(), part: None });
            }
            _ => followed(out)?,
        };
        if let Some(folder) = out.parent().filter(|folder| !folder.as_os_str().is_empty()) {
            fs::create_dir_all(folder).map_err(|error| about(folder, error))?;
        }
        // Another process may be at it, or have died there.
        for number in 0..PARTS_MAX {
            let part = beside(&out, &format!("{number}.part"));
            match OpenOptions::new().write(true).create_new(true).open(&part) {
                Ok(_) => return Ok(Self { out, part: Some(part) }),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(about(&part, error)),
            }
        }
        Err(about(&beside(&out, "*.part"), io::ErrorKind::AlreadyExists.into()))
    }

    /// Where to write.
    pub fn place(&self) -> &Path {
        self.part.as_deref().unwrap_or(&self.out)
    }

    /// Whether it is written into as it is, for it is no regular file.
    pub fn is_special(&self) -> bool {
        self.part.is_none()
    }

    /// Opens it for writing.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn open(&self) -> io::Result<File> {
        OpenOptions::new().write(true).open(self.place()).map_err(|error| about(self.place(), error))
    }

    /// What was written is whole, flushed and closed: it takes its place.
    ///
    /// # Errors
    /// Those of the file system; then what was there is there yet.
    pub fn keep(mut self) -> io::Result<()> {
        let Some(part) = &self.part else { return Ok(()) };
        // First on the disk, then in its place: a power cut leaves the old or the new.
        File::open(part).and_then(|file| file.sync_all()).map_err(|error| about(part, error))?;
        fs::rename(part, &self.out).map_err(|error| about(&self.out, error))?;
        self.part = None;
        Ok(())
    }
}

impl Drop for Target {
    fn drop(&mut self) {
        if let Some(part) = &self.part {
            // What went wrong is told already.
            let _ = fs::remove_file(part);
        }
    }
}

/// A name in the same folder.
pub fn beside(out: &Path, end: &str) -> PathBuf {
    let mut name = out.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{end}"));
    out.with_file_name(name)
}

/// Such as `/dev/stdout`: whoever opened what is behind it holds that file, and not its name.
fn is_link_of_the_system(out: &Path) -> bool {
    out.is_symlink() && (out.starts_with("/dev") || out.starts_with("/proc"))
}

fn followed(out: &Path) -> io::Result<PathBuf> {
    let mut path = out.to_owned();
    for _ in 0..LINKS_MAX {
        match fs::read_link(&path) {
            Ok(to) => path = path.parent().unwrap_or(Path::new("")).join(to),
            Err(_) => return Ok(path),
        }
    }
    Err(about(out, io::Error::other("too many symbolic links")))
}

#[cfg(test)]
mod tests {
    use std::io::{Read as _, Write as _};

    use super::*;

    fn folder(name: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("holdfast-target-{name}-{}", std::process::id()));
        fs::create_dir_all(&folder).expect("made");
        folder
    }

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).expect("folder").map(|entry| entry.expect("entry").file_name());
        let mut names: Vec<String> = entries.map(|name| name.to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    #[test]
    fn what_was_there_stays_until_the_new_is_whole() {
        let folder = folder("whole");
        let out = folder.join("a");
        fs::write(&out, "old").expect("written");
        let target = Target::of(&out).expect("found");
        target.open().expect("opens").write_all(b"ne").expect("written");
        drop(target);
        assert_eq!(fs::read(&out).expect("there"), b"old");
        let (target, other) = (Target::of(&out).expect("found"), Target::of(&out).expect("found"));
        target.open().expect("opens").write_all(b"new").expect("written");
        drop(other);
        target.keep().expect("kept");
        assert_eq!((fs::read(&out).expect("there"), names(&folder)), (b"new".to_vec(), vec!["a".to_owned()]));
        assert!(Target::of(&folder).is_err());
        fs::remove_dir_all(&folder).expect("removed");
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed_and_what_is_no_file_is_written_into() {
        use std::os::unix::fs::{FileTypeExt as _, symlink};

        let folder = folder("special");
        fs::write(folder.join("real"), "old").expect("written");
        symlink("real", folder.join("link")).expect("linked");
        symlink("link", folder.join("link of link")).expect("linked");
        symlink("new", folder.join("to nowhere")).expect("linked");
        for (out, real) in [("link of link", "real"), ("to nowhere", "new")] {
            let target = Target::of(&folder.join(out)).expect("found");
            target.open().expect("opens").write_all(out.as_bytes()).expect("written");
            target.keep().expect("kept");
            assert!(folder.join(out).is_symlink());
            assert_eq!(fs::read(folder.join(real)).expect("there"), out.as_bytes());
        }
        symlink("self", folder.join("self")).expect("linked");
        assert!(Target::of(&folder.join("self")).is_err());
        let null = folder.join("null");
        symlink("/dev/null", &null).expect("linked");
        let target = Target::of(&null).expect("found");
        assert!(target.is_special());
        target.open().expect("opens").write_all(b"gone").expect("written");
        target.keep().expect("kept");
        assert!(fs::metadata(&null).expect("there").file_type().is_char_device());
        let pipe = folder.join("pipe");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo");
        assert!(made.success());
        #[expect(clippy::disallowed_methods, reason = "somebody must read the pipe meanwhile")]
        let reader = std::thread::spawn({
            let pipe = pipe.clone();
            move || {
                let mut text = String::new();
                File::open(pipe).and_then(|mut file| file.read_to_string(&mut text)).map(|_| text)
            }
        });
        let target = Target::of(&pipe).expect("found");
        target.open().expect("opens").write_all(b"through").expect("written");
        target.keep().expect("kept");
        assert_eq!(reader.join().expect("read").expect("read"), "through");
        assert!(fs::metadata(&pipe).expect("there").file_type().is_fifo());
        fs::remove_dir_all(&folder).expect("removed");
    }
}
