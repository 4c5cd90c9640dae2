//! Random secrets: 256 bits that nobody guesses, so that a plain hash hides them.

use std::fmt::{self, Write as _};

use sha2::{Digest as _, Sha256};

use super::AccountsError;

/// A secret that is shown to its owner alone. Cannot be printed by accident.
pub struct Secret(String);

impl Secret {
    /// A new one: 32 random bytes in hexadecimal digits after a prefix.
    ///
    /// # Errors
    /// The system has no random numbers.
    pub fn draw(prefix: &str) -> Result<Self, AccountsError> {
        let mut bytes = [0; 32];
        getrandom::fill(&mut bytes)
            .map_err(|error| AccountsError::Invalid(format!("the system has no random numbers: {error}")))?;
        let mut text = prefix.to_owned();
        for byte in bytes {
            // Writing to a string does not fail.
            let _ = write!(text, "{byte:02x}");
        }
        Ok(Self(text))
    }

    /// One that somebody shows.
    pub fn of(text: &str) -> Self {
        Self(text.to_owned())
    }

    /// For its owner.
    pub fn reveal(&self) -> &str {
        &self.0
    }

    /// What is kept of it.
    pub fn hash(&self) -> [u8; 32] {
        Sha256::digest(self.0.as_bytes()).into()
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Secret")
    }
}
