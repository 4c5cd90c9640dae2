//! Passwords, hashed with argon2id.

use std::fmt;
use std::sync::OnceLock;

use argon2::Argon2;
use argon2::password_hash::phc::PasswordHash;
use argon2::password_hash::{PasswordHasher as _, PasswordVerifier as _};

use super::{AccountsError, Secret, invalid};

/// The least characters of a password.
pub const PASSWORD_MIN: usize = 10;
/// The most characters of a password.
pub const PASSWORD_MAX: usize = 200;

/// A password as somebody typed it. Cannot be printed by accident.
#[derive(serde::Deserialize)]
#[serde(transparent)]
pub struct Password(String);

impl Password {
    /// As it was typed.
    pub fn new(text: String) -> Self {
        Self(text)
    }

    /// Refuses what is no password for `name`.
    pub(super) fn check(&self, name: &str) -> Result<&Self, AccountsError> {
        let length = self.0.chars().count();
        if !(PASSWORD_MIN..=PASSWORD_MAX).contains(&length) {
            return Err(invalid(&format!("a password has {PASSWORD_MIN} to {PASSWORD_MAX} characters")));
        }
        if self.0.eq_ignore_ascii_case(name) {
            return Err(invalid("the password is the name"));
        }
        Ok(self)
    }

    pub(super) fn hash(&self) -> Result<String, AccountsError> {
        let salt = &Secret::draw("")?.hash()[..16];
        let hash: Result<PasswordHash, _> =
            Argon2::default().hash_password_with_salt(self.0.as_bytes(), salt);
        hash.map(|hash| hash.to_string())
            .map_err(|error| AccountsError::Invalid(format!("the password cannot be hashed: {error}")))
    }

    /// Whether it is the one of `hash`. Without one it is never right, and that takes as long to find out.
    pub(super) fn is_of(&self, hash: Option<&str>) -> bool {
        static NOBODYS: OnceLock<String> = OnceLock::new();
        let nobodys = || NOBODYS.get_or_init(|| Self("nobody's".to_owned()).hash().unwrap_or_default());
        let parsed = PasswordHash::new(hash.unwrap_or_else(|| nobodys()));
        // Longer ones were never taken, and hashing them would be work for nothing.
        let fits = self.0.len() <= 4 * PASSWORD_MAX;
        let right = fits
            && parsed
                .is_ok_and(|parsed| Argon2::default().verify_password(self.0.as_bytes(), &parsed).is_ok());
        right && hash.is_some()
    }
}

impl fmt::Debug for Password {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Password")
    }
}
