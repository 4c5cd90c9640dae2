//! holdfast tells a construction site where each of its excavators is, to the centimetre, also when GNSS
//! lets go. `src/README.md` is the map of the rooms; imports only look down.

pub mod cli;
pub mod config;
pub mod export;
pub mod fleet;
pub mod frames;
pub mod import;
pub mod lie;
pub mod record;
pub mod sensors;
pub mod simulate;
#[cfg(feature = "shells")]
pub mod site;
pub mod state;
pub mod time;
pub mod wire;
