//! holdfast tells a construction site where each of its excavators is, to the centimetre, also when GNSS
//! lets go. `src/README.md` is the map of the rooms; imports only look down.

pub mod config;
pub mod fleet;
pub mod frames;
pub mod lie;
pub mod record;
pub mod sensors;
#[cfg(feature = "shells")]
pub mod site;
pub mod state;
pub mod time;
pub mod wire;
