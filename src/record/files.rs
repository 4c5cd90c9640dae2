//! Which files a session has.

use std::path::{Path, PathBuf};

use super::{RecordError, file_error};

/// The MCAP files of a folder in the order of their numbers, `a_2.mcap` before `a_10.mcap`; none if there are none. A
/// path that is no folder is a file.
///
/// # Errors
/// [`RecordError::File`] if the folder cannot be read.
pub fn files_of(path: &Path) -> Result<Vec<PathBuf>, RecordError> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let entries = std::fs::read_dir(path).and_then(|entries| {
        entries.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<PathBuf>>>()
    });
    let mut files = entries.map_err(file_error(path, "cannot be read"))?;
    files.retain(|file| file.extension().is_some_and(|ending| ending == "mcap") && !file.is_dir());
    files.sort_by_cached_key(|file| {
        let stem = file.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        let name = stem.trim_end_matches(|character: char| character.is_ascii_digit()).to_owned();
        let number: u64 = stem[name.len()..].parse().unwrap_or(0);
        (name, number, stem)
    });
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recordings_of_a_folder_come_by_their_numbers() {
        let folder = std::env::temp_dir().join(format!("holdfast-files-{}", std::process::id()));
        std::fs::create_dir_all(folder.join("sub.mcap")).expect("made");
        for name in ["a_10.mcap", "a_2.mcap", "b.mcap", "a_2.mcap.part", "20261123T103859Z-0000.mcap"] {
            std::fs::write(folder.join(name), "").expect("written");
        }
        let names = ["20261123T103859Z-0000.mcap", "a_2.mcap", "a_10.mcap", "b.mcap"];
        assert_eq!(files_of(&folder).expect("read"), names.map(|name| folder.join(name)));
        assert_eq!(files_of(Path::new("b.mcap")).expect("a file"), [PathBuf::from("b.mcap")]);
        std::fs::remove_dir_all(&folder).expect("removed");
    }
}
