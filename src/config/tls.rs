//! Certificates by which the two ends of the wire know each other.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::{Violation, identifier, violation};

/// Who this end is, and whom it believes; files in PEM.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tls {
    /// Certificate of the authority that signs those of the site and of the machines.
    pub authority_file: PathBuf,
    /// Our own certificate, signed by it. The site's is for the name or address that machines dial; a machine's has
    /// its id as common name.
    pub certificate_file: PathBuf,
    /// Its private key.
    pub key_file: PathBuf,
}

/// Who may dial in, beside having a certificate: each by its common name.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Admitted {
    /// Machines, by their ids: each speaks for itself alone.
    pub machines: Vec<String>,
    /// Others, who listen to all machines and say nothing.
    pub listeners: Vec<String>,
}

impl Admitted {
    pub(super) fn check(&self) -> Result<(), Violation> {
        let mut names = std::collections::BTreeSet::new();
        for (key, list) in
            [("zenoh.admitted.machines", &self.machines), ("zenoh.admitted.listeners", &self.listeners)]
        {
            for name in list {
                identifier(key, name)?;
                if !names.insert(name) {
                    return violation(key, format!("has {name:?}, which is admitted already"));
                }
            }
        }
        Ok(())
    }
}
