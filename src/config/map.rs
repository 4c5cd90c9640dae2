//! The picture of the ground that the page draws under the plan.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::{Violation, violation};

/// An attribution is no longer: it stands in a corner of the plan.
const ATTRIBUTION_CHARS_MAX: usize = 300;

/// What lies under the plan.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Map {
    /// A PMTiles file (version 3) of raster tiles in Web Mercator; `None` for no basemap.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub basemap_file: Option<PathBuf>,
    /// Who is to be named beside it; `None` for what the file says itself, empty for nobody.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub attribution: Option<String>,
}

impl Map {
    pub(super) fn check(&self) -> Result<(), Violation> {
        let Some(attribution) = &self.attribution else { return Ok(()) };
        if self.basemap_file.is_none() {
            return violation("map.attribution", "means nothing without map.basemap_file".to_owned());
        }
        let chars = attribution.chars().count();
        if chars > ATTRIBUTION_CHARS_MAX || attribution.chars().any(char::is_control) {
            let message =
                format!("has {chars} characters, must be one line of {ATTRIBUTION_CHARS_MAX} at most");
            return violation("map.attribution", message);
        }
        Ok(())
    }
}
