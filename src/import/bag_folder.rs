//! The files of a ROS 2 bag: a single MCAP file, or a folder with `metadata.yaml`.

use std::fs;
use std::path::{Path, PathBuf};

use super::ImportError;
use crate::export::Faults;
use crate::record::files_of;

/// What a recorder writes beside the files of a bag.
pub(super) const METADATA: &str = "metadata.yaml";

/// Longer than any such file that a recorder writes.
const METADATA_BYTES_MAX: u64 = 64 << 20;

/// The MCAP files of a bag in their order.
#[derive(Debug)]
pub(super) struct BagFolder {
    pub(super) files: Vec<PathBuf>,
    pub(super) faults: Faults,
}

/// Finds the files of a bag.
pub(super) fn mcap_files(path: &Path) -> Result<BagFolder, ImportError> {
    let mut faults = Faults::default();
    if !path.is_dir() {
        return Ok(BagFolder { files: vec![path.to_owned()], faults });
    }
    let metadata = path.join(METADATA);
    let files = if metadata.exists() {
        listed(&metadata)?
    } else {
        let files = files_of(path)?;
        // A recorder writes it last: without it, the bag was not closed.
        let kind = format!("{}: bags without metadata.yaml", path.display());
        faults.note(&kind, || format!("its {} MCAP files are read by the order of their names", files.len()));
        files
    };
    if files.is_empty() {
        return Err(ImportError::Nothing { path: path.to_owned() });
    }
    Ok(BagFolder { files, faults })
}

/// The files that a `metadata.yaml` lists. Of its YAML, only the lines are read that matter here; they look the
/// same from every recorder.
fn listed(metadata: &Path) -> Result<Vec<PathBuf>, ImportError> {
    let unreadable = |source| ImportError::Unreadable { path: metadata.to_owned(), source };
    let refuse = |message: String| ImportError::Bag { path: metadata.to_owned(), message };
    if fs::metadata(metadata).map_err(unreadable)?.len() > METADATA_BYTES_MAX {
        return Err(refuse("is too long to be that of a bag".to_owned()));
    }
    let text = fs::read_to_string(metadata).map_err(unreadable)?;
    let about = BagMetadata::read(&text);
    if about.storage != "mcap" {
        return Err(refuse(format!(
            "storage_identifier is \"{}\", must be mcap; convert the bag first, for example with \
             rosbags-convert --src BAG --dst NEW --dst-storage mcap",
            about.storage
        )));
    }
    if !about.compression_mode.is_empty() && !about.compression_mode.eq_ignore_ascii_case("none") {
        return Err(refuse(format!(
            "compression_mode is \"{}\"; only MCAP's own compression (of chunks, mode storage) is read; convert \
             the bag first, for example with rosbags-convert --src BAG --dst NEW --dst-storage mcap",
            about.compression_mode
        )));
    }
    if about.files.is_empty() {
        return Err(refuse("relative_file_paths lists no files".to_owned()));
    }
    let folder = metadata.parent().unwrap_or(Path::new("."));
    about
        .files
        .iter()
        .map(|file| {
            // Old recorders put the folder's name in front.
            let name = Path::new(file).file_name().ok_or_else(|| refuse(format!("\"{file}\" is no file")))?;
            let path = folder.join(name);
            if path.exists() { Ok(path) } else { Err(refuse(format!("lists {file}, which is not there"))) }
        })
        .collect()
}

#[derive(Debug, Default, PartialEq)]
struct BagMetadata {
    storage: String,
    compression_mode: String,
    files: Vec<String>,
}

impl BagMetadata {
    fn read(text: &str) -> Self {
        let mut about = Self::default();
        let mut in_files = false;
        for line in text.lines() {
            let line = line.trim();
            if in_files && let Some(item) = line.strip_prefix("- ") {
                // A list of the newer `files:` has `- path: ...`, which is not this one.
                about.files.push(plain(item));
                continue;
            }
            in_files = false;
            let Some((key, value)) = line.split_once(':') else { continue };
            match key {
                "storage_identifier" => about.storage = plain(value),
                "compression_mode" => about.compression_mode = plain(value),
                "relative_file_paths" => {
                    let value = value.trim();
                    match value.strip_prefix('[').and_then(|list| list.strip_suffix(']')) {
                        Some(list) => {
                            about.files.extend(list.split(',').map(plain).filter(|item| !item.is_empty()));
                        }
                        None => in_files = true,
                    }
                }
                _ => {}
            }
        }
        about
    }
}

/// A scalar of YAML without its quotes.
fn plain(value: &str) -> String {
    let value = value.trim();
    let unquoted = ['"', '\''].iter().find_map(|quote| value.strip_prefix(*quote)?.strip_suffix(*quote));
    unquoted.unwrap_or(value).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metadata_of_recorders_is_read() {
        let text = "rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n  relative_file_paths:\n    \
                    - a_0.mcap\n    - \"old/a_1.mcap\"\n  message_count: 2\n  topics_with_message_count:\n    - \
                    topic_metadata:\n        name: /imu\n  compression_format: ''\n  compression_mode: \"\"\n  files:\n    \
                    - path: a_0.mcap\n";
        let about = BagMetadata::read(text);
        assert_eq!(about.storage, "mcap");
        assert_eq!(about.files, ["a_0.mcap", "old/a_1.mcap"]);
        assert_eq!(about.compression_mode, "");
        let about = BagMetadata::read("storage_identifier: 'sqlite3'\nrelative_file_paths: [a.db3]\n");
        assert_eq!((about.storage.as_str(), about.files), ("sqlite3", vec!["a.db3".to_owned()]));
    }
}
